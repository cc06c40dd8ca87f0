"""What the two loops ask of a dataset."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, WebCollection
from .protocol import Protocol

__all__ = ["Benchmark", "BenchmarkItem", "Row"]

Row = dict[str, Any]
"""A prediction: ``rotation``, ``translation``, ``score``, ...; or ``failed``, or ``skipped`` with the reason."""


@dataclass(frozen=True)
class BenchmarkItem:
    """One object to register.

    Attributes:
        key: its name, which no other object of the benchmark has.
        index: in the dataset.
        meshes: one, or all that may be tried.
        box: (4,) x0, y0, x1, y1 in px, as annotated; NaN where unknown.
        camera_matrix: (3, 3) in px, None where the method is not told.
    """

    key: str
    index: int
    meshes: tuple[Path, ...]
    box: Tensor
    camera_matrix: Tensor | None


class Benchmark(ABC):
    """A dataset, the protocol that objects are registered under, and its scores.

    Attributes:
        name: of the kind of dataset.
        unit: of its meshes.
        dataset, protocol: as given.
        items: all objects, in the order of the dataset.
    """

    name: ClassVar[str]
    unit: ClassVar[str]

    def __init__(self, dataset: Pascal3DPlus | BOPDataset | WebCollection, protocol: Protocol) -> None:
        self.dataset, self.protocol = dataset, protocol
        self.items = [self.item(i) for i in range(len(dataset))]

    def selection(self, limit: int | None) -> list[BenchmarkItem]:
        """``limit`` items spread evenly over the dataset, or all."""
        n = len(self.items)
        return self.items if limit is None or limit >= n else [self.items[i * n // limit] for i in range(limit)]

    def settings(self) -> Row:
        """What predictions depend on besides preset and protocol."""
        split = getattr(self.dataset, "split", None)  # which a collection of one's own has not
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    @abstractmethod
    def item(self, index: int) -> BenchmarkItem:
        """Object ``index`` of the dataset."""

    @abstractmethod
    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        """(N,) float64 errors in degrees up to the objects' symmetries, ``inf`` for a miss."""

    @abstractmethod
    def easy(self, item: BenchmarkItem) -> bool:
        """Whether the object is seen whole."""

    @abstractmethod
    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Scores of the predictions ``rows`` of ``items``, none of them skipped."""

    @abstractmethod
    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """The predictions as one table; ``path`` appears when it is complete."""
