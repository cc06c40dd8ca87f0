"""Made-up registrations: what is reliable, ambiguous, and how results become JSON and plain
words."""

import json
import math
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import Registration
from curvireg_torch.errors import InvalidInputError, LostObjectError
from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import object_frame
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import Detection, FailedRegistration, Hypothesis
from curvireg_torch.registration.result import (
    VERDICTS,
    ambiguity,
    detection_document,
    line_document,
    pose_in_words,
    remarks,
    result_document,
    two_decimals,
    verdict_counts,
)


def registration(covariance=None, confidence=0.9, detection=None):
    """A registration to a bank of two views, the second of which one term did not compare."""
    terms = {"hog": torch.tensor([[0.5, 0.4]]), "appearance": torch.tensor([[0.3, torch.nan]])}
    ranking = Ranking(torch.tensor([[0.9, 0.8]]), torch.tensor([[0, 1]]), terms)
    eye = torch.eye(3, dtype=torch.float64)
    common = {
        "rotation": eye,
        "translation": 2.0 * eye[2],
        "allocentric_rotation": eye,
        "distance": 2.0,
    }
    common |= {
        "evidence": {"rank": 0.0},
        "projection": (torch.eye(4).double(), eye),
        "covariance": covariance,
    }
    hypotheses = tuple(Hypothesis(**common, score=0.7 - 0.1 * view, view=view) for view in (0, 1))
    return Registration(hypotheses, (confidence, 0.0), ranking, detection=detection)


class Bank(list):
    mesh = SimpleNamespace(units="mm")


REGISTRAR = SimpleNamespace(
    bank=Bank([0, 1]),
    of_model=lambda _: REGISTRAR,
    pipeline=SimpleNamespace(describe=dict),
    is_exact=True,
    symmetries_of=lambda exact: torch.eye(4).repeat(3, 1, 1) if exact else None,
)


def test_to_dict_replaces_unbounded_deviations_by_null():
    """Unbounded from one radian, and from half the distance."""
    variances = torch.tensor([0.25, 0.81, 1.21, 0.81, 0.9801, 1.0201], dtype=torch.float64)
    document = registration(torch.diag(variances)).to_dict()
    degrees = 180.0 / torch.pi
    deviations = document["standard_deviations"]
    assert deviations["rotation_deg"] == [
        pytest.approx(0.5 * degrees),
        pytest.approx(0.9 * degrees),
        None,
    ]
    assert deviations["translation"] == [pytest.approx(0.9), pytest.approx(0.99), None]
    json.dumps(document, allow_nan=False)


def test_result_document_leaves_out_terms_that_did_not_compare_a_view():
    document = result_document(registration(), REGISTRAR, {"bank": 1.0})
    assert [list(pose["terms"]) for pose in document["hypotheses"]] == [
        ["hog", "appearance"],
        ["hog"],
    ]
    assert [pose["score"] for pose in document["hypotheses"]] == pytest.approx([0.7, 0.6])
    assert (document["bank_views"], document["unit"], document["seconds"]) == (
        2,
        "mm",
        {"bank": 1.0},
    )
    assert document["symmetries"] == 3
    assert "3 orientations" in remarks(document)[0]
    json.dumps(document, allow_nan=False)


def test_detection_document_reports_the_score_of_the_most_certain_instance():
    boxes = torch.tensor([[1.0, 2, 30, 40], [50, 2, 80, 40]]).double()
    responses = torch.tensor([7.0, 6.5])
    found = [
        Detection(box, p, r, boxes, responses)
        for box, p, r in zip(boxes, (0.9, 0.4), (7.0, 6.5), strict=True)
    ]
    document = detection_document(
        [registration(detection=one, confidence=0.5 * one.score) for one in found]
    )
    assert document["score"] == 0.9
    assert [(one["score"], one["confidence"]) for one in document["instances"]] == [
        (0.9, 0.45),
        (0.4, 0.2),
    ]
    assert [one["box"] for one in document["proposals"]] == boxes.tolist()
    assert [one["response"] for one in document["proposals"]] == [7.0, 6.5]


def test_remarks_name_a_contradicted_prior_and_the_replaced_box_in_whole_pixels():
    prior = {"azimuth": [0, 9], "contradiction": None}
    assert (
        remarks({"corrected_box": None}) == remarks({"corrected_box": None, "prior": prior}) == []
    )
    for contradiction, words in (
        ("better outside", "much better outside"),
        ("at the limit", "at one of"),
    ):
        (line,) = remarks(
            {"corrected_box": None, "prior": {**prior, "contradiction": contradiction}}
        )
        assert words in line
    (line,) = remarks({"corrected_box": [1.4, 2.6, 30.49, 40.51]})
    assert line.endswith(": 1 3 30 41")


