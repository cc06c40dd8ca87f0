"""Calibration files of further tools, each in the form in which the tool writes it."""

import numpy as np
import pytest

from curvireg_torch import load_camera
from tests._support.calibrations import VGA, K, check_camera
from tests._support.refusals import refused
from tests._support.tables import text_table

LENS = (-0.31, 0.12, 0.001, -0.002)
FLAT = {"fx": 520.5, "fy": 522.0, "cx": 321.25, "cy": 238.5}
SIZE = {"width": 640, "height": 480}
REALSENSE = {"ppx": 321.25, "ppy": 238.5, "fx": 520.5, "fy": 522.0, **SIZE}
BENT = (*LENS, 0.03)
MATRIX = K.tolist()
CORNER = {"fl_x": 520.5, "fl_y": 522.0, "cx": 321.75, "cy": 239.0, "w": 640, "h": 480}
FOUR = dict(zip(("k1", "k2", "p1", "p2"), LENS, strict=True))
ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 520.5
Camera.fy: 522.0
Camera.cx: 321.25
Camera.cy: 238.5
Camera.k1: -0.31
Camera.k2: 0.12
Camera.p1: 0.001
Camera.p2: -0.002
Camera.width: 640
Camera.height: 480
ORBextractor.nFeatures: 1000
"""
ORB_SLAM_3 = (
    ORB_SLAM.replace("Camera.", "Camera1.")
    .replace("Camera1.type", "Camera.type")
    .replace("Camera1.width", "Camera.width")
    .replace("Camera1.height", "Camera.height")
)
ANIPOSE = """# of aniposelib
[cam_0]
name = "A"
size = [ 640, 480,]
matrix = [ [ 520.5, 0.0, 321.25,], [ 0.0, 522.0, 238.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.31, 0.12, 0.001, -0.002, 0.0,]
rotation = [ 0.1, 0.2, 0.3,]

[metadata]
adjusted = false
"""
ZED = """[LEFT_CAM_HD]
fx=520.5
fy=522.0
cx=321.25
cy=238.5
k1=-0.31
k2=0.12
p1=0.001
p2=-0.002

[STEREO]
Baseline=120
"""


NO_LENS = {
    "my_distortion": [0.0, 0],
    "distance": 3.0,
    "distribution": [1],
    "undistorted": 1,
    "dist_b": "none",
    "k7": True,
}
JSON = {
    "width first": ({"K": MATRIX, "resolution": [640, 480]}, (), VGA),
    "single keys in a dict": ({**FLAT, "distortion_parameters": {**FOUR, "k3": 0.03}}, BENT, None),
    "camera in a dict": ({"dist": BENT, "intrinsics": FLAT, **SIZE}, BENT, VGA),
    "radial and tangential": (
        {
            "K": MATRIX,
            "RadialDistortion": [-0.31, 0.12, 0.03],
            "TangentialDistortion": [0.001, -0.002],
        },
        BENT,
        None,
    ),
    "radial alone": (
        {"K": MATRIX, "radial_distortion": [-0.31, 0.12]},
        (-0.31, 0.12, 0.0, 0.0),
        None,
    ),
    "realsense": ({**REALSENSE, "coeffs": BENT, "model": "brown_conrady"}, BENT, VGA),
    "realsense without distortion": (
        {**FLAT, "coeffs": [0.0] * 5, "model": "distortion.brown_conrady", "name": "D435", **SIZE},
        (0.0,) * 5,
        VGA,
    ),
    "bouguet": ({"fc": [520.5, 522.0], "cc": [321.25, 238.5], "kc": BENT}, BENT, None),
    "a camera's product name": ({**FLAT, "model": "Logitech C920", "distortion": None}, (), None),
    "unity": (
        {
            "focalLength": {"x": 520.5, "y": 522.0},
            "principalPoint": {"x": 321.25, "y": 238.5},
            "resolution": {"x": 640, "y": 480},
        },
        (),
        VGA,
    ),
    "arcore": (
        {
            "focalLength": [520.5, 522.0],
            "principalPoint": [321.25, 238.5],
            "imageDimensions": [640, 480],
        },
        (),
        VGA,
    ),
    "shape of an array": ({"K": MATRIX, "image_shape": [480, 640, 3]}, (), VGA),
    "height first": ({**FLAT, "image_shape": [480, 640]}, (), VGA),
    "size with the height first": ({**FLAT, "image_size": [480, 640]}, (), VGA),
    "not our matrix": ({"matrix": MATRIX, "size": [640, 480]}, (), VGA),
    "record3d": (
        {
            "K": K.T.flatten().tolist(),
            "w": 640,
            "h": 480,
            "perFrameIntrinsicCoeffs": [[520.5, 522.0, 321.25, 238.5]],
        },
        (),
        VGA,
    ),
    "inverse model without coefficients": (
        {**REALSENSE, "coeffs": [0.0] * 5, "model": "distortion.inverse_brown_conrady"},
        (0.0,) * 5,
        VGA,
    ),
    "python": ({"mtx": MATRIX, "dist": [BENT], "image_size": [640, 480]}, BENT, VGA),
    "bop": ({**FLAT, **SIZE, "depth_scale": 1.0}, (), VGA),
    "no distortion": ({"K": MATRIX, **NO_LENS}, (), None),
    "fisheye script": ({"DIM": [640, 480], "K": MATRIX, "D": BENT}, BENT, VGA),
    "ARKit": (
        {"intrinsicMatrix": MATRIX, "intrinsicMatrixReferenceDimensions": SIZE},
        (),
        VGA,
    ),
    "DepthAI": ({"K": MATRIX, "distortionCoeff": BENT, "cameraType": 0}, BENT, None),
    "realsense by number": ({**REALSENSE, "coeffs": BENT, "model": 4}, BENT, VGA),
    "realsense by a float": ({**REALSENSE, "coeffs": BENT, "model": 4.0}, BENT, VGA),
    "named like our model": (
        {"matrix": MATRIX, "model": "radial-tangential", "dist": BENT, **SIZE},
        BENT,
        VGA,
    ),
    "two coefficients": ({"K": MATRIX, "dist": [-0.31, 0.12]}, (-0.31, 0.12, 0.0, 0.0), None),
    "rational": (
        {**FLAT, "k1": -0.31, "k2": 0.12, "k4": 0.1, "distortion_model": "rational_polynomial"},
        (-0.31, 0.12, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0),
        None,
    ),
    "stereo rectified": ({"K": MATRIX, "D": BENT, "P1": [MATRIX[0] + [0.0]] * 3}, BENT, None),
    "metashape's covariance": (
        {"K": MATRIX, "D": BENT, "covariance": {"coeffs": [0.5, 0.1]}},
        BENT,
        None,
    ),
    "numbers of coefficients": (
        {"K": MATRIX, "D": BENT, "NumRadialDistortionCoefficients": 2},
        BENT,
        None,
    ),
}


NAMES = """
    dist_coeff dist_coef coeffs distortion_coefs distortion_parameters distCoeffs lens_distortion
"""
JSON |= {name: ({"camera_matrix": MATRIX, name: [BENT]}, BENT, None) for name in NAMES.split()}


@pytest.mark.parametrize(("content", "distortion", "size"), JSON.values(), ids=JSON)
def test_json_of_further_tools(read, content, distortion, size):
    check_camera(read(content), distortion, size)


REFUSED = [
    ({"K": MATRIX, "my_distortion": BENT}, "'my_distortion': looks like distortion"),
    ({"a": {"K": MATRIX}, "b": {"radial_terms": [0.1]}}, "'radial_terms': looks like"),
    ({"K": MATRIX, "lens": {"k1": -0.3}}, "'k1': looks like distortion"),
    ({**FLAT, "distortion": {**FOUR, "k9": 1}}, "'k9': looks like distortion"),
    ({"K": MATRIX, "dist": BENT, "distortion": [1.0, *BENT[1:]]}, "'dist': looks like distortion"),
    ({"K": MATRIX, "distortion_b": "-0.3 0.1"}, "'distortion_b': looks like distortion"),
    ({**FLAT, "coeffs": BENT, "model": "inverse_brown_conrady"}, "'inverse_brown_conrady' is not"),
    ({**CORNER, "k4": 0.1}, "k4 of nerfstudio"),
    ({**FLAT, **FOUR, "is_fisheye": True}, "a fisheye has k1, k2, k3, k4 alone"),
    (
        {**FLAT, "camera_model": "fisheye", "radial": [0.1, 0.2], "tangential": [0.1, 0.0]},
        "coefficients of the model 'fisheye'",
    ),
    (
        {**REALSENSE, "coeffs": BENT, "model": "RS2_DISTORTION_INVERSE_BROWN_CONRADY"},
        "INVERSE_BROWN_CONRADY' is not supported",
    ),
    ({**REALSENSE, "coeffs": BENT, "model": 2}, "'inversebrown' is not supported"),
    ({**REALSENSE, "coeffs": BENT, "model": 2.0}, "'inversebrown' is not supported"),
    ({"camera_type": "ds", "intrinsics": {**FLAT, "alpha": 0.6}}, "'ds' is not supported"),
    ({"camera_type": "ucm", "intrinsics": {**FLAT, "alpha": 0.6}}, "'ucm' is not supported"),
    ({"K": MATRIX, "xi": 0.9}, "'xi': looks like distortion"),
    ({"K": MATRIX, "D": BENT, "P1": [0.1, 0.2]}, "'P1': looks like distortion"),
    ({**FLAT, "k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}, "k1 to k4 without p1 and p2"),
    ({"K": MATRIX, "distortionCoeff": BENT, "cameraType": 3}, "'division' is not supported"),
]
FOREIGN = r"""
{"cameraFocalLength": 24.0, "cameraAperture": [20.9, 11.8]}          | Isaac Sim; write fx = wid
{"intrinsics": [{"width": "640", "pxFocalLength": "520", "type": "radial3"}]} | Meshroom; export them as COLMAP
{"android.lens.intrinsicCalibration": [520.5, 522, 321, 238, 0]}     | Camera2; write .* \(a, b, c, d, e\) as distortion_coefficients: \[a, b, d, e, c\]
{"K": [[520, 0, 321, 5], [0, 520, 238, 0], [0, 0, 1, 0]]}            | also moves the camera
{"K": [[520, 0, 0, 0], [0, 520, 0, 0], [321, 238, 1, 0], [5, 0, 0, 1]]} | also moves the camera
{"model_type": "MEI", "projection_parameters": {"gamma1": 1.0}}      | 'MEI' is not supported
{"camera_angle_x": 0.7, "frames": []}                                | no fl_x; without it, give the field of view
{"fl_x": 520.5, "w": 640, "h": 480}                                  | no cx and cy
{"K": [[0.8, 0, 0.5], [0, 1.1, 0.49], [0, 0, 1]], "width": 640, "height": 480} | in fractions of the picture, not in px
{"k": [0, 0, 0, 0, 0, 0, 0, 0, 0], "d": [], "width": 640, "height": 480} | a camera that is not calibrated
{"fx": 520.5, "fy": 522.0}                                           | got 2 of these; add cx, cy, in px
{"projection_type": "spherical", "focal": 0.8, "width": 640, "height": 480} | 'spherical' is not supported; choose from perspective, brown
{"projection_type": ["brown"], "focal": 0.8}                         | not supported; choose from perspective, brown
{"projection_type": "brown", "focal_x": 0.8}                         | no width, height
{"colmap": 5}                                                        | expected CAMERA_ID MODEL
{"lens": 50.0, "sensor_width": 36.0}                                 | no camera matrix
{"SensorWidth": 4096, "Intrinsics": {"ModelParameters": [0.5]}}      | no camera matrix
{"K": [520, 522, 321, 238], "fisheye": "perhaps"}                    | fisheye: expected yes or no, got 'perhaps'
"""  # noqa: E501


@pytest.mark.parametrize(("content", "words"), [*REFUSED, *text_table(FOREIGN)])
def test_what_cannot_be_read_is_named(read, content, words):
    """No distortion is dropped in silence."""
    with refused(words):
        read(content)


@pytest.mark.parametrize(
    ("key", "model", "room"), [("model", "Kannala Brandt4", 5), ("cameraType", 1, 14)]
)
def test_a_fisheye_may_have_room_for_more_coefficients(read, key, model, room):
    """As of librealsense and DepthAI."""
    name = {5: "coeffs", 14: "distortionCoeff"}[room]
    lens = [0.02, -0.01, 0.003, -0.001]
    content = {**REALSENSE, name: lens + [0.0] * (room - 4), key: model}
    check_camera(read(content), tuple(lens), VGA, model="fisheye")
    with refused("expected 4 finite coefficients"):
        read({**content, name: [*lens, *[0.5] * (room - 4)]})


def test_the_fisheye_of_basalt(read):
    lens = {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}
    inside = {"camera_type": "kb4", "intrinsics": {**FLAT, **lens}}
    camera = read({"value0": {"intrinsics": [inside], "resolution": [[640, 480]]}})
    check_camera(camera, tuple(lens.values()), VGA, model="fisheye")


def test_a_crop_keeps_the_order_of_a_size(read):
    """Its principal point is nearer to the centre of the turned picture."""
    K = [[520.5, 0.0, 200.0], [0.0, 522.0, 350.0], [0.0, 0.0, 1.0]]
    assert read({"matrix": K, "size": [640, 480]}).size == VGA


def test_comments_that_opencv_writes_into_json(write):
    text = f'{{\n    // flags: +fix_k3\n    "camera_matrix": {MATRIX}}}'
    check_camera(load_camera(write("a.json", text)), (), None)


@pytest.mark.parametrize("key", [{"fisheye": True}, {"distortion_model": "fisheye"}])
def test_the_model_in_arrays_of_numpy(tmp_path, key):
    lens = (0.02, -0.01, 0.003, -0.001)
    np.savez(tmp_path / "a.npz", K=K, D=lens, **key)
    check_camera(load_camera(tmp_path / "a.npz"), lens, None, model="fisheye")


OPENSFM = {
    "perspective": ({"focal": 0.8, "k1": -0.31, "k2": 0.12}, (0.8, 0.0, 0.0)),
    "brown": (
        {"focal_x": 0.8, "focal_y": 0.9, "c_x": 0.01, "c_y": -0.02, "k1": -0.31, "k2": 0.12},
        (0.9, 0.01, -0.02),
    ),
    "fisheye": ({"focal": 0.8, "k1": -0.31, "k2": 0.12}, (0.8, 0.0, 0.0)),
}


@pytest.mark.parametrize(("name", "values"), OPENSFM.items(), ids=OPENSFM)
@pytest.mark.parametrize(("width", "height"), [(640, 480), (480, 640)])
def test_opensfm_counts_in_longer_sides_from_the_centre(read, name, values, width, height):
    content, (fy, cx, cy) = values
    camera = {"projection_type": name, "width": width, "height": height, **content}
    found = read({"v2 unknown 640 480": camera})
    place = [width / 2 - 0.5 + 640 * cx, height / 2 - 0.5 + 640 * cy]
    expected = np.array([[512.0, 0.0, place[0]], [0.0, 640 * fy, place[1]], [0.0, 0.0, 1.0]])
    model = "fisheye" if name == "fisheye" else "radial-tangential"
    check_camera(found, (-0.31, 0.12, 0.0, 0.0), (height, width), matrix=expected, model=model)


def test_nerfstudio_fisheye(read):
    content = {**CORNER, "camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k4": -0.001}
    check_camera(read(content), (0.02, 0.0, 0.0, -0.001), VGA, model="fisheye")


def test_one_focal_length_counts_from_the_corner_unless_metashape_wrote_it(read):
    content = {"f": 520.5, "cx": 321.25, "cy": 238.5, **SIZE}
    square = np.diag([1.0, 520.5 / 522.0, 1.0]) @ K
    square[1, 2] = 238.5
    check_camera(read(content), (), VGA, matrix=square)
    of_metashape = {**content, "cx": 1.75, "cy": -1.0, "projection": "frame"}
    check_camera(read(of_metashape), (), VGA, matrix=square)


def test_what_nerfstudio_says_above_its_frames_counts_for_all(write):
    frames = [
        {**CORNER, "file_path": "a.jpg"},
        {**CORNER, "fl_x": 400.0, "file_path": "b.jpg"},
    ]
    content = {"camera_model": "OPENCV", **FOUR, "w": 640, "h": 480, "frames": frames}
    file = write("transforms.json", content)
    check_camera(load_camera(f"{file}:a.jpg"), LENS, VGA)
    assert float(load_camera(f"{file}:b.jpg").matrix[0, 0]) == 400.0


@pytest.mark.parametrize("text", [ORB_SLAM, ORB_SLAM_3], ids=["2", "3"])
def test_orb_slam(read, text):
    check_camera(read(text, "TUM1.yaml"), LENS, VGA)
    fisheye = text.replace("PinHole", "KannalaBrandt8").replace("p1:", "k3:").replace("p2:", "k4:")
    check_camera(read(fisheye, "TUM1.yaml"), LENS, VGA, model="fisheye")


def test_toml(read):
    check_camera(read(ANIPOSE, "calibration.toml", part="cam_0"), (*LENS, 0.0), VGA)
    check_camera(read(ZED, "SN1234.conf", part="LEFT_CAM_HD"), LENS, None)


def test_toml_that_takes_long_or_is_none_is_refused(read):
    deep = ".".join("a" * 200)
    for text, words in (
        (f"[a]\n{deep} = 1", "too large"),
        ("[a]\n" + "x = 1\n" * 10_000, "too large"),
        ("[image]\n\nwidth\n640\n", "neither TOML nor YAML"),
        ("[secret]\nsecret = 1\n[secret]\n", "neither TOML nor YAML"),
    ):
        with refused(words) as caught:
            read(text, "calibration.toml")
        assert "secret" not in str(caught.value)


def test_kitti_names_its_projection_matrices(write):
    row = "{} 0 321.25 {} 0 522 238.5 0 0 0 1 0"
    lines = [f"P{k}: {row.format(520.5 + k, offset)}" for k, offset in ((0, 0), (2, 44.9))]
    file = write("calib.txt", "\n".join([*lines, "R0_rect: 1 0 0 0 1 0 0 0 1"]))
    expected = K.copy()
    expected[0, 0] = 522.5
    check_camera(load_camera(f"{file}:P2"), (), None, matrix=expected)
    with refused("choose one as FILE:NAME from P0, P2"):
        load_camera(file)


def test_a_binary_model_of_colmap_is_named(write):
    file = write("cameras.bin", b"\1" + b"\0" * 60)
    with refused("colmap model_converter --output_type TXT"):
        load_camera(file)


def test_cameras_without_a_name_are_not_listed(write):
    inner = {**SIZE, "intrinsic_matrix": K.T.flatten().tolist()}
    file = write("intrinsic.json", {**inner, "color": {**inner, "color_mode": "MJPG"}})
    with refused(r"choose one as FILE:NAME from color$"):
        load_camera(file)
    check_camera(load_camera(f"{file}:color"), (), VGA)


MATLAB = {
    "FocalLength": [520.5, 522.0],
    "PrincipalPoint": [322.25, 239.5],
    "ImageSize": [480, 640],
    "RadialDistortion": [-0.31, 0.12],
    "TangentialDistortion": [0.001, -0.002],
    "Skew": 0,
}


@pytest.mark.parametrize(
    "matrix",
    [
        {},
        {"IntrinsicMatrix": [[520.5, 0, 0], [0, 522.0, 0], [322.25, 239.5, 1]]},
        {"K": [[520.5, 0, 322.25], [0, 522.0, 239.5], [0, 0, 1]]},
    ],
    ids=["lengths", "transposed", "K"],
)
def test_matlab_counts_from_one_and_has_rows_first(read, matrix):
    check_camera(read({**MATLAB, **matrix}), LENS, VGA)
    turned = {**MATLAB, "ImageSize": [640, 480], **matrix}
    assert read(turned).size == (640, 480), "whatever lies nearer to the principal point"
    with refused("'Skew': looks like distortion"):
        read({**MATLAB, "Skew": 0.5})


def test_a_camera_with_fx_is_none_of_metashape(read):
    values = {"f": 1.0, "type": "frame", "fx": 500.0, "fy": 400.0, "cx": 320.0, "cy": 240.0}
    assert read(values).matrix.diagonal().tolist() == [500.0, 400.0, 1.0]
