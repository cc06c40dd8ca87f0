"""Objects without a box: found, followed to a pose, counted, or said not to be there."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.errors import ImageError, InvalidInputError
from curvireg_torch.geometry import box_iou, rotation_error
from curvireg_torch.registration import RELIABLE
from curvireg_torch.registration import localization as localization_module
from curvireg_torch.registration.confidence import presence
from curvireg_torch.registration.inputs import ImageItem
from curvireg_torch.registration.localization import ScoredCandidates, localize
from curvireg_torch.registration.locator import Located
from curvireg_torch.synthetic import procedural_background
from tests._support.scenes import CAMERA, scene, unrefined
from tests.registration.locator.test_locator import SIZE, bank, placed_scene


@pytest.fixture(scope="module")
def registrar():
    return cr.Registrar(bank(), pipeline=unrefined(bank()))


def test_an_object_is_found_and_posed(registrar):
    """The box around the pose lies where the object was put; its pose is near that with the box given."""
    image, box = placed_scene(5, (90, 40), 0.9)
    result = registrar([image])[0]
    place = result.localization
    assert box_iou(place.box[None], box[None].double()) > 0.6
    size = (box[2:] - box[:2]).max()
    middle = 0.5 * (place.box[:2] + place.box[2:]) - 0.5 * (box[:2] + box[2:])
    assert middle.abs().max() < 0.1 * size, "to a tenth of its size"
    assert torch.equal(place.boxes[0], place.box), "the answer is the first of the proposals"
    assert len(place.boxes) == len(place.scores)
    given = registrar([image], box[None])[0]
    assert given.localization is None
    assert rotation_error(result.rotation, given.rotation) < 35, "one step of this bank"
    assert 0.0 <= result.confidence <= place.presence <= 1.0


@pytest.mark.parametrize(("seed", "corner", "scale"), [(5, (30, 60), 0.6), (3, (40, 10), 1.1)])
def test_an_object_is_found_to_a_tenth_of_its_size(seed, corner, scale):
    """Rendered, put into clutter elsewhere and at another scale, followed to its end: each edge of the box and the pose
    are those that it was rendered with, seen by the camera of the scene, which went along."""
    image, box = placed_scene(seed, corner, scale)
    K, truth = CAMERA.clone(), scene(seed)[2]
    K[:2, :2] *= scale
    K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5 + torch.tensor(corner)
    result = cr.Registrar(bank())([image], camera_matrices=K)[0]
    assert (result.localization.box - box).abs().max() < 0.1 * (box[2:] - box[:2]).max()
    assert rotation_error(result.rotation, truth[:3, :3]) < 5
    assert (result.translation - truth[:3, 3]).norm() < 0.05 * truth[:3, 3].norm()


def test_with_a_camera_the_pose_has_a_place(registrar):
    image, _, truth = scene(5)
    result = registrar([image], camera_matrices=CAMERA)[0]
    assert (result.translation - truth[:3, 3]).norm() < 0.25 * truth[:3, 3].norm()
    far = float(truth[2, 3])
    within = registrar([image], camera_matrices=CAMERA, distance=(0.8 * far, 1.2 * far))[0]
    assert 0.75 * far < float(within.translation[2]) < 1.3 * far


def test_a_place_that_is_not_sure_has_no_covariance(registrar):
    """The pose alone would be believed; where the object hardly is, it is a guess, and says no deviations."""
    image, box, _ = scene(5)
    given = registrar([image], box[None], CAMERA)[0]
    known = tuple(replace(h, covariance=torch.eye(6, dtype=torch.float64)) for h in given.hypotheses)
    sure = replace(given, hypotheses=known, confidence=RELIABLE)
    assert sure.covariance is not None
    assert sure.standard_deviations is not None
    unsure = replace(sure, confidence=RELIABLE - 0.01)
    assert not unsure.reliable
    assert unsure.covariance is None
    assert unsure.standard_deviations is None


def test_a_pose_that_left_the_photograph_is_of_nothing(registrar, monkeypatch):
    """It stays an answer, which nobody is to believe; the photograph does not fail."""
    image, _ = placed_scene(5, (90, 40), 0.9)
    outside = torch.tensor([-300.0, -200.0, -100.0, -50.0], dtype=torch.float64)
    monkeypatch.setattr(localization_module, "projected_box", lambda *_: outside)
    result = registrar([image])[0]
    assert result.ok
    assert (result.localization.presence, result.confidence) == (0.0, 0.0)


def test_photographs_without_the_object_are_less_sure(registrar):
    there = [registrar([placed_scene(seed, (40, 30), 0.9)[0]])[0].localization.presence for seed in (0, 1, 5)]
    absent = [procedural_background(SIZE, torch.Generator().manual_seed(20 + k)) for k in range(3)]
    assert min(there) > max(result.localization.presence for result in registrar(absent))


def test_several_objects_of_one_photograph(registrar):
    """Two trucks, one and the other: both are found, each once, and no third is needed."""
    first, box = placed_scene(5, (0, 0), 0.7)
    second, other = placed_scene(5, (150, 70), 0.7)
    image = first.clone()
    image[:, 70:, 150:] = second[:, 70:, 150:]
    results = localize(registrar, [image], instances=2)[0]
    overlap = box_iou(torch.stack([r.localization.box for r in results]), torch.stack([box, other]).double())
    assert len(results) == 2
    assert sorted(overlap.argmax(dim=1).tolist()) == [0, 1]
    assert overlap.amax(dim=1).min() > 0.5
    assert results[0].localization.presence >= results[1].localization.presence
    assert torch.equal(results[0].localization.boxes[:2], torch.stack([r.localization.box for r in results]))
    with pytest.raises(InvalidInputError, match="instances: expected >= 1, got 0"):
        localize(registrar, [image], instances=0)


def test_places_that_lead_to_one_object_give_one_answer(registrar, monkeypatch):
    """Two places beside each other are followed to the same truck, and two objects are asked for."""
    image, box = placed_scene(5, (60, 40), 0.9)
    side = float((box[2:] - box[:2]).max())
    beside = torch.stack([box - 0.36 * side, box + 0.36 * side]).float()
    assert box_iou(beside[:1], beside[1:]) < 0.5, "places that the locator takes for two"
    located = Located(beside, torch.tensor([9.0, 8.0]), torch.zeros(2, dtype=torch.long))
    monkeypatch.setattr(registrar, "locator", _Proposing(located, registrar.locator.features))
    monkeypatch.setattr(localization_module, "projected_box", lambda *_: box.double())
    results = localize(registrar, [image], instances=2)[0]
    assert len(results) == 1
    assert torch.equal(results[0].localization.box, box.double())


def test_of_answers_that_overlap_the_surest_stays(registrar):
    image, _ = placed_scene(5, (90, 40), 0.9)
    sure = registrar([image])[0]
    beside = replace(sure, localization=replace(sure.localization, box=sure.localization.box + 500.0, presence=0.1))
    less = replace(sure, localization=replace(sure.localization, presence=0.5 * sure.localization.presence))
    for first, second in ((sure, less), (less, sure)):
        answers = [beside, first]
        localization_module._add(answers, second)
        assert len(answers) == 2
        assert answers[0] is beside
        assert answers[1] is sure


class _Proposing:
    """A locator that always proposes the same places."""

    def __init__(self, located, features):
        self.located, self.features = located, features

    def __call__(self, *_, **__):
        return [self.located]


def test_what_cannot_be_searched_takes_nothing_else_down(registrar):
    image = placed_scene(5, (90, 40), 0.9)[0]
    nan = image.clone()
    nan[0, 3, 3] = torch.nan
    results = registrar([torch.full((3, 80, 100), 0.5), image, nan, torch.rand(2, 9, 9)])
    assert [result.ok for result in results] == [False, True, False, False]
    for failed, word, error in zip(
        (results[0], results[2], results[3]),
        ("image 0: .*one colour", "image 2: NaN", "image 3: photograph: expected 1"),
        (ImageError, ImageError, InvalidInputError),
        strict=True,
    ):
        with pytest.raises(error, match=word):
            _ = failed.rotation
    alone = registrar([image])[0]
    assert torch.equal(alone.localization.boxes, results[1].localization.boxes)
    with pytest.raises(InvalidInputError, match="distance: needs the camera"):
        registrar([image], distance=(1.0, 2.0))
    with pytest.raises(InvalidInputError, match="distance: limits the search"):
        registrar([image], [[4.0, 4.0, 40.0, 40.0]], CAMERA, distance=(1.0, 2.0))
    nowhere = registrar([image], camera_matrices=CAMERA, distance=(1e-3, 2e-3))[0]
    with pytest.raises(InvalidInputError, match="image 0: nothing of such a size fits"):
        _ = nowhere.rotation
    with pytest.raises(InvalidInputError, match="distance: expected 0 < MIN"):
        registrar([image], camera_matrices=CAMERA, distance=(3.0, 2.0))


@pytest.mark.parametrize(("preset", "evidence"), [("learned", [7.0, 0.6]), ("classical", [0.6])])
def test_constants_of_presence_are_those_that_the_script_found(preset, evidence):
    record = Path(__file__).parents[2] / "scripts" / "results" / "location.json"
    found = json.loads(record.read_text(encoding="utf-8"))["presence"][preset]
    logit = sum(w * v for w, v in zip(found["weights"], evidence, strict=True)) + found["bias"]
    assert presence(evidence) == pytest.approx(1 / (1 + math.exp(-logit)))


@pytest.mark.parametrize("base", [[6.0, 0.5], [0.5]])
def test_presence_rises_with_each_piece_of_evidence(base):
    for k in range(len(base)):
        more = list(base)
        more[k] += 0.1
        assert presence(more) > presence(base)


@pytest.mark.parametrize(("preset", "pieces"), [("learned", 2), ("fast", 2), ("classical", 1), ("paper", 1)])
def test_presence_is_judged_by_what_it_was_fitted_on(preset, pieces):
    """Scores of places count where the locator looks at pictures; those of fields mean nothing to what was fitted."""
    registrar = cr.Registrar(bank(preset))
    image, box = placed_scene(5, (90, 40), 0.9)
    places = [
        ScoredCandidates.score_boxes(registrar, ImageItem(image, box, None), box[None], torch.tensor([score]))
        for score in (4.0, 9.0)
    ]
    low, high = (float(place.presence[0]) for place in places)
    assert [len(place.evidence[0]) for place in places] == [pieces] * 2
    assert low < high if pieces == 2 else low == high


class Proposed:
    """A locator that proposes these boxes, whatever the photograph."""

    features = SimpleNamespace(learned=True)

    def __init__(self, boxes, scores):
        self.located = Located(torch.stack(boxes), torch.tensor(scores), torch.zeros(len(boxes), dtype=torch.long))

    def __call__(self, images, **_):
        return [self.located] * len(images)


def test_one_place_more_than_objects_is_looked_at():
    """The locator likes a place of the background a little better than the object's: the one that is surer is taken,
    also where only one place is to be followed."""
    pipeline = unrefined(bank(), locate=replace(bank().pipeline.locate, candidates=1))
    registrar = cr.Registrar(bank(), pipeline=pipeline)
    image, box = placed_scene(5, (90, 40), 0.9)
    elsewhere = torch.tensor([2.0, 2.0, 60.0, 40.0])
    registrar.__dict__["locator"] = Proposed([elsewhere, box], [6.2, 6.0])
    result = localize(registrar, [image], instances=1)[0][0]
    assert box_iou(result.localization.box[None], box[None].double()) > 0.5