def test_pose_and_verdict_in_words():
    for viewpoint, words in (
        ((0, 0, 0), "seen from the front (azimuth 0°), level"),
        (
            (88, -12, 5),
            "seen from the right (azimuth 88°), 12° below the horizon, tilted by 5° to the left",
        ),
        (
            (225, 30, -40),
            "seen from the back-left (azimuth 225°), 30° above the horizon, tilted by 40° to the "
            "right",
        ),
        ((45, 80, 0), "seen from above (azimuth 45°), 80° above the horizon"),
        ((45, -80, 0), "seen from below (azimuth 45°), 80° below the horizon"),
    ):
        R = rotation_from_viewpoint(*torch.tensor(viewpoint, dtype=torch.float64))
        assert pose_in_words(R) == words
        for up, front in (("y", None), ("-x", None), ("z", "x")):
            assert pose_in_words(R @ object_frame(up, front), up=up, front=front) == words
    # A high confidence that is not reliable, because of a questionable camera, is no reason to be
    # sure.
    sure = replace(registration(covariance=0.01 * torch.eye(6).double()), probabilities=(0.95,))
    doubtful = replace(sure, warnings=("the camera is questionable",))
    assert (sure.verdict, doubtful.verdict) == ("reliable", "unsure")
    for probabilities, word in (
        ((0.4, 0.21), "unsure"),
        ((0.4, 0.19), "no match"),
        ((0.5,), "unsure"),
        ((), "unsure"),
    ):
        assert replace(sure, probabilities=probabilities).verdict == word


def test_photographs_without_a_pose_have_a_verdict_too():
    lost = FailedRegistration(LostObjectError("not found"))
    failed = FailedRegistration(InvalidInputError("no such file"))
    assert (lost.verdict, failed.verdict) == ("lost", "failed")
    assert VERDICTS[3:] == ("lost", "failed")
    words = verdict_counts(Counter(["lost", "reliable", "reliable"]))
    assert words == "2 reliable, 0 unsure, 0 no match, 1 lost, 0 failed"


def test_lines_of_results_jsonl_keep_their_keys():
    document = registration(confidence=0.5).to_dict()
    line = line_document(document)
    assert line["top"] == document["hypotheses"]
    assert line["none"] == document["no_match_probability"]
    assert not {"hypotheses", "no_match_probability"} & line.keys()
    assert not {"top", "none"} & document.keys()
    others = document.keys() - {"hypotheses", "no_match_probability"}
    assert {key: line[key] for key in others} == {key: document[key] for key in others}


def test_confidence_is_never_shown_as_more_than_it_is():
    shown = [two_decimals(p) for p in (0.897, 0.8999, 0.9, 0.29, 0.57, 0.0, 1.0)]
    assert shown == ["0.89", "0.89", "0.90", "0.29", "0.57", "0.00", "1.00"]
    assert "confidence 0.89" in repr(registration(confidence=0.897))


def turned(*degrees: float, elevation: float = 0.0) -> torch.Tensor:
    return torch.stack([rotation_from_viewpoint(d, elevation, 0.0).double() for d in degrees])


def test_ambiguity():
    azimuths = (10.0,), (10.0, 190.0), (40.0, 320.0), (40.0, 100.0), (0.0, 120.0, 240.0)
    assert [ambiguity(turned(*some)) for some in azimuths] == [
        None,
        "half turn",
        "mirror",
        "several",
        "several",
    ]
    # Rivals that are half as probable:
    found = registration()
    pairs = zip(found.hypotheses, turned(40.0, 320.0), strict=True)
    hypotheses = tuple(replace(h, allocentric_rotation=R) for h, R in pairs)
    for second, word in ((0.31, "mirror"), (0.29, None)):
        result = replace(found, hypotheses=hypotheses, probabilities=(0.6, second))
        assert (result.ambiguous, result.no_match_probability) == (
            word,
            pytest.approx(0.4 - second),
        )


def test_reliable_needs_confidence_no_warnings_and_a_rotation_that_contours_determine():
    sure = replace(registration(covariance=0.01 * torch.eye(6).double()), probabilities=(0.9, 0.0))
    assert sure.reliable
    changes = [
        {"warnings": ("the camera is questionable",)},
        {"prior_contradiction": "better outside"},
    ]
    for change in (
        {"probabilities": (0.89, 0.0)},
        {"probabilities": (torch.nan, 0.0)},
        {"probabilities": ()},
        *changes,
    ):
        assert not replace(sure, **change).reliable
    assert replace(sure, prior_contradiction="at the limit").reliable
    # Not where all three rotations are unknown, as those of a sphere.
    variances = torch.tensor([9.0, 9.0, 9.0, 1e-4, 1e-4, 1e-4], dtype=torch.float64)
    sphere = registration(covariance=torch.diag(variances), confidence=0.95)
    fitted = replace(
        sphere, hypotheses=tuple(replace(h, edge_support=0.5) for h in sphere.hypotheses)
    )
    assert not fitted.reliable
    for keypoints, determine in ((7, False), (8, True)):
        evidence = {"landmarks": math.log1p(keypoints - 2)}
        agreed = tuple(replace(h, evidence=evidence) for h in fitted.hypotheses)
        assert replace(fitted, hypotheses=agreed).reliable == determine
    variances[0] = 1e-4
    known = tuple(replace(h, covariance=torch.diag(variances)) for h in fitted.hypotheses)
    assert replace(fitted, hypotheses=known).reliable
