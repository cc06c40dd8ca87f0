"""What a result says as JSON, of registrations that are made up."""

import json
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Registration
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import Hypothesis
from curvireg_torch.registration.document import correction, localization_document, result_document
from curvireg_torch.registration.results import Localization


def registration(covariance=None, confidence=0.9, localization=None, distance=2.0):
    """Of a bank of two views, the second of which one term did not compare."""
    terms = {"hog": torch.tensor([[0.5, 0.4]]), "appearance": torch.tensor([[0.3, torch.nan]])}
    ranking = Ranking(torch.tensor([[0.9, 0.8]]), torch.tensor([[0, 1]]), terms)
    eye = torch.eye(3, dtype=torch.float64)
    poses = tuple(
        Hypothesis(
            rotation=eye,
            translation=torch.tensor([0.0, 0.0, distance], dtype=torch.float64),
            score=0.7 - 0.1 * view,
            evidence={"rank": 0.0},
            allocentric_rotation=eye,
            distance=distance,
            projection=(torch.eye(4, dtype=torch.float64), eye),
            view=view,
            edge_support=0.5,
            covariance=covariance,
        )
        for view in (0, 1)
    )
    return Registration(poses, confidence, ranking, localization=localization)


class Bank(list):
    meshes = (SimpleNamespace(units="mm"),)


REGISTRAR = SimpleNamespace(bank=Bank([0, 1]), pipeline=SimpleNamespace(describe=dict))


def test_deviations_without_bound_are_null():
    """One radian of turn, or a shift of half the distance, is not known at all."""
    variances = torch.tensor([0.25, 0.81, 1.21, 0.81, 0.9801, 1.0201], dtype=torch.float64)
    document = result_document(registration(torch.diag(variances)), REGISTRAR, {})
    told = document["standard_deviations"]
    degrees = 180.0 / torch.pi
    assert told["rotation_deg"] == [pytest.approx(0.5 * degrees), pytest.approx(0.9 * degrees), None]
    assert told["translation"] == [pytest.approx(0.9), pytest.approx(0.99), None]
    json.dumps(document, allow_nan=False)


def test_terms_that_did_not_compare_a_view_are_left_out():
    document = result_document(registration(), REGISTRAR, {"bank": 1.0})
    assert [list(pose["terms"]) for pose in document["top"]] == [["hog", "appearance"], ["hog"]]
    assert [pose["score"] for pose in document["top"]] == pytest.approx([0.7, 0.6])
    assert (document["views"], document["unit"], document["seconds"]) == (2, "mm", {"bank": 1.0})
    json.dumps(document, allow_nan=False)


def test_presence_is_that_of_the_surest_instance():
    boxes, scores = torch.tensor([[1.0, 2, 30, 40], [50, 2, 80, 40]]).double(), torch.tensor([7.0, 6.5])
    results = [
        registration(localization=Localization(box, presence, score, boxes, scores), confidence=0.5 * presence)
        for box, presence, score in zip(boxes, (0.9, 0.4), (7.0, 6.5), strict=True)
    ]
    document = localization_document(results)
    assert document["presence"] == 0.9
    assert [one["presence"] for one in document["instances"]] == [0.9, 0.4]
    assert [one["confidence"] for one in document["instances"]] == [0.45, 0.2]
    assert [one["box"] for one in document["proposals"]] == boxes.tolist()
    assert [one["score"] for one in document["proposals"]] == [7.0, 6.5]


def test_a_corrected_box_is_told_in_whole_pixels():
    assert correction({"corrected_box": None}) == []
    (line,) = correction({"corrected_box": [1.4, 2.6, 30.49, 40.51]})
    assert line.endswith(": 1 3 30 41")
