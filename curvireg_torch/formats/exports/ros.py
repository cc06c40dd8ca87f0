"""Poses as messages of ROS, in YAML: metres, in the camera's optical frame or in the world."""

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path

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
    w, x, y, z = document["quaternion"]
    metres = UNITS[document["unit"] or "m"]
    px, py, pz = (v * metres for v in document["translation"])
    position = f"{{x: {px:.9g}, y: {py:.9g}, z: {pz:.9g}}}"
    orientation = f"{{x: {x:.12g}, y: {y:.12g}, z: {z:.12g}, w: {w:.12g}}}"
    frame_id = _text("world" if document["frame"] == "world" else frame)
    child_id = _text(re.sub(r"[^\w/-]", "_", child))  # as names of ROS may be
    header = f"{{stamp: {{sec: {stamp[0]}, nanosec: {stamp[1]}}}, frame_id: {frame_id}}}"
    pose = f"{{position: {position}, orientation: {orientation}}}"
    transform = f"{{translation: {position}, rotation: {orientation}}}"
    texts = {
        "pose.yaml": f"header: {header}\npose: {pose}\n",
        "tf.yaml": f"transforms:\n- header: {header}\n  child_frame_id: {child_id}\n"
        f"  transform: {transform}\n",
    }
    if document["covariance"] is not None:
        covariance = ros_covariance(document["covariance"], metres)
        numbers = ", ".join(f"{value:.9g}" for row in covariance for value in row)
        texts["pose_with_covariance.yaml"] = (
            f"header: {header}\npose:\n  pose: {pose}\n  covariance: [{numbers}]\n"
        )
    for name in FILES:
        if name in texts:
            write_file(out / name, texts[name].encode())


def _text(name: str) -> str:
    """A name in YAML, in quotes where it would be read otherwise."""
    return name if re.fullmatch(r"[A-Za-z]\w*(/\w+)*", name) else json.dumps(name)


def ros_covariance(covariance: Sequence[Sequence[float]], metres: float) -> list[list[float]]:
    """6 x 6 numbers in the order of ROS, position before rotation, in m and rad, of 6 x 6 in that
    of ``result.json``, whose unit of length has so many ``metres``. Both are about the fixed axes
    of the frame, through the object's origin.

    Example:
        >>> ours = [[1.0 if i == j == 0 else 0.0 for j in range(6)] for i in range(6)]
        >>> ours[0][3] = ours[3][0] = 200.0
        >>> [row[3] for row in ros_covariance(ours, 0.001)]
        [0.2, 0.0, 0.0, 1.0, 0.0, 0.0]
    """
    scaled = [
        [
            value * (metres if i >= 3 else 1.0) * (metres if j >= 3 else 1.0)
            for j, value in enumerate(row)
        ]
        for i, row in enumerate(covariance)
    ]
    return [[scaled[i][j] for j in ORDER] for i in ORDER]
