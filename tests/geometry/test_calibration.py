import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.geometry import Camera, camera_matrix, project_points, undistorted
from tests._support import double, eye, refused, seeded
from tests._support.tables import text_table

SIZE = (120, 160)
MATRIX = camera_matrix(110.0, 112.0, 77.0, 61.0)
RADIAL = Camera(MATRIX, (-0.3, 0.1, 0.003, -0.002, 0.01), size=SIZE)
TILTED = Camera(
    MATRIX,
    (-0.2, 0.05, 0.001, 0.001, 0, 0.1, 0, 0, 0.01, 0.001, 0.02, 0.003, 0.01, -0.02),
    size=SIZE,
)
FISHEYE = Camera(MATRIX, (0.02, -0.01, 0.003, -0.001), "fisheye", SIZE)


@pytest.mark.parametrize("camera", [RADIAL, TILTED, FISHEYE], ids=["radial", "tilted", "fisheye"])
def test_photograph_and_box_are_undistorted_as_by_opencv(camera):
    image = torch.rand(3, *SIZE, generator=seeded(0))
    box = torch.tensor([12.0, 8, 150, 100])
    K = camera.matrix.numpy()
    D = np.array(camera.distortion)
    pixels = image.permute(1, 2, 0).numpy()
    side = np.linspace(0.0, 1.0, 500)
    outline = [(12 + 138 * s, y) for s in side for y in (8, 100)] + [
        (x, 8 + 92 * s) for s in side for x in (12, 150)
    ]
    points = np.array(outline, np.float64)[:, None]
    if camera.model == "fisheye":
        expected = cv2.fisheye.undistortImage(pixels, K, D, Knew=K)
        points = cv2.fisheye.undistortPoints(points, K, D, P=K)[:, 0]
    else:
        expected = cv2.undistort(pixels, K, D)
        points = cv2.undistortImagePoints(points, K, D, None, (3, 500, 1e-12))[:, 0]
    seen = undistorted(image, camera, box)
    assert not seen.missing.any()
    assert_close(seen.image, torch.from_numpy(expected).permute(2, 0, 1), atol=0.05, rtol=0)
    assert undistorted(image.double(), camera).image.dtype == torch.float64
    in_bytes = undistorted((image * 255).round().byte(), camera).image
    assert in_bytes.dtype == torch.uint8
    assert_close(in_bytes.float() / 255, seen.image, atol=2 / 255, rtol=0)
    around = torch.tensor([*points.min(axis=0), *points.max(axis=0)]).float()
    assert_close(seen.box, around, atol=0.01, rtol=0)
    beyond, border = (
        undistorted(image, camera, torch.tensor([x, 8.0, 150, 100])).box for x in (-40.0, -0.5)
    )
    assert float(beyond[0]) == pytest.approx(float(border[0]) - 39.5, abs=0.1)


def test_pixels_beyond_the_valid_radius_repeat_its_border():
    # r - 0.5 r^3 grows up to r = 0.816, and falls beyond: rays at the corners would show the centre
    # again.
    camera = Camera(camera_matrix(60.0, 60.0, 79.5, 59.5), (-0.5, 0.0, 0.0, 0.0))
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    radius = torch.hypot(u - 79.5, v - 59.5) / 100
    seen = undistorted(radius[None], camera)
    beyond = torch.hypot(u - 79.5, v - 59.5) > 0.8165 * 60
    assert torch.equal(seen.missing, beyond)
    largest = 0.8165 * (1 - 0.5 * 0.8165**2) * 60 / 100
    assert (seen.image[0][beyond] - largest).abs().max() < 0.01
    folded = cv2.undistort(radius.numpy(), camera.matrix.numpy(), np.array(camera.distortion))
    assert folded[beyond.numpy()].min() < 0.05  # the centre again


def test_boxes_outside_of_what_is_shown_are_refused():
    camera = Camera(camera_matrix(60.0, 60.0, 79.5, 59.5), (0.0,) * 4, "fisheye")
    with refused(r"box \(0, 0, 15, 15\): outside .* too far from the optical axis"):
        undistorted(torch.zeros(1, *SIZE), camera, torch.tensor([0.0, 0, 15, 15]))
    with refused("entirely outside the 160 x 120 image"):
        undistorted(torch.zeros(1, *SIZE), camera, torch.tensor([200.0, 0, 300, 15]))


CAMERAS = r"""
{"distortion": [0.1, 0.2]}           | expected 0 or 4 or 5 or 8 or 12 or 14 finite coefficients
{"distortion": ["a", "a", "a", "a"]} | distortion: expected numbers
{"model": "fisheye"}                 | expected 4 finite coefficients
{"matrix": [[1]]}                    | camera matrix: expected shape \(3, 3\)
{"size": [0, 640]}                   | size of the image
{"size": [480, 640, 3]}              | size: expected height and width in px, got \[480, 640, 3\]
"""


@pytest.mark.parametrize(("arguments", "words"), text_table(CAMERAS))
def test_what_is_no_camera_is_refused(arguments, words):
    with refused(words):
        Camera(**{"matrix": MATRIX, **arguments})


@pytest.mark.parametrize("as_given", [np.array, torch.tensor, lambda x: np.array([x]).T])
def test_coefficients_may_be_arrays_such_as_those_of_opencv(as_given):
    camera = Camera(MATRIX, as_given([-0.3, 0.1, 0.0, 0.0]))
    assert camera.distortion == pytest.approx((-0.3, 0.1, 0.0, 0.0))


def test_camera_of_a_resized_photograph():
    small = RADIAL.at((60, 80))
    points = double([[0.3, -0.2, 1.0], [-0.5, 0.4, 2.0]])
    large = project_points(points, eye(4), MATRIX)
    pose = eye(4)
    # The corner of the picture, (-0.5, -0.5) in px, is the same point in both.
    assert_close(project_points(points, pose, small.matrix), (large + 0.5) / 2 - 0.5)
    assert (small.size, small.distortion) == ((60, 80), RADIAL.distortion)
    assert RADIAL.at((40, 53)).size == (40, 53)  # 53.3, rounded
    with refused(r"calibrated for 160 x 120 px, .* has 160 x 90 px, .* uncropped"):
        RADIAL.at((90, 160))
    with refused(r"has 120 x 160 px, .*turn the photograph by 90 degrees"):
        RADIAL.at((160, 120))


def test_sides_are_scaled_on_their_own_when_a_resized_picture_is_rounded():
    camera = Camera(camera_matrix(500.0, 500.0, 319.5, 239.5), size=(480, 640))
    small = camera.at((7, 9))  # 6.75 x 9, or 7 x 9.33
    x = 9 / 640
    y = 7 / 480
    assert_close(small.matrix, camera_matrix(500 * x, 500 * y, 320 * x - 0.5, 240 * y - 0.5))


@pytest.mark.parametrize(
    ("calibrated", "size"), [((10, 1000), (50, 4996)), ((1000, 10), (4996, 50))]
)
def test_one_side_may_be_rounded_by_what_the_other_is_many_pixels_of(calibrated, size):
    camera = Camera(camera_matrix(500.0, 500.0, 4.5, 4.5), size=calibrated)
    # 50 x 5000 within a pixel of the short side, not of the long one
    assert camera.at(size).size == size
    with refused("another aspect ratio"):
        camera.at((size[0] + 2, size[1] + 2))
