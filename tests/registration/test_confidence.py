"""Confidence of rankings and of poses."""

import json
import math
from pathlib import Path

import pytest
import torch
import trimesh

from curvireg_torch import Registrar, ViewBank, ViewMatcher, rotation_error, sample_views
from curvireg_torch.geometry import symmetry_transforms
from curvireg_torch.matching import Ranking
from curvireg_torch.mesh import mesh_symmetries
from curvireg_torch.mesh.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration import confidence, ranking_evidence, rescore
from curvireg_torch.registration import estimator as estimator_module
from curvireg_torch.registration.confidence import (
    CALIBRATION,
    CONFIDENCE_FEATURES,
    RANKING_FEATURES,
    RELIABLE,
    UNCOMPARED,
    LogisticModel,
    confidence_features,
    confidence_model,
    model_name,
)
from curvireg_torch.registration.contours import contour_support
from curvireg_torch.registration.rescoring import WEIGHTS
from curvireg_torch.synthetic import procedural_background
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, truck_registrar, unrefined

RECORD = Path(__file__).parents[2] / "scripts" / "results" / "calibration.json"
HALF_TURN = {"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
R30 = sample_views(azimuth_step=12, elevations=[0]).rotations
R4 = sample_views(azimuth_step=90, elevations=[0]).rotations


def ranking(scores: torch.Tensor, hog: float = 0.8) -> Ranking:
    order = scores.argsort(dim=1, descending=True, stable=True)
    return Ranking(scores, order, {"hog": hog * torch.ones_like(scores)})


def background(seed: int) -> torch.Tensor:
    return procedural_background(SIZE, torch.Generator().manual_seed(seed))


def scores_of(values: dict[int, float], others: float) -> torch.Tensor:
    return torch.tensor([[values.get(view, others) for view in range(30)]])


NEAR = 1 + 0.9**4 + 3 * 0.1**4  # views 1 to 5 are within 30 degrees of view 3


def test_ranking_evidence_in_closed_form():
    """Of a batch: two peaks, a plateau, one peak, and scores of zero."""
    two = scores_of({3: 1.0, 4: 0.9, 20: 0.5}, 0.1)
    evidence = ranking_evidence(
        ranking(torch.cat([two, torch.ones(1, 30), scores_of({5: 1.0}, 0.0), torch.zeros(1, 30)])), R30
    )
    margins, concentrations = [math.log(2.0), 0.0, 5.0, 0.0], [NEAR / (NEAR + 0.5**4 + 24 * 0.1**4), 5 / 30, 1.0, 0.0]
    assert evidence[:, 0].tolist() == pytest.approx([0.8] * 4)
    assert evidence[:, 1].tolist() == pytest.approx(margins, rel=1e-4, abs=1e-6)
    assert evidence[:, 2].tolist() == pytest.approx(concentrations, rel=1e-4, abs=1e-6)


def test_ranking_evidence_of_another_answer_than_the_best_view():
    scores = torch.tensor([[1.0, 0.2, 0.5, 0.1]])
    expected = [0.8, math.log(0.5), 0.5**4 / (1 + 0.2**4 + 0.5**4 + 0.1**4)]
    evidence = ranking_evidence(ranking(scores), R4, answer=torch.tensor([2]))[0]
    assert evidence.tolist() == pytest.approx(expected, rel=1e-5)


def test_ranking_evidence_ignores_symmetric_views():
    scores, symmetries = torch.tensor([[1.0, 0.2, 0.9, 0.1]]), symmetry_transforms(HALF_TURN)
    plain, symmetric = (float(ranking_evidence(ranking(scores), R4, symmetries=s)[0, 1]) for s in (None, symmetries))
    assert (plain, symmetric) == pytest.approx((math.log(1 / 0.9), math.log(1 / 0.2)), rel=1e-5)


def test_ranking_evidence_without_rival_views_is_nan():
    R = sample_views(azimuths=[0.0, 10.0, 20.0], elevations=[0]).rotations
    near = ranking(torch.tensor([[1.0, 0.1, 0.1]]))
    assert bool(ranking_evidence(near, R)[0, 1:].isnan().all())
    assert float(confidence(near, R)) <= UNCOMPARED


def test_confidence_grows_with_the_evidence():
    low = float(confidence(ranking(torch.ones(1, 30), 0.5), R30))
    high = float(confidence(ranking(scores_of({3: 1.0}, 0.01)), R30))
    assert 0 < low < 0.5 < high < 1


def test_confidence_was_calibrated_with_the_weights_in_use():
    assert json.loads(RECORD.read_text(encoding="utf-8"))["verdict"]["used"] == list(WEIGHTS)


def test_confidence_constants_are_the_recorded_ones():
    record = json.loads(RECORD.read_text(encoding="utf-8"))["confidence"]
    assert record.keys() == CALIBRATION["confidence"].keys()
    for name, model in CALIBRATION["confidence"].items():
        assert (record[name]["weights"], record[name]["bias"]) == (model["weights"], model["bias"])
        assert tuple(model["weights"]) == (RANKING_FEATURES if name.startswith("ranking") else CONFIDENCE_FEATURES)


def test_logistic_model():
    model = LogisticModel({"similarity": 3.0, "lead": 0.5}, -2.0)
    assert model({"similarity": 0.7, "lead": 2.0}) == pytest.approx(1 / (1 + math.exp(-(2.1 + 1.0 - 2.0))))
    assert model({"similarity": 0.1, "lead": None}) == model({"similarity": 0.1, "lead": 0.0}) < UNCOMPARED
    assert model({"similarity": 5.0, "lead": None}) == UNCOMPARED, "bounded without a rival"
    assert (LogisticModel({}, 1e4)({}), LogisticModel({}, -1e4)({})) == (1.0, 0.0)


@pytest.mark.parametrize("with_appearance", [True, False])
def test_confidence_model_of_contours(with_appearance):
    model = confidence_model(model_name("contours", exact=True, with_appearance=with_appearance))
    tied = {"similarity": 0.7, "lead": 0.0, "edge_support": 0.5, "appearance_lead": 0.0, "concentration": 0.3}
    clear = {**tied, "lead": 5.0, "appearance_lead": 3.0, "concentration": 0.9}
    assert model(tied) < RELIABLE < model(clear)


def test_confidence_features():
    evidence = torch.tensor([[0.0, 0.7, 0.4, 1.0], [-1.0, 0.6, 0.5, 0.4], [-2.0, 0.5, 0.1, 0.8]], dtype=torch.float64)
    scores = torch.tensor([9.0, 2.0, 3.0], dtype=torch.float64)
    assert confidence_features(evidence, scores, 0.3) == pytest.approx(
        {"similarity": 0.7, "lead": 5.0, "edge_support": 0.4, "appearance_lead": 0.2, "concentration": 0.3}
    ), "the lead is over the best rival, at most 5"
    behind = confidence_features(evidence, scores.flip(0) - torch.tensor([9.0, 0.0, 0.0]), 0.3)
    assert behind["lead"] == -5.0, "and at least -5"
    alone = confidence_features(evidence[:1], scores[:1], 0.0)
    assert alone["lead"] is alone["appearance_lead"] is None


def test_rescore_uses_pose_features_only_for_the_exact_mesh():
    evidence = torch.tensor([[0.0, 0.5, 0.3, 0.0], [-0.5, 0.6, 0.6, 0.1]], dtype=torch.float64)
    assert rescore(evidence, exact=True).tolist() == pytest.approx([5.0 + 3.0, -0.5 + 6.0 + 6.0 + 0.25])
    assert rescore(evidence, exact=False).tolist() == [0.0, -0.5]


def test_confidence_is_higher_for_the_object_than_for_clutter():
    matcher, R = ViewMatcher(truck_bank()), truck_bank().rotations
    boxes = torch.stack([scene(s)[1] for s in range(6)])
    there = confidence(matcher([scene(s)[0] for s in range(6)], boxes), R)
    absent = confidence(matcher([background(s) for s in range(6)], boxes), R)
    assert float((there[:, None] > absent[None]).float().mean()) > 0.9
    assert float(absent.mean()) < 0.5
    registrar = truck_registrar(search=False, contours=False)
    assert not registrar([background(0)], torch.tensor([[60.0, 40, 180, 140]]), CAMERA)[0].reliable


def test_symmetries_of_an_exact_grey_mesh_are_found():
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    cuboid = ViewBank.build(trimesh.creation.box((1, 2, 3)), views, image_size=64, progress=False)
    assert len(Registrar(cuboid).symmetries_of(exact=True)) == 4
    assert Registrar(cuboid).symmetries_of(exact=False) is None
    assert len(Registrar(cuboid, symmetries=torch.eye(4)[None]).symmetries_of(exact=True)) == 1
    assert Registrar(ViewBank.join([cuboid, cuboid])).symmetries_of(exact=True) is None
    result = Registrar(cuboid)(torch.rand(1, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30]]), CAMERA)[0]
    turned = (
        torch.stack([h.rotation for h in result.hypotheses])[:, None] @ mesh_symmetries(cuboid.meshes[0])[:, :3, :3]
    )
    for h, hypothesis in enumerate(result.hypotheses):
        others = torch.cat([turned[:h], turned[h + 1 :]])
        assert not len(others) or float(rotation_error(hypothesis.rotation, others).min()) > 10


