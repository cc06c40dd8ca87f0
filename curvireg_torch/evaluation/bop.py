"""BOP sets: 6D poses of given objects with calibrated cameras."""

from collections import defaultdict
from pathlib import Path

import torch
from torch import Tensor

from ..data import BOPDataset, BOPRow, write_bop_csv
from ..errors import InvalidInputError
from ..geometry import symmetry_transforms
from ..geometry.cameras import transform
from ..io.meshes import load_mesh
from ..metrics import (
    add_error,
    add_recall,
    adds_error,
    mspd_error,
    mspd_recall,
    mssd_error,
    mssd_recall,
    symmetric_rotation_error,
)
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import Protocol
from .scores import estimated_rotations, or_inf, viewpoint_scores

__all__ = ["BOPBenchmark"]

THRESHOLDS = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}
UNOCCLUDED = 0.95


class BOPBenchmark(Benchmark):
    """Poses on one BOP set. The method is given the box of the whole silhouette and the camera matrix.

    Args:
        dataset: :class:`BOPDataset`.
        protocol: of ``cad="annotated"``: in BOP the object is known.

    Raises:
        InvalidInputError: another ``cad``.
    """

    name, unit = "bop", "mm"
    dataset: BOPDataset

    def __init__(self, dataset: BOPDataset, protocol: Protocol) -> None:
        if protocol.cad != "annotated":
            raise InvalidInputError(f"protocol: BOP names the object, so cad=annotated; got cad={protocol.cad}")
        super().__init__(dataset, protocol)

    def item(self, index: int) -> BenchmarkItem:
        s = self.dataset.annotation(index)
        return BenchmarkItem(
            key=f"{s['scene_id']}/{s['image_id']}/{s['instance_index']}",
            index=index,
            photo=Path(s["image_path"]),
            meshes=(Path(s["model_path"]),),
            box=s["box"],
            camera_matrix=s["camera_matrix"],
        )

    def rotation_errors(self, items: list[BenchmarkItem], rows: list[Row]) -> Tensor:
        return self._errors_of(items, rows)[0][0]

    def easy(self, item: BenchmarkItem) -> bool:
        return float(self.dataset.annotation(item.index)["visib_fract"]) > UNOCCLUDED

    def summary(self, items: list[BenchmarkItem], rows: list[Row]) -> Row:
        """Rotation errors up to the objects' symmetries, ADD(-S) recall, AR of MSSD and MSPD."""
        errors, objects = self._errors_of(items, rows)
        easy = torch.tensor([self.easy(item) for item in items], dtype=torch.bool)
        return {
            **_scores(errors),
            "subsets": {"unoccluded": _scores(errors[:, easy])},
            "per_object": {str(o): _scores(errors[:, objects == o]) for o in objects.unique().tolist()},
        }

    def write_predictions(self, path: Path, items: list[BenchmarkItem], rows: list[Row]) -> None:
        """The results file of the BOP challenge; objects without an estimate are not in it."""
        samples = [self.dataset.annotation(item.index) for item in items]
        ids = [(s["scene_id"], s["image_id"]) for s in samples]
        times: dict[tuple[int, int], float] = defaultdict(float)
        for image, row in zip(ids, rows, strict=True):
            times[image] += row["seconds"]["register"]
        write_bop_csv(
            path,
            [
                BOPRow(
                    scene_id=image[0],
                    im_id=image[1],
                    obj_id=sample["obj_id"],
                    score=row["score"],
                    R=torch.tensor(row["rotation"], dtype=torch.float64),
                    t=torch.tensor(row["translation"], dtype=torch.float64),
                    time=times[image],
                )
                for image, sample, row in zip(ids, samples, rows, strict=True)
                if "rotation" in row
            ],
        )

    def _errors_of(self, items: list[BenchmarkItem], rows: list[Row]) -> tuple[Tensor, Tensor]:
        """(4, N) errors in degrees, diameters, diameters and image widths, see :meth:`_errors`; (N,) object ids."""
        samples = [self.dataset.annotation(item.index) for item in items]
        objects = torch.tensor([s["obj_id"] for s in samples], dtype=torch.long)
        errors = torch.full((4, len(rows)), torch.inf, dtype=torch.float64)
        for obj_id in objects.unique().tolist():
            chosen = (objects == obj_id).nonzero()[:, 0]
            errors[:, chosen] = self._errors([samples[i] for i in chosen], [rows[i] for i in chosen])
        return errors, objects

    def _errors(self, samples: list[Row], rows: list[Row]) -> Tensor:
        """(4, N) errors of N instances of one object: rotation in degrees, ADD(-S) and MSSD in diameters, MSPD in image
        widths."""
        info = samples[0]["model_info"]
        points = torch.from_numpy(load_mesh(samples[0]["model_path"], unit=self.unit).vertices.copy())
        symmetries = symmetry_transforms(info)
        R = estimated_rotations(rows)
        missing = [float("nan")] * 3
        t = torch.tensor([row.get("translation", missing) for row in rows], dtype=torch.float64)
        R_true, t_true, K = (
            torch.stack([s[name].double() for s in samples]) for name in ("rotation", "translation", "camera_matrix")
        )
        T, T_true = transform(R, t), transform(R_true, t_true)
        turn = or_inf(symmetric_rotation_error(R, R_true, symmetries[:, :3, :3]), R)
        add = (adds_error if len(symmetries) > 1 else add_error)(T, T_true, points)
        mssd = mssd_error(T, T_true, points, symmetries=symmetries)
        mspd = mspd_error(T, T_true, points, K, symmetries=symmetries)
        width = torch.tensor([row["image_size"][1] for row in rows], dtype=torch.float64)
        return torch.stack([turn, add / info["diameter"], mssd / info["diameter"], mspd / width])


def _scores(errors: Tensor) -> Row:
    turn, add, mssd, mspd = errors
    return {
        **viewpoint_scores(turn, THRESHOLDS),
        "add_recall_0.1d": add_recall(add, 1.0),
        "mssd_ar": mssd_recall(mssd, 1.0),
        "mspd_ar": mspd_recall(mspd, 1.0),
    }
