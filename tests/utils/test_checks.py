import math

import numpy as np
import pytest
import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch import geometry, metrics
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.terms import dilate_points
from curvireg_torch.utils.checks import (
    check_fraction,
    check_integer,
    check_number,
    check_pose,
    check_positive,
    check_rotation,
    check_square_pixels,
)
from tests.utils.conftest import CAMERA, Entries, changed, refused

BAD_CAMERAS = {
    "NaN": changed(CAMERA, (0, 2, math.nan)),
    "infinite": changed(CAMERA, (1, 1, math.inf)),
    "fx = 0": changed(CAMERA, (0, 0, 0.0)),
    "fy = 0": changed(CAMERA, (1, 1, 0.0)),
    "fx < 0": changed(CAMERA, (0, 0, -220.1)),
    "both < 0": changed(CAMERA, (0, 0, -220.1), (1, 1, -220.1)),
    "skew": changed(CAMERA, (0, 1, 0.5)),
    "last row": changed(CAMERA, (2, 0, 0.01)),
    "not scaled": 2.0 * CAMERA,
    "transposed": CAMERA.T.contiguous(),
}


@pytest.mark.parametrize("bad", BAD_CAMERAS)
def test_check_camera_matrix_runs_in_every_entry(entries: Entries, bad: str) -> None:
    for name, call in entries.cameras.items():
        error = refused(name, call, BAD_CAMERAS[bad], "camera.matri(x|ces): expected")
        assert isinstance(error, InvalidInputError)


def test_entries_accept_valid_cameras(entries: Entries) -> None:
    for call in entries.cameras.values():
        call(CAMERA)
        call(changed(CAMERA, (1, 1, 238.0)))  # 8 % apart


@pytest.mark.parametrize("fx", [195.0, 245.0])
def test_check_square_pixels_runs_where_views_are_compared(entries: Entries, fx: float) -> None:
    oblong = changed(CAMERA, (0, 0, fx))  # more than 10 % apart
    for name, call in entries.cameras.items():
        if name in entries.needs_square_pixels:
            refused(name, call, oblong, "square pixels.*resize")
        else:
            call(oblong)


def test_check_square_pixels_accepts_ten_per_cent() -> None:
    for ratio in (1.0 / 1.099, 1.0, 1.099):
        check_square_pixels(changed(CAMERA, (0, 0, 220.1 * ratio)))
    for ratio in (1.0 / 1.101, 1.101):
        with pytest.raises(InvalidInputError, match="square"):
            check_square_pixels(torch.stack([CAMERA, changed(CAMERA, (0, 0, 220.1 * ratio))]))


def bad_poses(T: Tensor) -> dict[str, Tensor]:
    def posed(R: Tensor) -> Tensor:
        return transform(R, T[:3, 3])

    shear = torch.eye(3, dtype=T.dtype)
    shear[0, 1] = 0.02
    return {
        "scaled up": posed(2.0 * T[:3, :3]),
        "scaled by 1 %": posed(1.01 * T[:3, :3]),
        "one axis scaled": posed(torch.diag(torch.tensor([1.0, 1.0, 1.02]).to(T)) @ T[:3, :3]),
        "mirrored": posed(torch.diag(torch.tensor([-1.0, 1.0, 1.0]).to(T)) @ T[:3, :3]),
        "inverted": posed(-T[:3, :3]),
        "sheared": posed(T[:3, :3] @ shear),
        "zero": posed(torch.zeros_like(T[:3, :3])),
        "NaN": changed(T, (1, 1, math.nan)),
        "infinite": changed(T, (0, 2, math.inf)),
    }


def test_check_pose_runs_in_every_entry(entries: Entries, pose: Tensor) -> None:
    other_rows = ((3, 0, 0.1), (3, 3, 2.0), (2, 3, math.inf))
    for T in (*bad_poses(pose).values(), *(changed(pose, row) for row in other_rows)):
        for name, call in entries.poses.items():
            refused(name, call, T, "expected (rigid|finite)")


