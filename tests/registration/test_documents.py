"""Results as JSON documents."""

import json
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch.jobs.documents import detection_document, line_document, result_document
from curvireg_torch.registration import Detection
from curvireg_torch.visualization.words import remarks
from tests._support.results import registration


class Bank(list):
    mesh = SimpleNamespace(unit="mm")


REGISTRAR = SimpleNamespace(
    bank=Bank([0, 1]),
    of_mesh=lambda _: REGISTRAR,
    pipeline=SimpleNamespace(describe=dict),
    is_exact=True,
    symmetries_of=lambda exact: torch.eye(4).repeat(3, 1, 1) if exact else None,
)


def test_result_document_leaves_out_terms_that_did_not_compare_a_view():
    document = result_document(registration(), REGISTRAR, {"bank": 1.0})
    first, second = document["hypotheses"]
    assert (list(first["terms"]), list(second["terms"])) == (["hog", "appearance"], ["hog"])
    assert (first["score"], second["score"]) == pytest.approx((0.7, 0.6))
    assert (document["bank_views"], document["unit"]) == (2, "mm")
    assert document["seconds"] == {"bank": 1.0}
    assert document["symmetries"] == 3
    assert "3 orientations" in remarks(document)[0]
    json.dumps(document, allow_nan=False)


def test_detection_document_reports_the_score_of_the_most_certain_instance():
    boxes = torch.tensor([[1.0, 2, 30, 40], [50, 2, 80, 40]]).double()
    responses = torch.tensor([7.0, 6.5])
    found = [
        registration(detection=Detection(box, score, 7.0, boxes, responses), confidence=0.5 * score)
        for box, score in zip(boxes, (0.9, 0.4), strict=True)
    ]
    document = detection_document(found)
    assert document["score"] == 0.9
    instances = [(one["score"], one["confidence"]) for one in document["instances"]]
    assert instances == [(0.9, 0.45), (0.4, 0.2)]
    proposals = [(one["box"], one["response"]) for one in document["proposals"]]
    assert proposals == [*zip(boxes.tolist(), [7.0, 6.5], strict=True)]


def test_lines_of_results_jsonl_keep_their_keys():
    document = registration(confidence=0.5).to_dict()
    line = line_document(document)
    assert line["top"] == document["hypotheses"]
    assert line["none"] == document["no_match_probability"]
    assert not {"hypotheses", "no_match_probability"} & line.keys()
    assert not {"top", "none"} & document.keys()
    others = document.keys() - {"hypotheses", "no_match_probability"}
    assert {key: line[key] for key in others} == {key: document[key] for key in others}
