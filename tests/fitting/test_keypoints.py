from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import curvireg_torch as cr
from curvireg_torch.fitting import keypoints as keypoints_module
from curvireg_torch.fitting.keypoints import KeypointMatches, Keypoints, _pose
from curvireg_torch.fitting.least_squares import apply_twist
from curvireg_torch.geometry import box_iou, camera_matrix, projected_boxes, rotation_error
from curvireg_torch.geometry.cameras import project_points, transform
from curvireg_torch.geometry.viewpoint import rotation_from_viewpoint
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.mesh.mesh import as_mesh, extreme_points, mesh_centre
from curvireg_torch.pipeline import BankSettings, FitSettings
from curvireg_torch.registration import block, stages
from curvireg_torch.registration.confidence import KEYPOINT_PROBABILITY, detection_probability
from curvireg_torch.registration.detection import detect, propose
from curvireg_torch.registration.hypotheses import fit_poses, placed
from curvireg_torch.registration.photograph import as_photographs
from curvireg_torch.rendering import render_colour
from curvireg_torch.synthetic import procedural_background
from tests._support import (
    answer_of,
    bank_of,
    degrees_off,
    double,
    exact_registrar,
    eye,
    seeded,
    slow_after,
    zeros,
)

SIZE = (360, 480)
K = camera_matrix(520.0, 520.0, 239.5, 179.5)