def test_check_rotation_runs_in_every_entry(entries: Entries, pose: Tensor) -> None:
    for bad, T in bad_poses(pose).items():
        if bad not in ("NaN", "infinite"):  # these stand for missing estimates
            for name, call in entries.rotations.items():
                refused(name, call, T[:3, :3], "expected rotations")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_check_pose_accepts_rounded_poses(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    R = geometry.rotation_from_axis_angle(2.0 * torch.randn(500, 3, generator=generator, dtype=torch.float64))
    T = transform(R, torch.randn(500, 3, generator=generator, dtype=torch.float64)).to(dtype)
    check_pose(T, "T")
    check_rotation(T[:, :3, :3], "R")
    check_pose(torch.linalg.inv(T.double()), "T")
    check_pose(T[:0], "T")
    check_pose(T[0], "T")


def test_entries_accept_poses_rounded_to_float32(entries: Entries, pose: Tensor) -> None:
    T = pose.float().double()  # rounded
    for call in entries.poses.values():
        call(T)
    for call in entries.rotations.values():
        call(T[:3, :3])


def test_check_photograph_runs_in_every_entry(entries: Entries, photograph: tuple[Tensor, Tensor]) -> None:
    image = photograph[0]
    for bad in (image[0], image[:2], image.long(), image > 0.5, image[None], image[:, :0], "missing.png", None):
        for name, call in entries.photographs.items():
            refused(name, call, bad)


def test_as_boxes_and_as_camera_matrices_accept_tensors_arrays_and_lists(
    registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]
) -> None:
    image, box = photograph
    images, boxes = [image, image], torch.stack([box, box])
    expected = registrar(images, boxes, CAMERA.expand(2, 3, 3))[1]
    for as_boxes in (boxes.double(), [*boxes], boxes.tolist(), [*boxes.numpy()], boxes.numpy(), [box.tolist(), box]):
        assert torch.equal(registrar.matcher(images, as_boxes).scores, registrar.matcher(images, boxes).scores)
        torch.testing.assert_close(cr.crop_images(images, as_boxes)[0], cr.crop_images(images, boxes)[0])
        assert torch.equal(registrar(images, as_boxes, CAMERA)[1].rotation, expected.rotation)
    for K in (CAMERA, [CAMERA, CAMERA], [CAMERA.tolist()] * 2, [*CAMERA.expand(2, 3, 3).numpy()], CAMERA.numpy()):
        found = registrar(images, boxes, K)[1]
        assert torch.equal(found.rotation, expected.rotation)
        assert torch.equal(found.translation, expected.translation)


def test_as_boxes_refuses_other_values(entries: Entries) -> None:
    others = [["a", "b", "c", "d"]], [[1.0, 2.0, 3.0]], [[1.0, 2.0], [3.0, 4.0, 5.0]], [None], {"x": 1}
    others += np.array([[1, 2, 3, None]]), torch.ones(1, 4, dtype=torch.bool)
    for bad in (*others, [[9.0, 9.0, 3.0, 3.0]], [[math.nan, 0.0, 3.0, 3.0]]):
        for name, call in entries.boxes.items():
            refused(name, call, bad, "box")


def test_as_camera_matrices_refuses_other_values(registrar: cr.Registrar, photograph: tuple[Tensor, Tensor]) -> None:
    image, box = photograph
    for bad in ([None], "camera", [CAMERA, None], [[1.0, 2.0, 3.0]], [CAMERA, CAMERA[:2]], [CAMERA] * 3):
        with pytest.raises(InvalidInputError, match="camera_matrices: expected"):
            registrar([image, image], torch.stack([box, box]), bad)


def test_check_masks_refuses_other_shapes_and_dtypes() -> None:
    mask = torch.zeros(1, 9, 9, dtype=torch.bool)
    for bad in (mask[0], mask[None], mask.float(), mask.byte(), mask.numpy()):
        with pytest.raises(InvalidInputError, match=r"points: expected bool \(N, H, W\)"):
            dilate_points(bad, 2.0)
    depth = torch.rand(1, 1, 9, 9) + 1.0
    for bad in (torch.ones(9, 1, dtype=torch.bool)[:5], mask.float()):
        with pytest.raises(InvalidInputError, match="mask: expected bool"):
            cr.depth_curvilinear_saliency(depth, bad)
    with pytest.raises(InvalidInputError, match="photo: expected bool"):
        metrics.intersection_percentage(mask.float(), mask)


@pytest.mark.parametrize("wrong", ["1", None, True, math.nan, math.inf, 10**400, [1.0], torch.ones(2)])
def test_numbers_of_the_wrong_type_are_refused(wrong: object) -> None:
    for check in (check_number, check_positive, check_fraction):
        with pytest.raises(InvalidInputError, match="value: expected"):
            check(wrong, "value")


@pytest.mark.parametrize("wrong", [2.5, 2.0, "2", None, True, 0, -1, torch.tensor(3)])
def test_integers_of_the_wrong_type_are_refused(wrong: object) -> None:
    with pytest.raises(InvalidInputError, match="scales: expected an integer >= 1, got"):
        check_integer(wrong, "scales")
    assert check_integer(np.int64(3), "scales") == 3
