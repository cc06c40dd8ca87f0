"""Objects without a box: detected, registered, counted, or reported as absent."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
import torch.nn.functional as F

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError, LostObjectError
from curvireg_torch.geometry import (
    PosePrior,
    box_iou,
    projected_boxes,
    rotation_error,
    viewpoint_from_rotation,
)
from curvireg_torch.matching import ViewDescriber, ViewMatcher
from curvireg_torch.matching.detector import _medoids
from curvireg_torch.registration import Detector, Proposals, block, detect
from curvireg_torch.registration import detection as detection_module
from curvireg_torch.registration.detection import RegisteredBox, _add, _allowed_views
from curvireg_torch.registration.photograph import Photograph
from curvireg_torch.synthetic import example_mesh, procedural_background
from curvireg_torch.visualization.words import corners
from tests._support import (
    CAMERA,
    answer_of,
    bank_of,
    check_agreement,
    check_near,
    double,
    refused,
    scene,
    seeded,
    slow_after,
    unrefined,
)

SIZE = (240, 320)
FOCAL = float(CAMERA[0, 0])
FEW = cr.pipeline.DetectionSettings(proposals=4, min_size=0.2)


@cache
def bank():
    views = cr.sample_views(azimuth_step=30, elevations=[15, 45])
    return bank_of(example_mesh(), views)


@cache
def detector():
    return Detector(ViewMatcher(bank()))


def pasted_scene(seed, corner, scale):
    """The scene's truck with its background, pasted into other clutter: image (3, H, W) and box
    (4,)."""
    image, box, _ = scene(seed)
    small = F.interpolate(image[None], scale_factor=scale, mode="bilinear", antialias=True)[0]
    canvas = clutter(100 + seed)
    x, y = corner
    h, w = small.shape[1:]
    canvas[:, y : y + h, x : x + w] = small
    return canvas, (box + 0.5) * scale - 0.5 + torch.tensor([x, y, x, y])


def clutter(seed):
    return procedural_background(SIZE, seeded(seed))


@pytest.fixture(scope="module")
def registrar():
    return cr.Registrar(bank(), pipeline=unrefined(bank(), detection=FEW))


@pytest.fixture(scope="module")
def found(registrar):
    """A truck pasted into clutter, its box, and the result."""
    image, box = pasted_scene(5, (90, 40), 0.9)
    return image, box, registrar([image])[0]


def fixed(boxes, responses):
    """A detector that always proposes the same boxes."""
    return lambda *_, **__: Proposals(
        boxes, torch.tensor(responses), torch.zeros(len(boxes), dtype=torch.long)
    )


@pytest.mark.parametrize(
    ("seed", "corner", "scale"), slow_after(1, [(5, (30, 60), 0.6), (7, (40, 10), 1.1)])
)
def test_detected_pose_is_the_true_one(seed, corner, scale):
    """Pasted elsewhere at another scale; the camera of the scene is transformed accordingly."""
    image, box = pasted_scene(seed, corner, scale)
    K = CAMERA.clone()
    K[:2] *= scale
    K[:2, 2] += 0.5 * scale - 0.5 + torch.tensor(corner)
    few = replace(bank().pipeline, detection=replace(FEW, proposals=2, min_size=0.1))
    result = cr.Registrar(bank(), pipeline=few)([image], camera_matrices=K)[0]
    assert (result.detection.box - box).abs().max() < 0.1 * (box[2:] - box[:2]).max()
    check_near(result.transform, scene(seed)[2], degrees=5.0, share=0.05)


def test_pose_outside_the_photograph_has_score_zero(registrar, found, monkeypatch):
    outside = double([-300.0, -200.0, -100.0, -50.0])
    monkeypatch.setattr(detection_module, "projected_box", lambda *_: outside)
    result = registrar([found[0]])[0]
    assert result.ok
    assert result.detection.score == 0.0


def test_detect_finds_several_instances(registrar):
    image, box = pasted_scene(5, (0, 0), 0.7)
    second, other = pasted_scene(5, (150, 70), 0.7)
    image[:, 70:, 150:] = second[:, 70:, 150:]
    results = detect(registrar, [image], instances=2)[0]
    boxes = torch.stack([r.detection.box for r in results])
    overlap = box_iou(boxes, torch.stack([box, other]).double())
    assert sorted(overlap.argmax(dim=1).tolist()) == [0, 1]
    assert overlap.amax(dim=1).min() > 0.5
    assert results[0].detection.score >= results[1].detection.score
    assert torch.equal(results[0].detection.boxes[:2], boxes)
    with refused("instances: expected >= 1, got 0"):
        detect(registrar, [image], instances=0)


def as_found(result, **changes):
    where = result.detection
    known = 0, where.box, where.response, None, where.score
    return replace(RegisteredBox(*known, registration=result), **changes)


def test_probabilities_are_those_of_a_right_box_times_its_score(found):
    one = as_found(replace(found[2], probabilities=(0.8, 0.1)))
    none = Proposals(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, dtype=torch.long))
    (found_there,) = detection_module._with_proposals([one], none)
    assert found_there.probabilities == pytest.approx((0.8 * one.score, 0.1 * one.score))


@pytest.mark.parametrize(("score", "lost"), [(0.099, True), (0.101, False)])
def test_an_object_at_no_convincing_place_is_lost(registrar, found, monkeypatch, score, lost):
    """Instead of a pose the answer says where it may be, and asks for a box."""
    certain = replace(found[2], probabilities=(1.0,))
    one = replace(as_found(certain), score=score)
    monkeypatch.setattr(detection_module, "_register_candidates", lambda *_: {0: [one]})
    result = registrar([found[0]])[0]
    assert result.ok != lost
    if lost:
        assert torch.equal(result.error.detection.box, one.box)
        assert len(result.error.with_subject("photo.jpg").detection.boxes) > 1
        assert isinstance(result.error, LostObjectError)
        place = f"at the most likely place, box {corners(one.box.tolist())}"
        seen = "the object is seen with a probability of 0.09; give a box"
        assert str(result.error) == f"image 0: not found: {place}, {seen}"


def test_bad_distances_raise(registrar, found):
    similar = cr.Registrar(bank(), mesh_is="similar")
    for boxes in (None, [[4.0, 4.0, 40.0, 40.0]]):
        (result,) = similar([found[0]], boxes, prior=cr.PosePrior(distance=(1.0, 2.0)))
        assert "distance: with a similar mesh, needs the camera" in str(result.error)
    inside = (
        "distance: at most 0.002 from the centre, the camera is inside the object, whose "
        "radius is 0.176"
    )
    for boxes, distance, message in (
        (None, (500.0, 900.0), "nothing of such a size fits"),
        (None, (1e-3, 2e-3), inside),
        ([[4.0, 4.0, 40.0, 40.0]], (1e-3, 2e-3), inside),
    ):
        prior = cr.PosePrior(distance=distance)
        with refused(f"image 0: {message}"):
            _ = registrar([found[0]], boxes, CAMERA, prior=prior)[0].rotation


def test_right_hint_that_leaves_no_view_at_some_proposals_does_not_fail(registrar, monkeypatch):
    """In a wide camera: the hint holds at the truck, and nowhere at the other proposals, which come
    first."""
    image, box = pasted_scene(5, (200, 120), 0.45)
    K = cr.camera_matrix(150.0, 150.0, 159.5, 119.5)
    alone = answer_of(registrar, image, box, K)
    prior = PosePrior(rotation=alone.rotation, within=2.0)
    far = torch.tensor([[4.0, 4.0, 44.0, 44.0], [4.0, 190.0, 44.0, 230.0]])
    monkeypatch.setattr(registrar, "detector", fixed(torch.cat([far, box[None]]), [9.0, 8.0, 7.0]))
    result = registrar([image], camera_matrices=K, prior=prior)[0]
    assert result.ok
    assert box_iou(result.detection.box[None], box[None].double()) > 0.5


def test_detector_does_not_compare_views_that_the_prior_excludes(registrar, found, monkeypatch):
    image = found[0]
    prior = PosePrior(azimuth=(180.0, 220.0))
    monkeypatch.setattr(registrar, "mesh_is", "similar")
    result = registrar([image], prior=prior)[0]
    item = Photograph(image, torch.tensor([0.0, 0.0, 9.0, 9.0]), None, prior)
    allowed = _allowed_views(registrar, item)
    azimuths = viewpoint_from_rotation(bank().rotations[allowed])[0]
    assert azimuths.round().unique().tolist() == [180.0, 210.0]
    located = registrar.detector(image, allowed=allowed)
    assert allowed[located.views].all(), "each view of this small bank is its own template"
    assert set(result.detection.responses.tolist()) <= set(located.responses.tolist())
    everything = registrar.detector(image, allowed=torch.ones_like(allowed))
    assert torch.equal(everything.boxes, registrar.detector(image).boxes)
    assert not allowed[everything.views].all()


def test_allowed_views_are_those_of_any_place_in_the_photograph(registrar):
    """Half of the diagonal is 30 degrees wide; 7.5 more are the spacing of views."""
    image = scene(0)[0]
    prior = PosePrior(rotation=bank().rotations[0], within=1.0)
    item = Photograph(image, torch.tensor([-0.5, -0.5, 239.5, 179.5]), cr.Camera(CAMERA), prior)
    degrees = rotation_error(bank().rotations, bank().rotations[0])
    unknown = replace(item, camera=None)
    similar = cr.Registrar(bank(), mesh_is="similar")
    for target, photograph, half in (
        (registrar, item, math.atan(150 / 260)),
        (registrar, unknown, math.atan(150 / (0.8 * 240))),  # a usual one
        (similar, unknown, 0.0),
    ):
        allowed = degrees <= 8.5 + math.degrees(half)
        assert torch.equal(_allowed_views(target, photograph), allowed)


def test_detector_finds_the_object():
    image, box = pasted_scene(1, (100, 30), 0.8)
    located = detector()(image)
    assert box_iou(located.boxes, box[None])[:2].max() > 0.6
    assert located.responses.diff().max() <= 0
    assert (len(located.boxes), located.boxes.dtype) == (20, torch.float32)
    assert (box_iou(located.boxes, located.boxes) > 0.5).sum() == len(located.boxes), (
        "boxes are distinct"
    )


def test_medoids_are_the_centres_of_clusters():
    order = torch.randperm(9, generator=seeded(0))
    points = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1, 5.2, 9.0, 9.1, 9.2])[order]
    medoids = _medoids((points[:, None] - points).square(), 3)
    assert sorted(points[medoids].tolist()) == pytest.approx([0.1, 5.1, 9.1])


def test_distance_limits_each_box_by_its_view():
    """To half a step of sizes, and what rounding a size to cells of 16 px adds."""
    image, _, T = scene(1)
    low = 0.95 * float(T[2, 3])
    high = 1.05 * float(T[2, 3])
    located = detector()(image, focal=FOCAL, distance=(low, high))
    boxes = bank().boxes[located.views]
    views = located.views
    sides = (boxes[:, 2:] - boxes[:, :2]).amax(dim=1) * bank().distances[views]
    away = sides * FOCAL / (located.boxes[:, 2:] - located.boxes[:, :2]).amax(dim=1)
    assert len(away) > 5
    assert away.min() > low / 2.0**0.25 * 0.9
    assert away.max() < high * 2.0**0.25 * 1.1


def test_detector_rejects_bad_distances_images_and_settings():
    image = torch.rand(3, 60, 80)
    for distance in ((0.0, 1.0), (2.0, 1.0), (1.0, float("inf")), (float("nan"), 1.0)):
        with refused("distance: expected 0 < NEAR <= FAR"):
            detector()(image, focal=FOCAL, distance=distance)
    with refused("distance: needs the camera matrix"):
        detector()(image, distance=(1.0, 2.0))
    with refused("images: expected"):
        detector()(image[:2])
    with refused("min_size"):
        cr.pipeline.DetectionSettings(min_size=0.0)
    with refused("views: expected an integer"):
        cr.pipeline.DetectionSettings(views=0)


def test_boxes_of_peaks_are_exact():
    """The box of a peak is that of the view's projected hull, scaled and shifted with the
    template."""
    views = detector()._views
    describer = ViewDescriber(example_mesh(), replace(bank().settings, image_size=96))
    T, K, _ = describer.cameras(bank().rotations[views], bank().distances[views])
    drawn = projected_boxes(describer.hull, T, K)
    for k, i, j, ratio in ((0, 8, 11, (1.0, 1.0)), (3, 5, 9, (0.5, 0.4)), (5, 9, 3, (1.5, 1.6))):
        similarity = torch.zeros(len(views), 15, 20)
        similarity[k, i, j] = 1.0
        best = detector()._peaks([similarity], [torch.ones(len(views), dtype=torch.bool)], [ratio])
        # The template's centre, 47.5 px, is 8 j px from the left border of the resized photograph.
        centre = double([8.0 * j, 8.0 * i] * 2)
        expected = (drawn[k] - 47.5 + centre) / double(ratio * 2) - 0.5
        torch.testing.assert_close(best.boxes[0].double(), expected, rtol=0, atol=0.01)
        assert int(best.views[0]) == int(views[k])


@pytest.mark.parametrize(
    ("shape", "least"), [((60, 80), 32.0), ((20, 24), 24.0), ((900, 1200), None)]
)
def test_smallest_size(shape, least):
    """32 px in small photographs, at most the whole photograph; a fraction of the longer side in
    large ones."""
    least = 1200 * detector().settings.min_size if least is None else least
    scales = detector()._scales(torch.zeros(3, *shape), None, None, 80.0)
    assert 80.0 / max(scales) == pytest.approx(least)


def box_at(x0, score, confidence=None):
    """One of 10 px whose registration has a confidence."""
    box = torch.tensor([x0, 0.0, x0 + 10.0, 10.0])
    registration = SimpleNamespace(confidence=confidence)
    return RegisteredBox(0, box, 1.0, None, score, registration=registration)


@pytest.mark.parametrize(("score", "kept"), [(0.2, [0.9, 0.3]), (0.5, [0.9, 0.3]), (0.95, [0.95])])
def test_an_object_replaces_those_that_it_overlaps_if_it_is_more_certain_than_each(score, kept):
    found = [box_at(0.0, 0.9), box_at(5.0, 0.3)]
    _add(found, box_at(2.0, score))
    assert [one.score for one in found] == kept
    _add(found, box_at(40.0, 0.1))  # elsewhere
    assert [one.score for one in found] == [*kept, 0.1]


def test_boxes_around_poses_are_registered_where_they_are_more_certain(monkeypatch):
    """Nothing supports a pose whose box lies outside the photograph."""
    ones = [box_at(0.0, 0.5) for _ in range(3)]
    again = [box_at(1.0, 0.49), InvalidInputError("outside"), box_at(1.0, 0.51)]
    other = box_at(2.0, 0.6)
    monkeypatch.setattr(detection_module, "_scored", lambda *_: again)
    registered = Mock(return_value=[other])
    monkeypatch.setattr(detection_module, "_registered", registered)
    kept, outside, better = detection_module._refined(None, {}, ones)
    assert kept is ones[0]
    assert outside.score == 0.0
    assert better is other
    registered.assert_called_once_with(None, {}, [again[2]])


def test_places_of_one_object_leave_room_for_others(monkeypatch):
    """The first three lead to one object, and another takes their place, though one was asked for.
    It is the more probable one."""
    boxes = torch.cat([box_at(20.0 * k, 0.0).box[None] for k in range(4)])
    same = {response: box_at(0.0, response / 10, 0.5) for response in (9.0, 8.0, 7.0)}
    there = {**same, 6.0: box_at(40.0, 0.6)}
    asked = []

    def registered(_, __, some):
        asked.append([one.response for one in some])
        return [there[one.response] for one in some]

    monkeypatch.setattr(detection_module, "_registered", registered)
    monkeypatch.setattr(detection_module, "_refined", lambda _, __, some: some)
    monkeypatch.setattr(
        detection_module,
        "_scored",
        lambda _, __, some: [replace(one, score=one.response / 10) for one in some],
    )
    proposals = Proposals(boxes, torch.tensor([9.0, 8, 7, 6]), torch.zeros(4, dtype=torch.long))
    found = detection_module._register_candidates(None, {}, {0: proposals}, 1)
    assert asked == [[9.0, 8.0], [7.0], [6.0]]
    assert [one.score for one in found[0]] == [0.6]


@pytest.mark.slow
def test_photographs_are_searched_together_as_alone(registrar, found, monkeypatch):
    """One that cannot be searched fails alone, and each answer is that of its own photograph."""
    monkeypatch.setattr(block, "BLOCK", {"cpu": 2})
    images = [found[0], pasted_scene(5, (200, 120), 0.45)[0], torch.zeros_like(found[0])]
    together = detect(registrar, images, instances=2)
    for number, image in enumerate(images):
        (alone,) = detect(registrar, [image], instances=2)
        assert len(together[number]) == len(alone)
        for one, other in zip(together[number], alone, strict=True):
            assert one.ok == other.ok == (number != 2)
            if one.ok:
                assert torch.allclose(one.detection.box, other.detection.box, atol=0.05)
                check_agreement(one, other)
            else:
                assert str(one.error) == str(other.error).replace("image 0", f"image {number}")


def test_scores_are_relative_to_the_view_elsewhere_in_the_photograph():
    """Level and spread of a view's similarity do not matter."""
    generator = seeded(3)
    K = len(detector()._views)
    maps = [0.1 * torch.rand(K, *size, generator=generator) for size in ((15, 20), (21, 28))]
    fits = [torch.ones(K, dtype=torch.bool)] * 2
    ratios = [(1.0, 1.0), (1.4, 1.4)]
    gain, level = 0.5 + torch.rand(2, K, 1, 1, generator=generator)
    plain = detector()._peaks(maps, fits, ratios)
    biased = detector()._peaks([gain * m + level for m in maps], fits, ratios)
    assert torch.equal(biased.views, plain.views)
    assert torch.allclose(biased.responses, plain.responses, atol=1e-4)
    every = torch.cat([m.flatten(1) for m in maps], dim=1)
    z = (every - every.mean(dim=1, keepdim=True)) / every.std(dim=1, keepdim=True)
    assert float(plain.responses[0]) == pytest.approx(float(z.max()), rel=1e-4)
