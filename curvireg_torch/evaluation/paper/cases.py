"""Photographs with known true view, from any of the datasets."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

from ...data import read_image
from ...errors import InvalidInputError
from ...geometry import crop_images, rotation_towards
from ...geometry.views import DEFAULT_DISTANCE
from ...mesh import load_mesh, mesh_centre, mesh_radius
from ...pipeline import BankSettings
from ..bop import UNOCCLUDED
from ..registry import DATASETS, DatasetSpec

__all__ = ["Case", "find_cases", "grouped"]


@dataclass(frozen=True)
class Case:
    """One object in one photograph.

    Attributes:
        category: class or object.
        image_path, mesh_path, unit: files, and the unit of the mesh.
        box: (4,) x0, y0, x1, y1 in px.
        pose: (3, 4) float64 model to camera; without translation (NaN) it is that of a camera that looks at the box.
    """

    category: str
    image_path: str
    mesh_path: str
    unit: str
    box: Tensor
    pose: Tensor

    def crop(self, settings: BankSettings) -> Tensor:
        """(1, 3, S, S) crop of the photograph, framed as the views of a bank."""
        image = read_image(self.image_path)
        return crop_images([image], self.box[None], size=settings.image_size, margin=settings.margin)[0]

    def view(self, mesh: trimesh.Trimesh) -> tuple[Tensor, float]:
        """Rotation (3, 3) and distance in model units of a camera that looks at the object's centre.

        Without translation the distance is that of banks.
        """
        R, t = self.pose[:, :3], self.pose[:, 3]
        if not bool(t.isfinite().all()):
            return R, DEFAULT_DISTANCE * mesh_radius(mesh)
        centre = R @ mesh_centre(mesh) + t
        return rotation_towards(centre).T @ R, float(torch.linalg.vector_norm(centre))


def find_cases(kind: str, root: Path, *, pixel_origin: int = 1, limit: int | None = None) -> list[Case]:
    """The objects that the paper uses: neither occluded nor truncated, with known pose; grouped by mesh.

    Args:
        kind: "pascal3d", "bop" or "web".
        root: of the dataset.
        pixel_origin: of PASCAL3D+, see :class:`Pascal3DPlus`.
        limit: use only this many, spread evenly.

    Raises:
        InvalidInputError: no such object, or an unknown kind.
        MissingFileError: the dataset is missing.
    """
    row = DATASETS[kind]
    origin = {"pixel_origin": pixel_origin} if "pixel_origin" in row.options else {}
    dataset = row.open(root, **row.whole, **origin)
    cases = [case for i in range(len(dataset)) if (case := _case(row, dataset.annotation(i))) is not None]
    if not cases:
        raise InvalidInputError(f"{root}: holds no whole object with a known pose")
    if limit is not None and limit < len(cases):
        cases = [cases[i * len(cases) // limit] for i in range(limit)]
    return sorted(cases, key=lambda case: case.mesh_path)


def _case(kind: DatasetSpec, s: dict[str, Any]) -> Case | None:
    translation = s.get("translation", torch.full((3,), math.nan))
    pose = torch.cat([s["rotation"], translation[:, None]], dim=1).double()
    known = bool(pose[:, :3].isfinite().all() and s["box"].isfinite().all())
    if not known or s.get("visib_fract", 1.0) <= UNOCCLUDED:
        return None
    return Case(kind.category.format_map(s), s["image_path"], str(s[kind.mesh]), kind.scored.unit, s["box"], pose)


def grouped(cases: list[Case], label: str, progress: bool) -> Iterator[tuple[trimesh.Trimesh, list[Case]]]:
    """Meshes with their cases; one mesh is in memory at a time."""
    with tqdm(total=len(cases), desc=label, unit="photo", disable=not progress) as bar:
        for (path, unit), group in groupby(cases, key=lambda case: (case.mesh_path, case.unit)):
            chosen = list(group)
            yield load_mesh(path, unit=unit), chosen
            bar.update(len(chosen))
