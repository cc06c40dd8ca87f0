import json
import math
from dataclasses import replace

import pytest
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, rotation_error, sample_views
from curvireg_torch.evidence import EvidenceWeights
from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.mesh import mesh_symmetries
from curvireg_torch.pipeline import PRESETS, FitSettings
from curvireg_torch.registration import confidence
from curvireg_torch.synthetic import procedural_background
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    bank_around,
    double,
    exact_registrar,
    first_scenes,
    learned_registrar,
    scene,
    seeded,
    slow_after,
    truck_answer,
    truck_registrar,
    zeros,
)
from tests._support.hypotheses import evidence_of
from tests._support.results import FEATURES
from tests.fitting.cube import edges_in

R30 = sample_views(azimuth_step=12, elevations=[0]).rotations


def scores_of(values, others):
    return torch.tensor([values.get(view, others) for view in range(30)])


def test_ranking_share_in_closed_form():
    """Two peaks, a plateau, one peak, and scores of zero; views 1 to 5 are within 30 degrees of
    view 3."""
    near = confidence.are_near(R30, R30[3])
    assert near.nonzero()[:, 0].tolist() == [1, 2, 3, 4, 5]
    share = 1 + 0.9**4 + 3 * 0.1**4
    for scores, expected in (
        (scores_of({3: 1.0, 4: 0.9, 20: 0.5}, 0.1), share / (share + 0.5**4 + 24 * 0.1**4)),
        (torch.ones(30), 5 / 30),
        (scores_of({5: 1.0}, 0.0), 1.0),
        (torch.zeros(30), 0.0),
    ):
        assert confidence.ranking_share(scores, near) == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert confidence.ranking_share(torch.ones(3), torch.ones(3, dtype=torch.bool)) is None


@pytest.mark.parametrize(("degrees", "expected"), [(30.0004, True), (30.01, False)])
def test_views_exactly_thirty_degrees_apart_are_near_whatever_the_rounding(degrees, expected):
    one = rotation_from_viewpoint(12.0, 0.0, 0.0).double()
    other = rotation_from_viewpoint(12.0 + degrees, 0.0, 0.0).double()
    assert bool(confidence.are_near(other[None], one)) == expected


def test_logistic_model_in_closed_form():
    model = confidence.LogisticModel({"similarity": 3.0, "margin": 0.5}, -2.0)
    for similarity, margin, logit in (
        (0.7, 2.0, 2.1 + 1.0 - 2.0),
        (0.1, 0.0, 0.3 - 2.0),
        (0.1, None, 0.3 - 2.0),
    ):
        found = model({"similarity": similarity, "margin": margin})
        assert found == pytest.approx(1 / (1 + math.exp(-logit)))
    without_rival = model({"similarity": 5.0, "margin": None})
    assert without_rival == confidence.UNCOMPARED_CONFIDENCE
    for bias, expected in ((1e4, 1.0), (-1e4, 0.0)):
        assert confidence.LogisticModel({}, bias)({}) == expected


def test_shares_are_equal_within_the_resolution_and_fall_with_the_slope_beyond(monkeypatch):
    monkeypatch.setitem(confidence.CALIBRATION, "instance", {"slope": 2.0, "resolution": 0.5})
    for scores, weights in (
        ([3.0, 2.6], [1.0, 1.0]),
        ([2.6, 3.0], [1.0, 1.0]),
        ([3.0, 1.5, -1.0], [1.0, math.exp(-2.0), math.exp(-7.0)]),
        ([3.0], [1.0]),
    ):
        found = confidence.shares(torch.tensor(scores), exact=True)
        assert found.tolist() == pytest.approx([w / sum(weights) for w in weights])
    found = confidence.hypothesis_probabilities(0.8, torch.tensor([3.0, 2.0]), exact=True)
    assert found == pytest.approx((0.8 / (1 + math.exp(-1.0)), 0.8 - 0.8 / (1 + math.exp(-1.0))))


