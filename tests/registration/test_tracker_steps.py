"""The tracker's steps in closed cases: predictions, keyframes, features, what is learned."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
import trimesh

from curvireg_torch.errors import ImageError
from curvireg_torch.fitting.contour_problem import ContourState
from curvireg_torch.fitting.least_squares import PointMatches
from curvireg_torch.fitting.regions import RegionModel
from curvireg_torch.geometry.framing import boxes_at
from curvireg_torch.registration import tracking
from curvireg_torch.registration.tracking import Tracker
from tests._support import double, eye, zeros
from tests.fitting.cube import pose

K = double([[200.0, 0, 99.5], [0, 200.0, 49.5], [0, 0, 1]])
SIZE = (100, 200)


def at(x=0.0, z=5.0):
    return pose([0.0, 0.0, 0.0], [x, 0.0, z])[None]


HULL = torch.from_numpy(trimesh.creation.box().vertices)
PLATE = HULL * torch.tensor([1.0, 1.0, 0.0])


def test_boxes_of_meshes_outside_the_image_mean_nothing():
    """A plate of 40 px, at pixels of its centre; and a cube that reaches behind the camera."""
    half = 20.0
    for pixel, visible in (
        (99.5, True),
        (-0.5 - half + 0.1, True),
        (-0.5 - half - 0.1, False),
        (199.5 + half - 0.1, True),
        (199.5 + half + 0.1, False),
    ):
        boxes, found = boxes_at(PLATE, at(x=(pixel - 99.5) / 40.0), K[None], SIZE)
        assert found.tolist() == [visible], pixel
        assert float(boxes[0, 0]) < float(boxes[0, 2])
    for z, visible in ((0.6, True), (0.4, False), (-5.0, False)):
        assert boxes_at(HULL, at(z=z), K[None], SIZE)[1].tolist() == [visible], z


def fitted(monkeypatch, keyframes, last, shift=100.0, *, stale=False):
    """Of each step of a fit: the weights of its matches, its crop's focal length, its radius in px.

    Of the ``keyframes`` the second is the nearest. The flow of number k in n levels has the weight
    10 k + n, finds a point on the ray (1, 1, 1), and moves the object by ``shift`` px in the first
    crop, whose focal length is 1 px; that of the second is 2 px. Steps leave a pose that is not
    quite rigid, and contours that are always, or never, ``stale``."""
    used = []
    problem = SimpleNamespace(
        state=lambda T: ContourState(T, T, None),
        with_current_contours=lambda state: replace(state, points="new") if stale else state,
    )
    crops = [
        SimpleNamespace(K=double([[[f, 0, 10.0], [0, f, 10.0], [0, 0, 1]]]), problem=problem)
        for f in (1.0, 2.0)
    ]

    def track(keyframe, frame, *_, levels):
        weight = double([[10.0 * keyframe + levels]])
        return PointMatches(torch.zeros(1, 1, 3), frame.K[:, None, :2].sum(dim=3), weight)

    def step(frame, state, corners, radius):
        assert (corners.uv == frame.K[:, None, :2].sum(dim=3)).all(), "in the crop of the step"
        used.append((corners.weight[0].tolist(), float(frame.K[0, 0, 0]), radius))
        return state.T * double([1.01, 1.01, 1.01, 1.0])

    def tracked(_, state, flows):
        torch.testing.assert_close(state.T[:, :3, :3], eye(3)[None])
        assert state.points == ("new" if stale else None)
        assert len(flows) == len(used[-1][0])

    monkeypatch.setattr(tracking, "track_points", track)
    monkeypatch.setattr(tracking, "fit_points", lambda *_: at(x=5.0 * shift))
    angles = torch.tensor([9.0, 2.0, 5.0])
    follow = SimpleNamespace(
        _last=last,
        _keyframes=keyframes,
        _frame=lambda *_: crops.pop(0),
        _angles=lambda _: angles[: len(keyframes)],
        _step=step,
        _tracked=tracked,
        centre=zeros(3),
        hull=PLATE,
    )
    image = None
    Tracker._fit(follow, image, K, at())
    return used


def test_a_fit_uses_the_flow_from_the_last_frame_and_from_the_nearest_keyframe(monkeypatch):
    keyframe = tracking.KEYFRAME_WEIGHT * (20 + tracking.PYRAMID_KEYFRAME)
    for number, also in ((4, [keyframe]), (2, [])):
        weights, _, _ = fitted(monkeypatch, [1, 2, 3], number)[0]
        last = tracking.POINT_WEIGHT * (10 * number + tracking.PYRAMID_LAST)
        assert weights == pytest.approx([last, *also])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("part", "crop"), [(0.99, 1.0), (1.01, 2.0)])
def test_the_crop_of_the_predicted_pose_serves_where_the_flow_moves_it_little(
    monkeypatch, sign, part, crop
):
    steps = fitted(monkeypatch, [1, 2], 3, sign * part * tracking.WINDOW_SHIFT)
    assert {zoom for _, zoom, _ in steps} == {crop}


@pytest.mark.parametrize("stale", [False, True])
def test_a_round_is_left_out_after_one_that_hardly_moved_the_contours(monkeypatch, stale):
    first, *between, last = tracking.SEARCH_RADII
    radii = [first, *between, last] if stale else [first, last]
    steps = fitted(monkeypatch, [1, 2], 3, stale=stale)
    assert [r for _, _, r in steps] == [r for r in radii for _ in range(tracking.STEPS_PER_ROUND)]


def flow(ratio):
    return SimpleNamespace(inlier_ratio=lambda *_: ratio)


def features(mean, variance, *flows):
    ends = double(mean), double(variance)
    follow = SimpleNamespace(
        _regions=SimpleNamespace(ends=lambda *_: ends),
        _silhouette=lambda *_: None,
        centre=torch.zeros(3),
    )
    problem = SimpleNamespace(edge_support=lambda _: torch.tensor(0.4))
    frame = SimpleNamespace(problem=problem, K=K, bins=None)
    return dict(Tracker._tracked(follow, frame, SimpleNamespace(T=at()), flows).features)


def test_features_in_closed_form():
    """A flat posterior has a variance of a third of the radius' square."""
    flat = tracking.REGION_FEATURE_RADIUS**2 / 3.0
    variances = [0.0, 0.0, 0.5 * flat, flat]
    region = (1.0 + math.exp(-0.5) + 0.5) / 4.0
    for given, expected in (
        (([0.0, 2.0, 0.0, 0.0], variances, flow(0.8), flow(0.3)), (region, 0.8, 0.3)),
        (([0.0], [2.0 * flat], flow(0.8)), (0.0, 0.8, 0.8)),
        (([], []), (0.0, 0.0, 0.0)),
    ):
        names = ("edge_support", "region", "flow", "keyframe")
        assert features(*given) == pytest.approx(dict(zip(names, (0.4, *expected), strict=True)))


