"""PASCAL3D+: viewpoints of objects of twelve classes, with CADs of each class."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from ..data import Pascal3DPlus
from ..geometry import rotation_error, viewpoint_from_rotation
from .benchmark import Benchmark, BenchmarkItem, Row
from .metrics import AVP_BINS, accuracy, axis_rotation_error, binned_accuracy, median_error, symmetric_rotation_error
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


Z_AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
HALF_ROTATION = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))

SYMMETRIES: dict[str, tuple[str, Callable[[Tensor, Tensor], Tensor]]] = {
    "bottle": ("any rotation about z", lambda R, truth: axis_rotation_error(R, truth, Z_AXIS)),
    "diningtable": (
        "half a rotation about z",
        lambda R, truth: symmetric_rotation_error(R, truth, HALF_ROTATION[None]),
    ),
}
"""Classes whose objects have the same, or nearly the same, appearance from several azimuths."""


class Pascal3DBenchmark(Benchmark):
    """Viewpoints on PASCAL3D+. The method gets no camera: viewpoints are relative to a camera that looks at the box."""

    name, key, mesh = "pascal3d", "{category}/{image_id}/{object_index}", "cad_path"
    dataset: Pascal3DPlus

    def __init__(self, dataset: Pascal3DPlus, protocol: Protocol) -> None:
        self._cads = cache(lambda category: tuple(sorted((dataset.root / "CAD" / category).glob("*.off"))))
        super().__init__(dataset, protocol)

    def meshes(self, sample: Row) -> tuple[Path, ...]:
        return super().meshes(sample) if self.protocol.cad == "annotated" else self._cads(sample["category"])

    def settings(self) -> Row:
        return {**super().settings(), "part": self.dataset.part, "pixel_origin": self.dataset._pixel_origin}

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        return self._errors(items, rows)[3]

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Acc(pi/6), Acc(pi/18), MedErr: of all, of subsets, of each class, and up to the symmetries of the classes."""
        samples = self.samples(items)
        R, truth, plain, symmetric = self._errors(items, rows)

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
                "easy": scores_of([not any(s[flag] for flag in FLAGS) for s in samples]),
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
        """One line for each object: estimate, truth and error."""
        _, _, plain, symmetric = self._errors(items, rows)
        errors = {"error_deg": plain, "symmetric_error_deg": symmetric}
        write_viewpoints(path, COLUMNS, self.samples(items), rows, errors)

    def _errors(self, items: list[BenchmarkItem], rows: list[Row]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Estimated and true rotations (N, 3, 3), and their errors (N,) without and with symmetries."""
        samples, R = self.samples(items), estimated_rotations(rows)
        truth = torch.stack([s["rotation"].double() for s in samples]) if samples else R
        plain = symmetric = rotation_error(R, truth)
        for category, (_, error) in SYMMETRIES.items():
            mask = torch.tensor([s["category"] == category for s in samples], dtype=torch.bool)
            symmetric = torch.where(mask, error(R, truth), symmetric)
        return R, truth, or_inf(plain, R), or_inf(symmetric, R)
