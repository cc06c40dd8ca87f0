"""The objects that the paper uses, of any of the datasets."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from curvireg_torch.data import read_image
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import DATASETS
from curvireg_torch.evaluation.bop import UNOCCLUDED
from curvireg_torch.geometry import crop_images, rotation_towards
from curvireg_torch.geometry.viewpoint import DEFAULT_DISTANCE
from curvireg_torch.mesh import Mesh, mesh_centre, mesh_radius
from curvireg_torch.pipeline import BankSettings
from scripts._shared import Record


@dataclass(frozen=True)
class Case:
    """One object in one photograph.

    Attributes:
        category: class or object.
        image_path, mesh_path, unit: files, and the unit of the mesh.
        box: (4,) x0, y0, x1, y1 in px.
        pose: (3, 4) float64 model to camera; without translation (NaN) it is that of a camera that
            looks at the box.
        camera: (3, 3) camera matrix in px, None if unknown.
    """

    category: str
    image_path: str
    mesh_path: str
    unit: str
    box: Tensor
    pose: Tensor
    camera: Tensor | None = None

    @property
    def key(self) -> str:
        """What tells the object from all others."""
        return f"{self.image_path} {self.box.tolist()}"

    def crop(self, settings: BankSettings) -> Tensor:
        """(1, 3, S, S) crop of the photograph, framed as the views of a bank."""
        image = read_image(self.image_path)
        return crop_images(
            [image], self.box[None], size=settings.image_size, margin=settings.margin
        )[0]

    def view(self, mesh: Mesh) -> tuple[Tensor, float]:
        """Rotation (3, 3) and distance in model units of a camera that looks at the object's
        centre.

        Without translation the distance is that of banks.
        """
        R = self.pose[:, :3]
        t = self.pose[:, 3]
        if not bool(t.isfinite().all()):
            return R, DEFAULT_DISTANCE * mesh_radius(mesh)
        centre = R @ mesh_centre(mesh) + t
        return rotation_towards(centre).T @ R, float(torch.linalg.vector_norm(centre))

    @property
    def has_distance(self) -> bool:
        """Whether camera and true translation are known, without which there is no error of the
        distance."""
        return self.camera is not None and bool(self.pose[:, 3].isfinite().all())


def find_cases(kind: str, root: Path) -> list[Case]:
    """The objects that the paper uses: neither occluded nor truncated, with known pose; grouped by
    mesh.

    ``kind`` is "pascal3d", "bop" or "web".
    """
    row = DATASETS[kind]
    dataset = row.open(root, **row.whole)
    found = (_case(row, dataset.annotation(i)) for i in range(len(dataset)))
    cases = [case for case in found if case is not None]
    if not cases:
        raise InvalidInputError(f"{root}: holds no whole object with a known pose")
    return sorted(cases, key=lambda case: case.mesh_path)


def _case(kind: Any, s: Record) -> Case | None:
    translation = s.get("translation", torch.full((3,), math.nan))
    pose = torch.cat([s["rotation"], translation[:, None]], dim=1).double()
    known = bool(pose[:, :3].isfinite().all() and s["box"].isfinite().all())
    if not known or s.get("visib_fract", 1.0) < UNOCCLUDED:
        return None
    return Case(
        category=kind.category.format_map(s),
        image_path=s["image_path"],
        mesh_path=str(s[kind.scored.mesh]),
        unit=kind.scored.unit,
        box=s["box"],
        pose=pose,
        camera=s.get("camera_matrix"),
    )


def by_mesh(cases: list[Case]) -> Iterator[list[Case]]:
    """Cases of the same mesh."""
    for _, group in groupby(cases, key=lambda case: (case.mesh_path, case.unit)):
        yield list(group)
