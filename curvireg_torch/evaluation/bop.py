"""BOP datasets: 6D poses of known objects with calibrated cameras."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..data import BOPDataset, BOPRow, write_bop_csv
from ..geometry import symmetry_transforms
from ..geometry.cameras import transform
from ..mesh import load_mesh
from .benchmark import Benchmark, BenchmarkItem, Row
from .metrics import (
    add_error,
    add_recall,
    adds_error,
    mspd_error,
    mspd_recall,
    mssd_error,
    mssd_recall,
    symmetric_rotation_error,
)
from .scores import THRESHOLDS, estimated_rotations, or_inf, viewpoint_scores

__all__ = ["BOPBenchmark", "bop_row"]

UNOCCLUDED = 0.95
"""Visible fraction above which an object counts as whole."""


class BOPBenchmark(Benchmark):
    """Poses on one BOP dataset. The method gets the box of the whole silhouette and the camera matrix."""

    name, unit, mesh, gives_camera = "bop", "mm", "model_path", True
    key = "{scene_id}/{image_id}/{instance_index}"
    dataset: BOPDataset

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        return self._pose_errors(items, rows)[0]

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Rotation errors up to the symmetries, ADD(-S) recall, average recall of MSSD and MSPD."""
        errors, samples = self._pose_errors(items, rows), self.samples(items)
        objects = torch.tensor([s["obj_id"] for s in samples], dtype=torch.long)
        whole = torch.tensor([float(s["visib_fract"]) > UNOCCLUDED for s in samples], dtype=torch.bool)
        return {
            **_scores(errors),
            "subsets": {"unoccluded": _scores(errors[:, whole])},
            "per_object": {str(o): _scores(errors[:, objects == o]) for o in objects.unique().tolist()},
        }

    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """The results file of the BOP challenge; it omits objects without an estimate."""
        results = [((s["scene_id"], s["image_id"]), s, row) for s, row in zip(self.samples(items), rows, strict=True)]
        times: dict[tuple[int, int], float] = defaultdict(float)
        for image, _, row in results:
            times[image] += row["seconds"]["register"]
        poses = [
            bop_row((*image, s["obj_id"]), row["score"], row, time=times[image])
            for image, s, row in results
            if "rotation" in row
        ]
        write_bop_csv(path, poses)

    def _pose_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        """(4, N) errors: rotation in degrees, ADD(-S) and MSSD in diameters, MSPD in image widths."""
        samples = self.samples(items)
        objects = torch.tensor([s["obj_id"] for s in samples], dtype=torch.long)
        errors = torch.full((4, len(rows)), torch.inf, dtype=torch.float64)
        for obj_id in objects.unique().tolist():
            chosen = (objects == obj_id).nonzero()[:, 0]
            errors[:, chosen] = self._errors_of_one_object([samples[i] for i in chosen], [rows[i] for i in chosen])
        return errors

    def _errors_of_one_object(self, samples: list[Row], rows: list[Row]) -> Tensor:
        info = samples[0]["model_info"]
        points = torch.from_numpy(load_mesh(samples[0]["model_path"], unit=self.unit).vertices.copy())
        symmetries = symmetry_transforms(info)
        R = estimated_rotations(rows)
        t = torch.tensor([row.get("translation", [float("nan")] * 3) for row in rows], dtype=torch.float64)
        names = ("rotation", "translation", "camera_matrix")
        R_true, t_true, K = (torch.stack([s[name].double() for s in samples]) for name in names)
        T, T_true = transform(R, t), transform(R_true, t_true)
        rotation = or_inf(symmetric_rotation_error(R, R_true, symmetries[:, :3, :3]), R)
        add = (adds_error if len(symmetries) > 1 else add_error)(T, T_true, points)
        mssd = mssd_error(T, T_true, points, symmetries=symmetries)
        mspd = mspd_error(T, T_true, points, K, symmetries=symmetries)
        width = torch.tensor([row["image_size"][1] for row in rows], dtype=torch.float64)
        return torch.stack([rotation, add / info["diameter"], mssd / info["diameter"], mspd / width])


def bop_row(ids: Sequence[int], score: float, pose: Row, *, time: float = -1.0, scale: float = 1.0) -> BOPRow:
    """A line of the BOP format: scene, image, object, and the pose of a result, whose unit is ``scale`` mm."""
    R, t = (torch.tensor(pose[name], dtype=torch.float64) for name in ("rotation", "translation"))
    return BOPRow(scene_id=ids[0], im_id=ids[1], obj_id=ids[2], score=score, R=R, t=t * scale, time=time)


def _scores(errors: Tensor) -> Row:
    rotation, add, mssd, mspd = errors
    return {
        **viewpoint_scores(rotation, THRESHOLDS),
        "add_recall_0.1d": add_recall(add, 1.0),
        "mssd_ar": mssd_recall(mssd, 1.0),
        "mspd_ar": mspd_recall(mspd, 1.0),
    }
