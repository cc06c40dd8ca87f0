"""PASCAL3D+: viewpoints of objects of twelve classes, with CADs of the class."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from ..data import Pascal3DPlus
from ..geometry import rotation_error, viewpoint_from_rotation
from ..metrics import AVP_BINS, accuracy, axis_rotation_error, binned_accuracy, median_error, symmetric_rotation_error
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import Protocol
from .scores import estimated_rotations, or_inf, viewpoint_scores, write_viewpoints

__all__ = ["Pascal3DBenchmark"]

FLAGS = ("truncated", "occluded", "difficult")
THRESHOLDS = {"acc_pi_6": 30.0, "acc_pi_18": 10.0}
COLUMNS = [
    *("image_id", "object_index", "category", "cad_index", "mesh", "azimuth", "elevation", "theta"),
    *("true_azimuth", "true_elevation", "true_theta", "error_deg", "symmetric_error_deg", "score", "confidence"),
    *("truncated", "occluded", "difficult", "failed", "seconds"),
]


def _any_turn(R: Tensor, truth: Tensor) -> Tensor:
    return axis_rotation_error(R, truth, torch.tensor([0.0, 0.0, 1.0], dtype=R.dtype))


def _half_turn(R: Tensor, truth: Tensor) -> Tensor:
    return symmetric_rotation_error(R, truth, torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=R.dtype))[None])


SYMMETRIES: dict[str, tuple[str, Callable[[Tensor, Tensor], Tensor]]] = {
    "bottle": ("any turn about z", _any_turn),
    "diningtable": ("half a turn about z", _half_turn),
}
"""Classes whose objects look alike, or nearly, from several azimuths."""


class Pascal3DBenchmark(Benchmark):
    """Viewpoints on PASCAL3D+. The method is given no camera: viewpoints are those of one looking straight at the box.

    Args:
        dataset: :class:`Pascal3DPlus` of any split, categories and filters.
        protocol: see :class:`Protocol`.
    """

    name, unit = "pascal3d", "m"
    dataset: Pascal3DPlus

    def __init__(self, dataset: Pascal3DPlus, protocol: Protocol) -> None:
        self._meshes = cache(lambda category: tuple(sorted((dataset.root / "CAD" / category).glob("*.off"))))
        super().__init__(dataset, protocol)

    def item(self, index: int) -> BenchmarkItem:
        sample = self.dataset.annotation(index)
        annotated = (Path(sample["cad_path"]),)
        return BenchmarkItem(
            key=f"{sample['category']}/{sample['image_id']}/{sample['object_index']}",
            index=index,
            photo=Path(sample["image_path"]),
            meshes=annotated if self.protocol.cad == "annotated" else self._meshes(sample["category"]),
            box=sample["box"],
            camera_matrix=None,
        )

    def settings(self) -> Row:
        return {**super().settings(), "part": self.dataset.part, "pixel_origin": self.dataset._pixel_origin}

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        return self._errors_of(items, rows)[4]

    def easy(self, item: BenchmarkItem) -> bool:
        return not any(self.dataset.annotation(item.index)[flag] for flag in FLAGS)

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Acc(pi/6), Acc(pi/18), MedErr: of all, of subsets, of each class, and up to the symmetries of the classes."""
        samples, R, truth, plain, symmetric = self._errors_of(items, rows)

        def scores_of(chosen: list[bool]) -> Row:
            mask = torch.tensor(chosen, dtype=torch.bool)
            aware = viewpoint_scores(symmetric[mask], THRESHOLDS)
            del aware["n"]
            return {**viewpoint_scores(plain[mask], THRESHOLDS), "symmetry_aware": aware}

        azimuth, true_azimuth = (viewpoint_from_rotation(rotations)[0] for rotations in (R, truth))
        classes = sorted({s["category"] for s in samples})
        return {
            **scores_of([True] * len(samples)),
            "subsets": {
                "easy": scores_of([self.easy(item) for item in items]),
                **{flag: scores_of([s[flag] for s in samples]) for flag in FLAGS},
            },
            "per_class": {c: scores_of([s["category"] == c for s in samples]) for c in classes},
            "symmetries": {c: text for c, (text, _) in SYMMETRIES.items()},
            "azimuth_bin_accuracy": {str(b): binned_accuracy(azimuth, true_azimuth, b) for b in AVP_BINS},
            "legacy_sqrt2": {
                "acc_pi_6": accuracy(plain, 30.0, legacy_sqrt2=True),
                "med_err_deg": median_error(plain, legacy_sqrt2=True),
            },
        }

    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """One line per object: what was estimated, what is true, and the error."""
        samples, _, _, plain, symmetric = self._errors_of(items, rows)
        write_viewpoints(path, COLUMNS, samples, rows, {"error_deg": plain, "symmetric_error_deg": symmetric})

    def _errors_of(
        self, items: list[BenchmarkItem], rows: list[Row]
    ) -> tuple[list[Row], Tensor, Tensor, Tensor, Tensor]:
        """Annotations, estimated and true rotations (N, 3, 3), and their errors (N,) without and with symmetries."""
        samples = [self.dataset.annotation(item.index) for item in items]
        R = estimated_rotations(rows)
        truth = torch.stack([s["rotation"].double() for s in samples]) if samples else R
        plain = rotation_error(R, truth)
        symmetric = plain
        for category, (_, error) in SYMMETRIES.items():
            mask = torch.tensor([s["category"] == category for s in samples], dtype=torch.bool)
            symmetric = torch.where(mask, error(R, truth), symmetric)
        return samples, R, truth, or_inf(plain, R), or_inf(symmetric, R)
