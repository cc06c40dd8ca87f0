"""JSON documents of made-up registrations."""

import json
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Registration
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import Hypothesis, Localization
from curvireg_torch.registration.answer_set import AnswerSet
from curvireg_torch.registration.document import localization_document, remarks, result_document


def registration(covariance=None, confidence=0.9, localization=None):
    """A registration to a bank of two views, the second of which one term did not compare."""
    terms = {"hog": torch.tensor([[0.5, 0.4]]), "appearance": torch.tensor([[0.3, torch.nan]])}
    ranking = Ranking(torch.tensor([[0.9, 0.8]]), torch.tensor([[0, 1]]), terms)
    eye = torch.eye(3, dtype=torch.float64)
    hypotheses = tuple(
        Hypothesis(
            rotation=eye,
            translation=2.0 * eye[2],
            score=0.7 - 0.1 * view,
            evidence={"rank": 0.0},
            allocentric_rotation=eye,
            distance=2.0,
            projection=(torch.eye(4, dtype=torch.float64), eye),
            view=view,
            covariance=covariance,
        )
        for view in (0, 1)
    )
    return Registration(hypotheses, AnswerSet((confidence, 0.0)), ranking, localization=localization)


class Bank(list):
    meshes = (SimpleNamespace(units="mm"),)


REGISTRAR = SimpleNamespace(
    bank=Bank([0, 1]),
    pipeline=SimpleNamespace(describe=dict),
    is_exact=lambda with_camera: with_camera,
    symmetries_of=lambda exact: torch.eye(4).repeat(3, 1, 1) if exact else None,
)


def test_to_dict_replaces_unbounded_deviations_by_null():
    """Unbounded from one radian, and from half the distance."""
    variances = torch.tensor([0.25, 0.81, 1.21, 0.81, 0.9801, 1.0201], dtype=torch.float64)
    document = registration(torch.diag(variances)).to_dict()
    degrees = 180.0 / torch.pi
    deviations = document["standard_deviations"]
    assert deviations["rotation_deg"] == [pytest.approx(0.5 * degrees), pytest.approx(0.9 * degrees), None]
    assert deviations["translation"] == [pytest.approx(0.9), pytest.approx(0.99), None]
    json.dumps(document, allow_nan=False)


def test_result_document_leaves_out_terms_that_did_not_compare_a_view():
    document = result_document(registration(), REGISTRAR, {"bank": 1.0})
    assert [list(pose["terms"]) for pose in document["top"]] == [["hog", "appearance"], ["hog"]]
    assert [pose["score"] for pose in document["top"]] == pytest.approx([0.7, 0.6])
    assert (document["views"], document["unit"], document["seconds"]) == (2, "mm", {"bank": 1.0})
    assert document["symmetries"] == 3
    assert "3 orientations" in remarks(document)[0]
    json.dumps(document, allow_nan=False)


def test_localization_document_reports_the_presence_of_the_most_certain_instance():
    boxes, scores = torch.tensor([[1.0, 2, 30, 40], [50, 2, 80, 40]]).double(), torch.tensor([7.0, 6.5])
    found = [Localization(box, p, s, boxes, scores) for box, p, s in zip(boxes, (0.9, 0.4), (7.0, 6.5), strict=True)]
    document = localization_document([registration(localization=x, confidence=0.5 * x.presence) for x in found])
    assert document["presence"] == 0.9
    assert [(one["presence"], one["confidence"]) for one in document["instances"]] == [(0.9, 0.45), (0.4, 0.2)]
    assert [one["box"] for one in document["proposals"]] == boxes.tolist()
    assert [one["score"] for one in document["proposals"]] == [7.0, 6.5]


@pytest.mark.parametrize(
    ("contradiction", "words"),
    [(None, ""), ("better outside", "much better outside"), ("at the limit", "at one of")],
)
def test_remarks_name_a_contradicted_prior(contradiction, words):
    lines = remarks({"corrected_box": None, "prior": {"azimuth": [0, 9], "contradiction": contradiction}})
    assert len(lines) == bool(words)
    assert words in "".join(lines)


def test_remarks_print_the_replaced_box_in_whole_pixels():
    assert remarks({"corrected_box": None}) == []
    (line,) = remarks({"corrected_box": [1.4, 2.6, 30.49, 40.51]})
    assert line.endswith(": 1 3 30 41")
