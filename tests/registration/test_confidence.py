import json
import math
from pathlib import Path

import pytest
import torch
import trimesh

from curvireg_torch import Registrar, ViewBank, ViewMatcher, rotation_error, sample_views
from curvireg_torch.geometry import symmetry_transforms, views_without_symmetric
from curvireg_torch.io.meshes.mesh import mesh_centre, mesh_radius
from curvireg_torch.matching import Ranking
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import confidence, distinct_views, ranking_evidence, rescore
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
)
from curvireg_torch.registration.contours import contour_support
from curvireg_torch.synthetic import procedural_background
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, truck_registrar, unrefined

RECORD = Path(__file__).parents[2] / "scripts" / "results" / "calibration.json"


def ranking(scores: torch.Tensor, hog: float = 0.8, rep: float = 0.6) -> Ranking:
    order = scores.argsort(dim=1, descending=True, stable=True)
    same = torch.ones_like(scores)
    return Ranking(scores, order, {"hog": hog * same, "repeatability": rep * same, "box": same})


def test_evidence_in_closed_form():
    R = sample_views(azimuth_step=12, elevations=[0]).rotations
    scores = torch.full((1, 30), 0.1)
    scores[0, 3], scores[0, 4], scores[0, 20] = 1.0, 0.9, 0.5
    got = dict(zip(RANKING_FEATURES, ranking_evidence(ranking(scores), R)[0].tolist(), strict=True))
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


