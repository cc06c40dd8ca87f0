"""Evaluation on web collections: viewpoints of given objects, where they are known."""

from pathlib import Path

import torch
from torch import Tensor

from ..data import WebCollection
from ..errors import InvalidInputError
from ..geometry import rotation_error
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import Protocol
from .scores import estimated_rotations, or_inf, viewpoint_scores, write_viewpoints

__all__ = ["WebBenchmark"]

THRESHOLDS = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}
COLUMNS = [
    *("category", "object_index", "image_id", "azimuth", "elevation", "theta", "true_azimuth", "true_elevation"),
    *("true_theta", "error_deg", "score", "confidence", "reliable", "failed", "seconds"),
]


class WebBenchmark(Benchmark):
    """Viewpoints on a web collection. The method is given the box and the object's mesh, and no camera.

    Photographs of unknown pose are registered, too: they count in ``n``, ``reliable`` and ``mean_confidence``, but in
    no share or error; those are of the ``n_posed`` others.

    Args:
        dataset: :class:`WebCollection`.
        protocol: of ``cad="annotated"``: every object has its mesh.

    Raises:
        InvalidInputError: another ``cad``.
    """

    name, unit = "web", "m"
    dataset: WebCollection

    def __init__(self, dataset: WebCollection, protocol: Protocol) -> None:
        if protocol.cad != "annotated":
            raise InvalidInputError(f"protocol: every object has its mesh, so cad=annotated; got cad={protocol.cad}")
        super().__init__(dataset, protocol)

    def item(self, index: int) -> BenchmarkItem:
        s = self.dataset.annotation(index)
        return BenchmarkItem(
            key=f"{s['category']}/{s['object_index']}",
            index=index,
            photo=Path(s["image_path"]),
            meshes=(Path(s["mesh_path"]),),
            box=s["box"],
            camera_matrix=None,
        )

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        """(N,) float64 degrees, ``inf`` for a miss, NaN where the truth is unknown; symmetries are not known."""
        R = estimated_rotations(rows)
        truth = torch.cat([torch.empty(0, 3, 3), *(self.dataset.annotation(i.index)["rotation"][None] for i in items)])
        truth = truth.double()
        known = truth.isfinite().flatten(1).all(1)
        errors = torch.full((len(rows),), torch.nan, dtype=torch.float64)
        errors[known] = or_inf(rotation_error(R[known], truth[known]), R[known])
        return errors

    def easy(self, item: BenchmarkItem) -> bool:
        """True: a collection does not say what is hidden."""
        return True

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Shares within 15 and 30 degrees and the median error of what has a known pose; the rest by its confidence."""
        errors = self.rotation_errors(items, rows)
        groups = [str(self.dataset.annotation(item.index)["category"]) for item in items]

        def scores_of(chosen: list[bool]) -> Row:
            mask = torch.tensor(chosen, dtype=torch.bool)
            posed = errors[mask & ~errors.isnan()]
            scores = viewpoint_scores(posed, THRESHOLDS) if len(posed) else dict.fromkeys((*THRESHOLDS, "med_err_deg"))
            found = [row for row, wanted in zip(rows, chosen, strict=True) if wanted]
            return {
                **scores,
                "n": len(found),
                "n_posed": len(posed),
                "reliable": sum(bool(row.get("reliable")) for row in found),
                "mean_confidence": sum(row.get("confidence", 0.0) for row in found) / len(found) if found else None,
            }

        return {
            **scores_of([True] * len(rows)),
            "per_object": {name: scores_of([g == name for g in groups]) for name in sorted(set(groups))},
        }

    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """One line per object: what was estimated and, where it is known, what is true."""
        samples = [self.dataset.annotation(item.index) for item in items]
        write_viewpoints(path, COLUMNS, samples, rows, {"error_deg": self.rotation_errors(items, rows)})
