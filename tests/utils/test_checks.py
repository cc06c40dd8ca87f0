import math
import pickle

import numpy as np
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch import errors, geometry
from curvireg_torch.errors import ImageError, InvalidInputError
from curvireg_torch.utils import checks
from tests._support import double, eye, refused, seeded

CAMERA = cr.camera_matrix(220.1, 220.1, 63.5, 47.5)
POSE = geometry.transform(cr.rotation_from_viewpoint(30.0, 20.0), double([0.1, 0.2, 6.0]))


def changed(matrix, *changes):
    matrix = matrix.clone()
    for i, j, value in changes:
        matrix[i, j] = value
    return matrix


BAD_CAMERAS = {
    "NaN": changed(CAMERA, (0, 2, math.nan)),
    "infinite": changed(CAMERA, (1, 1, math.inf)),
    "fx = 0": changed(CAMERA, (0, 0, 0.0)),
    "fy < 0": changed(CAMERA, (1, 1, -220.1)),
    "skew": changed(CAMERA, (0, 1, 0.5)),
    "last row": changed(CAMERA, (2, 0, 0.01)),
    "not scaled": 2.0 * CAMERA,
    "transposed": CAMERA.T.contiguous(),
}


POINT = double([[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("bad", BAD_CAMERAS)
def test_what_is_no_camera_matrix_is_refused(bad):
    with refused("camera matrix: expected"):
        cr.project_points(POINT, POSE, BAD_CAMERAS[bad])


R = POSE[:3, :3]
BAD_ROTATIONS = {
    "scaled by 1 %": 1.01 * R,
    "one axis scaled": torch.diag(double([1.0, 1.0, 1.02])) @ R,
    "mirrored": torch.diag(double([-1.0, 1.0, 1.0])) @ R,
    "inverted": -R,
    "sheared": changed(eye(3), (0, 1, 0.02)) @ R,
    "zero": 0.0 * R,
}


@pytest.mark.parametrize("bad", BAD_ROTATIONS)
def test_what_is_not_rigid_is_refused(bad):
    R = BAD_ROTATIONS[bad]
    with refused("expected rotations"):
        cr.rotation_error(R, R)
    with refused("expected rigid"):
        cr.project_points(POINT, geometry.transform(R, POSE[:3, 3]), CAMERA)


def test_check_pose_refuses_other_rows_and_missing_values():
    for change in ((3, 0, 0.1), (3, 3, 2.0), (2, 3, math.inf), (1, 1, math.nan)):
        with refused(r"T: expected (rigid|finite)"):
            checks.check_pose(changed(POSE, change), "T")
    checks.check_rotation(changed(R, (1, 1, math.nan)), "R")  # a missing estimate


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_check_pose_accepts_rounded_poses(dtype):
    generator = seeded(0)
    R = geometry.rotation_from_axis_angle(
        2.0 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    )
    T = geometry.transform(R, torch.randn(500, 3, generator=generator, dtype=torch.float64)).to(
        dtype
    )
    checks.check_pose(T, "T")
    checks.check_rotation(T[:, :3, :3], "R")
    checks.check_pose(torch.linalg.inv(T.double()), "T")
    checks.check_pose(T[:0], "T")
    checks.check_pose(T[0], "T")


def test_check_photograph_and_check_pixels_refuse_other_images():
    image = torch.rand(3, 8, 9)
    checks.check_photograph(image)
    for bad in (
        image[0],
        image[:2],
        image.long(),
        image > 0.5,
        image[None],
        image[:, :0],
        "missing.png",
        None,
    ):
        with refused("images: expected"):
            checks.check_photograph(bad)
    checks.check_pixels(1.0005 * torch.ones(3, 2, 2), "of the box")
    for value, match in (
        (math.nan, "NaN or inf"),
        (-math.inf, "NaN or inf"),
        (1.01, "255"),
        (-0.01, "255"),
    ):
        with refused(match, ImageError):
            checks.check_pixels(torch.full((3, 2, 2), value), "of the box")


def test_as_boxes_and_as_camera_matrices_accept_tensors_arrays_and_lists_only():
    boxes = torch.tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    arrays = boxes.int().numpy(), boxes.numpy().astype(">f4"), boxes.flip(0).numpy()[::-1]
    for given in (boxes.double(), [*boxes], boxes.tolist(), [*boxes.numpy()], *arrays):
        assert torch.equal(checks.as_boxes(given, 2).float(), boxes)
    others = (
        [["a", "b", "c", "d"]],
        [[10**400, 0, 1, 1]],
        boxes[:1].to_sparse(),
        [[1.0, 2.0, 3.0]],
        [[1.0, 2.0], [3.0, 4.0, 5.0]],
        [None],
        {"x": 1},
    )
    for bad in (*others, np.array([[1, 2, 3, None]]), torch.ones(1, 4, dtype=torch.bool)):
        with refused("boxes: expected"):
            checks.as_boxes(bad, 1)
    for K in (CAMERA, [CAMERA.tolist()] * 2):
        assert torch.equal(checks.as_camera_matrices(K, 2), CAMERA.expand(2, 3, 3))
    for bad in ("camera", [[1.0, 2.0, 3.0]], [CAMERA] * 3):
        with refused("camera_matrices: expected"):
            checks.as_camera_matrices(bad, 2)


def test_numbers_and_integers_of_the_wrong_type_are_refused():
    for wrong in ("1", None, True, math.nan, math.inf, 10**400, [1.0], torch.ones(2)):
        for check in (checks.check_number, checks.check_positive, checks.check_fraction):
            with refused("value: expected"):
                check(wrong, "value")
    for wrong in (2.5, 2.0, "2", None, True, 0, -1, torch.tensor(3)):
        with refused("scales: expected an integer >= 1, got"):
            checks.check_integer(wrong, "scales")
    assert checks.check_integer(np.int64(3), "scales") == 3


@pytest.mark.parametrize(
    "name", [n for n in vars(errors) if n.endswith(("Error", "Warning")) and n[0] != "_"]
)
def test_errors_keep_message_and_subject(name):
    error = getattr(errors, name)("unusable; use another", subject="a.png")
    for copy in (
        error,
        pickle.loads(pickle.dumps(error)),
        type(error)("unusable; use another").with_subject("a.png"),
    ):
        assert str(copy) == "a.png: unusable; use another"
        assert (copy.message, copy.subject) == ("unusable; use another", "a.png")
    assert str(error.with_subject("image 3")) == "image 3: unusable; use another"
    assert str(type(error)("unusable")) == "unusable"


def test_copies_of_errors_are_their_own_beside_dask():
    pytest.importorskip("distributed", reason="the extra cluster")  # changes copies of errors
    error = ImageError("unusable", subject="a.png")
    assert str(error.with_subject("b.png")) == "b.png: unusable"
    assert str(error.of_image(2)) == "image 2: a.png: unusable"
    assert str(error) == "a.png: unusable"


def test_errors_carry_the_numbers_of_photographs():
    names = ["a.png", "b.png", "c.png"]
    error = InvalidInputError("unusable", subject="mask.png", kind="camera").of_image(2)
    assert str(error) == "image 2: mask.png: unusable"
    assert str(error.with_image_names(names)) == "c.png: mask.png: unusable"
    assert str(error.with_subject("photo.jpg")) == "photo.jpg: unusable"
    assert error.with_image_names(names).kind == "camera"
    pair = InvalidInputError("the same", images=(2, 0))
    assert str(pair.with_image_names(names)) == "c.png and a.png: the same"
    both = InvalidInputError("none", causes=[InvalidInputError("dark").of_image(1), pair])
    assert str(both) == "none: image 1: dark; image 2 and image 0: the same"
    named = pickle.loads(pickle.dumps(both)).with_image_names(names)
    assert str(named) == "none: b.png: dark; c.png and a.png: the same"
    assert both.causes[0].images == (1,)


def test_check_square_pixels_accepts_ten_per_cent():
    for ratio in (1.0 / 1.099, 1.0, 1.099):
        checks.check_square_pixels(changed(CAMERA, (0, 0, 220.1 * ratio)))
    for ratio in (1.0 / 1.101, 1.101):
        with refused("square"):
            checks.check_square_pixels(
                torch.stack([CAMERA, changed(CAMERA, (0, 0, 220.1 * ratio))])
            )


def test_numbers_of_a_tensor_stay_on_its_device():
    with torch.device("meta"):  # as with torch.set_default_device
        boxes = checks.as_boxes(torch.zeros(1, 4, device="cpu"), 1)
    assert boxes.device.type == "cpu"
