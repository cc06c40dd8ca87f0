"""Objects without a box: located, registered, counted, or reported as absent."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.errors import CurviregError, InvalidInputError
from curvireg_torch.geometry import PosePrior, box_iou, rotation_error, viewpoint_from_rotation
from curvireg_torch.registration import localization as localization_module
from curvireg_torch.registration import localize
from curvireg_torch.registration.confidence import presence
from curvireg_torch.registration.inputs import ImageItem
from curvireg_torch.registration.localization import ScoredCandidates, _allowed_views
from curvireg_torch.registration.locator import Located
from tests._support.scenes import CAMERA, scene, unrefined
from tests.registration.locator.test_locator import bank, clutter, pasted_scene


@pytest.fixture(scope="module")
def registrar():
    return cr.Registrar(bank(), pipeline=unrefined(bank()))


@pytest.fixture(scope="module")
def found(registrar):
    """A truck pasted into clutter, its box, and the result."""
    image, box = pasted_scene(5, (90, 40), 0.9)
    return image, box, registrar([image])[0]


class FixedLocator:
    """A locator that always proposes the same boxes."""

    features = SimpleNamespace(learned=True)

    def __init__(self, boxes, scores):
        self.located = Located(boxes, torch.tensor(scores), torch.zeros(len(boxes), dtype=torch.long))

    def __call__(self, images, **_):
        return [self.located] * len(images)


def test_localization_agrees_with_the_given_box(registrar, found):
    image, box, result = found
    where = result.localization
    assert box_iou(where.box[None], box[None].double()) > 0.6
    centre = 0.5 * (where.box[:2] + where.box[2:]) - 0.5 * (box[:2] + box[2:])
    assert centre.abs().max() < 0.1 * (box[2:] - box[:2]).max(), "a tenth of its size"
    assert torch.equal(where.boxes[0], where.box), "the result is the first of the proposals"
    assert len(where.boxes) == len(where.scores)
    given = registrar([image], box[None])[0]
    assert given.localization is None
    assert rotation_error(result.rotation, given.rotation) < 35, "one step of this bank"
    assert 0.0 <= result.confidence <= where.presence <= 1.0


@pytest.mark.parametrize(("seed", "corner", "scale"), [(5, (30, 60), 0.6), (3, (40, 10), 1.1)])
def test_localized_pose_is_the_true_one(seed, corner, scale):
    """Pasted elsewhere at another scale; the camera of the scene is transformed accordingly."""
    image, box = pasted_scene(seed, corner, scale)
    K, truth = CAMERA.clone(), scene(seed)[2]
    K[:2, :2] *= scale
    K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5 + torch.tensor(corner)
    result = cr.Registrar(bank())([image], camera_matrices=K)[0]
    assert (result.localization.box - box).abs().max() < 0.1 * (box[2:] - box[:2]).max()
    assert rotation_error(result.rotation, truth[:3, :3]) < 5
    assert (result.translation - truth[:3, 3]).norm() < 0.05 * truth[:3, 3].norm()


def test_localization_with_camera_and_distance(registrar):
    image, _, truth = scene(5)
    result = registrar([image], camera_matrices=CAMERA)[0]
    assert (result.translation - truth[:3, 3]).norm() < 0.25 * truth[:3, 3].norm()
    far = float(truth[2, 3])
    within = registrar([image], camera_matrices=CAMERA, prior=cr.PosePrior(distance=(0.8 * far, 1.2 * far)))[0]
    assert 0.75 * far < float(within.translation[2]) < 1.3 * far


def test_pose_outside_the_photograph_has_presence_zero(registrar, found, monkeypatch):
    outside = torch.tensor([-300.0, -200.0, -100.0, -50.0], dtype=torch.float64)
    monkeypatch.setattr(localization_module, "projected_box", lambda *_: outside)
    result = registrar([found[0]])[0]
    assert result.ok
    assert (result.localization.presence, result.confidence) == (0.0, 0.0)


def test_presence_is_lower_without_the_object(registrar):
    there = [registrar([pasted_scene(seed, (40, 30), 0.9)[0]])[0].localization.presence for seed in (0, 1, 5)]
    absent = registrar([clutter(20 + k) for k in range(3)])
    assert min(there) > max(result.localization.presence for result in absent)


def two_trucks():
    first, box = pasted_scene(5, (0, 0), 0.7)
    second, other = pasted_scene(5, (150, 70), 0.7)
    first[:, 70:, 150:] = second[:, 70:, 150:]
    return first, box, other


def test_localize_sorts_by_the_presence_of_refined_boxes(registrar, monkeypatch):
    def inverted(_, __, result):
        where = result.localization
        return replace(result, localization=replace(where, presence=1.0 - where.presence))

    monkeypatch.setattr(localization_module, "_refined", inverted)
    first, second = localize(registrar, [two_trucks()[0]], instances=2)[0]
    assert first.localization.presence > second.localization.presence


def test_localize_finds_several_instances(registrar):
    image, box, other = two_trucks()
    results = localize(registrar, [image], instances=2)[0]
    boxes = torch.stack([r.localization.box for r in results])
    overlap = box_iou(boxes, torch.stack([box, other]).double())
    assert sorted(overlap.argmax(dim=1).tolist()) == [0, 1]
    assert overlap.amax(dim=1).min() > 0.5
    assert results[0].localization.presence >= results[1].localization.presence
    assert torch.equal(results[0].localization.boxes[:2], boxes)
    with pytest.raises(InvalidInputError, match="instances: expected >= 1, got 0"):
        localize(registrar, [image], instances=0)


def test_localize_reports_an_object_once(registrar, monkeypatch):
    """Two proposals lead to the same truck, and two instances are requested."""
    image, box = pasted_scene(5, (60, 40), 0.9)
    side = float((box[2:] - box[:2]).max())
    beside = torch.stack([box - 0.36 * side, box + 0.36 * side]).float()
    assert box_iou(beside[:1], beside[1:]) < 0.5, "distinct proposals"
    monkeypatch.setattr(registrar, "locator", FixedLocator(beside, [9.0, 8.0]))
    monkeypatch.setattr(localization_module, "projected_box", lambda *_: box.double())
    results = localize(registrar, [image], instances=2)[0]
    assert len(results) == 1
    assert torch.equal(results[0].localization.box, box.double())


def test_localize_follows_one_proposal_more_than_instances():
    """The locator prefers a box of the background; the more certain one is reported, even if one is to be followed."""
    pipeline = unrefined(bank(), locate=replace(bank().pipeline.locate, candidates=1))
    registrar = cr.Registrar(bank(), pipeline=pipeline)
    image, box = pasted_scene(5, (90, 40), 0.9)
    background = torch.tensor([2.0, 2.0, 60.0, 40.0])
    registrar.__dict__["locator"] = FixedLocator(torch.stack([background, box]), [6.2, 6.0])
    result = localize(registrar, [image], instances=1)[0][0]
    assert box_iou(result.localization.box[None], box[None].double()) > 0.5


@pytest.mark.parametrize("sure_first", [True, False])
def test_add_keeps_the_most_certain_of_overlapping_results(found, sure_first):
    sure = found[2]
    where = sure.localization
    beside = replace(sure, localization=replace(where, box=where.box + 500.0, presence=0.1))
    less = replace(sure, localization=replace(where, presence=0.5 * where.presence))
    results = [beside, sure if sure_first else less]
    localization_module._add(results, less if sure_first else sure)
    assert len(results) == 2
    assert results[0] is beside
    assert results[1] is sure


def test_failures_do_not_affect_other_photographs(registrar, found):
    image, _, alone = found
    nan = image.clone()
    nan[0, 3, 3] = torch.nan
    results = registrar([torch.full((3, 80, 100), 0.5), image, nan, torch.rand(2, 9, 9)])
    assert [result.ok for result in results] == [False, True, False, False]
    assert torch.equal(alone.localization.boxes, results[1].localization.boxes)
    for k, message in ((0, ".*one colour"), (2, "NaN"), (3, "photograph: expected 1")):
        with pytest.raises(CurviregError, match=f"image {k}: {message}"):
            _ = results[k].rotation


def test_bad_distances_raise(registrar, found):
    for boxes in (None, [[4.0, 4.0, 40.0, 40.0]]):
        with pytest.raises(InvalidInputError, match="distance: needs the camera"):
            registrar([found[0]], boxes, prior=cr.PosePrior(distance=(1.0, 2.0)))
    near, far = cr.PosePrior(distance=(1e-3, 2e-3)), cr.PosePrior(distance=(500.0, 900.0))
    for boxes, prior, message in (
        (None, far, "nothing of such a size fits"),
        (None, near, "distance: at most 0.002 from the centre, the camera is inside the object, whose radius is 0.176"),
        ([[4.0, 4.0, 40.0, 40.0]], near, "distance: at most 0.002 from the centre"),
    ):
        with pytest.raises(InvalidInputError, match=f"image 0: {message}"):
            _ = registrar([found[0]], boxes, CAMERA, prior=prior)[0].rotation


@pytest.mark.parametrize(("preset", "features"), [("learned", [7.0, 0.6]), ("classical", [0.6])])
def test_presence_uses_the_recorded_constants(preset, features):
    record = Path(__file__).parents[2] / "scripts" / "results" / "location.json"
    fit = json.loads(record.read_text(encoding="utf-8"))["presence"][preset]
    logit = sum(w * v for w, v in zip(fit["weights"], features, strict=True)) + fit["bias"]
    assert presence(features) == pytest.approx(1 / (1 + math.exp(-logit)))
    for k in range(len(features)):
        more = [value + 0.1 * (i == k) for i, value in enumerate(features)]
        assert presence(more) > presence(features)


@pytest.mark.parametrize(("preset", "count"), [("learned", 2), ("fast", 2), ("classical", 1), ("paper", 1)])
def test_presence_uses_the_locator_score_of_learned_features_only(preset, count):
    registrar = cr.Registrar(bank(preset))
    image, box = pasted_scene(5, (90, 40), 0.9)
    low, high = (
        ScoredCandidates.score_boxes(registrar, ImageItem(image, box, None), box[None], torch.tensor([score]))
        for score in (4.0, 9.0)
    )
    assert len(low.evidence[0]) == len(high.evidence[0]) == count
    assert float(low.presence[0]) < float(high.presence[0]) if count == 2 else low.presence.equal(high.presence)


def test_locator_does_not_compare_views_that_the_prior_excludes(registrar, found):
    image, azimuth = found[0], 200.0
    prior = PosePrior(azimuth=(azimuth - 20, azimuth + 20))
    result = registrar([image], prior=prior)[0]
    allowed = _allowed_views(registrar, ImageItem(image, torch.tensor([0.0, 0.0, 9.0, 9.0]), None, prior))
    assert sorted(viewpoint_from_rotation(bank().rotations[allowed])[0].round().unique().tolist()) == [180.0, 210.0]
    located = registrar.locator([image], allowed=allowed)[0]
    assert bool(allowed[located.views].all()), "each view of this small bank is its own template"
    assert set(result.localization.scores.tolist()) <= set(located.scores.tolist())
    everything = registrar.locator([image], allowed=torch.ones_like(allowed))[0]
    assert torch.equal(everything.boxes, registrar.locator([image])[0].boxes)
    assert not bool(allowed[everything.views].all())


def test_allowed_views_are_those_of_any_place_in_the_photograph(registrar):
    """Half of the diagonal is 30 degrees wide; 7.5 more are the spacing of views."""
    image, prior = scene(0)[0], PosePrior(rotation=bank().rotations[0], within=1.0)
    item = ImageItem(image, torch.tensor([-0.5, -0.5, 239.5, 179.5]), CAMERA, prior)
    degrees = rotation_error(bank().rotations, bank().rotations[0])
    half = math.degrees(math.atan(150 / 260))
    assert torch.equal(_allowed_views(registrar, item), degrees <= 8.5 + half)
    assert torch.equal(_allowed_views(registrar, replace(item, camera_matrix=None)), degrees <= 8.5)
