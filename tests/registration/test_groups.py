"""Answers that count as one: turns about an axis, and pairs."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.mesh.round_axis import RoundAxis
from curvireg_torch.registration.confidence import probability_of_any, shares
from curvireg_torch.registration.judging import Rivals, axis_of, directions_agree, pair_probability
from curvireg_torch.registration.result import AXIS_TOLERANCE, Axis
from curvireg_torch.visualization.contours import AXIS
from curvireg_torch.visualization.overlay import contour_overlay, registration_sheet
from tests._support import answer_of, bank_around, double, exact_registrar, photograph_of, zeros
from tests._support.canisters import canister
from tests._support.results import FEATURES, registration

UPRIGHT = RoundAxis(double([0.0, 0.0, 1.0]), zeros(3), False)


def turned(*viewpoints):
    return torch.stack([rotation_from_viewpoint(a, e, 0.0).double() for a, e in viewpoints])


def rivals_of(*viewpoints, scores):
    values = double(scores)
    views = turned((0.0, 20.0), (90.0, 20.0), (180.0, 20.0), (0.0, -70.0)).float()
    ranked = torch.tensor([1.0, 0.9, 0.95, 0.8])
    return Rivals(turned(*viewpoints), values, values - 0.5, FEATURES, views, ranked)


@cache
def of_canister():
    """Seen from where the turn is hard to tell."""
    registrar = exact_registrar(bank_around(canister(), 15, [0, 25, 50]))
    image, box, T = photograph_of(canister(), 160.0, 40.0, 1)
    return registrar, answer_of(registrar, image, box), (image, box, T)


def test_the_axis_of_a_canister_is_certain_where_its_turn_is_not():
    registrar, result, (_, _, T) = of_canister()
    assert result.verdict == "reliable axis"
    assert not result.reliable
    expected = T[:3, :3] @ registrar.round_axis.direction
    angle = torch.rad2deg((result.axis.direction @ expected).acos())
    assert float(angle) < 2.0
    assert result.axis.probability > 0.95 > result.confidence
    assert result.to_dict()["axis"] == result.axis.to_dict()


def test_the_axis_is_drawn_where_it_alone_is_certain():
    registrar, result, (image, box, _) = of_canister()
    for answer, least, most in ((result, 51, math.inf), (replace(result, axis=None), 0, 0)):
        picture = contour_overlay(registrar, answer, image, box)
        assert least <= (picture == AXIS).all(axis=-1).sum() <= most
    assert registration_sheet(registrar, result, image, box).shape[1] > 0


def test_axes_agree_by_their_direction_whatever_the_turn():
    rotations = turned((0.0, 20.0), (170.0, 20.0), (40.0, 34.0), (40.0, 36.0))
    agree = directions_agree(rotations, UPRIGHT, AXIS_TOLERANCE)
    assert agree.tolist() == [True, True, True, False]
    upside_down = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    both = torch.stack([rotations[0], rotations[0] @ upside_down])
    assert directions_agree(both, UPRIGHT, AXIS_TOLERANCE).tolist() == [True, False]
    either = UPRIGHT._replace(ends_are_alike=True)
    assert directions_agree(both, either, AXIS_TOLERANCE).tolist() == [True, True]


WEIGHTS = double([1.0, 0.9, 0.95, 0.8]) ** 4  # of the ranked views


def expected_of(rivals, views, **features):
    """The probability of the first two rivals, to which these views are near."""
    share = float(WEIGHTS[views].sum() / WEIGHTS.sum())
    features = {**FEATURES, "ranking_share": share, **features}
    together = float(shares(rivals.scores, exact=True)[:2].sum())
    return pytest.approx(probability_of_any(features, exact=True) * together)


def test_an_axis_is_judged_by_its_margin_to_the_others():
    rivals = rivals_of((0.0, 20.0), (90.0, 22.0), (0.0, -70.0), scores=[3.0, 2.9, 1.0])
    axis = axis_of(rivals, UPRIGHT, rivals.rotations[0])
    assert axis.direction.tolist() == pytest.approx(rivals.rotations[0][:, 2].tolist())
    assert axis.probability == expected_of(rivals, [0, 1, 2], margin=2.0, undetermined=0.2)


def test_the_margin_of_a_pair_is_that_to_the_third():
    rivals = rivals_of((0.0, 20.0), (180.0, 20.0), (90.0, 20.0), scores=[3.0, 2.9, 1.5])
    assert pair_probability(rivals, None) == expected_of(rivals, [0, 2], margin=1.5)


def test_an_axis_is_reliable_only_without_doubts():
    sure = Axis(double([0.0, 0.0, 1.0]), 0.9)
    result = replace(registration(confidence=0.4), axis=sure)
    assert result.verdict == "reliable axis"
    assert replace(result, warnings=("of the box",)).verdict != "reliable axis"
    assert replace(result, prior_contradiction="better outside").verdict != "reliable axis"
    assert replace(result, axis=replace(sure, probability=0.89)).verdict != "reliable axis"
    half = replace(result, pair_probability=0.8).scaled(0.5)
    assert half.axis.probability == pytest.approx(0.45)
    assert half.pair_probability == pytest.approx(0.4)
    assert half.probabilities == pytest.approx((0.2, 0.0))
