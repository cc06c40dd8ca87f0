"""Folders of the user: objects, each with a mesh and photographs of known or unknown pose."""

import math
from contextlib import suppress
from pathlib import Path
from typing import Unpack

from ..errors import InvalidInputError, MissingFileError
from ..utils.aliases import PathName
from ..utils.choices import MESHES
from ..utils.files import read_csv
from ._base import ObjectDataset, Sample, Transforms, existing_root, is_plain_name, pose_fields

_README = "datasets/web/README.md"
_COLUMNS = ["image", "x0", "y0", "x1", "y1", "azimuth", "elevation", "theta", "distance"]


class PoseFolder(ObjectDataset):
    """One folder per object, with ``mesh.*``, photographs, and ``views.csv`` with boxes and poses.

    ``views.csv`` is UTF-8 with the header ``image,x0,y0,x1,y1,azimuth,elevation,theta,distance``: a
    file of the folder, the box in pixels (centre of the first pixel = 0), PASCAL3D+ viewpoint
    angles in degrees, distance in units of the mesh. Pose columns may be empty: without azimuth and
    elevation there is no pose, an empty theta is 0. A photograph may have several lines. The mesh
    is one file in any format of :func:`curvireg_torch.load_mesh`.

    Args:
        root: the folder of the objects' folders.
        transform, target_transform, transforms: see :class:`ObjectDataset`.

    Samples are dicts (tensors are float32):
        - ``image`` (3, H, W) RGB in [0, 1]; ``image_path``, ``image_id`` str
        - ``box`` (4,) x0, y0, x1, y1
        - ``viewpoint`` (3,) azimuth, elevation, theta in degrees; ``rotation`` (3, 3) model to
          OpenCV camera; NaN if the pose is unknown
        - ``distance`` float, NaN if unknown
        - ``category`` str, the object's folder; ``mesh_path`` str; ``object_index`` int: line of
          ``views.csv`` from 0

    Reasons in ``skipped``: ``missing_annotation`` (no ``views.csv``), ``corrupt_annotation``,
    ``missing_image``, ``missing_mesh``, ``bad_box`` (no area).

    Raises:
        MissingFileError: the root does not exist, or holds no folder.
        InvalidInputError: a folder has two meshes.

    Example:
        >>> PoseFolder("data/web")[0]["viewpoint"]  # doctest: +SKIP
    """

    def __init__(
        self,
        root: PathName,
        **functions: Unpack[Transforms],
    ) -> None:
        super().__init__(existing_root(root, _README), **functions)
        folders = sorted(
            p for p in self.root.iterdir() if p.is_dir() and not p.name.startswith(".")
        )
        if not folders:
            raise MissingFileError(
                f"holds no folder of an object; {_README} shows the layout", subject=self.root
            )
        self.categories = [folder.name for folder in folders]
        for folder in folders:
            self._index(folder)

    def _index(self, folder: Path) -> None:
        named = sorted(path for path in folder.iterdir() if path.stem == "mesh" and path.is_file())
        meshes = [path for path in named if path.suffix.lower() in MESHES]
        if len(meshes) > 1:
            raise InvalidInputError(
                f"expected one mesh, got {', '.join(p.name for p in meshes)}", subject=folder
            )
        if not meshes:
            return self._skip("missing_mesh", folder.name)
        table = folder / "views.csv"
        if not table.is_file():
            return self._skip("missing_annotation", f"{folder.name}/views.csv")
        lines = []
        with suppress(ValueError):  # damaged
            lines = [[cell.strip() for cell in line] for line in read_csv(table)]
        if lines[:1] != [_COLUMNS]:
            return self._skip("corrupt_annotation", f"{folder.name}/views.csv")
        for index, line in enumerate(lines[1:]):
            ids = {"category": folder.name, "mesh_path": str(meshes[0]), "object_index": index}
            self._add(_parse(line, folder), f"{folder.name}/views.csv #{index}", **ids)
        return None


def _parse(line: list[str], folder: Path) -> Sample | str:
    """The sample of one line, or the reason to skip it."""
    try:
        numbers = [float(cell) if cell else math.nan for cell in line[1:]]
    except ValueError:
        return "corrupt_annotation"
    if len(line) != len(_COLUMNS) or not is_plain_name(line[0]) or any(map(math.isinf, numbers)):
        return "corrupt_annotation"
    x0, y0, x1, y1, azimuth, elevation, theta, distance = numbers
    if math.isnan(azimuth) != math.isnan(elevation):
        return "corrupt_annotation"
    if not (x1 > x0 and y1 > y0):
        return "bad_box"
    image = folder / line[0]
    if not image.is_file():
        return "missing_image"
    theta = math.nan if math.isnan(azimuth) else 0.0 if math.isnan(theta) else theta
    image_fields = {"image_path": str(image), "image_id": image.stem, "box": (x0, y0, x1, y1)}
    return {**image_fields, **pose_fields(azimuth, elevation, theta), "distance": distance}
