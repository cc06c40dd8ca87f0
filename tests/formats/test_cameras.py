"""Calibration files as their tools write them, and damaged ones."""

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import load_camera
from curvireg_torch.errors import MAX_CAMERA_BYTES, InvalidInputError
from tests._support.calibrations import K, check_camera
from tests._support.doubling import check_linear
from tests._support.refusals import refused
from tests._support.tables import text_table

LENS = (-0.31, 0.12, 0.001, -0.002, 0.03)
FISHEYE = (0.02, -0.01, 0.003, -0.001)

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
7 FULL_OPENCV 640 480 520.5 522 321.75 239 -0.31 0.12 0.001 -0.002 0.03 0.5 0.6 0.7
8 RADIAL_FISHEYE 640 480 520.5 321.75 239 0.02 -0.01
9 FOV 640 480 520.5 522 321.75 239 0.1
"""


def check(camera, distortion, *, fy=522.0, **expected):
    matrix = K.copy()
    matrix[1, 1] = fy
    check_camera(camera, distortion, matrix=matrix, **expected)


def store(file, **values):
    """Write a file of OpenCV, with a comment where it may have one."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    if file.suffix != ".json":
        storage.writeComment("flags: +zero_tangent_dist")
    for name, value in values.items():
        storage.write(name, value)
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
def test_opencv(tmp_path, suffix):
    file = tmp_path / f"camera.{suffix}"
    store(
        file,
        calibration_time="Thu 01 Jan 2026: [noon",
        image_width=640,
        image_height=480,
        camera_matrix=K,
        distortion_coefficients=np.array([LENS]),
        image_points=np.random.default_rng(0).random((40, 2)).astype(np.float32),
    )
    check(load_camera(file), LENS)


def test_opencv_with_other_keys(tmp_path, read):
    file = tmp_path / "fisheye.yml"
    store(file, cameraMatrix=K, distCoeffs=np.array(LENS[:4]), fisheye_model=1)
    check(load_camera(file), LENS[:4], model="fisheye", size=None)
    text = file.read_text()
    for flag in ("0", "no", "Off", "false", '"0"'):
        other = text.replace("fisheye_model: 1", f"fisheye_model: {flag}")
        check(read(other, "fisheye.yml"), LENS[:4], size=None)


@pytest.mark.parametrize(
    "text", [ROS, ROS_MESSAGE, ROS.replace("\n", "\r\n")], ids=["file", "message", "windows"]
)
def test_ros_camera_info(write, text):
    file = write("camera_info.yaml", text.encode())
    check(load_camera(file), LENS)


def test_other_models_of_ros(read):
    models = ("rational_polynomial", 8, "radial-tangential"), ("equidistant", 4, "fisheye")
    for ros_model, count, model in models:
        numbers = tuple(0.01 * k for k in range(count))
        check(
            read(
                ROS.replace("plumb_bob", ros_model).replace(str(list(LENS)), str(list(numbers))),
                f"{ros_model}.yaml",
            ),
            numbers,
            model=model,
        )


def test_kalibr(write):
    file = write("camchain.yaml", KALIBR)
    check(load_camera(f"{file}:cam0"), LENS[:4])
    camera = load_camera(f"{file}:cam1")
    assert (camera.model, camera.distortion) == ("fisheye", FISHEYE)


def test_colmap_counts_from_the_corner_of_the_picture(write):
    file = write("cameras.txt", COLMAP)
    check(load_camera(f"{file}:1"), (), fy=520.5)
    check(load_camera(f"{file}:2"), ())
    check(load_camera(f"{file}:3"), (-0.31, 0.0, 0.0, 0.0), fy=520.5)
    check(load_camera(f"{file}:4"), (-0.31, 0.12, 0.0, 0.0), fy=520.5)
    check(load_camera(f"{file}:5"), LENS[:4])
    check(load_camera(f"{file}:6"), FISHEYE, model="fisheye")
    check(load_camera(f"{file}:7"), (*LENS, 0.5, 0.6, 0.7))
    check(load_camera(f"{file}:8"), (0.02, -0.01, 0.0, 0.0), fy=520.5, model="fisheye")
    with refused(r"line 10: expected CAMERA_ID MODEL .* FULL_OPENCV \(12\)"):
        load_camera(f"{file}:9")


