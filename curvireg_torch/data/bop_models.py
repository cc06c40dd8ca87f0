"""The models of a BOP dataset: their files, diameters and symmetries."""

import re
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.distance import pdist
from torch import Tensor

from ..errors import CurviregError, CurviregWarning, InvalidInputError, MissingFileError
from ..geometry import symmetry_transforms
from ..utils.aliases import Fields
from ..utils.checks import check_symmetries
from ..utils.files import finite_numbers, read_json

README = "datasets/bop/README.md"
# between a mesh's diameter and the one that models_info.json names: 25.4, 10 or 1000 are units
MAX_UNIT_FACTOR = 5.0
MAX_HULL_POINTS = 3000  # of which the diameter is computed; a hull with more is thinned


class BOPModels:
    """The models in a folder such as ``models`` or ``models_cad``, called ``obj_000001.ply`` or
    with fewer digits.

    Attributes:
        info: obj_id -> entry of ``models_info.json``, each with a diameter; without the file
            computed from the meshes.

    Raises:
        MissingFileError: neither ``models_info.json`` nor a mesh is there.
        InvalidInputError: ``models_info.json`` is damaged, or names a diameter that does not fit
            the first mesh.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files = model_files(folder)
        self._hulls: dict[int, Tensor | None] = {}
        table = folder / "models_info.json"
        if table.is_file():
            self.info = read_models_info(table)
            self._check_unit()
        elif self.files:
            hulls = {number: self.hull(number) for number in self.files}
            self.info = {n: _measured(hull) for n, hull in hulls.items() if hull is not None}
        else:
            raise MissingFileError(
                f"neither models_info.json nor obj_000001.ply; {README} shows the layout",
                subject=folder,
            )

    def hull(self, number: int) -> Tensor | None:
        """(V, 3) float64 vertices of a model's convex hull, in the file's unit; None if it cannot
        be read."""
        if number not in self._hulls:
            self._hulls[number] = self._read_hull(number)
        return self._hulls[number]

    def _read_hull(self, number: int) -> Tensor | None:
        from ..mesh import load_mesh

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CurviregWarning)  # for whoever registers the mesh
            try:
                mesh = load_mesh(self.files[number], unit="mm")
            except CurviregError:  # reported when the model is needed
                return None
        try:
            vertices = mesh.surface.convex_hull.vertices
        except RuntimeError:  # flat
            vertices = mesh.vertices
        return torch.from_numpy(np.array(vertices, dtype=np.float64))

    def _check_unit(self) -> None:
        """Refuse meshes in another unit than the diameters: of all, the first that can be read is
        measured."""
        for number in sorted(self.info.keys() & self.files.keys()):
            hull = self.hull(number)
            if hull is None:
                continue
            measured = _diameter(hull)
            listed = float(self.info[number]["diameter"])
            if not 1.0 / MAX_UNIT_FACTOR < measured / listed < MAX_UNIT_FACTOR:
                metres = "in metres? " if 500 < listed / measured < 2000 else ""
                message = (
                    f"the mesh is {measured:.4g} across, models_info.json says {listed:.4g}: "
                    f"{metres}scale the models to mm, as the poses are"
                )
                raise InvalidInputError(message, subject=self.files[number])
            return


def _diameter(hull: Tensor) -> float:
    """The largest distance of two vertices (V, 3)."""
    step = -(-len(hull) // MAX_HULL_POINTS)
    return float(pdist(hull[::step].numpy()).max())


def _measured(hull: Tensor) -> Fields:
    """An entry as models_info.json has it, without symmetries."""
    low = hull.amin(dim=0).tolist()
    size = (hull.amax(dim=0) - hull.amin(dim=0)).tolist()
    sides = {f"min_{axis}": value for axis, value in zip("xyz", low, strict=True)}
    sides |= {f"size_{axis}": value for axis, value in zip("xyz", size, strict=True)}
    return {"diameter": _diameter(hull), **sides}


def model_files(folder: Path) -> dict[int, Path]:
    """obj_id -> file, of a folder that need not exist."""
    matches = (
        (re.fullmatch(r"obj_(\d{1,9})\.ply", path.name), path)
        for path in sorted(folder.glob("obj_*.ply"))
    )
    return {int(match[1]): path for match, path in matches if match}


def read_models_info(path: Path) -> dict[int, Fields]:
    """obj_id -> entry, each with a diameter and symmetries that metrics can use."""
    entries = {}
    for key, entry in read_json(path, dict, README).items():
        name = f"entry {key[:20]!r}"
        if not (key.isdecimal() and len(key) < 10 and isinstance(entry, dict)):
            raise InvalidInputError(
                f"{name}: expected an object's number and its values; {README}", subject=path
            )
        diameter = finite_numbers([entry.get("diameter")], 1)
        if diameter is None or diameter[0] <= 0:
            raise InvalidInputError(
                f"{name}: expected a diameter > 0 in mm; {README}", subject=path
            )
        try:
            check_symmetries(symmetry_transforms(entry, max_step_fraction=1.0))
        except InvalidInputError as error:
            raise InvalidInputError(f"{name}: {error}", subject=path) from None
        entries[int(key)] = entry
    return entries
