"""Made-up registrations: what is reliable, and what is ambiguous."""

import json
import math
from dataclasses import replace

import pytest
import torch

from curvireg_torch.errors import InvalidInputError, LostObjectError
from curvireg_torch.registration import FailedRegistration
from curvireg_torch.registration.result import Axis, ambiguity, likely_rivals
from tests._support import double, eye, refused
from tests._support.hypotheses import turned
from tests._support.results import registration


def test_to_dict_replaces_unbounded_deviations_by_null():
    """Unbounded from one radian, and from half the distance."""
    variances = double([0.25, 0.81, 1.21, 0.81, 0.9801, 1.0201])
    document = registration(torch.diag(variances)).to_dict()
    for name, known in (
        ("rotation_deg", [math.degrees(0.5), math.degrees(0.9)]),
        ("translation", [0.9, 0.99]),
    ):
        *some, unknown = document["standard_deviations"][name]
        assert some == pytest.approx(known)
        assert unknown is None
    json.dumps(document, allow_nan=False)


def test_a_questionable_answer_is_unsure_and_an_improbable_one_no_match():
    sure = registration(covariance=0.01 * eye(6))
    for changes, word in (
        ({"probabilities": (0.9, 0.0)}, "reliable"),
        ({"prior_contradiction": "at the limit"}, "reliable"),
        ({"prior_contradiction": "better outside"}, "unsure"),
        ({"warnings": ("the camera is questionable",)}, "unsure"),
        ({"probabilities": (0.89, 0.0)}, "unsure"),
        ({"probabilities": (0.4, 0.21)}, "unsure"),
        ({"probabilities": (0.4, 0.19)}, "no match"),
        ({"probabilities": (0.5,)}, "unsure"),
        ({"probabilities": ()}, "unsure"),
    ):
        result = replace(sure, **changes)
        assert result.verdict == word
        assert result.reliable == (word == "reliable")
    assert not replace(sure, probabilities=(torch.nan, 0.0)).reliable


LOST = FailedRegistration(LostObjectError("not found"))


def test_photographs_without_a_pose_have_a_verdict_too():
    failed = FailedRegistration(InvalidInputError("no such file"))
    assert (LOST.verdict, failed.verdict) == ("lost", "failed")


def test_what_no_registration_has_a_photograph_without_a_pose_has_neither():
    assert getattr(LOST, "foo", 7) == 7
    assert not hasattr(LOST, "_repr_html_"), "notebooks ask for it"
    with refused("'FailedRegistration' object has no attribute 'foo'", AttributeError):
        LOST.foo  # noqa: B018
    for name in ("rotation", "confidence", "reliable", "to_dict"):
        with refused("not found", LostObjectError):
            getattr(LOST, name)


def test_the_confidence_is_shown_rounded_down():
    assert "confidence 0.89" in repr(registration(confidence=0.897))


def with_each(result, **changes):
    """With the same changes of each hypothesis."""
    return replace(result, hypotheses=tuple(replace(h, **changes) for h in result.hypotheses))


def seen_at(*degrees):
    """A registration whose hypotheses are turned so."""
    found = registration()
    pairs = zip(found.hypotheses, turned(*degrees), strict=True)
    return replace(found, hypotheses=tuple(replace(h, allocentric_rotation=R) for h, R in pairs))


def test_ambiguity():
    for azimuths, word in (
        ((10.0,), None),
        ((10.0, 190.0), "half turn"),
        ((40.0, 320.0), "mirror"),
        ((40.0, 100.0), "several"),
        ((0.0, 120.0, 240.0), "several"),
    ):
        assert ambiguity(turned(*azimuths)) == word
    # Rivals that are half as probable:
    for second, word in ((0.31, "mirror"), (0.29, None)):
        result = replace(seen_at(40.0, 320.0), probabilities=(0.6, second))
        assert result.ambiguous == word
        assert result.no_match_probability == pytest.approx(0.4 - second)


@pytest.mark.parametrize(
    ("probabilities", "pair", "rivals"),
    [
        ((), None, []),
        ((0.6,), 0.95, []),
        ((0.6, 0.3, 0.2), None, [1]),
        ((0.6, 0.29, 0.31), None, [2]),
        ((0.6, 0.29, 0.05), 0.9, [1]),
        ((0.6, 0.29, 0.05), 0.89, []),
        ((0.89, 0.05), 0.94, [1]),
        ((0.9, 0.05), 0.95, []),
    ],
)
def test_rivals_are_half_as_probable_or_the_second_of_a_reliable_pair(probabilities, pair, rivals):
    assert likely_rivals(probabilities, pair) == rivals


def test_a_reliable_pair_of_which_none_is_reliable_is_ambiguous():
    result = replace(seen_at(0.0, 180.0), probabilities=(0.6, 0.29))
    assert result.ambiguous is None
    result = replace(result, pair_probability=0.9)
    assert result.ambiguous == "half turn"
    assert replace(result, feature_is_hidden=True).ambiguous == "several"


def test_of_several_meshes_none_is_right_where_all_of_them_are_improbable():
    """The poses of the best one alone leave room for the others."""
    found = replace(registration(), probabilities=(0.4, 0.1), mesh_probabilities=(0.5, 0.3))
    assert found.no_match_probability == pytest.approx(0.2)


def test_reliable_needs_a_rotation_that_contours_or_keypoints_determine():
    """Not where all three rotations are unknown, as those of a sphere."""
    variances = double([9.0, 9.0, 9.0, 1e-4, 1e-4, 1e-4])
    sphere = registration(covariance=torch.diag(variances), confidence=0.95)
    fitted = with_each(sphere, edge_support=0.5)
    assert not fitted.reliable
    for keypoints, determine in ((7, False), (8, True)):
        evidence = {"keypoints": math.log1p(keypoints - 2)}
        assert with_each(fitted, evidence=evidence).reliable == determine
    variances[0] = 1e-4
    assert with_each(fitted, covariance=torch.diag(variances)).reliable


def test_a_rotation_that_is_not_determined_is_not_reliable():
    sure = with_each(registration(covariance=1e-4 * eye(6), confidence=0.95), edge_support=0.6)
    # of a nearly round object it may be the turn about its axis, which is reliable by itself
    nearly_round = replace(sure, axis=Axis(eye(3)[2], 0.95))
    for result, otherwise in ((sure, "unsure"), (nearly_round, "reliable axis")):
        for undetermined, verdict in ((0.99, "reliable"), (1.0, otherwise)):
            judged = replace(result, confidence_features={"undetermined": undetermined})
            assert judged.reliable == (verdict == "reliable")
            assert judged.verdict == verdict
            assert (judged.confidence_bound < judged.reliable_from) == (not judged.reliable)
        unsure = replace(result, probabilities=(0.5,), confidence_features={"undetermined": 1.0})
        assert unsure.confidence_bound < result.reliable_from
    assert registration(confidence=0.5).confidence_bound == 1.0, "its own confidence is a bound"


def test_results_are_equal_to_themselves_alone():
    """Fields are tensors, whose equality is no truth value."""
    one, same = registration(), registration()
    assert one in [same, one]
    assert len({one, same, one}) == 2
    assert one.hypotheses[0] != same.hypotheses[0]