def test_malicious_files_are_refused(tmp_path, write):
    for name, content, words in (
        (
            "a.yaml",
            ROS.replace("plumb_bob", "double_sphere"),
            "'double_sphere' is not supported; choose from none",
        ),
        (
            "a.json",
            '{"K": ' + "[" * 100_000 + "]" * 100_000 + "}",
            "cannot be read|nested too deeply",
        ),
        ("a.xml", "<a>" * 100_000 + "</a>" * 100_000, "cannot be read|nested too deeply"),
        ("a.yaml", " " * (MAX_CAMERA_BYTES + 1), "larger than 4,194,304 bytes"),
        ("a.yaml", "a: &a [1, 1]\nb: [*a, *a]\nK: [1]", "has aliases"),
        ("a.yaml", "a: " + "[" * 45 + "1" + "]" * 45, "no camera matrix"),
        ("a.yaml", "a: " + "[" * 55 + "1" + "]" * 55, "nested too deeply"),
        ("a.yaml", "a: " + "[" * 1000 + "]" * 1000, "nested too deeply|key: value"),
        ("a.yaml", "- " * 2000 + "1", "nested too deeply|key: value"),
        ("a.yaml", "version https://git-lfs.github.com/spec/v1\nsize 9\n", "pointer of Git LFS"),
        ("a.pkl", b"\x80\x04\x95\xff\x00", r"pickle is not read; save it as JSON: json\.dump"),
    ):
        write(name, content)
        with refused(words) as error:
            load_camera(tmp_path / name)
        assert str(error.value).startswith(f"{tmp_path / name}: ")
        assert error.value.kind == "calibration"
        assert "--" not in error.value.message, "options are of the command line"


MATRIX = K.tolist()
OWN = {"matrix": MATRIX, "distortion": LENS[:4], "model": "radial-tangential", "size": [480, 640]}


def test_numbers_alone_are_the_matrix(tmp_path, read):
    file = tmp_path / "cam_K.txt"
    homogeneous = np.eye(4)
    homogeneous[:3, :3] = K
    for matrix in (
        K,
        homogeneous,
        homogeneous[:3],
        K.T,
        homogeneous.T,
        np.array([[520.5, 522.0, 321.25, 238.5]]),
    ):
        np.savetxt(file, matrix, header="camera matrix")
        check(load_camera(file), (), size=None)
    check(read(str(MATRIX), "cam_K.txt"), (), size=None)
    np.save(tmp_path / "K.npy", K)
    check(load_camera(tmp_path / "K.npy"), (), size=None)
    with refused(r"line 1: expected 'key: value'|no camera matrix"):
        read("520.5 0 321.25 0 522", "cam_K.txt")


def test_yaml_of_pyyaml_and_of_other_tools(read):
    yaml = pytest.importorskip("yaml")
    content = {
        "camera_matrix": MATRIX,
        "dist_coeff": [[*LENS]],
        "image_width": 640,
        "image_height": 480,
    }
    for flow in (False, True, None):
        check(read(yaml.dump(content, default_flow_style=flow), "camera.yaml"), LENS)
    numbers = (
        "k2: 0.02, k3: -0.01, k4: 0.003, k5: -0.001, mu: 520.5, mv: 522, u0: 321.25, v0: 238.5"
    )
    fisheye = numbers.replace(", ", "\n   ")
    check(
        read(
            f"%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\nimage_width: 640\nimage_height: 480\n"
            f"projection_parameters:\n   {fisheye}\n",
            "camera.yaml",
        ),
        FISHEYE,
        model="fisheye",
    )


