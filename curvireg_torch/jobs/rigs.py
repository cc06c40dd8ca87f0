"""Rigs: photographs of one object from cameras whose poses are known, as CSV, COLMAP models and
scenes of BOP sets."""

import math
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from scipy.spatial.transform import Rotation

from ..data.bop import bop_box, entry_at
from ..data.cameras import Calibrations
from ..errors import MAX_RIG_VIEWS, CurviregError, InvalidInputError, MissingFileError
from ..geometry import Camera, camera_matrix
from ..geometry.cameras import transform
from ..registration import Registrar
from ..registration.photograph import Photograph
from ..utils.checks import check_pose
from ..utils.files import FindFile, check_table_size, finite_numbers, found_in, read_csv, read_json
from .documents import result_document
from .entry import Entry
from .lists import BOX, CAMERA, ROTATION, TRANSLATION, given_camera, numbers_of
from .options import PRIOR_OPTIONS
from .photograph import register_views
from .result_files import RegisteredViews

QUATERNION = ("qw", "qx", "qy", "qz")
COLUMNS = (
    f"photo, {' '.join(BOX)}, {' '.join(CAMERA)} or camera, r11 to r33 or "
    f"{' '.join(QUATERNION)}, {' '.join(TRANSLATION)}"
)


def read_rig(path: Path, mesh: Path | None = None, *, find: FindFile | None = None) -> list[Entry]:
    """Read a rig: a CSV file, a folder of COLMAP with ``images.txt`` and ``cameras.txt``, or a
    scene of a BOP set.

    docs/results.md describes the columns of the CSV. Of a BOP scene, boxes are those of the object
    that the name of ``mesh`` numbers, if each photograph shows it once at most. ``find`` finds the
    photographs and calibrations that the rig names, by default from its own folder on.
    """
    folder = path if path.is_dir() else path.parent
    find = find or found_in(folder)
    with _about(path):
        if not path.exists():
            raise MissingFileError("no such file; check the path of the rig")
        if path.name == "images.txt" or (folder == path and (path / "images.txt").is_file()):
            rows = _colmap(folder, find)
        elif path.is_file():
            rows = _table(read_csv(path), find)
        elif (path / "scene_camera.json").is_file():
            rows = _bop(path, mesh, find)
        else:
            raise InvalidInputError(
                "a folder without images.txt (COLMAP) or scene_camera.json (BOP)"
            )
        views = list(islice(rows, MAX_RIG_VIEWS + 1))
        if not views:
            raise InvalidInputError("no photographs")
        if len(views) > MAX_RIG_VIEWS:
            raise InvalidInputError(f"more than {MAX_RIG_VIEWS:,} photographs; leave some out")
    return views


@contextmanager
def _about(subject: object) -> Iterator[None]:
    """Context whose errors name this subject, before their own."""
    try:
        yield
    except CurviregError as error:
        own = "" if error.subject == str(subject) else error.subject
        raise error.with_subject(": ".join(filter(None, (str(subject), own)))) from error


def _view(
    name: str,
    photo: Path,
    box: Any,
    camera: Camera | Sequence[float] | None,
    rotation: Any,
    translation: Any,
) -> Entry:
    """A row; ``rotation`` are 9 numbers, or 4 of a quaternion."""
    numbers = finite_numbers(rotation, 9) or finite_numbers(rotation, 4)
    t = finite_numbers(translation, 3)
    if numbers is None or t is None:
        raise InvalidInputError(
            f"a rotation and a translation are needed; expected columns {COLUMNS}"
        )
    if camera is None:
        raise InvalidInputError("expected fx fy cx cy, or camera (a calibration file)")
    R = torch.tensor(numbers, dtype=torch.float64)
    if len(numbers) == 4:
        length = math.hypot(*numbers)
        if abs(length - 1.0) > 1e-2:
            raise InvalidInputError(
                f"expected qw qx qy qz of length 1, got {length:.3g}; check their order"
            )
        R = torch.from_numpy(Rotation.from_quat(numbers, scalar_first=True).as_matrix())
    T = transform(R.view(3, 3), torch.tensor(t, dtype=torch.float64))
    check_pose(T, "the camera's pose")
    known = camera if isinstance(camera, Camera) else Camera(camera_matrix(*camera))
    return Entry(name=name, photo=photo, box=box, camera=known, T_cam_from_world=T)


def _table(cells: Sequence[Sequence[str]], find: FindFile) -> Iterator[Entry]:
    header, *rows = cells or [[]]
    names = [name.strip().lower() for name in header]
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise InvalidInputError(
            f"two columns {', '.join(twice)}; keep one of each", subject="header"
        )
    if unused := sorted({"mask", "mesh", *PRIOR_OPTIONS}.intersection(names)):
        raise InvalidInputError(
            f"a rig takes no {', '.join(unused)}; leave these columns out", subject="header"
        )
    calibrations = Calibrations()
    for number, values in enumerate(rows, start=1):
        row = dict(zip(names, map(str.strip, values), strict=False))
        photo = row.get("photo", "")
        name = f"row {number}: {photo}"
        with _about(name if photo else f"row {number}"):
            if not photo:
                raise InvalidInputError(f"no photo; expected columns {COLUMNS}")
            if beyond := [cell for cell in values[len(names) :] if cell.strip()]:
                raise InvalidInputError(
                    f"{beyond[0][:40]!r} is beyond the last column; quote texts with commas"
                )
            box = numbers_of(row, BOX)
            camera = given_camera(row, find, calibrations)
            matrix = numbers_of(row, ROTATION)
            quaternion = numbers_of(row, QUATERNION)
            if matrix and quaternion:
                raise InvalidInputError("r11 to r33 and qw to qz; give one of them")
            pose = matrix or quaternion, numbers_of(row, TRANSLATION)
            yield _view(name, find(photo), box, camera, *pose)


