"""Dataclasses of tensors whose rows belong together: selected, joined and replaced as one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from .aliases import Fields

Part = TypeVar("Part", bound="Rows")


@dataclass(frozen=True)
class Rows:
    """Base of frozen dataclasses with a row for each of N things in every column.

    Columns are the fields that are tensors, numpy arrays or :class:`Rows`; their first dimension is
    N. All rows share what the other fields hold.

    Example:
        >>> @dataclass(frozen=True)
        ... class Circles(Rows):
        ...     centre: Tensor
        ...     radius: Tensor
        >>> circles = Circles(torch.zeros(3, 2), torch.tensor([1.0, 2.0, 3.0]))
        >>> len(circles), circles[torch.tensor([2, 0])].radius.tolist()
        (3, [3.0, 1.0])
        >>> Circles.cat([circles, circles[:1]]).radius.tolist()
        [1.0, 2.0, 3.0, 1.0]
    """

    def columns(self) -> Fields:
        """The fields that have a row for each thing, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: x for name, x in values.items() if isinstance(x, Tensor | np.ndarray | Rows)}

    def __len__(self) -> int:
        return len(next(iter(self.columns().values())))

    def __getitem__(self, index: Any) -> Self:
        """The rows at an index, as tensors take it."""
        return replace(self, **{name: column[index] for name, column in self.columns().items()})

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """The rows of all parts, of which there must be one; it has what is no column."""
        return _combined(parts, _cat)

    @classmethod
    def cat_within(cls, parts: Sequence[Self]) -> Self:
        """The same rows, each with what all parts have in it: along the second dimension."""
        return _combined(parts, lambda columns: torch.cat(columns, dim=1))

    @classmethod
    def stack(cls, parts: Sequence[Self]) -> Self:
        """Parts of equal shapes along a new first dimension."""
        return _combined(parts, torch.stack)

    def replaced(self, index: Tensor, others: Self) -> Self:
        """These rows with ``others`` in the places ``index`` (M,)."""
        return _combined([self, others], lambda columns: _replaced(index, *columns))


def _combined(parts: Sequence[Part], combine: Callable[[list[Any]], Any]) -> Part:
    """The first part with each column combined with the others'."""
    first = parts[0]
    columns = [part.columns() for part in parts]
    return replace(first, **{name: combine([c[name] for c in columns]) for name in columns[0]})


def _cat(columns: list[Any]) -> Any:
    first = columns[0]
    if isinstance(first, Rows):
        return type(first).cat(columns)
    return np.concatenate(columns) if isinstance(first, np.ndarray) else torch.cat(columns)


def _replaced(index: Tensor, column: Any, others: Any) -> Any:
    if isinstance(column, Rows):
        return column.replaced(index, others)
    return column.index_copy(0, index, others)