def test_arrays_of_objects_and_damaged_ones_are_refused(tmp_path, write):
    file = tmp_path / "B.npz"
    np.savez(file, mtx=np.array([K.tolist(), "text"], dtype=object))
    with refused("no camera matrix"):
        load_camera(file)
    np.save(tmp_path / "huge.npy", K)
    data = (tmp_path / "huge.npy").read_bytes().replace(b"(3, 3), ", b"(3, 3000000000), ".ljust(8))
    write("huge.npy", data)
    for damaged in (tmp_path / "huge.npy", file):
        damaged.write_bytes(damaged.read_bytes()[:150])
        with refused(r"damaged|larger than its file"):
            load_camera(damaged)


def test_stereo_calibrations_name_two_cameras(tmp_path, read):
    file = tmp_path / "intrinsics.yml"
    D = np.array([LENS])
    store(file, M1=K, D1=D, M2=2 * K - np.diag([0, 0, 1.0]), D2=2 * D)
    check(load_camera(f"{file}:1"), LENS, size=None)
    second = load_camera(f"{file}:2")
    assert second.distortion == tuple(2 * v for v in LENS)
    assert second.matrix[0, 0] == 1041.0
    with refused("several cameras; choose one as FILE:NAME from 1, 2"):
        load_camera(file)
    check(
        read(
            {"K_left": MATRIX, "D_left": LENS, "K_right": MATRIX, "D_right": LENS[:4], "R": [1]},
            part="left",
        ),
        LENS,
        size=None,
    )


SOURCES = """
given     | 0.0  | given
given     | 0.04 | given
estimated | 0.35 | estimated
exif      | 0.05 | given
"""


@pytest.mark.parametrize(("source", "deviation", "expected"), text_table(SOURCES))
def test_the_camera_of_a_result_is_as_uncertain_as_it_was(read, source, deviation, expected):
    own = {**OWN, "focal_deviation": deviation, "source": source}
    for content in (own, {"camera": own, "inputs": {"camera": None}}):
        camera = read(content, "result.json")
        assert (camera.focal_deviation, camera.source) == (deviation, expected)
        assert camera.size == (480, 640)


def test_metashape_counts_from_the_centre_and_swaps_the_tangential_coefficients(read):
    lens = "<k1>-0.31</k1><k2>0.12</k2><k3>0.03</k3><p1>-0.002</p1><p2>0.001</p2>"
    text = (
        "<?xml version='1.0'?><calibration><projection>frame</projection><width>640</width><height>480</height>"  # noqa: E501
        f"<f>522</f><cx>1.75</cx><cy>-1</cy><b1>-1.5</b1>{lens}<date>2026-01-01T00:00:00Z</date></calibration>"
    )
    check(read(text, "calibration.xml"), LENS)
    sensor = text.split("?>")[1].replace(
        "<width>640</width><height>480</height>", '<resolution width="640" height="480"/>'
    )
    other = sensor.replace("<f>522", "<f>999")
    check(
        read(
            f"<document><sensor label='a'>{sensor}</sensor><sensor "
            f"label='b'>{other}</sensor></document>",
            "calibration.xml",
            part="0",
        ),
        LENS,
    )
    for wrong in ("<b2>0.1</b2>", "<k4>0.1</k4>", "<p3>0.1</p3>"):
        with refused("of Metashape have no counterpart in OpenCV"):
            read(text.replace("<date>", f"{wrong}<date>"), "calibration.xml")
    check(
        read(
            text.replace("frame", "fisheye").replace(
                "<p1>-0.002</p1><p2>0.001</p2>", "<k4>-0.001</k4>"
            ),
            "calibration.xml",
        ),
        (-0.31, 0.12, 0.03, -0.001),
        model="fisheye",
    )


