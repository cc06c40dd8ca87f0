"""Answer sets: probabilities, members, and how the members differ."""

import math

import pytest
import torch

from curvireg_torch import Registrar, rotation_from_viewpoint
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.registration.answer_set import AnswerSet, ambiguity, answer_set
from curvireg_torch.registration.confidence import CALIBRATION, model_name
from tests._support.scenes import CAMERA, scene, truck_bank, truck_registrar

CONSTANTS = {"slope": 2.0, "none": -1.0, "threshold": 0.9}


def test_answer_set_shares_the_rest_among_rivals_and_none_of_them():
    scores = torch.tensor([9.0, 3.0, 2.5], dtype=torch.float64)
    answers = answer_set(0.6, scores, CONSTANTS)
    total = 1.0 + math.exp(-1.0) + math.exp(-1.0)  # the best rival, the other one 0.5 below it, none of them
    expected = [0.6, 0.4 / total, 0.4 * math.exp(-1.0) / total]
    assert answers.probabilities == pytest.approx(expected)
    assert answers.none == pytest.approx(0.4 * math.exp(-1.0) / total)
    few = answer_set(0.6, scores, CONSTANTS, reported=2)
    assert few.probabilities == pytest.approx(expected[:2])
    assert few.none == pytest.approx(1.0 - sum(expected[:2])), "hypotheses that are not reported count as none of them"
    assert answer_set(0.7, scores[:1], CONSTANTS).none == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("probabilities", "threshold", "members", "holds_none"),
    [
        ((0.95, 0.03), 0.9, (0,), False),
        ((0.5, 0.1, 0.3), 0.8, (0, 2), False),
        ((0.5, 0.12, 0.3), 0.81, (0, 2, 1), False),
        ((0.2, 0.5, 0.1), 0.7, (0, 1), False),
        ((0.3, 0.1), 0.6, (0,), True),
        ((0.3, 0.1), 1.0, (0, 1), True),
        ((0.0,), 0.9, (0,), True),
    ],
)
def test_members_are_added_by_probability_up_to_the_threshold(probabilities, threshold, members, holds_none):
    answers = AnswerSet(probabilities, threshold)
    assert (answers.members, answers.holds_none) == (members, holds_none)


def test_scaled_answers_leave_the_rest_to_none_of_them():
    answers = AnswerSet((0.8, 0.1), 0.85).scaled(0.5)
    assert answers.probabilities == pytest.approx((0.4, 0.05))
    assert answers.none == pytest.approx(0.55)
    assert answers.holds_none


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ((210.0, 20.0, 0.0), "half turn"),
        ((30.0, 20.0, 175.0), "half turn"),
        ((-30.0, 20.0, 0.0), "mirror"),
        ((150.0, 20.0, 0.0), "mirror"),
        ((30.0, -20.0, 0.0), "mirror"),
        ((100.0, 20.0, 0.0), "several"),
    ],
)
def test_ambiguity_of_two_poses(second, expected):
    first, other = (rotation_from_viewpoint(*torch.tensor(v).double()) for v in ((30.0, 20.0, 0.0), second))
    assert ambiguity(torch.stack([first, other])) == expected


def test_ambiguity_of_one_pose_and_of_three():
    R = torch.eye(3).double()
    assert ambiguity(R[None]) is None
    assert ambiguity(rotation_from_axis_angle(torch.tensor([[0.0, 0, 0], [0, 0, 2.0], [0, 2.0, 0]]))) == "several"


def test_registration_has_answers_for_its_hypotheses():
    image, box, _ = scene(0)
    result = truck_registrar()([image], box[None], CAMERA)[0]
    answers = result.answer_set
    assert len(answers.probabilities) == len(result.hypotheses)
    assert result.confidence == answers.probabilities[0]
    assert sum(answers.probabilities) + answers.none == pytest.approx(1.0)
    assert result.ambiguous == ambiguity(torch.stack([result.hypotheses[m].rotation for m in answers.members]))
    name = model_name("contours", exact=True, with_appearance=False)
    assert answers.threshold == CALIBRATION["answer_set"][name]["threshold"]


def test_mesh_is_decides_the_calibration_and_the_order_of_hypotheses():
    image, box, _ = scene(0)
    default, exact, similar = (
        Registrar(truck_bank(), mesh_is=kind)([image], box[None], CAMERA)[0] for kind in (None, "exact", "similar")
    )
    assert default.answer_set == exact.answer_set
    name = model_name("contours", exact=False, with_appearance=False)
    assert similar.answer_set.threshold == CALIBRATION["answer_set"][name]["threshold"]
    assert similar.confidence != exact.confidence
    assert similar.hypotheses[0].evidence["rank"] == 0.0, "a similar mesh keeps the order of the ranking"
    with pytest.raises(InvalidInputError, match="mesh_is"):
        Registrar(truck_bank(), mesh_is="alike")