UNUSABLE = ImageError("pixels outside [0, 1]")


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([0.5, 0.8], 0.8),
        ([0.8, 0.5], 0.8),
        ([0.95, 0.99], 0.95),
        ([0.5, UNUSABLE], 0.5),
        ([UNUSABLE, 0.5], 0.5),
    ],
)
def test_the_prediction_that_convinces_ends_the_search_else_the_best_counts(found, expected):
    """One among unusable pixels does not hide another."""
    fits = Mock(side_effect=[x if x is UNUSABLE else SimpleNamespace(confidence=x) for x in found])
    follow = SimpleNamespace(reliable=0.9, predictions=lambda: "ab", _fit=fits)
    nothing = None
    assert Tracker.track(follow, nothing, nothing).confidence == expected


def test_starting_again_forgets_what_was_seen(monkeypatch):
    """Of three accepted poses the last two predict the next one."""
    renderer = SimpleNamespace(render=lambda *_: torch.zeros(1))
    contours = SimpleNamespace(centre=zeros(3), radius=1.0, renderer=lambda _: renderer)
    follow = Tracker(contours, HULL)
    monkeypatch.setattr(follow, "_learn", lambda *_: None)
    monkeypatch.setattr(follow, "_remember", lambda *_: follow._keyframes.append(None))
    seen = [
        SimpleNamespace(state=SimpleNamespace(T=at(x)), frame=SimpleNamespace(K=K))
        for x in (0, 1, 3)
    ]
    for measurement in seen:
        follow.accept(measurement)
    predicted, last = follow.predictions()
    assert float(last[0, 0, 3]) == 3.0
    assert float(predicted[0, 0, 3]) == pytest.approx(5.0)
    regions = follow._regions
    monkeypatch.setattr(follow, "measure", lambda *_: seen[1])
    nothing = None
    follow.start(nothing, nothing, nothing)
    assert [float(T[0, 0, 3]) for T in follow.predictions()] == [1.0]
    assert len(follow._keyframes) == 1
    assert type(follow._regions) is RegionModel
    assert follow._regions is not regions