def test_hypotheses_differ_by_more_than_symmetries():
    symmetries = symmetry_transforms(HALF_TURN)
    image, box, _ = scene(0)
    bank = truck_bank()
    result = Registrar(bank, pipeline=unrefined(bank), symmetries=symmetries)([image], box[None])[0]
    rotations = bank.rotations[result.candidates].double()
    rotated = rotations @ symmetries[1, :3, :3]
    errors = rotation_error(rotations[:, None], rotated[None]) + 1000 * torch.eye(len(rotations))
    assert float(errors.min()) > 29.9


@pytest.mark.parametrize(("seed", "camera"), [(0, CAMERA), (1, None)])
def test_confidence_is_computed_from_the_reported_hypotheses(seed, camera):
    """Restored hypotheses, which photographs of the calibration had too, count as rivals."""
    image, box, _ = scene(seed)
    result = truck_registrar()([image], box[None], camera)[0]
    evidence = torch.tensor([list(h.evidence.values()) for h in result.hypotheses], dtype=torch.float64)
    concentration = float(ranking_evidence(result.ranking, truck_bank().rotations)[0, 2])
    features = confidence_features(evidence, rescore(evidence, exact=camera is not None), concentration)
    assert result.confidence_features == pytest.approx(features)
    model = confidence_model(model_name("contours", exact=camera is not None, with_appearance=False))
    assert result.confidence == pytest.approx(model(features))