def test_ros_region_and_binning_are_applied(read):
    camera = read(
        ROS + "binning_x: 2\nbinning_y: 4\nroi: {x_offset: 100, y_offset: 40, width: 400, height: "
        "200}\n",
        "info.yaml",
    )
    assert camera.size == (50, 200)
    assert camera.distortion == LENS
    # The pixel (101, 40) of the sensor has its left edge at 100.5: the binned one at (0, 0) covers
    # it from 99.5 on.
    x = (321.25 - 99.5) / 2 - 0.5
    y = (238.5 - 39.5) / 4 - 0.5
    expected = torch.tensor([[260.25, 0, x], [0, 130.5, y], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(camera.matrix, expected)
    assert read(ROS + "roi:\n  x_offset: 100\n  y_offset: 40\n", "info.yaml").size == (440, 540)
    check(
        read(
            ROS + "binning_x: 1\nroi: {x_offset: 0, y_offset: 0, width: 0, height: 0}\n",
            "info.yaml",
        ),
        LENS,
    )


def test_ros_rectified_camera(read):
    with refused("projection matrix: expected 12 numbers, got 7"):
        read(ROS.replace(", 0, 0, 0, 1, 0]", "]"), "info.yaml", part="P")


def test_yaml_cannot_run_code(tmp_path, read):
    with refused("expected 9 numbers, or fx, fy, cx, cy, got 1"):
        read(f"a: !!python/object/apply:os.mkdir [{tmp_path}/made]\nfx: 1\n", "a.yaml")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "text",
    [
        "TOKEN=hunter2\nroot:x:0:0:root:/root\n",
        "TOKEN-hunter2\n",
        "hunter2: [",
        "K: [hunter2",
        "x:\n  hunter2\n",
        '{"hunter2": ',
        "{hunter2",
        "[hunter2",
        "<hunter2>",
        "<hunter2",
        "- hunter2",
        "hunter2\n",
    ],
)
def test_messages_quote_nothing_of_a_foreign_file(read, text):
    with pytest.raises(InvalidInputError) as error:
        read(text, "secrets")
    assert "hunter2" not in str(error.value)


def test_both_coordinates_of_the_principal_point_decide_the_order_of_the_sides(read):
    # 262 alone would say the other order
    for cx, cy, size in ((262.0, 238.5, (480, 640)), (238.5, 262.0, (640, 480))):
        for written in ([480, 640], [640, 480]):
            matrix = [[520.5, 0, cx], [0, 522.0, cy], [0, 0, 1]]
            assert read({"K": matrix, "resolution": written}).size == size


def test_distortion_beside_several_cameras_belongs_to_none_of_them(read):
    other = (2 * K - np.diag([0, 0, 1.0])).tolist()
    with refused("'dist': looks like distortion, but is not read"):
        read({"a": {"K": MATRIX}, "b": {"K": other}, "dist": LENS}, part="a")


REPEATED = r"""
"K: "         | "["     | ""
"K: "         | "[1, "  | ""
"K: ["        | "[1], " | ""
"K: ["        | "1, "   | ""
"K: ["        | "1, "   | "]"
"K: "         | "\""    | ""
"K: "         | "\t"    | "x"
"K: "         | " #"    | ""
""            | "a:\n"  | ""
"K:\n"        | "- 1\n" | ""
""            | "---\n" | ""
""            | "\n%"   | ""
""            | "1"     | " PINHOLE "
"1 PINHOLE "  | "1 "    | ""
"K: !"        | "!"     | ""
"<a>"         | "<b/>"  | "</a>"
"""
"""What precedes and follows the part that comes again and again."""


@pytest.mark.parametrize(("head", "part", "end"), text_table(REPEATED))
def test_calibrations_are_read_in_linear_time(tmp_path, write, head, part, end):
    def make(count):
        write("cam", head + part * count + end)

    check_linear(lambda _: load_camera(tmp_path / "cam"), make, 5_000)
