"""Poses as messages of ROS, in YAML: metres, in the camera's optical frame or in the world."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from ...errors import InvalidInputError
from ...utils.aliases import Document
from ...utils.choices import UNITS
from ...utils.files import write_file

FILES = ("pose.yaml", "pose_with_covariance.yaml", "tf.yaml")
"""A geometry_msgs/PoseStamped, a geometry_msgs/PoseWithCovarianceStamped where the covariance is
known, and a tf2_msgs/TFMessage."""

OPTICAL_FRAME = "camera_optical_frame"
ORDER = (3, 4, 5, 0, 1, 2)  # of x, y, z and rotations about them, among our rotations, x, y, z


def time_stamp(text: str) -> tuple[int, int]:
    """Type of an option: seconds and nanoseconds.

    Example:
        >>> time_stamp("1700000000.25"), time_stamp("3")
        ((1700000000, 250000000), (3, 0))
    """
    found = re.fullmatch(r"(\d{1,10})(?:\.(\d{1,9})\d*)?", text)
    if found is None or int(found[1]) >= 2**31:
        raise argparse.ArgumentTypeError(f"expected seconds since 1970, got {text[:40]!r}")
    return int(found[1]), int((found[2] or "").ljust(9, "0"))


def write_ros(
    out: Path,
    document: Document,
    *,
    stamp: tuple[int, int] = (0, 0),
    frame: str = OPTICAL_FRAME,
    child: str = "object",
) -> None:
    """Write the ``FILES`` of a result into the folder ``out``.

    Args:
        out: the folder.
        document: the content of ``result.json``.
        stamp: seconds and nanoseconds at which the photograph was taken.
        frame: of the camera; that of several photographs is called world.
        child: frame of the object in the TFMessage.

    Raises:
        InvalidInputError: the pose has no translation.
        OutputError: a file cannot be written.
    """
    if document["translation"] is None:
        raise InvalidInputError("--format ros: a pose without translation; give a camera")
    metres = UNITS[document["unit"] or "m"]
    position = dict(zip("xyz", (metres * x for x in document["translation"]), strict=True))
    w, *vector = document["quaternion"]
    orientation = dict(zip("xyzw", (*vector, w), strict=True))
    header = {
        "stamp": dict(zip(("sec", "nanosec"), stamp, strict=True)),
        "frame_id": "world" if document["frame"] == "world" else frame,
    }
    pose = {"position": position, "orientation": orientation}
    transform = {
        "header": header,
        "child_frame_id": re.sub(r"[^\w/-]", "_", child),  # as names of ROS may be
        "transform": {"translation": position, "rotation": orientation},
    }
    contents = {
        "pose.yaml": {"header": header, "pose": pose},
        "tf.yaml": {"transforms": [transform]},
    }
    if document["covariance"] is not None:
        rows = _ros_covariance(document["covariance"], metres)
        covariance = [number for row in rows for number in row]
        message = {"header": header, "pose": {"pose": pose, "covariance": covariance}}
        contents["pose_with_covariance.yaml"] = message
    for name, content in contents.items():
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
        write_file(out / name, text.encode())


def _ros_covariance(covariance: Sequence[Sequence[float]], metres: float) -> list[list[float]]:
    """6 x 6 numbers in the order of ROS, position before rotation, in m and rad, of 6 x 6 in that
    of ``result.json``, whose unit of length has so many ``metres``. Both are about the fixed axes
    of the frame, through the object's origin.

    Example:
        >>> ours = [[1.0 if i == j == 0 else 0.0 for j in range(6)] for i in range(6)]
        >>> ours[0][3] = ours[3][0] = 200.0
        >>> [row[3] for row in _ros_covariance(ours, 0.001)]
        [0.2, 0.0, 0.0, 1.0, 0.0, 0.0]
    """
    scale = (1.0, 1.0, 1.0, metres, metres, metres)
    return [[covariance[i][j] * (scale[i] * scale[j]) for j in ORDER] for i in ORDER]
