"""Files of one pose: results of this library, and those of other tools."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.transformations import quaternion_matrix

from ..errors import InvalidInputError, MissingFileError
from ..utils.arrays import Floats
from ..utils.choices import UNITS, listed
from ..utils.files import check_table_size, finite_numbers, split_name
from .cameras.record import Record, flattened
from .documents import read_document

_README = "docs/guides/known-pose.md"
_MATRIX_NAMES = """
    T_cam_from_model T_cam_from_object cam_from_model T_cam_obj T_co T pose matrix transform
    transform_matrix ob_in_cam K
"""
# frames of ROS in which no camera looks along z: the world's, and bodies, whose x points forward
_OTHER_FRAMES = re.compile(
    r"(^|/)((\w+_)?(world|map|odom|earth|link\d*|tool\d*)|base\w*|\w+_frame)$"
)
FORMATS = (
    "JSON with rotation and translation, or T_cam_from_model; 4 x 4 numbers; TWO of MegaPose; "
    "scene_gt.json:IMAGE_ID of BOP; pose.yaml of ROS"
)


@dataclass(frozen=True, eq=False)
class PoseRecord:
    """A pose that a file holds.

    Attributes:
        T: (4, 4) float64 model -> OpenCV camera, finite; its rotation is not checked.
        unit: of the translation, where the format or the file says it; None: that of the mesh.
        confidence: of the pose, if the file has one.
    """

    T: Floats
    unit: str | None = None
    confidence: float | None = None


def read_pose(path: Path, *, convention: str = "opencv", mesh: str = "") -> PoseRecord:
    """Read the pose of an object in a camera.

    Args:
        path: ``FILE``, or ``FILE:NAME`` of one with several poses: the label of MegaPose, the image
            of BOP, or ``IMAGE:INDEX`` where it shows several objects.
        convention: "opengl" for poses whose camera looks along -z; x points right and y up.
        mesh: name of the mesh's file without its ending, as ``obj_000001``: it chooses among the
            objects of an image.

    Raises:
        MissingFileError: the file does not exist.
        InvalidInputError: it holds no such pose, or several.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "pose.txt")
        >>> _ = file.write_text("1 0 0 0.1  0 1 0 0  0 0 1 0.5  0 0 0 1")
        >>> read_pose(file).T[:3, 3].tolist()
        [0.1, 0.0, 0.5]
    """
    file, name = split_name(path)
    if not file.is_file():
        raise MissingFileError(f"no such file; {_README} shows the layout", subject=path)
    check_table_size(file)
    try:
        found = _pose_of(read_document(file, FORMATS), name, mesh)
    except RecursionError:
        raise InvalidInputError("nested too deeply; write it again", subject=path) from None
    except InvalidInputError as error:
        raise error.with_subject(path) from error
    if convention == "opencv":
        return found
    return replace(found, T=np.diag([1.0, -1.0, -1.0, 1.0]) @ found.T)


def _pose_of(content: Any, name: str, mesh: str) -> PoseRecord:
    content = _named(content, name, mesh)
    if not isinstance(content, dict):
        raise InvalidInputError(f"expected {FORMATS}")
    record = Record(content, set())
    for key, read in _READERS.items():
        if record.has(key):
            return read(record)
    for name in _MATRIX_NAMES.split():
        numbers = flattened(record.get(name))
        if len(numbers) in (12, 16):
            return PoseRecord(_pose_matrix(numbers), _own_unit(record), _confidence(record))
    return _rotation_and_translation(record)


def _named(content: Any, name: str, mesh: str) -> Any:
    """The part of a file with several poses that is meant."""
    if isinstance(content, list) and content and all(isinstance(item, dict) for item in content):
        return _item(content, name, mesh)
    images = content if isinstance(content, dict) else {}
    if not images or not all(k.isdecimal() and isinstance(v, list) for k, v in images.items()):
        return content
    image, _, index = name.partition(":")
    if not image and len(images) == 1:
        (image,) = images
    chosen = {key.lstrip("0"): value for key, value in images.items()}.get(image.lstrip("0"))
    if chosen is None or not image:
        raise InvalidInputError(
            f"poses of several images; choose one as FILE:IMAGE_ID from {listed(images)}"
        )
    return _item(chosen, index, mesh)


def _item(items: Sequence[Any], name: str, mesh: str) -> Any:
    """The pose of a list with this label or index, or of the mesh's number; the only one without a
    name."""
    number = re.search(r"obj_(\d+)$", mesh)
    fields = [item if isinstance(item, dict) else {} for item in items]
    labels = [str(item.get("label", "")) for item in fields]
    objects = [item.get("obj_id") for item in fields]
    of_object = ""
    if name and name not in labels:
        chosen = [int(name)] if name.isdecimal() and int(name) < len(items) else []
    elif name:
        chosen = [k for k, label in enumerate(labels) if label == name]
    elif number and None not in objects:
        of_object = f" of object {int(number[1])}"
        chosen = [k for k, one in enumerate(objects) if one == int(number[1])]
    else:
        own = [k for k, label in enumerate(labels) if label and label == mesh]
        chosen = own or [*range(len(items))]
    if len(chosen) != 1:
        names = listed(label or index for index, label in enumerate(labels))
        raise InvalidInputError(
            f"expected one pose{of_object}, got {len(chosen)} of {len(items)}; choose one as "
            f"FILE:NAME: {names}"
        )
    return items[chosen[0]]


def _pose_matrix(numbers: Sequence[Any]) -> Floats:
    """(4, 4) of 12 or 16 numbers row by row; or of 16 column by column, which have 0 0 0 1 in the
    last column and the translation in the last row."""
    last = [0.0, 0.0, 0.0, 1.0]
    values = _numbers(numbers, "pose", len(numbers))
    T = np.append(values, last if len(values) == 12 else []).reshape(4, 4)
    is_by_column = T[:, 3].tolist() == last and T[3].tolist() != last
    T = np.ascontiguousarray(T.T) if is_by_column else T
    if T[3].tolist() != last:
        raise InvalidInputError(
            "pose: expected a last row of 0 0 0 1; give T_cam_from_model row by row"
        )
    return T


def _numbers(values: Any, name: str, count: int) -> Floats:
    """``count`` finite numbers of nested lists."""
    numbers = finite_numbers(flattened(values), count)
    if numbers is None:
        raise InvalidInputError(f"{name}: expected {count} finite numbers, got {values!r:.80}")
    return np.array(numbers)


def _transform(R: Floats, t: Floats) -> Floats:
    T = np.eye(4)
    T[:3, :3] = R.reshape(3, 3)
    T[:3, 3] = t
    return T


def _rotation_and_translation(record: Record) -> PoseRecord:
    if record.get("frame") == "world":
        raise InvalidInputError(
            "a result of several photographs, whose pose is in the world; give that in one "
            "camera, as in 'photographs'"
        )
    rotation = record.get("rotation", "R")
    translation = record.get("translation", "t")
    if translation is None and record.has("rotation") and record.has("translation"):
        raise InvalidInputError(
            "a result without a translation, as of a photograph without a camera; register with "
            "a camera first"
        )
    if rotation is None or translation is None:
        missing = "rotation of 3 x 3 numbers" if rotation is None else "translation"
        raise InvalidInputError(f"no {missing}; expected {FORMATS}")
    R = _numbers(rotation, "rotation", 9)
    t = _numbers(translation, "translation", 3)
    return PoseRecord(_transform(R, t), _own_unit(record), _confidence(record))


def _own_unit(record: Record) -> str | None:
    """The unit that a result of this library states; other files may mean something else by it."""
    unit = record.get("unit")
    return unit if record.has("schema") and isinstance(unit, str) and unit in UNITS else None


def _confidence(record: Record) -> float | None:
    numbers = finite_numbers([record.get("confidence")], 1)
    return numbers[0] if numbers else None


def _bop(record: Record) -> PoseRecord:
    """An entry of scene_gt.json: millimetres."""
    R = _numbers(record.get("cam_R_m2c"), "cam_R_m2c", 9)
    t = _numbers(record.get("cam_t_m2c"), "cam_t_m2c", 3)
    return PoseRecord(_transform(R, t), "mm")


def _megapose(record: Record) -> PoseRecord:
    """An entry of object_data.json: a quaternion x, y, z, w and metres, in the camera, which is the
    world."""
    numbers = _numbers(record.get("TWO"), "TWO", 7)
    if record.has("TWC"):
        raise InvalidInputError(
            "TWO: in the world of TWC; give the pose in the camera, TWC^-1 TWO, without TWC"
        )
    return PoseRecord(_transform(_rotation(numbers[:4], "TWO"), numbers[4:]), "m")


def _ros(record: Record) -> PoseRecord:
    """A PoseStamped, as ``--format ros`` writes it: metres, in the camera's optical frame."""
    header = record.inside("header")
    frame = str((header and header.get("frame_id")) or "")
    if "optical" not in frame.rpartition("/")[2] and _OTHER_FRAMES.search(frame):
        raise InvalidInputError(
            f"frame_id {frame!r:.60} is not the camera's optical frame (x right, y down, z "
            f"forward); transform the pose into that, as tf2 does"
        )
    pose = record.inside("pose")
    while pose is not None and pose.has("pose"):  # with a covariance beside it
        pose = pose.inside("pose")
    place = pose and pose.inside("position")
    turn = pose and pose.inside("orientation")
    if place is None or turn is None:
        raise InvalidInputError(
            "pose: expected position and orientation; or a matrix of 4 x 4 numbers"
        )
    t = _numbers([place.get(axis) for axis in "xyz"], "position", 3)
    q = _numbers([turn.get(axis) for axis in "xyzw"], "orientation", 4)
    return PoseRecord(_transform(_rotation(q, "orientation"), t), "m")


def _rotation(quaternion: Floats, name: str) -> Floats:
    """(3, 3) of x, y, z, w."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-2:
        raise InvalidInputError(
            f"{name}: expected a quaternion x, y, z, w of length 1, got {length:.3g}"
        )
    return np.asarray(quaternion_matrix(np.roll(quaternion, 1))[:3, :3])


_READERS: dict[str, Callable[[Record], PoseRecord]] = {
    "cam_R_m2c": _bop,
    "TWO": _megapose,
    "header": _ros,
}
"""Formats by a key that only they have."""