def carton(seed=0):
    """A box with coloured bars and dots on every side, which are all different."""
    random = np.random.default_rng(seed)
    picture = np.full((384, 384, 3), 225, np.uint8)
    for _ in range(900):
        (x, y), (w, h) = random.integers(0, 384, 2), random.integers(3, 18, 2)
        picture[y : y + h, x : x + w] = random.integers(0, 230, 3)
    box = trimesh.creation.box((1.0, 0.7, 1.4))
    corners = box.vertices[box.faces].reshape(-1, 3)
    uv = np.zeros((len(corners), 2))
    for face, normal in enumerate(box.face_normals):
        axis = int(np.abs(normal).argmax())
        side = 2 * axis + (normal[axis] > 0)
        at = np.delete(corners[3 * face : 3 * face + 3], axis, axis=1) / 1.5 + 0.5  # in [0, 1]
        uv[3 * face : 3 * face + 3] = (at + np.array([side % 3, side // 3])) / np.array([3, 2])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(
        corners, np.arange(len(corners)).reshape(-1, 3), visual=visual, process=False
    )


@cache
def mesh():
    return as_mesh(carton())


def keypoints_of(mesh):
    """From half as many views as usual, which take seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keypoints_module, "VIEWS", 24)
        return Keypoints(ViewDescriber(mesh, BankSettings()))


@cache
def keypoints():
    return keypoints_of(mesh())


def registrar_of(**views):
    """One of the carton; its keypoints, which take seconds, are those above."""
    made = exact_registrar(bank_of(mesh(), cr.sample_views(**views)), mesh_is="exact")
    made._keypoints = keypoints()
    return made


def pose(azimuth, x=0.4, z=4.0):
    R = rotation_from_viewpoint(azimuth, 25.0, 10.0).double()
    return transform(R, double([x, 0.1, z]))


def photograph(*poses, shown=None):
    """(3, H, W) meshes in dim light, in front of clutter."""
    image = procedural_background(SIZE, seeded(3))
    for T in poses:
        picture = render_colour(shown or mesh(), T[None], K[None], SIZE)[0]
        image = torch.where(picture.amin(dim=0) < 0.999, 0.7 * picture + 0.05, image)
    noise = torch.randn(image.shape, generator=seeded(0))
    return (image + 0.02 * noise).clamp(0, 1)


def answer(registrar, T, **options):
    """The registration of a photograph of the carton at T."""
    return answer_of(registrar, photograph(T), box_of(T), K, **options)


def box_of(T):
    return projected_boxes(extreme_points(mesh()), T[None], K)[0].float()


def check_pose(found, T, degrees=3.0):
    assert rotation_error(found[:3, :3], T[:3, :3]) < degrees
    assert (found - T)[:3, 3].norm() < 0.02 * 4.0


@pytest.mark.parametrize("azimuth", slow_after(1, [20.0, 130.0, 250.0]))
@pytest.mark.parametrize("with_box", [True, False])
def test_pose_is_that_of_the_print(azimuth, with_box):
    T = pose(azimuth)
    box = box_of(T) if with_box else None
    found, counts = keypoints().matches(photograph(T), K, box).poses()
    assert bool((counts[1:] < 12).all())
    assert counts[0] >= 15
    check_pose(found[0], T, 2.0)


def test_photograph_may_be_large_and_of_any_dtype(monkeypatch):
    """Features are those of a smaller copy, in px of the photograph."""
    T = pose(20.0)
    image = (255.0 * photograph(T)).round().to(torch.uint8)
    monkeypatch.setattr(keypoints_module, "MAX_SIDE", 400)
    (found,), _ = keypoints().matches(image, K).poses()
    check_pose(found, T)


@pytest.mark.slow
def test_photograph_may_be_dark():
    T = pose(20.0, 0.3, 6.0)
    bright = photograph(T)
    dark = (255 * 0.1 * bright).round() / 255
    _, most = keypoints().matches(bright, K, box_of(T)).poses()
    found, counts = keypoints().matches(dark, K, box_of(T)).poses()
    assert counts[0] > 0.5 * most[0]
    assert rotation_error(found[0, :3, :3], T[:3, :3]) < 3.0
    # nor does one of a single colour fail
    assert not len(keypoints().matches(torch.full_like(bright, 0.3), K).uv)
    alone = render_colour(mesh(), T[None], K[None], SIZE)[0]
    alone = torch.where(alone.amin(dim=0) < 0.999, alone, torch.full_like(alone, 0.1))
    # the bright object covers 0.3 %
    wide = torch.nn.functional.pad(alone, (800, 800, 600, 600), value=0.1)
    moved = K + torch.tensor([[0, 0, 800], [0, 0, 600], [0, 0, 0]])
    _, counts = keypoints().matches(wide, moved).poses()
    assert counts[0] > 50


def test_each_copy_has_a_pose():
    there = [pose(20.0, -0.9, 4.5), pose(150.0, 0.9, 4.5)]
    found, counts = keypoints().matches(photograph(*there), K).poses()
    assert len(found) == 2
    assert counts[0] >= counts[1]
    errors = rotation_error(found[:, None, :3, :3], torch.stack(there)[:, :3, :3])
    assert sorted(errors.argmin(dim=1).tolist()) == [0, 1]
    assert errors.amin(dim=1).max() < 3.0


def test_nothing_is_found_where_the_print_is_not():
    T = pose(20.0)
    other = photograph(T, shown=as_mesh(carton(seed=1)))
    plain = torch.full((1, 40, 40), 0.5)
    missing = torch.full((3, 40, 40), torch.nan)
    for image, box in ((photograph(), None), (other, box_of(T)), (plain, None), (missing, None)):
        matches = keypoints().matches(image, K, box)
        assert [len(column) for column in matches.poses()] == [0, 0]
        assert float(matches.agreeing(T[None])) < 4


def test_keypoints_agree_with_the_poses_of_their_object():
    T = pose(20.0, -0.9, 4.5)
    other = pose(150.0, 0.9, 4.5)
    matches = keypoints().matches(photograph(T, other), K)
    off = torch.stack(
        [apply_twist(T[None], twist[None], mesh_centre(mesh()))[0] for twist in 0.4 * eye(6)]
    )
    counts = matches.agreeing(torch.stack([T, other, *off]))
    assert counts[:2].min() >= FitSettings().min_keypoints
    # about what a view of the mesh has, in which the print is in full view
    assert 0.5 * matches.per_view < counts[:2].min() < matches.per_view
    assert counts[2:].max() < 0.5 * float(counts[0])
    twice = replace(
        matches, uv=matches.uv.repeat(2, axis=0), points=matches.points.repeat(2, axis=0)
    )
    assert twice.agreeing(T[None]) == counts[0]
    assert matches.agreeing(-T[None]) < 4  # behind the camera


@pytest.mark.slow
def test_keypoints_decide_where_most_of_the_object_is_hidden():
    T = pose(65.0)
    image = photograph(T)
    box = box_of(T)
    hidden = slice(int(box[1] + 0.4 * (box[3] - box[1])), None)
    image[:, hidden] = photograph()[:, hidden]
    around = registrar_of(azimuth_step=90, elevations=[0, 45])
    result = answer_of(around, image, box, K)
    assert degrees_off(result, T) < 5.0
    first, *others = (h.evidence["keypoints"] for h in result.hypotheses)
    assert first > max(others)


def test_a_fit_that_leaves_the_keypoints_is_not_kept(monkeypatch):
    T = pose(65.0)

    def fit_elsewhere(describer, crops, poses, **options):
        fitted = fit_poses(describer, crops, poses, **options)
        twist = double([[0.0, 0.0, 1.5, 0.0, 0.0, 0.0]]).expand(len(fitted), 6)
        turned = apply_twist(fitted.T, twist, describer.centre)
        return placed(fitted, turned, describer.centre)

    monkeypatch.setattr(block, "fit_poses", fit_elsewhere)
    monkeypatch.setattr(stages, "fit_texture_of", lambda *_: None)
    result = answer(registrar(), T)
    assert degrees_off(result, T) < 3.0
    assert result.edge_support > 0.0
    assert result.covariance is not None


def test_a_pose_needs_enough_keypoints_at_different_places():
    points = np.random.default_rng(0).uniform(-1, 1, (14, 3))
    camera = K.numpy()
    seen = (points + np.array([0, 0, 6])) @ camera.T
    uv = seen[:, :2] / seen[:, 2:]
    assert _pose(points, uv, camera, 2.0, 8)[1] == 14
    assert _pose(points[:7], uv[:7], camera, 2.0, 8) is None
    assert _pose(points[:7], uv[:7], camera, 2.0, 7)[1] == 7
    twice = np.repeat(np.arange(7), 2)
    assert _pose(points[twice], uv[twice], camera, 2.0, 8) is None
    assert _pose(points[[0] * 14], uv[[0] * 14], camera, 2.0, 8) is None


@pytest.mark.slow
def test_origin_of_the_mesh_may_be_far_away():
    """Behind the camera, and a thousand object radii off."""
    T = pose(20.0)
    away = double([0.0, 0.0, 1000.0])
    moved = as_mesh(carton().apply_translation(away.numpy()))
    matches = keypoints_of(moved).matches(photograph(T), K)
    (found,), _ = matches.poses()
    found[:3, 3] += found[:3, :3] @ away
    check_pose(found, T, 2.0)


@cache
def registrar():
    """Of views from far away directions."""
    return registrar_of(azimuth_step=180, elevations=[-60])


def test_registration_starts_from_keypoints_too(monkeypatch):
    """No view of the bank is near the pose."""
    T = pose(65.0)
    assert degrees_off(answer(registrar(), T), T) < 1.0
    nothing = zeros(0, 4, 4), torch.zeros(0)
    monkeypatch.setattr(KeypointMatches, "poses", lambda *_: nothing)
    assert degrees_off(answer(registrar(), T), T) > 10.0


def test_a_pose_outside_the_limits_is_no_start():
    T = pose(65.0)
    other = pose(155.0)
    limits = cr.PosePrior(rotation=other[:3, :3], within=40.0)
    around = registrar_of(azimuth_step=60, elevations=[25])
    result = answer(around, T, prior=limits)
    assert min(float(degrees_off(h, T)) for h in result.hypotheses) > 40.0


def test_meshes_without_colours_and_photographs_without_a_camera_have_no_keypoints():
    T = pose(65.0)
    item = as_photographs([photograph(T)], box_of(T)[None], K)[0]
    grey = cr.Registrar(
        trimesh.creation.box(), views=cr.sample_views(azimuth_step=180, elevations=[0])
    )
    assert grey.keypoint_matches(item) is None
    assert registrar().keypoint_matches(replace(item, camera=None)) is None
    poses, count = block.keypoint_poses(grey, None)
    assert len(poses) == len(count) == 0


@pytest.mark.slow
def test_boxes_of_keypoints_are_the_first_proposals_less_certain_with_a_rival():
    T = pose(65.0)
    item = as_photographs([photograph(T)], None, K)[0]
    proposals = propose(registrar(), item)
    assert float(box_iou(proposals.boxes[:1], box_of(T)[None])) > 0.9
    counts = keypoints().matches(item.image, K).poses()[1].tolist()
    assert proposals.by_keypoints == len(counts)
    assert proposals.responses[: len(counts)].tolist() == counts
    (found,) = detect(registrar(), [item.image], K)[0]
    assert found.detection.score == detection_probability(
        counts[0], 0.5, rival=max(counts[1:], default=0)
    )
    near = replace(item, prior=cr.PosePrior(distance=(1.0, 2.0)))
    assert propose(registrar(), near).by_keypoints == 0
    assert len(proposals.boxes) == len(proposals.responses) == len(proposals.views) > 1
    # As two objects with similar prints do.
    alone, first, second = (
        detection_probability(n, 0.5, rival=m) for n, m in ((40, 0), (40, 20), (20, 40))
    )
    assert alone == KEYPOINT_PROBABILITY
    assert (first, second) == pytest.approx((0.8 * alone, 0.5 * alone))


def test_keypoints_are_where_the_mesh_shows_them():
    """Of several photographs: the median distance in px of matched features from their
    keypoints."""
    residuals = []
    for place in ((20.0, 0.4, 4.0), (75.0, -0.3, 3.2), (150.0, 0.1, 4.4), (260.0, -0.2, 3.5)):
        T = pose(*place)
        matches = keypoints().matches(photograph(T), K)
        away = matches.uv - project_points(torch.from_numpy(matches.points), T, K).numpy()
        residuals.append(np.median(away[np.linalg.norm(away, axis=1) < 3.0], axis=0))
    assert np.abs(np.mean(residuals, axis=0)).max() < 0.04
