"""Distorted photographs give the poses of undistorted ones, and masks stand in for boxes and
predicted masks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from curvireg_torch import Camera, camera_matrix, project_points, render_depth
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import undistorted
from curvireg_torch.geometry.cameras import boxes_around
from curvireg_torch.registration import Follower, detect
from curvireg_torch.registration.photograph import as_photograph, as_photographs
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from tests._support import (
    CAMERA,
    SIZE,
    degrees_off,
    errors,
    eye,
    learned_registrar,
    refused,
    scene,
    seeded,
    slow_after,
    truck_answer,
    truck_registrar,
)

# The object, in the middle of the picture, is 20 degrees off its axis, where distortion moves it
OFF_CENTRE = camera_matrix(260.0, 260.0, 20.0, 30.0)
RADIAL = Camera(OFF_CENTRE, (-0.35, 0.12, 0.004, -0.003, 0.0), size=SIZE)
FISHEYE = Camera(OFF_CENTRE, (0.02, -0.01, 0.003, -0.001), "fisheye", SIZE)


def box_of(mask):
    """Of the white pixels of a mask (H, W)."""
    y, x = mask.nonzero().unbind(1)
    around = boxes_around(torch.stack([x, y], dim=1).float())
    return around + torch.tensor([-0.5, -0.5, 0.5, 0.5])


def distorted(camera, seed):
    """A photograph by a camera with distortion, the box and mask of the object in it, and the true
    pose."""
    generator = seeded(seed)
    T = random_pose(example_mesh(), OFF_CENTRE, SIZE, generator, elevations=(5.0, 50.0))
    ideal, _ = synthesize_photograph(example_mesh(), T, OFF_CENTRE, SIZE, generator)
    mask = (render_depth(example_mesh(), T, OFF_CENTRE, SIZE)[0, 0] > 0).float()
    K = camera.matrix.numpy()
    D = np.array(camera.distortion)
    columns, rows = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    if camera.model == "fisheye":
        source = cv2.fisheye.undistortPoints(pixels, K, D, P=K)
    else:
        source = cv2.undistortImagePoints(pixels, K, D, None, (3, 500, 1e-12))
    source = source.reshape(*SIZE, 2).astype(np.float32)
    planes = [cv2.remap(plane.numpy(), source, None, cv2.INTER_CUBIC) for plane in (*ideal, mask)]
    moved = torch.from_numpy(np.stack(planes)).clamp(0, 1)
    return ideal, moved[:3], box_of(moved[3] >= 0.5), moved[3], T


@pytest.mark.parametrize("camera", [RADIAL, FISHEYE], ids=["radial-tangential", "fisheye"])
@pytest.mark.parametrize("seed", slow_after(1, [1, 2]))
def test_distorted_photograph_gives_the_pose_of_the_true_camera(camera, seed):
    ideal, photo, box, _, T = distorted(camera, seed)
    true_box = undistorted(photo, camera, box).box[None]
    register = truck_registrar()
    angle, away = errors(register([ideal], true_box, OFF_CENTRE)[0], T)
    result, ignored = register([photo] * 2, torch.stack([box] * 2), [camera, OFF_CENTRE])
    assert not result.warnings
    assert torch.equal(result.projection[1], OFF_CENTRE)
    assert degrees_off(result, T) < angle + 0.3
    assert errors(result, T)[1] < away + 0.005
    assert errors(ignored, T)[1] > 0.02  # so the photograph needs it


@pytest.mark.slow
def test_detection_refinement_and_following_take_cameras():
    _, photo, box, _, T = distorted(RADIAL, 0)
    register = truck_registrar()
    assert errors(detect(register, [photo], RADIAL)[0][0], T)[1] < 0.02
    start = T.clone()
    start[0, 3] += 0.02 * start[2, 3]
    assert errors(register.refine([photo], RADIAL, [start])[0], T)[1] < 0.01
    follow = Follower(learned_registrar(), RADIAL)
    assert errors(follow(photo, box=box), T)[1] < 0.02
    assert errors(follow(photo), T)[1] < 0.02


def test_inverted_masks_and_boxes_that_the_camera_did_not_record_are_warned_of():
    camera = Camera(CAMERA, (1.5, 0.0, 0.0, 0.0), size=SIZE)
    photo = torch.rand(3, *SIZE)
    assert not as_photograph(photo, torch.tensor([0.0, 0.0, 60.0, 60.0]), camera).warnings
    item = as_photograph(photo, torch.tensor([-60.0, -60.0, 30.0, 30.0]), camera)
    assert "% of the box lie where the distorted photograph shows nothing" in item.warnings[0]
    mask = torch.zeros(SIZE)
    mask[20:140, 80:200] = 1.0
    assert not as_photograph(photo, None, mask=mask).warnings
    inverted = as_photograph(photo, None, mask=1.0 - mask)
    assert "must be white, not black" in inverted.warnings[0]


def test_mask_gives_the_box_and_the_outline():
    _, photo, box, mask, T = distorted(RADIAL, 2)
    (result,) = truck_registrar()([photo], None, RADIAL, masks=iter([mask]))
    assert degrees_off(result, T) < 1.0
    true_box = box_of(render_depth(example_mesh(), T, OFF_CENTRE, SIZE)[0, 0] > 0)
    assert_close(as_photograph(photo, None, RADIAL, mask=mask).box, true_box, atol=1.0, rtol=0)
    assert torch.equal(
        as_photograph(photo, box, RADIAL, mask=mask).box, undistorted(photo, RADIAL, box).box
    )


def test_mask_decides_which_edges_are_the_outline():
    image, box, T = scene(0)
    mask = render_depth(example_mesh(), T, CAMERA, SIZE)[0, 0] > 0
    register = truck_registrar()
    with_mask, wrong = register([image] * 2, box.repeat(2, 1), CAMERA, masks=[mask, ~mask])
    assert errors(with_mask, T)[1] < errors(truck_answer(), T)[1]
    assert not torch.equal(wrong.translation, with_mask.translation)
    query = register.matcher.query([image], box[None])
    crop = register.object_mask(query, [as_photograph(image, box, CAMERA, mask=mask)])
    assert crop.shape == (1, 1, 96, 96)
    assert 0.3 < crop.mean() < 0.7
    assert register.object_mask(query, [as_photograph(image, box, CAMERA)]) is None


def test_a_given_mask_replaces_the_predicted_one_of_the_box():
    image, box, _ = scene(0)
    register = learned_registrar()
    query = register.matcher.query([image], box[None])
    predicted, given = (
        register.object_mask(query, [as_photograph(image, box, CAMERA, mask=mask)])
        for mask in (None, torch.ones(SIZE))
    )
    assert_close(predicted, register.matcher.field.mask(query.crops), atol=1e-4, rtol=0)
    assert given.min() == 1.0


def test_masks_in_any_form_are_read_and_unusable_ones_named(tmp_path):
    mask = torch.zeros(40, 60, dtype=torch.bool)
    mask[10:30, 20:50] = True
    Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
    photo = torch.rand(3, 40, 60)
    file = tmp_path / "mask.png"
    turned = mask.flip(1).numpy()[:, ::-1]
    for form in (mask, 255 * mask.byte(), mask.byte(), mask.double().numpy(), file, turned):
        item = as_photograph(photo, None, mask=form)
        assert torch.equal(item.mask, mask.float())
        assert item.box.tolist() == [19.5, 9.5, 49.5, 29.5]
    whole = torch.ones(40, 60)
    beside = [[50.0, 0.0, 58.0, 9.0]]
    other_shape = r"expected shape \(40, 60\), that of the photograph, got \(60, 40\)"
    for mask, boxes, words in (
        (0.0 * whole, None, "mask: no white pixel; expected the object white"),
        (torch.eye(40, 60), beside, "mask: no white pixel in the box"),
        (whole.T, None, f"mask: {other_shape}"),
        (whole.long(), None, "mask: expected bool, uint8 or floating"),
        (whole.long().numpy(), None, r"a path, got int64 of shape \(40, 60\)"),
        (whole.numpy().astype(object), None, "mask: expected numbers of a dtype of torch"),
        (whole.to_sparse(), None, "mask: expected a dense tensor"),
        (255.0 * whole, None, "mask: expected values from 0 to 1"),
        ("no.png", None, "no.png: no such file"),
    ):
        (result,) = truck_registrar()([photo], boxes, masks=[mask])
        with refused(words, (InvalidInputError, FileNotFoundError)):
            _ = result.rotation


def test_an_empty_box_is_refused():
    """It is not a missing one, for which the object is searched for."""
    with refused("boxes: expected"):
        as_photographs([scene(0)[0]], [[]], CAMERA)


def test_camera_is_scaled_to_each_photograph():
    _, photo, box, _, _ = distorted(RADIAL, 1)
    half = torch.nn.functional.avg_pool2d(photo[None], 2)[0]
    items = as_photographs([photo, half], [box.tolist(), ((box + 0.5) / 2 - 0.5).tolist()], RADIAL)
    point = torch.tensor([[0.4, 0.2, 1.0]]).double()
    large, small = (project_points(point, eye(4), items[i].K) for i in (0, 1))
    assert_close((large + 0.5) / 2 - 0.5, small)
    assert_close((items[0].box + 0.5) / 2 - 0.5, items[1].box, atol=0.02, rtol=0)
    (error,) = as_photographs([photo[:, :90]], None, RADIAL)
    assert "calibrated for 240 x 180 px, but the photograph has 240 x 90 px" in str(error)
    with refused("expected 1, one for each image, got 2"):
        as_photographs([photo], None, [RADIAL, OFF_CENTRE])


def test_a_photograph_keeps_the_camera_whose_distortion_was_removed():
    photo = torch.rand(3, *SIZE)
    item = as_photograph(photo, None, replace(RADIAL, focal_deviation=0.1, source="exif"))
    assert torch.equal(item.image, undistorted(photo, RADIAL).image)
    assert (item.camera.distortion, item.has_box) == (RADIAL.distortion, False)
    pinhole = item.pinhole
    assert not pinhole.distorts
    assert (pinhole.matrix.tolist(), pinhole.size) == (RADIAL.matrix.tolist(), SIZE)
    assert (pinhole.focal_deviation, pinhole.source) == (0.1, "exif")
    other = item.by(CAMERA, source="estimated").camera
    assert torch.equal(other.matrix, CAMERA)
    assert (other.distortion, other.source) == (RADIAL.distortion, "estimated")
    unknown = as_photograph(photo, None)
    assert unknown.pinhole is None
    assert not unknown.has_estimated_camera
    usual = unknown.by(CAMERA, source="estimated")
    assert (usual.camera.size, usual.has_estimated_camera) == (SIZE, True)
    mask = torch.zeros(SIZE).index_fill(0, torch.arange(20, 60), 1.0)
    assert as_photograph(photo, None, mask=mask).has_box