@pytest.mark.parametrize("exact", [True, False])
def test_evidence_raises_the_confidence_and_doubt_lowers_it(exact):
    model = confidence.CALIBRATION["instance" if exact else "category"]
    assert set(model["weights"]) == set(confidence.CONFIDENCE_FEATURES)
    assert all(model["weights"][name] >= 0.0 for name in confidence.EVIDENCE_FEATURES)
    assert all(model["weights"][name] <= 0.0 for name in confidence.DOUBT_FEATURES)
    tied = {**FEATURES, "margin": 0.0}
    less = confidence.probability_of_any(tied, exact=exact)
    for name in ("similarity", "edge_support") if exact else ("similarity",):
        assert confidence.probability_of_any({**tied, name: tied[name] + 0.1}, exact=exact) > less


def test_confidence_features():
    evidence = evidence_of(
        rank=[0.0, -1.0, -2.0],
        similarity=[0.7, 0.6, 0.5],
        edge_support=[0.4, 0.5, 0.1],
        appearance=[1.0, 0.4, 0.8],
        keypoints=[2.0, 0.0, 3.0],
        details=[0.5, 0.0, 0.0],
        contours=[0.9, 0.8, 1.0],
    )
    scores = double([5.5, 2.0, 3.0])
    doubts = {"undetermined": 0.2, "outside": 0.25, "border": 1.0, "focal": 0.3}
    given = {**doubts, "printed": 3.5}
    expected = {
        "similarity": 0.7,
        "margin": 2.5,
        "edge_support": 0.4,
        "contours": 0.9,
        "ranking_share": 0.3,
        "keypoints": 2.0,
        "unmatched": 1.5,
        **doubts,
    }
    assert confidence.confidence_features(evidence, scores, 0.3, **given) == pytest.approx(expected)
    for factor in (10.0, -10.0):
        margin = confidence.confidence_features(evidence, factor * scores, 0.3, **given)["margin"]
        assert margin == math.copysign(5.0, factor)
    other = {**given, "printed": 0.0, "focal": 3.0}
    found = confidence.confidence_features(evidence, scores, 0.3, **other)
    assert (found["unmatched"], found["focal"]) == (0.0, 1.0)
    alone = confidence.confidence_features(evidence[:1], scores[:1], None, **given)
    assert alone["margin"] is alone["ranking_share"] is None


def test_undetermined_axes():
    variances = double([0.04, 0.25, 9.0, 1.0, 1.0, 1.0])
    covariance = torch.diag(variances)
    assert confidence.undetermined_axes(covariance) == pytest.approx(0.2 + 0.5 + 1.0)
    assert confidence.undetermined_axes(torch.full_like(covariance, torch.nan)) == 3.0
    # of bodies of revolution one axis need not be known
    few = torch.eye(4).repeat(35, 1, 1)
    many = torch.eye(4).repeat(36, 1, 1)
    assert confidence.undetermined_axes(covariance, few) == pytest.approx(1.7)
    assert confidence.undetermined_axes(covariance, many) == pytest.approx(0.7)
    assert confidence.undetermined_axes(0.01 * covariance, many) == 0.0


def test_one_unknown_axis_counts_once_in_any_direction():
    axis = torch.nn.functional.normalize(double([1.0, 1.0, 0.8]), dim=0)
    covariance = zeros(6, 6)
    covariance[:3, :3] = math.pi**2 * torch.outer(axis, axis)
    assert confidence.undetermined_axes(covariance) == pytest.approx(1.0)


def test_only_the_default_pipeline_is_calibrated():
    for pipeline, calibrated in (
        (Pipeline(), True),
        (replace(Pipeline(), hypotheses=1, box_jitter=0.0), True),
        (replace(Pipeline(), contours=False), False),
        (Pipeline().with_term("appearance", weight=0), False),
        (Pipeline().with_term("appearance", top=8), True),
        (replace(Pipeline(), fit=FitSettings(reliable=0.5)), True),
        (replace(Pipeline(), fit=FitSettings(screened_views=20)), False),
        (replace(Pipeline(), fit=FitSettings(weights=EvidenceWeights(details=2.0))), False),
        *((PRESETS[name], False) for name in ("classical", "paper", "fast")),
    ):
        assert confidence.is_calibrated(pipeline) == calibrated


def test_uncalibrated_pipeline_gives_no_number():
    result = truck_answer()
    assert result.confidence is result.no_match_probability is result.ambiguous is None
    assert result.probabilities == ()
    assert not result.reliable
    assert result.covariance is None
    assert result.hypotheses[0].covariance is not None
    document = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert (document["confidence"], document["no_match_probability"]) == (None, None)
    assert document["probabilities"] == []


