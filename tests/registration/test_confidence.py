import json
import math
from pathlib import Path

import pytest
import torch

from curvireg_torch import Registrar, ViewBank, ViewMatcher, rotation_error, sample_views
from curvireg_torch.geometry import symmetry_transforms
from curvireg_torch.geometry.mesh import mesh_centre, mesh_radius
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import confidence, distinct_views, ranking_evidence, verdict
from curvireg_torch.registration.confidence import (
    _BIAS,
    _POSE_BIAS,
    _POSE_WEIGHTS,
    _WEIGHTS,
    EVIDENCE,
    POSE_EVIDENCE,
    RELIABLE,
    pose_confidence,
    pose_evidence,
)
from curvireg_torch.registration.contour import contour_support
from curvireg_torch.registration.verify import WEIGHTS
from curvireg_torch.synthetic import procedural_background
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank

CONSTANTS = Path(__file__).parents[2] / "scripts" / "results" / "confidence_calibration.json"


def ranking(scores: torch.Tensor, hog: float = 0.8, rep: float = 0.6) -> Ranking:
    order = scores.argsort(dim=1, descending=True, stable=True)
    same = torch.ones_like(scores)
    return Ranking(scores, order, {"hog": hog * same, "repeatability": rep * same, "box": same})


def test_evidence_in_closed_form():
    R = sample_views(azimuth_step=12, elevations=[0]).rotations
    scores = torch.full((1, 30), 0.1)
    scores[0, 3], scores[0, 4], scores[0, 20] = 1.0, 0.9, 0.5
    got = dict(zip(EVIDENCE, ranking_evidence(ranking(scores), R)[0].tolist(), strict=True))
    near = 1 + 0.9**4 + 3 * 0.1**4  # views 1 to 5 lie within 30 degrees
    assert got["similarity"] == pytest.approx(0.8)
    assert got["margin"] == pytest.approx(0.6931, abs=1e-3)  # log(1 / 0.5)
    assert got["concentration"] == pytest.approx(near / (near + 0.5**4 + 24 * 0.1**4), rel=1e-4)


def test_evidence_of_a_plateau_and_of_nothing():
    R = sample_views(azimuth_step=12, elevations=[0]).rotations
    plateau = ranking_evidence(ranking(torch.ones(1, 30)), R)[0]
    assert plateau[1:].tolist() == pytest.approx([0.0, 5 / 30])
    assert bool(ranking_evidence(ranking(torch.zeros(2, 30)), R).isfinite().all())
    alone = torch.zeros(1, 30)
    alone[0, 5] = 1.0
    assert ranking_evidence(ranking(alone), R)[0, 1:].tolist() == [5.0, 1.0]


def test_confidence_is_a_probability_that_grows_with_the_evidence():
    R = sample_views(azimuth_step=12, elevations=[0]).rotations
    sharp = torch.full((1, 30), 0.01)
    sharp[0, 3] = 1.0
    low, high = (float(confidence(r, R)) for r in (ranking(torch.ones(1, 30), 0.5, 0.3), ranking(sharp)))
    assert 0 < low < 0.5 < high < 1


def test_constants_are_those_that_the_script_found():
    kept = json.loads(CONSTANTS.read_text())
    assert kept["evidence"] == list(EVIDENCE)
    assert kept["weights"] == pytest.approx(_WEIGHTS)
    assert kept["bias"] == pytest.approx(_BIAS)


def test_constants_of_verified_poses_are_those_that_the_script_found():
    kept = json.loads(CONSTANTS.with_name("verdict.json").read_text())
    assert kept["confidence"]["evidence"] == list(POSE_EVIDENCE)
    assert kept["confidence"]["weights"] == pytest.approx(_POSE_WEIGHTS)
    assert kept["confidence"]["bias"] == pytest.approx(_POSE_BIAS)
    assert kept["verdict"]["used"] == list(WEIGHTS)
    precision, coverage = kept["confidence"]["held_out"]["precision_at"][f"{RELIABLE:g}"]
    assert precision > 0.9
    assert coverage > 0.3


def test_confidence_of_a_pose_is_the_logistic_function():
    evidence = pose_evidence(0.7, 9.0, with_camera=True, support=0.4)
    assert evidence == [0.7, 5.0, 1.0, 0.4], "a lead counts up to 5"
    x = 0.7 * _POSE_WEIGHTS[0] + 5.0 * _POSE_WEIGHTS[1] + _POSE_WEIGHTS[2] + 0.4 * _POSE_WEIGHTS[3] + _POSE_BIAS
    assert pose_confidence(evidence) == pytest.approx(1 / (1 + math.exp(-x)))
    assert pose_confidence(pose_evidence(0.7, 9.0, with_camera=False, support=0.4)) < pose_confidence(evidence)
    few = pose_evidence(0.7, 0.1, with_camera=True, support=0.4), pose_evidence(0.7, 2.0, with_camera=True)
    assert max(map(pose_confidence, few)) < RELIABLE < pose_confidence(evidence), "no lead; no edges under the contours"


def test_verdict_counts_what_was_found_only_where_the_camera_is_known():
    evidence = torch.tensor([[0.0, 0.5, 0.3, 0.0], [-0.5, 0.6, 0.6, 0.1]], dtype=torch.float64)
    assert verdict(evidence, with_camera=True).tolist() == pytest.approx([2.5 + 3.0, -0.5 + 3.0 + 6.0 + 0.1])
    assert verdict(evidence, with_camera=False).tolist() == [0.0, -0.5]


