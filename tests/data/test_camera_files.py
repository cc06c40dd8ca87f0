"""Calibration files as their tools write them, and damaged ones."""

import json

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import load_camera
from curvireg_torch.errors import MAX_CAMERA_BYTES, InvalidInputError
from tests._support.doubling import check_linear

K = np.array([[520.5, 0.0, 321.25], [0.0, 522.0, 238.5], [0.0, 0.0, 1.0]])
D = np.array([[-0.31, 0.12, 0.001, -0.002, 0.03]])

ROS = """image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [520.5, 0, 321.25, 0, 522, 238.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.31, 0.12, 0.001, -0.002, 0.03]
projection_matrix:
  rows: 3
  cols: 4
  data: [480, 0, 322, 0, 0, 500, 239, 0, 0, 0, 1, 0]
"""
ROS_MESSAGE = """header:
  stamp: {sec: 12, nanosec: 3}
  frame_id: "head"
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.31
- 0.12
- 0.001
- -0.002
- 0.03
k: [[520.5, 0.0, 321.25],
  [0.0, 522.0, 238.5], [0.0, 0.0, 1.0]]
binning_x: 0
roi:
  x_offset: 0
  do_rectify: false
---
height: 1
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.31, 0.12, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [520.5, 522.0, 321.25, 238.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.99, 0.0, 0.0, -0.1]
  - [0.0, 0.99, 0.0, 0.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.02, -0.01, 0.003, -0.001]
  distortion_model: equidistant
  intrinsics: [519.0, 519.0, 320.0, 240.0]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""
COLMAP = """#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 SIMPLE_PINHOLE 640 480 520.5 321.75 239
2 PINHOLE 640 480 520.5 522 321.75 239
3 SIMPLE_RADIAL 640 480 520.5 321.75 239 -0.31
4 RADIAL 640 480 520.5 321.75 239 -0.31 0.12
5 OPENCV 640 480 520.5 522 321.75 239 -0.31 0.12 0.001 -0.002
6 OPENCV_FISHEYE 640 480 520.5 522 321.75 239 0.02 -0.01 0.003 -0.001
"""


def check(camera, distortion, *, fy=522.0, model="radial-tangential", size=(480, 640)):
    expected = torch.from_numpy(K).clone()
    expected[1, 1] = fy
    torch.testing.assert_close(camera.matrix, expected)
    assert (camera.distortion, camera.model, camera.size) == (distortion, model, size)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
def test_opencv(tmp_path, suffix):
    file = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu 01 Jan 2026: [noon")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    if suffix != "json":
        storage.writeComment("flags: +zero_tangent_dist")
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", D)
    storage.write("image_points", np.random.default_rng(0).random((40, 2)).astype(np.float32))
    storage.release()
    check(load_camera(file), tuple(D[0]))


def test_opencv_with_other_keys_and_bop(tmp_path):
    file = tmp_path / "fisheye.yml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in {"cameraMatrix": K, "distCoeffs": D[0, :4], "fisheye_model": 1}.items():
        storage.write(name, value)
    storage.release()
    check(load_camera(file), tuple(D[0, :4]), model="fisheye", size=None)
    file.write_text(file.read_text().replace("fisheye_model: 1", "fisheye_model: 0"))
    check(load_camera(file), tuple(D[0, :4]), size=None)
    file = tmp_path / "python.json"
    file.write_text(json.dumps({"mtx": K.tolist(), "dist": D.tolist(), "image_size": [640, 480]}))
    check(load_camera(file), tuple(D[0]))
    bop = {"cx": 321.25, "cy": 238.5, "depth_scale": 1.0, "fx": 520.5, "fy": 522.0, "height": 480, "width": 640}
    file.write_text(json.dumps(bop))
    check(load_camera(file), ())


@pytest.mark.parametrize("text", [ROS, ROS_MESSAGE, ROS.replace("\n", "\r\n")], ids=["file", "message", "windows"])
def test_ros_camera_info(tmp_path, text):
    file = tmp_path / "camera_info.yaml"
    file.write_bytes(text.encode())
    check(load_camera(file), tuple(D[0]))


def test_other_models_of_ros(tmp_path):
    models = ("rational_polynomial", 8, "radial-tangential"), ("equidistant", 4, "fisheye")
    for ros_model, count, model in models:
        file, numbers = tmp_path / f"{ros_model}.yaml", tuple(0.01 * k for k in range(count))
        file.write_text(ROS.replace("plumb_bob", ros_model).replace(str(D[0].tolist()), str(list(numbers))))
        check(load_camera(file), numbers, model=model)


def test_kalibr(tmp_path):
    file = tmp_path / "camchain.yaml"
    file.write_text(KALIBR)
    check(load_camera(f"{file}:cam0"), tuple(D[0, :4]))
    camera = load_camera(f"{file}:cam1")
    assert (camera.model, camera.distortion) == ("fisheye", (0.02, -0.01, 0.003, -0.001))


def test_colmap_counts_from_the_corner_of_the_picture(tmp_path):
    file = tmp_path / "cameras.txt"
    file.write_text(COLMAP)
    check(load_camera(f"{file}:1"), (), fy=520.5)
    check(load_camera(f"{file}:2"), ())
    check(load_camera(f"{file}:3"), (-0.31, 0.0, 0.0, 0.0), fy=520.5)
    check(load_camera(f"{file}:4"), (-0.31, 0.12, 0.0, 0.0), fy=520.5)
    check(load_camera(f"{file}:5"), tuple(D[0, :4]))
    check(load_camera(f"{file}:6"), (0.02, -0.01, 0.003, -0.001), model="fisheye")


def test_malicious_files_are_refused(tmp_path):
    for name, content, words in (
        ("a.yaml", ROS.replace("plumb_bob", "double_sphere"), "'double_sphere' is not supported; choose from none"),
        ("a.json", '{"K": ' + "[" * 100_000 + "]" * 100_000 + "}", "damaged|nested too deeply"),
        ("a.xml", "<a>" * 100_000 + "</a>" * 100_000, "damaged|nested too deeply"),
        ("a.yaml", " " * (MAX_CAMERA_BYTES + 1), "larger than 4,194,304 bytes"),
    ):
        (tmp_path / name).write_text(content)
        with pytest.raises(InvalidInputError, match=words) as error:
            load_camera(tmp_path / name)
        assert str(error.value).startswith(f"{tmp_path / name}: ")
        assert "--camera exif" in str(error.value)


@pytest.mark.parametrize(
    ("head", "part", "end"),
    [
        ("K: ", "[", ""),
        ("K: ", "[1, ", ""),
        ("K: [", "[1], ", ""),
        ("K: [", "1, ", ""),
        ("K: [", "1, ", "]"),
        ("K: ", '"', ""),
        ("K: ", "\t", "x"),
        ("K: ", " #", ""),
        ("", "a:\n", ""),
        ("K:\n", "- 1\n", ""),
        ("", "---\n", ""),
        ("", "\n%", ""),
        ("", "1", " PINHOLE "),
        ("1 PINHOLE ", "1 ", ""),
        ("K: !", "!", ""),
        ("<a>", "<b/>", "</a>"),
    ],
)
def test_calibrations_are_read_in_linear_time(tmp_path, head, part, end):
    def make(count):
        (tmp_path / "cam").write_text(head + part * count + end)

    check_linear(lambda _: load_camera(tmp_path / "cam"), make, 20_000)


def test_messages_do_not_quote_lines_of_a_file_that_is_no_calibration(tmp_path):
    for content in (
        "TOKEN-hunter2\n",
        "[hunter2",
        "K: [hunter2",
        "x:\n  hunter2\n",
        "{hunter2",
        "<hunter2",
        "- hunter2",
    ):
        (tmp_path / "env").write_text(content)
        with pytest.raises(InvalidInputError) as error:
            load_camera(tmp_path / "env")
        assert "hunter2" not in str(error.value)