def test_a_turn_goes_on_about_the_axes_of_the_camera():
    """From A to B it is B A^T, and so B A^T B comes next."""
    before = pose([0.3, 0.0, 0.0], [0.0, 0.0, 5.0])[None]
    last = pose([0.0, 0.5, 0.0], [0.0, 0.0, 5.0])[None]
    follow = SimpleNamespace(_poses=[before, last], last_pose=last, centre=zeros(3))
    predicted, _ = Tracker.predictions(follow)
    A = before[0, :3, :3]
    B = last[0, :3, :3]
    torch.testing.assert_close(predicted[0, :3, :3] @ B.T, B @ A.T)


def remembered(monkeypatch, angle, count):
    """Places of the keyframes after ``count`` frames that each turn by an angle in degrees."""
    monkeypatch.setattr(tracking, "surface_corners", lambda *_, **__: (None, None))
    follow = SimpleNamespace(_keyframes=[])
    follow._angles = partial(Tracker._angles, follow)
    frame = SimpleNamespace(grey=None, K=K)
    for x in range(count):
        turned = pose([0.0, math.radians(20.0 + x * angle), 0.0], [float(x), 0.0, 5.0])
        Tracker._remember(follow, frame, turned[None], None)
    assert follow._last is not None
    return [float(keyframe.T[0, 0, 3]) for keyframe in follow._keyframes]


@pytest.mark.parametrize(("angle", "kept"), [(7.9, [0.0]), (8.1, [0.0, 1.0])])
def test_frames_from_other_directions_are_kept(monkeypatch, angle, kept):
    assert remembered(monkeypatch, angle, 2) == kept


def test_so_many_keyframes_are_kept(monkeypatch):
    latest = [float(x) for x in range(40 - tracking.MAX_KEYFRAMES, 40)]
    assert remembered(monkeypatch, 9.0, 40) == latest


def test_lines_along_which_colours_say_nothing_do_not_count():
    """A variance as flat as a search of 4 px has: 16 / 3, of which half a px² is the tracker's."""
    radius = 4
    flat = radius**2 / 3.0 - tracking.REGION_VARIANCE
    mean = double([1.0, 2.0, -1.0])
    variance = double([0.0, flat, 2.0 * flat])
    J = torch.ones(1, 3, 6).double()
    follow = SimpleNamespace(
        _regions=SimpleNamespace(ends=lambda *_: (mean, variance)), _silhouette=lambda *_: None
    )
    frame = SimpleNamespace(bins=None)
    nothing = None
    colours = Tracker._colours(follow, frame, nothing, J, radius)
    information = 1.0 / tracking.REGION_VARIANCE - 3.0 / radius**2
    expected = [tracking.REGION_WEIGHT * information, 0.0, 0.0]
    assert colours.weight.flatten().tolist() == pytest.approx(expected)
    assert colours.distance.flatten().tolist() == mean.tolist()
    assert colours.J is J
