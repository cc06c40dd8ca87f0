"""Objects rendered into clutter at known places are found there."""

from dataclasses import replace
from functools import cache

import pytest
import torch
import torch.nn.functional as F

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import box_iou, projected_boxes
from curvireg_torch.matching import ViewDescriber, ViewMatcher
from curvireg_torch.registration.locator import Locator
from curvireg_torch.registration.locator.dense_features import BackboneFeatures, dense_features_for
from curvireg_torch.synthetic import example_mesh, procedural_background
from tests._support.scenes import CAMERA, scene, truck_bank

SIZE = (240, 320)


@cache
def bank(preset="learned"):
    views = cr.sample_views(azimuth_step=30, elevations=[15, 45])
    pipeline = cr.Pipeline() if preset == "learned" else cr.pipeline.PRESETS[preset]
    return cr.ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False)


@cache
def locator(preset="learned"):
    return Locator(ViewMatcher(bank(preset)))


def test_the_network_of_the_appearance_term_is_not_loaded_again():
    matcher = ViewMatcher(bank())
    cells = dense_features_for(matcher)
    assert isinstance(cells, BackboneFeatures)
    assert any(cells.backbone is module for module in matcher.modules())


def test_pictures_are_looked_at_wherever_something_was_learnt():
    """A preset without the appearance term, but with the learnt field, finds as the default does: 0 of 14 without."""
    assert locator("fast").features.learned
    assert not locator("classical").features.learned
    image, box = placed_scene(1, (100, 30), 0.8)
    fast, default = locator("fast")([image])[0], locator()([image])[0]
    assert torch.equal(fast.boxes, default.boxes)
    assert box_iou(fast.boxes[:1], box[None]) > 0.6


def placed_scene(seed, corner, scale, size=SIZE):
    """The scene's truck, its background and all, pasted into other clutter: image (3, H, W) and box (4,)."""
    image, box, _ = scene(seed)
    small = F.interpolate(image[None], scale_factor=scale, mode="bilinear", antialias=True)[0]
    canvas = procedural_background(size, torch.Generator().manual_seed(100 + seed))
    x, y = corner
    h, w = small.shape[1:]
    canvas[:, y : y + h, x : x + w] = small
    return canvas, (box + 0.5) * scale - 0.5 + torch.tensor([x, y, x, y])


@pytest.mark.parametrize("preset", ["learned", "classical"])
@pytest.mark.parametrize(("seed", "corner", "scale"), [(0, (10, 20), 0.8), (1, (100, 30), 0.8), (3, (40, 10), 1.1)])
def test_an_object_is_found_where_it_was_put(preset, seed, corner, scale):
    image, box = placed_scene(seed, corner, scale)
    found = locator(preset)([image])[0]
    overlap = box_iou(found.boxes, box[None])[:, 0]
    told = overlap[:6].tolist(), found.scores[:6].tolist()
    if preset == "learned":
        assert overlap[:2].max() > 0.6, told
    else:
        assert overlap[:5].max() > 0.55, told
    assert found.scores.diff().max() <= 0
    assert found.boxes.dtype == torch.float32
    assert (box_iou(found.boxes, found.boxes) > 0.5).sum() == len(found.boxes), "no place twice"


def test_what_is_found_moves_with_the_picture():
    """Pasted elsewhere, the best box goes along: places are not mirrored, swapped or shifted."""
    middles = []
    for corner in ((10, 40), (100, 40), (100, 10)):
        image, box = placed_scene(5, corner, 0.8)
        best = locator()([image])[0].boxes[0]
        assert box_iou(best[None], box[None]) > 0.6
        middles.append(0.5 * (best[:2] + best[2:]))
    for moved, true in zip(torch.stack(middles).diff(dim=0).tolist(), [(90, 0), (0, -30)], strict=True):
        assert moved == pytest.approx(true, abs=10)


def test_pictures_without_the_object_score_lower():
    with_it = [locator()([placed_scene(seed, (40, 30), 0.9)[0]])[0].scores[0] for seed in (0, 1, 3)]
    without = [
        locator()([procedural_background(SIZE, torch.Generator().manual_seed(7 + k))])[0].scores[0] for k in range(3)
    ]
    assert min(with_it) > max(without)