@pytest.mark.parametrize(("seed", "camera"), [(0, CAMERA), (1, None)])
def test_confidence_is_that_of_the_reported_features(seed, camera):
    image, box, _ = scene(seed)
    exact = camera is not None
    registrar = exact_registrar(learned_registrar().bank, mesh_is=None if exact else "similar")
    result = answer_of(registrar, image, box, camera)
    any_right = confidence.probability_of_any(result.confidence_features, exact=exact)
    weights = vars(registrar.score_weights(exact=exact))
    scores = [
        sum(weights[name] * value for name, value in h.evidence.items()) for h in result.hypotheses
    ]
    # those near the best one, which come last, have no probability of their own
    R = torch.stack([h.allocentric_rotation for h in result.hypotheses])
    rivals = ~confidence.are_near(R[1:], R[0])
    far = int(rivals.sum()) + 1
    assert rivals.tolist() == [True] * (far - 1) + [False] * (len(R) - far)
    expected = confidence.hypothesis_probabilities(
        any_right, torch.tensor(scores[:far]), exact=exact
    )
    assert result.probabilities == pytest.approx((*expected, *[0.0] * (len(R) - far)), abs=1e-5)
    best = result.hypotheses[0].evidence
    assert result.confidence_features["similarity"] == result.score
    assert result.confidence_features["edge_support"] == best["edge_support"]
    assert sum(result.probabilities) + result.no_match_probability == pytest.approx(1.0)


@pytest.mark.parametrize("count", slow_after(1, [2, 6]))
def test_confidence_is_higher_for_the_object_than_for_clutter(count):
    registrar = learned_registrar()
    images, boxes, _ = first_scenes(count)
    there = registrar(images, boxes, CAMERA)
    clutter = [procedural_background(SIZE, seeded(s)) for s in range(count)]
    box = torch.tensor([60.0, 40, 180, 140])
    absent = registrar(clutter, box.expand(count, 4), CAMERA)
    assert min(r.confidence for r in there) > max(r.confidence for r in absent)
    assert sorted(r.confidence for r in absent)[(count - 1) // 2] < 0.5
    assert not any(r.reliable for r in absent)
    assert sum(r.confidence >= confidence.RELIABLE for r in there) >= 2 * count // 3


def test_evidence_is_measured_at_the_reported_pose():
    """Similarity, edge support and score; of restored hypotheses too, and without a camera."""
    registrar = truck_registrar()
    describer, (image, box, _) = registrar.describer, scene(0)
    query = describer.descriptor(registrar.matcher.query([image], box[None]).field)
    without_camera = answer_of(registrar, image, box, None)
    for h in (*truck_answer().hypotheses, *without_camera.hypotheses):
        distance = double([h.distance])
        view = describer.descriptors(h.allocentric_rotation[None], distance)
        assert h.score == pytest.approx(
            float(torch.nn.functional.cosine_similarity(view, query)), abs=1e-5
        )
        T, K = h.projection
        assert h.distance == pytest.approx(float((T[:3, :3] @ describer.centre + T[:3, 3]).norm()))
        support, _ = edges_in(image, box, describer.contours, K, T[None])
        assert h.edge_support == pytest.approx(float(support), abs=0.03)
        # without that term
        assert (h.evidence["edge_support"], h.evidence["appearance"]) == (h.edge_support, 0.0)


def test_symmetries_of_the_shape_count_for_an_exact_mesh_only():
    mesh = trimesh.creation.box((1, 2, 3))
    cuboid = bank_around(mesh, 45, [20], pipeline=PRESETS["classical"], image_size=64)
    assert len(Registrar(cuboid).symmetries_of(exact=True)) == 4
    assert Registrar(cuboid).symmetries_of(exact=False) is None
    assert len(Registrar(cuboid, symmetries=torch.eye(4)[None]).symmetries_of(exact=True)) == 1
    image = torch.rand(3, 48, 64)
    result = answer_of(exact_registrar(cuboid), image, torch.tensor([4.0, 4, 40, 30]))
    rotations = torch.stack([h.rotation for h in result.hypotheses])
    turned = rotations[:, None] @ mesh_symmetries(cuboid.mesh)[:, :3, :3]
    apart = rotation_error(rotations[:, None, None], turned).amin(dim=2)
    assert float(apart.fill_diagonal_(180.0).min()) > 10