def test_views_that_a_symmetry_makes_one_are_no_rivals():
    half_turn = symmetry_transforms({"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]})
    R = sample_views(azimuth_step=90, elevations=[0]).rotations
    scores = torch.tensor([[1.0, 0.2, 0.9, 0.1]])
    plain, symmetric = (ranking_evidence(ranking(scores), R, symmetries=s)[0, 1] for s in (None, half_turn))
    assert float(plain) == pytest.approx(math.log(1 / 0.9), rel=1e-5)
    assert float(symmetric) == pytest.approx(math.log(1 / 0.2), rel=1e-5)


def test_without_a_view_far_away_nothing_was_compared():
    R = sample_views(azimuths=[0.0, 10.0, 20.0], elevations=[0]).rotations
    alone = ranking_evidence(ranking(torch.tensor([[1.0, 0.1, 0.1]])), R)
    assert bool(alone[0, 1:].isnan().all())
    assert float(confidence(ranking(torch.tensor([[1.0, 0.1, 0.1]])), R)) <= UNCOMPARED


def test_evidence_of_another_answer_than_the_best_view():
    R = sample_views(azimuth_step=90, elevations=[0]).rotations
    scores = torch.tensor([[1.0, 0.2, 0.5, 0.1]])
    similarity, margin, concentration = ranking_evidence(ranking(scores), R, answer=torch.tensor([2]))[0].tolist()
    assert similarity == pytest.approx(0.8)
    assert margin == pytest.approx(math.log(0.5))
    assert concentration == pytest.approx(0.5**4 / (1 + 0.2**4 + 0.5**4 + 0.1**4), rel=1e-5)


def test_constants_are_those_that_the_script_found():
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    assert record["confidence"].keys() == CALIBRATION["confidence"].keys()
    for name, model in CALIBRATION["confidence"].items():
        assert record["confidence"][name]["weights"] == model["weights"]
        assert record["confidence"][name]["bias"] == model["bias"]
        assert list(model["weights"]) == list(RANKING_FEATURES if name.startswith("ranking") else CONFIDENCE_FEATURES)


def test_confidence_of_a_pose_is_the_logistic_function():
    model = LogisticModel({"similarity": 3.0, "lead": 0.5}, -2.0)
    assert model({"similarity": 0.7, "lead": 2.0}) == pytest.approx(1 / (1 + math.exp(-(2.1 + 1.0 - 2.0))))
    assert model({"similarity": 0.1, "lead": None}) == model({"similarity": 0.1, "lead": 0.0}) < UNCOMPARED
    assert model({"similarity": 5.0, "lead": None}) == UNCOMPARED, "an answer without a rival is not believed"
    assert LogisticModel({}, 1e4)({}) == 1.0
    assert LogisticModel({}, -1e4)({}) == 0.0


@pytest.mark.parametrize("with_appearance", [True, False])
def test_more_evidence_is_more_confidence(with_appearance):
    model = confidence_model("contours", with_camera=True, with_appearance=with_appearance)
    tied = {"similarity": 0.7, "lead": 0.0, "edge_support": 0.5, "appearance_lead": 0.0, "concentration": 0.3}
    clear = {**tied, "lead": 5.0, "appearance_lead": 3.0, "concentration": 0.9}
    assert model(tied) < RELIABLE < model(clear)


def test_features_of_a_pose():
    evidence = torch.tensor([[0.0, 0.7, 0.4, 1.0], [-1.0, 0.6, 0.5, 0.4], [-2.0, 0.5, 0.1, 0.8]], dtype=torch.float64)
    verdicts = torch.tensor([9.0, 2.0, 3.0], dtype=torch.float64)
    assert confidence_features(evidence, verdicts, 0.3) == pytest.approx(
        {"similarity": 0.7, "lead": 5.0, "edge_support": 0.4, "appearance_lead": 0.2, "concentration": 0.3}
    ), "the lead is over the best rival, and 5 at most"
    behind = confidence_features(evidence, verdicts.flip(0) - torch.tensor([9.0, 0.0, 0.0]), 0.3)
    assert behind["lead"] == -5.0, "nor less than -5"
    alone = confidence_features(evidence[:1], verdicts[:1], 0.0)
    assert alone["lead"] is None
    assert alone["appearance_lead"] is None


def test_verdict_counts_what_was_found_only_where_the_camera_is_known():
    evidence = torch.tensor([[0.0, 0.5, 0.3, 0.0], [-0.5, 0.6, 0.6, 0.1]], dtype=torch.float64)
    assert rescore(evidence, with_camera=True).tolist() == pytest.approx([2.5 + 3.0, -0.5 + 3.0 + 6.0 + 0.1])
    assert rescore(evidence, with_camera=False).tolist() == [0.0, -0.5]


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
    result = truck_registrar(search=False, contours=False)([empty], torch.tensor([[60.0, 40, 180, 140]]), CAMERA)[0]
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
    result = Registrar(truck_bank(), pipeline=unrefined(truck_bank()), symmetries=symmetries)([image], box[None])[0]
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


def test_confidence_rests_on_what_the_hypotheses_say():
    """Also where a rival returned to its view: it still is a rival, as it was in the photographs of the fit."""
    for seed, K in ((0, CAMERA), (1, None)):
        image, box, _ = scene(seed)
        result = Registrar(truck_bank())([image], box[None], K)[0]
        evidence = torch.tensor([list(h.evidence.values()) for h in result.hypotheses], dtype=torch.float64)
        verdicts = rescore(evidence, with_camera=K is not None)
        concentration = float(ranking_evidence(result.ranking, truck_bank().rotations)[0, 2])
        features = confidence_features(evidence, verdicts, concentration)
        assert result.confidence_features == pytest.approx(features)
        model = confidence_model("contours", with_camera=K is not None, with_appearance=False)
        assert result.confidence == pytest.approx(model(features))


def test_without_contours_the_confidence_is_that_of_the_answers_view(monkeypatch):
    image, box, _ = scene(0)
    registrar = truck_registrar(search=False, contours=False)
    result = registrar([image], box[None], CAMERA)[0]
    assert list(result.confidence_features) == list(RANKING_FEATURES)
    assert result.confidence == pytest.approx(float(confidence(result.ranking, truck_bank().rotations)))
    # If the hypotheses are reordered, the confidence is that of the answer, not of the best view.
    monkeypatch.setattr(estimator_module, "rescore", lambda evidence, **_: evidence[:, 0].neg())
    other = registrar([image], box[None], CAMERA)[0]
    view = int(other.candidates[0])
    assert view != int(other.ranking.order[0, 0])
    assert other.confidence_features["similarity"] == pytest.approx(float(other.ranking.hog[0, view]))
    assert other.confidence_features["margin"] < 0.0
    assert other.confidence < result.confidence


def test_one_hypothesis_is_not_believed_for_want_of_a_rival() -> None:
    """Its rivals are followed all the same: the confidence is that of two hypotheses, of which one is reported."""
    for seed in range(3):
        image, box, _ = scene(seed)
        one, two = (truck_registrar(hypotheses=n)([image], box[None], CAMERA)[0] for n in (1, 2))
        assert (len(one.hypotheses), len(two.hypotheses)) == (1, 2)
        assert torch.equal(one.rotation, two.rotation)
        assert one.confidence_features == two.confidence_features
        assert one.confidence_features["lead"] is not None
        assert one.confidence == two.confidence


def test_a_bank_without_a_rival_view_has_no_lead() -> None:
    image, box, _ = scene(0)
    near = sample_views(azimuths=[0.0, 10.0, 20.0], elevations=[10])
    bank = ViewBank.build(truck_bank().mesh, near, pipeline=truck_bank().pipeline, image_size=96, progress=False)
    result = Registrar(bank)([image], box[None], CAMERA)[0]
    assert result.confidence_features["lead"] is None
    assert result.confidence_features["concentration"] is None
    assert result.confidence <= UNCOMPARED
    ranked = Registrar(bank, pipeline=unrefined(bank))([image], box[None], CAMERA)[0]
    assert ranked.confidence_features["margin"] is None
    assert ranked.confidence <= UNCOMPARED


def test_a_bottle_with_its_symmetry_said_is_not_believed_for_want_of_rivals() -> None:
    """The recipe of docs/guides/symmetric.md: four views are left, and hardly one of them is a rival."""
    bottle = trimesh.creation.revolve([[0, 0], [0.04, 0], [0.04, 0.15], [0.015, 0.2], [0.015, 0.25], [0, 0.25]])
    turns = symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]})
    views = views_without_symmetric(sample_views(elevations=[0, 15]), turns)
    bank = ViewBank.build(bottle, views, pipeline=PRESETS["classical"], progress=False)
    empty = procedural_background(SIZE, torch.Generator().manual_seed(3))
    result = Registrar(bank, symmetries=turns)([empty], torch.tensor([[80.0, 30, 140, 150]]), CAMERA)[0]
    assert len(views) == 2
    assert result.confidence_features["lead"] is None
    assert result.confidence <= UNCOMPARED


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
                T, camera = h.projection
                edge_support = contour_support(
                    registrar.describers[0].renderer,
                    image,
                    box,
                    camera,
                    T[None],
                    centre=mesh_centre(truck_bank().mesh),
                    radius=mesh_radius(truck_bank().mesh),
                    margin=truck_bank().settings.margin,
                )
                assert h.edge_support == pytest.approx(float(edge_support), abs=0.02)
                assert h.evidence["edge_support"] == h.edge_support
