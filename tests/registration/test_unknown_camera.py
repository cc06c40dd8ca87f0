"""Cameras that are tried and focal lengths that are fitted, in closed cases."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.fitting.camera_fit import USUAL_FOCAL, CameraInformation, scaled_cameras
from curvireg_torch.fitting.least_squares import apply_twist
from curvireg_torch.geometry import Camera
from curvireg_torch.registration import camera as camera_module
from curvireg_torch.registration.photograph import Photograph
from tests._support import CAMERA, SIZE, double, refused, zeros
from tests._support.hypotheses import all_kept, competing, evidence_of, poses_at, target_of

NOTHING = None
CENTRE = double([0.3, -0.2, 0.4])
BOX = torch.tensor([60.0, 40.0, 180.0, 140.0])


def photographed(camera, prior=None):
    return Photograph(torch.zeros(3, *SIZE), BOX, camera, prior)


def poses_of(count):
    """Of the views 0, 1, ..., turned about the vertical axis."""
    return poses_at(*(70.0 * number for number in range(count)), centre=CENTRE)


def test_cameras_that_are_tried_have_all_fields_of_view():
    """Across the longer side."""
    for size in ((640, 480), (480, 640)):
        cameras = camera_module.possible_cameras(size)
        assert cameras[0][:2, 2].tolist() == [0.5 * (size[1] - 1), 0.5 * (size[0] - 1)]
        fields_of_view = [2.0 * math.degrees(math.atan(320.0 / float(K[0, 0]))) for K in cameras]
        assert fields_of_view == pytest.approx(camera_module.FIELDS_OF_VIEW)
    assert list(camera_module.FIELDS_OF_VIEW) == sorted(set(camera_module.FIELDS_OF_VIEW))
    assert fields_of_view[0] < 15.0
    assert fields_of_view[-1] > 80.0
    assert float(camera_module.usual_camera((480, 640))[0, 0]) == pytest.approx(USUAL_FOCAL * 640)


def test_the_angle_to_the_centre_of_the_box():
    box = torch.tensor([119.5 + 100, 89.5 - 20, 119.5 + 160, 89.5 + 20])
    item = Photograph(torch.zeros(3, *SIZE), box, Camera(CAMERA))
    expected = math.degrees(math.atan(130.0 / 260.0))
    assert camera_module.off_axis_angle(item) == pytest.approx(expected)


def test_starts_are_the_best_view_of_each_camera_and_the_best_views():
    """Of three cameras and four views; the short fits of the second camera reach most."""
    support = double([[0.20, 0.30, 0.10, 0.10], [0.50, 0.10, 0.45, 0.10], [0.10, 0.15, 0.10, 0.40]])
    ranked = support * 20.0 - torch.arange(4)
    found = [divmod(place, 4) for place in camera_module.best_of_fields(ranked, 2).tolist()]
    # the best view of each camera, and the third view with its best camera, the second best of all
    expected = [(1, 0), (1, 2), (0, 1), (2, 3)]
    assert found == sorted(expected, key=lambda place: -float(ranked[place]))
    every = camera_module.best_of_fields(ranked, 4)
    assert sorted((every % 4).tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize(("source", "factors"), [("estimated", [2, 1]), ("exif", [1])])
def test_unknown_focal_lengths_are_fitted_at_half_size_first(monkeypatch, source, factors):
    """Each fit moves the pose by 1 to the right, and adds 0.1 to log f."""
    poses = poses_of(1)
    fitted = []

    def problem(_, __, K, ___, *, factor=1):
        return SimpleNamespace(factor=factor, K=K, edge_support=lambda _: torch.ones(1))

    def fit(problem, T, *_):
        fitted.append(problem.factor)
        T = T.clone()
        T[0, 0, 3] += 1.0
        state = SimpleNamespace(T=T)
        return SimpleNamespace(problem=problem, state=state, log_factor=double([0.1]))

    def measured(_, state, support, __):
        return replace(poses.fit, transform=state.T, edge_support=support.double())

    monkeypatch.setattr(camera_module.ContourProblem, "of", problem)
    monkeypatch.setattr(camera_module, "fit_camera", fit)
    monkeypatch.setattr(camera_module, "measured_fit", measured)
    describer = SimpleNamespace(contours=None, centre=CENTRE)
    camera = Camera(CAMERA, focal_deviation=0.1, source=source)
    item = photographed(camera)
    found = camera_module.with_focal_length(describer, NOTHING, poses, item)
    assert fitted == factors
    assert float((found.T - poses.T)[0, 0, 3]) == len(factors)
    assert_close(found.cameras, scaled_cameras(poses.cameras, double([0.1 * len(factors)])))
    assert float(found.edge_support) == 1.0


def test_the_covariance_is_that_of_the_origin(monkeypatch):
    """With the motion of the centre and the rotation about it, of an origin beside the centre."""
    pose = replace(poses_of(1), covariance=zeros(1, 6, 6))
    motion = double([[0.02, -0.03, 0.01, 0.3, -0.1, 0.5]])
    one = double([1.0])
    information = CameraInformation(amount=one, scale=0.04 * one, step=one)
    problem = SimpleNamespace(state=lambda _: None)
    monkeypatch.setattr(camera_module.ContourProblem, "of", lambda *_: problem)
    monkeypatch.setattr(camera_module, "camera_information", lambda *_: (information, motion))
    describer = SimpleNamespace(contours=None, centre=CENTRE)
    item = photographed(Camera(CAMERA, focal_deviation=0.2))
    covariance, deviation = camera_module.focal_covariance(describer, NOTHING, pose, item)
    measured = camera_module.REPORTED_VARIANCE * 0.04
    variance = 1.0 / (1.0 / measured + 1.0 / 0.2**2)
    assert deviation == pytest.approx(math.sqrt(variance))
    step = 1e-6
    # a twist turns about the centre, and moves it
    moved = apply_twist(pose.T, step * motion, CENTRE)
    origin = (moved - pose.T)[:, :3, 3] / step
    expected = torch.cat([motion[:, :3], origin], dim=1)[0]
    assert_close(covariance[0], variance * expected[:, None] * expected, atol=1e-6, rtol=1e-4)


def refitted(monkeypatch, evidence, new, *, tried_cameras=True, outside=None):
    """Views that were fitted with their focal lengths, those that changed, and the evidence."""
    poses = poses_of(len(evidence))
    tried = []

    def fit(_, __, some, ___):
        tried.extend(some.view.tolist())
        return replace(some, cameras=2.0 * some.cameras)

    def measure(_, __, some):
        return replace(some, evidence=evidence_of(*[new[view] for view in some.view.tolist()]))

    monkeypatch.setattr(camera_module, "with_focal_length", fit)
    monkeypatch.setattr(camera_module, "with_evidence", measure)
    target = target_of(describer=SimpleNamespace(centre=CENTRE))
    block = SimpleNamespace(
        tried_cameras=torch.tensor([tried_cameras]),
        photographs=[SimpleNamespace(focal_deviation=0.1)],
        symmetries=None,
        keeps=all_kept,
    )
    before = competing(poses, evidence, outside)
    after = camera_module.with_fitted_focal_lengths(target, block, NOTHING, before)
    differ = (after.cameras != poses.cameras).flatten(1).any(dim=1)
    return tried, differ.nonzero()[:, 0].tolist(), after.evidence


def test_fitted_focal_lengths_may_lower_scores_a_little(monkeypatch):
    """By 0.2, which is 0.02 of similarity."""
    evidence = evidence_of(0.6, 0.9, 0.8)
    new = {0: 0.6, 1: 0.885, 2: 0.775}
    tried, changed, after = refitted(monkeypatch, evidence, new)
    assert (tried, changed) == ([1, 2], [1])
    assert after.similarity.tolist() == pytest.approx([0.6, 0.885, 0.8])
    assert refitted(monkeypatch, evidence, new, tried_cameras=False)[0] == [1], "of a known camera"
    tried, changed, _ = refitted(monkeypatch, evidence, new, outside=[False, True, False])
    assert (tried, changed) == ([2, 0], [0])
    assert refitted(monkeypatch, evidence, new, outside=[True, True, False])[0] == [2]
    close = evidence_of(0.7, 0.9, 0.8)
    assert refitted(monkeypatch, close, new)[0] == [1, 2, 0], "a close rival"


def test_fits_also_begin_from_the_focal_length_of_another_pose():
    """If it differs by more than 0.2 of log f; the first pose from that of the second such."""
    focal_lengths = 500.0 * double([9.0, 1.0, 1.1, 1.3, 0.7])
    chosen = torch.tensor([1, 2, 3, 4])
    index, starts = camera_module._focal_starts(chosen, focal_lengths)
    assert index.tolist() == [1, 2, 3, 4, 1, 3, 4]
    assert starts.tolist() == pytest.approx([500.0, 550.0, 650.0, 350.0, 650.0, 500.0, 500.0])
    alone = torch.tensor([2])
    assert camera_module._focal_starts(alone, focal_lengths)[0].tolist() == [2]


def test_only_the_best_pose_has_a_covariance_and_its_camera_is_the_photographs(monkeypatch):
    """The third pose is outside the limits, and the last one of a photograph of a known camera."""
    poses = poses_of(4)
    poses = replace(
        poses,
        cameras=scaled_cameras(poses.cameras, double([0.0, 0.1, 0.2, 0.3])),
        covariance=torch.ones(4, 6, 6).double(),
        evidence=evidence_of(0.7, 0.8, 0.9, 0.6),
        is_outside=torch.tensor([False, False, True, False]),
        photograph=torch.tensor([0, 0, 0, 1]),
    )
    best = torch.full((1, 6, 6), 2.0).double()
    monkeypatch.setattr(camera_module, "focal_covariance", lambda *_: (best, 0.07))
    target = target_of(describer=None)
    items = [photographed(Camera(CAMERA, focal_deviation=f)) for f in (0.1, 0.0)]
    block = SimpleNamespace(photographs=items, with_photographs=dict.items)
    ((p, item),), after = camera_module.with_focal_deviation(target, block, NOTHING, poses)
    assert p == 0
    assert item.focal_deviation == 0.07
    assert torch.equal(item.K, poses.cameras[1])
    assert after.covariance[[0, 2]].isnan().all()
    assert torch.equal(after.covariance[[1]], best)
    assert torch.equal(after.covariance[3], poses.covariance[3])


def test_limits_of_an_unknown_camera_are_wider_by_how_far_the_box_is_off_the_axis(monkeypatch):
    def limits(item, _, off_centre=0.0):
        return item, off_centre

    monkeypatch.setattr(camera_module, "Limits", limits)
    known = photographed(Camera(CAMERA), SimpleNamespace(distance=None))
    unknown = replace(known, camera=None)
    target = SimpleNamespace(bank=None, is_exact=True)
    similar = SimpleNamespace(bank=None, is_exact=False)
    for one, item in ((target, known), (similar, unknown)):
        assert camera_module.limits_of(one, item) == (item, 0.0)
    usual, off = camera_module.limits_of(target, unknown)
    assert torch.equal(usual.K, camera_module.usual_camera(SIZE))
    assert off == pytest.approx(camera_module.off_axis_angle(usual))
    with_distance = SimpleNamespace(distance=(1.0, 2.0))
    with refused("distance"):
        camera_module.limits_of(similar, replace(unknown, prior=with_distance))
