"""A dataset as evaluation sees it: objects to register, and scores of the results."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, WebCollection
from ..errors import InvalidInputError
from ..geometry.pose_prior import PosePrior, object_frame
from ..mesh.mesh import format_up
from .protocol import Protocol, hint_of_truth
from .store import Row

__all__ = ["Benchmark", "BenchmarkItem", "Row"]


@dataclass(frozen=True)
class BenchmarkItem:
    """One object to register.

    Attributes:
        key: a name that no other object of the benchmark has.
        index: in the dataset.
        photo, meshes: files; one mesh, or all that the protocol allows.
        box: (4,) x0, y0, x1, y1 in px, as annotated; NaN where unknown.
        camera_matrix: (3, 3) in px; None if the method does not get it.
        prior: limits on the pose that the protocol's ``hint`` gives to the method.
    """

    key: str
    index: int
    photo: Path
    meshes: tuple[Path, ...]
    box: Tensor
    camera_matrix: Tensor | None
    prior: PosePrior | None = None

    def request(self) -> Row:
        """Box, camera matrix and prior, to the last digit."""
        camera = None if self.camera_matrix is None else self.camera_matrix.tolist()
        hint = {} if self.prior is None else {"prior": self.prior.to_dict()}
        return {"key": self.key, "box": self.box.tolist(), "camera": camera, **hint}


class Benchmark(ABC):
    """A dataset with the protocol of its evaluation, and its scores.

    Attributes:
        name: kind of dataset.
        unit: unit of its meshes.
        key: format of the items' keys, from a sample.
        mesh: key of the mesh in a sample.
        gives_camera: whether the method gets the camera matrix.
        dataset, protocol: as given.
        items: all objects, in the order of the dataset.

    Raises:
        InvalidInputError: a ``cad`` that the dataset cannot offer.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "m"
    key: ClassVar[str]
    mesh: ClassVar[str]
    gives_camera: ClassVar[bool] = False

    def __init__(self, dataset: Pascal3DPlus | BOPDataset | WebCollection, protocol: Protocol) -> None:
        self.dataset, self.protocol = dataset, protocol
        self.items = [self._item(i, dataset.annotation(i)) for i in range(len(dataset))]

    def selection(self, limit: int | None) -> list[BenchmarkItem]:
        """``limit`` items spread evenly over the dataset, or all."""
        n = len(self.items)
        count = n if limit is None else min(limit, n)
        return [self.items[i * n // count] for i in range(count)]

    def settings(self) -> Row:
        """What results depend on besides pipeline and protocol."""
        split = getattr(self.dataset, "split", None)  # web collections have none
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    def samples(self, items: list[BenchmarkItem]) -> list[Row]:
        """Annotations of the items."""
        return [self.dataset.annotation(item.index) for item in items]

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        """Meshes that an object is registered to: its own; other datasets may offer more."""
        if self.protocol.cad != "annotated":
            raise InvalidInputError(
                f"protocol: each object of this dataset has one mesh, so cad=annotated; got cad={self.protocol.cad}"
            )
        return (Path(sample[self.mesh]),)

    def _item(self, index: int, sample: Row) -> BenchmarkItem:
        key, meshes = self.key.format_map(sample), self.meshes(sample)
        frame = object_frame(format_up(meshes[0].suffix))
        return BenchmarkItem(
            key=key,
            index=index,
            photo=Path(sample["image_path"]),
            meshes=meshes,
            box=sample["box"],
            camera_matrix=sample["camera_matrix"] if self.gives_camera else None,
            prior=hint_of_truth(sample["rotation"], frame, self.protocol, key),
        )

    @abstractmethod
    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        """(N,) float64 errors in degrees, up to symmetries; ``inf`` for a miss, NaN where the truth is unknown."""

    @abstractmethod
    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Scores of the results ``rows`` of ``items``, none of them skipped."""

    @abstractmethod
    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """Write the results as one table; ``path`` appears when it is complete."""
