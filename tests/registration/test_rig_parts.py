"""Parts of a rig in closed cases: votes, places, units, and photographs that do not show the
pose."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.evidence import EvidenceWeights
from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.geometry import rotation_from_axis_angle, transform
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import rig as rig_module
from curvireg_torch.registration.rig import ELSEWHERE, Rig, RigPhotograph, RigProblem
from tests._support import double, eye, refused, zeros
from tests._support.hypotheses import HALF_TURN, evidence_of

LOST_CONFIDENCE = Pipeline().fit.lost_confidence
CENTRE = double([0.2, -0.1, 0.3])
RADIUS = 2.0
ORIGIN = eye(4)


def turned(*degrees, shift=0.0):
    """(N, 4, 4) world poses about the z axis through the object's centre."""
    angles = torch.deg2rad(double(degrees))
    R = rotation_from_axis_angle(angles[:, None] * double([0.0, 0.0, 1.0]))
    moved = double([shift, 0.0, 0.0]) + CENTRE
    return transform(R, moved - (R @ CENTRE))


def rig_of(eyes, **attributes):
    """A rig of cameras at ``eyes`` (V, 3), relative to the object's centre."""
    rig = object.__new__(Rig)
    rig.eyes = eyes + CENTRE
    rig.describer = SimpleNamespace(centre=CENTRE, radius=RADIUS, hull=None)
    rig.target = SimpleNamespace(pipeline=Pipeline())
    rig.symmetries = rig.answer_symmetries = eye(3)[None]
    for name, value in attributes.items():
        setattr(rig, name, value)
    return rig


def around(*degrees, distance=10.0):
    angles = torch.deg2rad(double(degrees))
    return distance * torch.stack([angles.cos(), angles.sin(), 0.0 * angles], dim=1)


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ([0.0, 90.0, 180.0], [1.0, 1.0, 1.0]),
        ([0.0, 30.0, 60.0], [1.0, 1.0, 1.0]),
        ([0.0, 15.0, 180.0], [1.0 / 1.5, 1.0 / 1.5, 1.0]),
        ([0.0, 0.0, 0.0], [1.0 / 3.0] * 3),
        ([0.0, 15.0, -15.0], [0.5, 1.0 / 1.5, 1.0 / 1.5]),
    ],
)
def test_photographs_from_nearly_the_same_side_share_one_vote(degrees, expected):
    weights = rig_of(around(*degrees)).weights(ORIGIN)
    assert weights.tolist() == pytest.approx(expected, abs=1e-5)


def test_a_photograph_knows_the_place_across_its_ray_better_than_along_it():
    place = CENTRE[None]
    precision = rig_of(around(0.0)).precision(place, torch.zeros(1, dtype=torch.long))[0]
    along = rig_module.DEPTH_ERROR * 10.0
    across = math.hypot(rig_module.CENTRE_ERROR * RADIUS, rig_module.RIG_ERROR * 10.0)
    assert_close(precision, torch.diag(double([along, across, across]) ** -2.0))
    assert along > across


def test_candidates_that_are_nearly_equal_count_once():
    """Within 15 degrees and half a radius of a better one, up to symmetries."""
    beside = [turned(0.0, shift=part * RADIUS) for part in (0.45, 0.55)]
    T = torch.cat([turned(0.0, 14.0, 16.0), *beside, turned(180.0)])
    score = double([6.0, 5.0, 4.0, 3.0, 2.0, 1.0])
    rig = rig_of(around(0.0))
    assert rig.distinct(T, score).tolist() == [0, 2, 4, 5]
    assert rig.distinct(T, -score).tolist() == [5, 4, 2, 0]
    rig.answer_symmetries = torch.stack([eye(4), HALF_TURN])[:, :3, :3]
    assert rig.distinct(T, score).tolist() == [0, 2, 4]


def test_a_photograph_alone_lowers_a_pose_by_at_most_five_points():
    found = [
        SimpleNamespace(evidence=evidence_of(0.9, 0.1).named(h), covariance=None) for h in (0, 1)
    ]
    alone = SimpleNamespace(result=SimpleNamespace(hypotheses=found), poses=turned(0.0, 90.0))
    rig = rig_of(
        around(0.0),
        photographs=[alone],
        cameras=eye(4).double()[None],
        score_weights=EvidenceWeights.only(similarity=10.0),
    )
    assert rig.hypotheses_of_one().scores.tolist() == [pytest.approx([9.0, 4.0])]


def photograph(index, sees):
    return SimpleNamespace(index=index, sees=lambda _, T: torch.tensor([sees] * len(T)))


@pytest.mark.parametrize(
    ("sees", "similarity", "lost"),
    [
        ([True, True, True], [0.8, 0.7, 0.9], []),
        ([True, False, True], [0.8, 0.9, 0.8], [5]),
        ([True, True, True], [0.8, 0.8 * LOST_CONFIDENCE - 0.001, 0.8], [5]),
        ([True, True, True], [0.8, 0.8 * LOST_CONFIDENCE + 0.001, 0.8], []),
        ([False, False, True], [0.1, 0.9, 0.01], [3, 5]),
        ([False, False, False], [0.8, 0.8, 0.8], []),
    ],
)
def test_photographs_that_do_not_show_the_pose_are_named(monkeypatch, sees, similarity, lost):
    """Their confidence is compared with the best of those that may show it."""
    monkeypatch.setattr(rig_module, "refinement_confidence", lambda known: known["similarity"])
    seen = dict(zip((3, 5, 8), sees, strict=True))
    photographs = [photograph(*one) for one in seen.items()]
    rig = rig_of(around(0.0, 90.0, 180.0), photographs=photographs)
    evidence = evidence_of(similarity=double(similarity)[:, None].tolist())
    reasons = rig.lost(SimpleNamespace(evidence=evidence, T=ORIGIN[None]))
    assert sorted(reasons) == lost
    for index, reason in reasons.items():
        assert (reason == ELSEWHERE) != seen[index]