def _colmap(folder: Path, find: FindFile) -> Iterator[Entry]:
    """Photographs of ``images.txt`` that lie in the folder, in ``images`` in it, or beside it."""
    check_table_size(folder / "images.txt")
    with _about("images.txt"):
        try:
            lines = (folder / "images.txt").read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError as error:
            raise InvalidInputError(f"not text ({error})") from error
    calibrations = Calibrations()
    for line in _without_points([line for line in lines if not line.startswith("#")]):
        words = line.split(maxsplit=9)
        try:
            pose = list(map(float, words[1:8]))
        except ValueError:
            pose = []
        if len(words) < 10 or not pose or not (words[0].isdecimal() and words[8].isdecimal()):
            message = f"expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line[:60]!r}"
            raise InvalidInputError(message, subject="images.txt")
        name = words[9].rstrip()
        beside = (folder, *folder.resolve().parents[:3])
        photo = _first_file([name, *(str(place / "images" / name) for place in beside)], find)
        camera = calibrations.load(f"{folder / 'cameras.txt'}:{words[8]}")
        with _about(f"image {name}"):
            yield _view(f"image {name}", photo, None, camera, pose[:4], pose[4:])


def _first_file(names: Sequence[str], find: FindFile) -> Path:
    """The first of the named files that exists, else the first one."""
    paths = list(map(find, names))
    return next(filter(os.path.isfile, paths), paths[0])


def _without_points(lines: Sequence[str]) -> Iterator[str]:
    """The lines of ``images.txt`` that name images: COLMAP writes a line of points X Y POINT3D_ID
    ..., often empty, behind each; other programs leave it out."""
    may_be_points = False
    for line in lines:
        if not line.strip() or (may_be_points and _are_points(line)):
            may_be_points = False
        else:
            may_be_points = True
            yield line


def _are_points(line: str) -> bool:
    words = line.split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:  # a name
        return False
    return len(numbers) % 3 == 0 and all(
        number == int(number) for number in numbers[2::3] if math.isfinite(number)
    )


def _bop(folder: Path, mesh: Path | None, find: FindFile) -> Iterator[Entry]:
    """Photographs of a scene whose cameras have ``cam_R_w2c`` and ``cam_t_w2c``; lengths in mm."""
    cameras, truths, infos = (
        read_json(folder / name, dict, "datasets/bop/README.md")
        if (folder / name).is_file()
        else {}
        for name in ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
    )
    number = re.search(r"obj_(\d+)$", mesh.stem) if mesh is not None else None
    for key, camera in cameras.items():
        name = f"image {key}"
        with _about(name):
            values = camera if isinstance(camera, dict) else {}
            K = finite_numbers(values.get("cam_K"), 9)
            if K is None:
                raise InvalidInputError("no cam_K of 9 numbers in scene_camera.json")
            objects = truths.get(key, [])
            if not isinstance(objects, list) or not all(isinstance(one, dict) for one in objects):
                raise InvalidInputError("expected a list of objects in scene_gt.json")
            mine = [
                k for k, one in enumerate(objects) if number and one.get("obj_id") == int(number[1])
            ]
            known = entry_at(infos.get(key), mine[0]) if len(mine) == 1 else {}
            if "cam_R_w2c" not in values:
                raise InvalidInputError(
                    "no cam_R_w2c in scene_camera.json, the pose of the camera in the world, which "
                    "a rig needs; register these photographs one by one, or write the poses in a "
                    "CSV"
                )
            with _about("cam_K in scene_camera.json"):  # of skew, for instance
                pinhole = Camera(torch.tensor(K, dtype=torch.float64).view(3, 3))
            pose = values["cam_R_w2c"], values.get("cam_t_w2c")
            photo = _first_file(_names_in_bop(key), find)
            yield _view(name, photo, bop_box(known.get("bbox_obj")), pinhole, *pose)


def _names_in_bop(key: str) -> list[str]:
    """What the picture of an image's number may be called in a scene."""
    return [
        f"{kind}/{number}{end}"
        for kind in ("rgb", "gray")
        for number in dict.fromkeys((key.zfill(6), key.zfill(4), key))
        for end in (".png", ".jpg", ".tif")
    ]


def register_rig(
    path: Path,
    rig: Sequence[Entry],
    photographs: Sequence[Photograph | CurviregError],
    registrar: Registrar,
    *,
    bank_seconds: float,
) -> RegisteredViews:
    """Register the ``photographs`` of a rig together, see :meth:`.Registrar.register_views`; an
    error is why one cannot be used."""
    start = time.perf_counter()
    with _about(path):
        result = register_views(rig, photographs, registrar)
    document = result_document(
        result, registrar, {"bank": bank_seconds, "register": time.perf_counter() - start}
    )
    document["inputs"] = {"rig": str(path), "box": None}
    for row, view, item in zip(document["photographs"], rig, photographs, strict=True):
        camera, T = view.in_world
        if isinstance(item, Photograph):
            camera = item.camera or camera
        row |= {"name": view.name, "photo": str(view.photo), "camera": camera.describe()}
        row["T_cam_from_world"] = T.tolist()
    return RegisteredViews(registrar, result, photographs, document)