def test_a_view_that_agrees_with_everything_tells_nothing():
    """How much a view agrees on the whole, and how unevenly, does not count: it scores against itself elsewhere."""
    generator = torch.Generator().manual_seed(3)
    K = len(locator()._templates.views)
    maps = [0.1 * torch.rand(K, *size, generator=generator) for size in ((15, 20), (21, 28))]
    fits = [torch.ones(K, dtype=torch.bool)] * 2
    gain, level = 0.5 + torch.rand(2, K, 1, 1, generator=generator)
    plain = locator()._peaks(maps, fits, [(1.0, 1.0), (1.4, 1.4)])
    biased = locator()._peaks([gain * m + level for m in maps], fits, [(1.0, 1.0), (1.4, 1.4)])
    assert torch.equal(biased.views, plain.views)
    assert torch.allclose(biased.scores, plain.scores, atol=1e-4)
    every = torch.cat([m.flatten(1) for m in maps], dim=1)
    z = (every - every.mean(dim=1, keepdim=True)) / every.std(dim=1, keepdim=True)
    assert float(plain.scores[0]) == pytest.approx(float(z.max()), rel=1e-4)


def test_a_photograph_is_answered_the_same_alone_grey_or_as_bytes():
    images = [placed_scene(0, (10, 20), 0.8)[0], placed_scene(1, (60, 30), 0.8)[0]]
    both, alone = locator()(images), locator()(images[1:])
    assert torch.equal(both[1].boxes, alone[0].boxes)
    assert torch.equal(both[1].scores, alone[0].scores)
    known = (images[0] * 255).round().to(torch.uint8)
    as_float, as_bytes = locator()([known.float() / 255])[0], locator()([known])[0]
    assert torch.equal(as_float.boxes, as_bytes.boxes)
    grey = images[0].mean(dim=0, keepdim=True)
    assert torch.equal(locator()([grey])[0].boxes, locator()([grey.expand(3, -1, -1)])[0].boxes)


def test_distances_rule_out_sizes():
    """A camera and the distances that are possible: only boxes of such sizes, and the true one among them."""
    image, box, T = scene(1)
    true = float(T[2, 3])
    within = locator()([image], camera_matrices=[CAMERA], distance=(0.85 * true, 1.15 * true))[0]
    assert box_iou(within.boxes[:2], box[None]).max() > 0.5
    side = (box[2:] - box[:2]).max()
    for factor in (0.5, 2.0):
        other = locator()([image], camera_matrices=[CAMERA], distance=(0.9 * factor * true, 1.1 * factor * true))[0]
        sides = (other.boxes[:, 2:] - other.boxes[:, :2]).amax(dim=1)
        assert 0.5 < float(sides.median() * factor / side) < 2.0, "nearer is larger"
    twice = CAMERA.clone()
    twice[:2] *= 2
    same = locator()([image], camera_matrices=[twice], distance=(1.7 * true, 2.3 * true))[0]
    assert torch.equal(same.boxes, within.boxes), "twice the focal length is half the distance"


def test_what_cannot_be_asked():
    image = torch.rand(3, 60, 80)
    for distance in ((0.0, 1.0), (2.0, 1.0), (-1.0, 1.0), (1.0, float("inf")), (float("nan"), 1.0)):
        with pytest.raises(InvalidInputError, match="distance: expected 0 < MIN <= MAX"):
            locator()([image], camera_matrices=[CAMERA], distance=distance)
    with pytest.raises(InvalidInputError, match="distance: needs the camera matrix"):
        locator()([image], distance=(1.0, 2.0))
    for wrong in (torch.rand(2, 60, 80), torch.rand(60, 80), torch.rand(3, 0, 80)):
        with pytest.raises(InvalidInputError, match="images: expected"):
            locator()([wrong])
    with pytest.raises(InvalidInputError, match="min_size"):
        cr.pipeline.LocateSettings(min_size=0.0)
    with pytest.raises(InvalidInputError, match="views, proposals"):
        cr.pipeline.LocateSettings(views=0)


