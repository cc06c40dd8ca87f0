"""Datasets as evaluation sees them: the objects to register, and the scores of the results."""

import math
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..data import BOPDataset, Pascal3DPlus, PoseFolder
from ..errors import InvalidInputError
from ..geometry import Camera, viewpoint_from_rotation
from ..geometry.pose_prior import object_frame
from ..jobs.entry import Entry
from ..jobs.store import Row, Rows
from ..mesh.mesh import format_up
from ..utils.files import write_csv
from . import metrics
from .metrics import symmetric_rotation_error
from .protocol import Protocol, hint_of_truth, perturbed_box

Errors = Mapping[str, Tensor]
"""Errors (N,) of results by name."""

VIEWPOINT_COLUMNS = (
    "azimuth",
    "elevation",
    "theta",
    "true_azimuth",
    "true_elevation",
    "true_theta",
    "error_deg",
)
"""Columns of tables of predictions that hold viewpoints, in degrees: found, true, and the rotation
between them."""

NO_SYMMETRIES = torch.empty(0, 3, 3, dtype=torch.float64)


class Benchmark(ABC):
    """A dataset with the protocol of its evaluation, and its scores.

    Attributes:
        name, unit: kind of dataset, and unit of its meshes.
        label: format of the entries' labels, from a sample.
        mesh: key of the mesh in a sample.
        gives_camera: whether the method gets the camera matrix.
        thresholds: degrees of the accuracies in the summary.
        groups: name of the groups that are scored by themselves, and key of the group in a sample.
        columns: of the table of predictions.
        page_error: name of the error by which the page of the best and the worst marks an object:
            that up to symmetries, where they are known.
        measures: scores that are means over the objects: name of the error, and thresholds below
            which it is right.
        dataset, protocol: as given.
        samples, entries: annotations without photographs, and what is registered, in the order of
            the dataset.

    Raises:
        InvalidInputError: a ``cad`` that the dataset cannot offer, or ``views`` without poses of
            the cameras.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "m"
    label: ClassVar[str]
    mesh: ClassVar[str] = "mesh_path"
    gives_camera: ClassVar[bool] = False
    thresholds: ClassVar[Mapping[str, float]] = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}
    groups: ClassVar[tuple[str, str]] = ("per_object", "category")
    columns: ClassVar[Sequence[str]] = ()
    page_error: ClassVar[str] = "error_deg"
    measures: ClassVar[Mapping[str, tuple[str, Sequence[float]]]] = {
        "acc_15_deg": ("error_deg", (15.0,)),
        "acc_30_deg": ("error_deg", (30.0,)),
    }

    def __init__(self, dataset: Pascal3DPlus | BOPDataset | PoseFolder, protocol: Protocol) -> None:
        if protocol.views > 1 and not self.gives_camera:
            raise InvalidInputError(
                "protocol: views needs a dataset with cameras, such as a BOP set; leave it out"
            )
        self.dataset = dataset
        self.protocol = protocol
        self.samples = [dataset.annotation(i) for i in range(len(dataset))]
        self.entries = [self._entry(sample) for sample in self.samples]

    def selection(self, limit: int | None) -> list[int]:
        """Indices of ``limit`` objects spread evenly over the dataset, or of all."""
        n = len(self.entries)
        count = n if limit is None else min(limit, n)
        return [i * n // count for i in range(count)]

    def copies(self, samples: Rows) -> list[list[Row]]:
        """For each of some samples, all samples of the same object or class in its photograph,
        itself first."""
        groups = defaultdict[Any, list[Row]](list)
        key = self.groups[1]
        for sample in self.samples:
            groups[sample["image_path"], sample[key]].append(sample)
        return [
            [one, *(s for s in groups[one["image_path"], one[key]] if s is not one)]
            for one in samples
        ]

    def settings(self) -> Row:
        """What results depend on besides pipeline and protocol."""
        split = getattr(self.dataset, "split", None)  # folders of the user have none
        return {"dataset": self.name, "root": str(self.dataset.root.resolve()), "split": split}

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        """Meshes that an object is registered to: its own; other datasets may offer more."""
        if self.protocol.cad != "annotated":
            raise InvalidInputError(
                f"protocol: each object of this dataset has one mesh, so cad=annotated; got "
                f"cad={self.protocol.cad}"
            )
        return (Path(sample[self.mesh]),)

    def _entry(self, sample: Row) -> Entry:
        label = self.label.format_map(sample)
        meshes = self.meshes(sample)
        photo = Path(sample["image_path"])
        protocol = self.protocol
        box = sample["box"]
        if protocol.box_is == "visible":
            box = sample.get("box_visible", torch.full_like(box, torch.nan))
        error = "" if meshes else "no_other_cad"
        if protocol.box is not None and not bool(box.isfinite().all()):
            error = "unknown_box"
        frame = object_frame(format_up(Path(sample[self.mesh]).suffix))
        return Entry(
            name=str(photo.relative_to(self.dataset.root)),
            photo=photo,
            meshes=meshes,
            box=None
            if protocol.box is None
            else tuple(perturbed_box(box, protocol, label).tolist()),
            camera=Camera(sample["camera_matrix"]) if self.gives_camera else None,
            prior=hint_of_truth(sample["rotation"], frame, protocol, label),
            as_stored=True,
            label=label,
            error=error,
        )

    def errors(self, samples: Rows, rows: Rows) -> dict[str, Tensor]:
        """Errors (N,) by name, float64: ``inf`` for a miss, NaN where the truth is unknown."""
        R = estimated_rotations(rows)
        truth = true_rotations(samples)
        known = truth.isfinite().flatten(1).all(1)
        errors = torch.full((len(rows),), torch.nan, dtype=torch.float64)
        errors[known] = symmetric_rotation_error(R[known], truth[known], NO_SYMMETRIES)
        return {"error_deg": errors}

    @abstractmethod
    def scores(self, rows: Rows, errors: Errors, chosen: list[int]) -> Row:
        """Scores of the chosen results."""

    def subsets(self, samples: Rows) -> dict[str, list[bool]]:
        """Which objects belong to each subset that is scored by itself."""
        return {}

    def summary(self, samples: Rows, rows: Rows, errors: Errors) -> Row:
        """Scores of the results ``rows``, none of them skipped: of all, of subsets, and of each
        group."""
        everything = list(range(len(rows)))
        subsets = {
            subset: self.scores(rows, errors, [i for i in everything if members[i]])
            for subset, members in self.subsets(samples).items()
        }
        return {
            **self.scores(rows, errors, everything),
            **({"subsets": subsets} if subsets else {}),
            self.groups[0]: self.scores_of_groups(samples, rows, errors, everything),
        }

    def scores_of_groups(
        self, samples: Rows, rows: Rows, errors: Errors, chosen: Sequence[int]
    ) -> Row:
        """Scores of each group of the chosen results."""
        groups = defaultdict[Any, list[int]](list)
        for i in chosen:
            groups[samples[i][self.groups[1]]].append(i)
        return {str(group): self.scores(rows, errors, groups[group]) for group in sorted(groups)}

    def rotation_scores(self, errors: Tensor) -> Row:
        """``n``, an accuracy for each threshold, and ``med_err_deg``, of errors (N,) in degrees."""
        accuracies = {
            name: metrics.average_recall(errors, (degrees,))
            for name, degrees in self.thresholds.items()
        }
        return {"n": len(errors), **accuracies, "med_err_deg": metrics.median_error(errors)}

    def write_predictions(self, path: Path, samples: Rows, rows: Rows, errors: Errors) -> None:
        """Write one line for each object: its annotation, the estimate, errors, the true angles,
        ``true_azimuth``..."""
        names = ("azimuth", "elevation", "theta")
        R = estimated_rotations(rows)
        lines: list[Sequence[object]] = [self.columns]
        for i, (sample, row) in enumerate(zip(samples, rows, strict=True)):
            line = {
                **sample,
                **row,
                "seconds": row["seconds"]["register"],
                "failed": row["message"],
            }
            line |= zip(
                [f"true_{name}" for name in names], sample["viewpoint"].tolist(), strict=True
            )
            line |= {name: float(values[i]) for name, values in errors.items()}
            if "rotation" in row:
                line |= zip(names, map(float, viewpoint_from_rotation(R[i])), strict=True)
                line["mesh"] = Path(row["mesh"]).name
            lines.append([_cell(line.get(name, "")) for name in self.columns])
        write_csv(path, lines)

    def write_errors(self, path: Path, keys: Sequence[str], samples: Rows, errors: Errors) -> None:
        """Write one line for each object with all digits of its errors: ``inf`` for a miss, empty
        where the truth is unknown."""
        lines: list[Sequence[object]] = [("key", "group", *errors)]
        for i, (key, sample) in enumerate(zip(keys, samples, strict=True)):
            values = [float(error[i]) for error in errors.values()]
            cells = ["" if math.isnan(value) else repr(value) for value in values]
            lines.append((key, sample[self.groups[1]], *cells))
        write_csv(path, lines)

    def results_name(self, settings: Row) -> str | None:
        """Name of a copy of the predictions that a benchmark's own tools ask for, if there are such
        tools."""
        return None


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value


def estimated_rotations(rows: Rows) -> Tensor:
    """(N, 3, 3) float64; NaN for rows without an estimate."""
    missing = [[math.nan] * 3] * 3
    return torch.tensor([row.get("rotation", missing) for row in rows], dtype=torch.float64).view(
        -1, 3, 3
    )


def true_rotations(samples: Rows) -> Tensor:
    """(N, 3, 3) float64; NaN where the pose is unknown."""
    return torch.cat([NO_SYMMETRIES, *(sample["rotation"].double()[None] for sample in samples)])
