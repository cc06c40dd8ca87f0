"""Evaluation on web collections: viewpoints of given objects, where they are known."""

from pathlib import Path

import torch
from torch import Tensor

from ..data import WebCollection
from ..geometry import rotation_error
from .benchmark import Benchmark, BenchmarkItem, Row
from .scores import THRESHOLDS, estimated_rotations, or_inf, viewpoint_scores, write_viewpoints

__all__ = ["WebBenchmark"]

COLUMNS = [
    *("category", "object_index", "image_id", "azimuth", "elevation", "theta", "true_azimuth", "true_elevation"),
    *("true_theta", "error_deg", "score", "confidence", "reliable", "failed", "seconds"),
]


class WebBenchmark(Benchmark):
    """Viewpoints on a web collection. The method is given the box and the object's mesh, and no camera.

    Photographs of unknown pose are registered too. They count in ``n``, ``reliable`` and ``mean_confidence``; accuracy
    and errors are those of the ``n_posed`` others.
    """

    name, key, mesh = "web", "{category}/{object_index}", "mesh_path"
    dataset: WebCollection

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        R = estimated_rotations(rows)
        truth = torch.cat([torch.empty(0, 3, 3), *(s["rotation"][None] for s in self.samples(items))]).double()
        known = truth.isfinite().flatten(1).all(1)
        errors = torch.full((len(rows),), torch.nan, dtype=torch.float64)
        errors[known] = or_inf(rotation_error(R[known], truth[known]), R[known])
        return errors

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Accuracy at 15 and 30 degrees and the median error where the pose is known; confidence of all."""
        errors = self.rotation_errors(items, rows)
        groups = [str(sample["category"]) for sample in self.samples(items)]

        def scores_of(chosen: list[bool]) -> Row:
            mask = torch.tensor(chosen, dtype=torch.bool)
            posed = errors[mask & ~errors.isnan()]
            scores = viewpoint_scores(posed, THRESHOLDS) if len(posed) else dict.fromkeys((*THRESHOLDS, "med_err_deg"))
            some = [row for row, wanted in zip(rows, chosen, strict=True) if wanted]
            return {
                **scores,
                "n": len(some),
                "n_posed": len(posed),
                "reliable": sum(bool(row.get("reliable")) for row in some),
                "mean_confidence": sum(row.get("confidence") or 0.0 for row in some) / len(some) if some else None,
            }

        return {
            **scores_of([True] * len(rows)),
            "per_object": {name: scores_of([g == name for g in groups]) for name in sorted(set(groups))},
        }

    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """One line for each object: the estimate and, where it is known, the truth."""
        write_viewpoints(path, COLUMNS, self.samples(items), rows, {"error_deg": self.rotation_errors(items, rows)})