def test_the_right_object_is_trusted_more_than_clutter():
    """Six photographs of the truck, and the same boxes on pictures without it."""
    matcher, R = ViewMatcher(truck_bank()), truck_bank().rotations
    boxes = torch.stack([scene(s)[1] for s in range(6)])
    own = confidence(matcher([scene(s)[0] for s in range(6)], boxes), R)
    empty = [procedural_background(SIZE, torch.Generator().manual_seed(s)) for s in range(6)]
    none = confidence(matcher(empty, boxes), R)
    assert float((own[:, None] > none[None]).float().mean()) > 0.9
    assert float(none.mean()) < 0.5


def test_no_reliable_match_is_an_answer():
    empty = procedural_background(SIZE, torch.Generator().manual_seed(0))
    result = Registrar(truck_bank(), refine=False)([empty], torch.tensor([[60.0, 40, 180, 140]]), CAMERA)[0]
    assert not result.reliable


def test_symmetric_duplicates_are_reported_once():
    info = {"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
    symmetries = symmetry_transforms(info)
    R = sample_views(azimuth_step=30, elevations=[10]).rotations
    plain = distinct_views(torch.arange(12), R, count=12, angle=25)
    merged = distinct_views(torch.arange(12), R, count=12, angle=25, symmetries=symmetries)
    assert plain.tolist() == list(range(12))
    assert merged.tolist() == list(range(6))
    image, box, _ = scene(0)
    result = Registrar(truck_bank(), refine=False, symmetries=symmetries)([image], box[None])[0]
    found = truck_bank().rotations[result.candidates].double()
    turned = found @ symmetries[1, :3, :3]
    apart = rotation_error(found[:, None], turned[None]) + 1000 * torch.eye(len(found))
    assert float(apart.min()) > 29.9


def test_evidence_depends_on_each_photograph_alone():
    bank = ViewBank.build(
        truck_bank().mesh, sample_views(azimuth_step=45, elevations=[20]), image_size=64, progress=False
    )
    matcher = ViewMatcher(bank)
    images, boxes = [scene(s)[0] for s in range(2)], torch.stack([scene(s)[1] for s in range(2)])
    together = ranking_evidence(matcher(images, boxes), bank.rotations)
    alone = ranking_evidence(matcher(images[1:], boxes[1:]), bank.rotations)
    torch.testing.assert_close(together[1:], alone, atol=1e-4, rtol=1e-4)


def test_confidence_rests_on_the_lead_that_the_hypotheses_tell():
    """Also where a rival was sent back to its view: it still is a rival, as it was in the photographs of the fit."""
    for seed in range(2):
        image, box, _ = scene(seed)
        result = Registrar(truck_bank())([image], box[None], CAMERA)[0]
        told = torch.tensor([list(h.evidence.values()) for h in result.hypotheses], dtype=torch.float64)
        score = verdict(told, with_camera=True)
        lead = float(score[0] - score[1:].max())
        support = result.hypotheses[0].evidence["support"]
        expected = pose_confidence(pose_evidence(result.score, lead, with_camera=True, support=support))
        assert result.confidence == pytest.approx(expected)


def test_one_hypothesis_is_not_believed_for_want_of_a_rival() -> None:
    """Its rivals are followed all the same: the confidence is that of two hypotheses, of which one is reported."""
    for seed in range(3):
        image, box, _ = scene(seed)
        one, two = (Registrar(truck_bank(), hypotheses=n)([image], box[None], CAMERA)[0] for n in (1, 2))
        assert (len(one.hypotheses), len(two.hypotheses)) == (1, 2)
        assert torch.equal(one.rotation, two.rotation)
        assert one.lead == two.lead is not None
        assert one.confidence == two.confidence


def test_a_bank_without_a_rival_view_has_no_lead() -> None:
    image, box, _ = scene(0)
    near = sample_views(azimuths=[0.0, 10.0, 20.0], elevations=[10])
    bank = ViewBank.build(truck_bank().mesh, near, pipeline=truck_bank().pipeline, image_size=96, progress=False)
    result = Registrar(bank)([image], box[None], CAMERA)[0]
    assert result.lead is None
    support, similarity = result.support, result.score
    tied = pose_confidence(pose_evidence(similarity, 0.0, with_camera=True, support=support))
    assert (
        result.confidence == tied < pose_confidence(pose_evidence(similarity, 5.0, with_camera=True, support=support))
    )
    assert not result.reliable


def test_what_is_said_of_a_pose_is_measured_of_that_pose() -> None:
    """Also without a camera, and of hypotheses that returned to their view: similarity, support and score."""
    for K in (CAMERA, None):
        registrar = Registrar(truck_bank())
        for seed in range(2):
            image, box, _ = scene(seed)
            result = registrar([image], box[None], K)[0]
            descriptors = registrar.describers[0].descriptor(registrar.matcher.query([image], box[None]).field)
            for h in result.hypotheses:
                pose = registrar.describers[0].descriptors(
                    h.allocentric_rotation[None], torch.tensor([h.distance], dtype=torch.float64)
                )
                cosine = torch.nn.functional.cosine_similarity(pose, descriptors)
                assert h.score == pytest.approx(float(cosine), abs=1e-5)
                assert h.evidence["similarity"] == h.score
                T, camera = h.seen_by
                support = contour_support(
                    registrar.describers[0].renderer,
                    image,
                    box,
                    camera,
                    T[None],
                    centre=mesh_centre(truck_bank().mesh),
                    radius=mesh_radius(truck_bank().mesh),
                    margin=truck_bank().settings.margin,
                )
                assert h.support == pytest.approx(float(support), abs=0.02)
                assert h.evidence["support"] == h.support
