"""A dataset as evaluation sees it: objects to register, and scores of the results."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, WebCollection
from .protocol import Protocol

__all__ = ["Benchmark", "BenchmarkItem", "Row"]

Row = dict[str, Any]
"""A result: ``rotation``, ``translation``, ``score``, ...; or ``failed``, or ``skipped`` with the reason."""


@dataclass(frozen=True)
class BenchmarkItem:
    """One object to register.

    Attributes:
        key: a name that no other object of the benchmark has.
        index: in the dataset.
        photo: the file of the photograph.
        meshes: one, or all that the protocol allows.
        box: (4,) x0, y0, x1, y1 in px, as annotated; NaN where unknown.
        camera_matrix: (3, 3) in px; None if the protocol does not give it to the method.
    """

    key: str
    index: int
    photo: Path
    meshes: tuple[Path, ...]
    box: Tensor
    camera_matrix: Tensor | None

    def request(self) -> Row:
        """Box and camera matrix, to the last digit."""
        camera = None if self.camera_matrix is None else self.camera_matrix.tolist()
        return {"key": self.key, "box": self.box.tolist(), "camera": camera}


class Benchmark(ABC):
    """A dataset with the protocol of its evaluation, and its scores.

    Attributes:
        name: kind of dataset.
        unit: unit of its meshes.
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
        """What results depend on besides pipeline and protocol."""
        split = getattr(self.dataset, "split", None)  # a collection of the user's own has none
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    @abstractmethod
    def item(self, index: int) -> BenchmarkItem:
        """Object ``index`` of the dataset."""

    @abstractmethod
    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        """(N,) float64 errors in degrees up to the objects' symmetries, ``inf`` for a miss."""

    @abstractmethod
    def easy(self, item: BenchmarkItem) -> bool:
        """Whether the whole object is visible."""

    @abstractmethod
    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Scores of the results ``rows`` of ``items``, none of them skipped."""

    @abstractmethod
    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """Write the results as one table; ``path`` appears when it is complete."""