def test_locate_pads_what_differs_in_number():
    one_colour = torch.full((3, 120, 160), 0.5)
    boxes, scores = cr.locate(truck_bank().pipeline, truck_bank(), [placed_scene(0, (10, 20), 0.8)[0], one_colour])
    assert boxes.shape[:2] == scores.shape
    assert len(scores) == 2
    assert torch.equal(boxes.isnan().all(dim=2), scores == -torch.inf)
    assert cr.locate(truck_bank().pipeline, truck_bank(), [])[0].shape == (0, 0, 4)


def test_size_of_the_picture_does_not_matter():
    """Cost and answer are those of the picture's proportions: sizes are shares of it."""
    image, box = placed_scene(3, (40, 10), 1.1)
    large = F.interpolate(image[None], scale_factor=3, mode="bilinear")[0]
    found = [locator()([picture])[0].boxes[0] for picture in (image, large)]
    assert box_iou(found[0][None], (found[1][None] + 0.5) / 3 - 0.5) > 0.7
    assert box_iou(found[0][None], box[None]) > 0.4


def test_boxes_of_places_are_those_of_the_rendered_views_to_a_hundredth_of_a_pixel():
    """A view's picture of 96 px is scaled and moved as a peak says; its hull, projected by the camera of that picture
    and moved along, has the box that is proposed. Pixel centres are whole numbers."""
    views = locator()._templates.views
    describe = ViewDescriber(example_mesh(), replace(bank().settings, image_size=96))
    T, K, _ = describe.cameras(bank().rotations[views], bank().distances[views])
    drawn = projected_boxes(describe.hull, T, K)
    for k, i, j, ratio in ((0, 8, 11, (1.0, 1.0)), (3, 5, 9, (0.5, 0.4)), (5, 9, 3, (1.5, 1.6))):
        found = torch.zeros(len(views), 15, 20)
        found[k, i, j] = 1.0
        best = locator()._peaks([found], [torch.ones(len(views), dtype=torch.bool)], [ratio])
        # A point at the picture's middle, 47.5 px, lies 8 j px from the left border of the resized photograph.
        middle = torch.tensor([8.0 * j, 8.0 * i] * 2, dtype=torch.float64)
        expected = (drawn[k] - 47.5 + middle) / torch.tensor(ratio * 2, dtype=torch.float64) - 0.5
        torch.testing.assert_close(best.boxes[0].double(), expected, rtol=0, atol=0.01)
        assert int(best.views[0]) == int(views[k])


def test_every_box_is_as_large_as_its_view_would_be_at_a_distance_that_was_given():
    """Half a step of sizes beyond it at most, and what rounding a size to cells of 16 px does."""
    image, _, T = scene(1)
    low, high = 0.95 * float(T[2, 3]), 1.05 * float(T[2, 3])
    found = locator()([image], camera_matrices=[CAMERA], distance=(low, high))[0]
    known, views = bank(), found.views
    sides = (known.boxes[views, 2:] - known.boxes[views, :2]).amax(dim=1) * known.distances[views]
    shown = (found.boxes[:, 2:] - found.boxes[:, :2]).amax(dim=1)
    away = sides * float(CAMERA[0, 0]) / shown
    assert len(away) > 5
    assert float(away.min()) > low / 2.0**0.25 * 0.9
    assert float(away.max()) < high * 2.0**0.25 * 1.1


def test_objects_of_less_than_32_px_are_not_looked_for():
    """In a small photograph the least size counts, not the share of its longer side; a smaller one is looked at as a
    whole."""
    reach = 80.0
    for shape, least in (((60, 80), 32.0), ((20, 24), 24.0)):
        scales = locator()._scales(torch.zeros(3, *shape), None, None, reach)
        assert reach / max(scales) == pytest.approx(least)
    large = locator()._scales(torch.zeros(3, 900, 1200), None, None, reach)
    assert reach / max(large) == pytest.approx(1200 * locator().settings.min_size)
