"""Messages of ROS: what is read back is the pose, in metres, with the covariance in ROS's order."""

import argparse

import numpy as np
import pytest
import yaml

from curvireg_torch.data.poses import read_pose
from curvireg_torch.formats.exports.ros import FILES, time_stamp, write_ros
from tests._support.refusals import refused
from tests._support.tables import text_table

DOCUMENT = {
    "translation": [1000.0, -2000.0, 500.0],
    "quaternion": [0.8, 0.0, 0.6, 0.0],
    "unit": "mm",
    "frame": "camera",
    "covariance": None,
}


def written(folder, **changes):
    options = {name: changes.pop(name) for name in ("stamp", "frame", "child") if name in changes}
    write_ros(folder, {**DOCUMENT, **changes}, **options)
    files = {name: folder / name for name in FILES}
    return {name: yaml.safe_load(f.read_text()) for name, f in files.items() if f.exists()}


def test_pose_and_transform_are_in_metres_at_a_time(tmp_path):
    found = written(tmp_path, stamp=(1700000000, 5), frame="cam: 1", child="part 7")
    header = {"stamp": {"sec": 1700000000, "nanosec": 5}, "frame_id": "cam: 1"}
    position = {"x": 1, "y": -2, "z": 0.5}
    orientation = {"x": 0, "y": 0.6, "z": 0, "w": 0.8}
    assert found["pose.yaml"] == {
        "header": header,
        "pose": {"position": position, "orientation": orientation},
    }
    (one,) = found["tf.yaml"]["transforms"]
    assert one == {
        "header": header,
        "child_frame_id": "part_7",
        "transform": {"translation": position, "rotation": orientation},
    }
    assert set(found) == {"pose.yaml", "tf.yaml"}, "no covariance is invented"


def test_several_photographs_are_in_the_world(tmp_path):
    write_ros(tmp_path, {**DOCUMENT, "frame": "world"}, frame="camera_7")
    assert yaml.safe_load((tmp_path / "pose.yaml").read_text())["header"]["frame_id"] == "world"
    with refused("frame_id 'world' is not"):
        read_pose(tmp_path / "pose.yaml")


def test_the_covariance_has_positions_first_in_metres(tmp_path):
    ours = np.arange(36.0).reshape(6, 6)
    found = written(tmp_path, covariance=ours.tolist())["pose_with_covariance.yaml"]
    unit = np.repeat([1e-3, 1.0], 3)  # of positions, and of rotations
    expected = np.roll(ours, 3, axis=(0, 1)) * np.outer(unit, unit)
    np.testing.assert_allclose(found["pose"]["covariance"], expected.ravel())
    assert read_pose(tmp_path / "pose_with_covariance.yaml").T[:3, 3].tolist() == [1.0, -2.0, 0.5]


@pytest.mark.parametrize("text", ["-1", "now", "1e9", "3000000000", ""])
def test_stamps_are_seconds(text):
    assert time_stamp("1700000000.123456789") == (1700000000, 123456789)
    with refused("seconds since 1970", argparse.ArgumentTypeError):
        time_stamp(text)


FRAMES = """
camera_optical_frame | true
cam: 1               | true
linked               | true
camera_optical_link  | true
world                | false
robot/map            | false
camera_link          | false
base_footprint       | false
camera_color_frame   | false
odom_frame           | false
panda_link0          | false
tool0                | false
"""


@pytest.mark.parametrize(("frame", "is_optical"), text_table(FRAMES))
def test_a_start_in_another_frame_than_the_optical_one_is_refused(tmp_path, frame, is_optical):
    write_ros(tmp_path, DOCUMENT, frame=frame)
    if is_optical:
        assert read_pose(tmp_path / "pose.yaml").T[:3, 3].tolist() == [1.0, -2.0, 0.5]
        return
    with refused(f"frame_id '{frame}' is not the camera's optical"):
        read_pose(tmp_path / "pose.yaml")