def test_confidence_without_contours_is_that_of_the_reported_view(monkeypatch):
    image, box, _ = scene(0)
    registrar = truck_registrar(search=False, contours=False)
    result = registrar([image], box[None], CAMERA)[0]
    assert tuple(result.confidence_features) == RANKING_FEATURES
    assert result.confidence == pytest.approx(float(confidence(result.ranking, truck_bank().rotations, exact=True)))
    monkeypatch.setattr(estimator_module, "rescore", lambda evidence, **_: evidence[:, 0].neg())  # another order
    other = registrar([image], box[None], CAMERA)[0]
    view = int(other.candidates[0])
    assert view != int(other.ranking.order[0, 0])
    assert other.confidence_features["similarity"] == pytest.approx(float(other.ranking.hog[0, view]))
    assert other.confidence_features["margin"] < 0.0
    assert other.confidence < result.confidence


@pytest.mark.parametrize("seed", range(3))
def test_confidence_does_not_depend_on_the_number_of_reported_hypotheses(seed) -> None:
    image, box, _ = scene(seed)
    one, two = (truck_registrar(hypotheses=n)([image], box[None], CAMERA)[0] for n in (1, 2))
    assert (len(one.hypotheses), len(two.hypotheses)) == (1, 2)
    assert torch.equal(one.rotation, two.rotation)
    assert one.confidence_features == two.confidence_features
    assert one.confidence_features["lead"] is not None
    assert one.confidence == two.confidence


def test_confidence_of_a_bank_without_rival_views() -> None:
    image, box, _ = scene(0)
    near = sample_views(azimuths=[0.0, 10.0, 20.0], elevations=[10])
    bank = ViewBank.build(truck_bank().mesh, near, pipeline=truck_bank().pipeline, image_size=96, progress=False)
    for pipeline, missing in ((bank.pipeline, ["lead", "concentration"]), (unrefined(bank), ["margin"])):
        result = Registrar(bank, pipeline=pipeline)([image], box[None], CAMERA)[0]
        assert [result.confidence_features[name] for name in missing] == [None] * len(missing)
        assert result.confidence <= UNCOMPARED


@pytest.mark.parametrize("camera", [CAMERA, None])
@pytest.mark.parametrize("seed", range(2))
def test_evidence_is_measured_at_the_reported_pose(seed, camera) -> None:
    """Similarity, edge support and score; of restored hypotheses too."""
    registrar, mesh = truck_registrar(), truck_bank().mesh
    describer, (image, box, _) = registrar.describers[0], scene(seed)
    options = {"centre": mesh_centre(mesh), "radius": mesh_radius(mesh), "margin": truck_bank().settings.margin}
    query = describer.descriptor(registrar.matcher.query([image], box[None]).field)
    for h in registrar([image], box[None], camera)[0].hypotheses:
        distance = torch.tensor([h.distance], dtype=torch.float64)
        view = describer.descriptors(h.allocentric_rotation[None], distance)
        assert h.score == pytest.approx(float(torch.nn.functional.cosine_similarity(view, query)), abs=1e-5)
        assert h.evidence["similarity"] == h.score
        T, K = h.projection
        support = contour_support(describer.renderer, image, box, K, T[None], **options)
        assert h.edge_support == pytest.approx(float(support), abs=0.02)
        assert h.evidence["edge_support"] == h.edge_support