@pytest.mark.parametrize("factor", [1.0, 1e3, 1e-3, 25.0, 0.04])
def test_cameras_in_another_unit_are_refused(factor):
    """The rays of three cameras meet ``factor`` times as far away as the object's size says."""
    eyes = factor * around(0.0, 40.0, 90.0)
    rig = rig_of(eyes, photographs=[photograph(4, True)])
    places = CENTRE + eyes * (1.0 - 1.0 / factor)
    vars(rig)["places"] = places, None
    if factor in (1e3, 1e-3):
        with refused("unit") as error:
            rig.check_unit()
        assert "the object is 10 away" in str(error.value)
        assert f"{10.0 * factor:.3g}" in str(error.value)
    else:
        rig.check_unit()


def test_rays_that_are_nearly_parallel_tell_no_unit():
    eyes = 1e3 * around(0.0, 2.0)
    rig = rig_of(eyes, photographs=[photograph(0, True)])
    vars(rig)["places"] = CENTRE + eyes * (1.0 - 1e-3), None
    rig.check_unit()


def test_a_photograph_lowers_a_pose_by_five_points_at_most():
    low = -torch.inf
    scores = double([[3.0, 1.0, -9.0, low], [low, low, low, low]])
    assert rig_module._bounded(scores).tolist() == [[3.0, 1.0, -2.0, -2.0], [0.0] * 4]


def test_unknown_covariances_have_nearly_no_precision():
    known = torch.diag(torch.arange(1.0, 7.0).double())
    both = torch.stack([known, torch.full((6, 6), torch.nan).double()])
    precision = rig_module._inverse(both)
    assert_close(precision[0], torch.linalg.inv(known))
    assert 0.0 < precision[1].diagonal().max() < 1e-9


def test_a_pose_is_seen_where_its_box_overlaps_that_of_the_photograph(monkeypatch):
    boxes = double([[0.0, 0, 10, 10], [5, 0, 15, 10], [6, 0, 16, 10], [0, 0, 10, 10]])
    in_front = torch.tensor([True, True, True, False])
    monkeypatch.setattr(rig_module, "boxes_at", lambda *_: (boxes, in_front))
    photograph = SimpleNamespace(K=None, size=(20, 20), box=boxes[0])
    one = SimpleNamespace(camera=ORIGIN, photograph=photograph)
    hull = None
    # the second overlaps by a third, the third by a quarter
    seen = RigPhotograph.sees(one, hull, ORIGIN.repeat(4, 1, 1))
    assert seen.tolist() == [True, True, False, False]


def problem(**changes):
    """Two world poses in two photographs each."""
    nothing = None
    given = {
        "contours": SimpleNamespace(centre=CENTRE),
        "edges": nothing,
        "image_index": torch.tensor([0, 1, 0, 1]),
        "K": eye(3).repeat(4, 1, 1),
        "size": 256,
        "axes": eye(3).repeat(4, 1, 1),
        "group": torch.tensor([0, 0, 1, 1]),
        "alone": ORIGIN.repeat(4, 1, 1),
        "root": eye(6).repeat(4, 1, 1),
    }
    return RigProblem(**(given | changes))


def test_photographs_of_a_pose_take_the_shortest_step_of_all(monkeypatch):
    fractions = double([0.9, 0.4, 0.7, 1.0])
    monkeypatch.setattr(ContourProblem, "step_fraction", lambda *_: fractions)
    found = problem().step_fraction(torch.zeros(4, 6), ORIGIN.repeat(4, 1, 1))
    assert found.tolist() == pytest.approx([0.4, 0.4, 0.7, 0.7])


def test_sums_are_over_the_photographs_of_each_pose():
    assert problem().summed(torch.tensor([1.0, 2.0, 4.0, 8.0])).tolist() == [3.0, 12.0]


def test_gaps_are_towards_the_poses_that_photographs_alone_found():
    """10 degrees about z, and half a unit to the right: in standard deviations of half of each."""
    alone = torch.cat([turned(10.0), turned(0.0, shift=0.5), turned(0.0, 0.0)])
    one = problem(alone=alone, root=2.0 * eye(6).repeat(4, 1, 1))
    expected = zeros(4, 6, 1)
    expected[0, 2] = 2.0 * math.radians(10.0)
    expected[1, 3] = 1.0
    assert_close(one.gaps(turned(0.0).repeat(4, 1, 1)), expected)


def test_a_solution_is_common_to_the_photographs_along_their_own_axes():
    """Each photograph knows one direction of the world well: together they know both."""
    quarter = rotation_from_axis_angle(double([0.0, 0.0, math.pi / 2]))
    axes = torch.stack([eye(3), quarter] * 2)
    wanted = double([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    A = torch.diag(double([5.0, 1.0, 1.0, 5.0, 1.0, 1.0])).repeat(4, 1, 1)
    own = (rig_module.in_frames(axes) @ wanted[:, None])[..., 0]
    steps = problem(axes=axes).solution(A, (A @ own[..., None]))
    assert_close(steps, own, rtol=0.05, atol=0.02)
