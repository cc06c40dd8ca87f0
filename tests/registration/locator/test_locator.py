"""Objects rendered into clutter at known positions are located there."""

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
from curvireg_torch.synthetic import example_mesh, procedural_background
from tests._support.scenes import CAMERA, scene, truck_bank

SIZE = (240, 320)


@cache
def bank(preset="learned"):
    views = cr.sample_views(azimuth_step=30, elevations=[15, 45])
    return cr.ViewBank.build(example_mesh(), views, pipeline=cr.pipeline.PRESETS[preset], progress=False)


@cache
def locator(preset="learned"):
    return Locator(ViewMatcher(bank(preset)))


def pasted_scene(seed, corner, scale):
    """The scene's truck with its background, pasted into other clutter: image (3, H, W) and box (4,)."""
    image, box, _ = scene(seed)
    small = F.interpolate(image[None], scale_factor=scale, mode="bilinear", antialias=True)[0]
    canvas = clutter(100 + seed)
    x, y = corner
    h, w = small.shape[1:]
    canvas[:, y : y + h, x : x + w] = small
    return canvas, (box + 0.5) * scale - 0.5 + torch.tensor([x, y, x, y])


def clutter(seed):
    return procedural_background(SIZE, torch.Generator().manual_seed(seed))


def test_dense_features_reuse_the_network_of_the_appearance_term():
    assert any(locator().features.backbone is module for module in locator().matcher.modules())


def test_locator_uses_learned_features_where_the_pipeline_has_any():
    """The preset "fast" has the learned field, but not the appearance term."""
    assert locator("fast").features.learned
    assert not locator("classical").features.learned
    image, box = pasted_scene(1, (100, 30), 0.8)
    fast, default = locator("fast")([image])[0], locator()([image])[0]
    assert torch.equal(fast.boxes, default.boxes)
    assert box_iou(fast.boxes[:1], box[None]) > 0.6


@pytest.mark.parametrize(("preset", "among", "least"), [("learned", 2, 0.6), ("classical", 5, 0.55)])
@pytest.mark.parametrize(("seed", "corner", "scale"), [(0, (10, 20), 0.8), (1, (100, 30), 0.8), (3, (40, 10), 1.1)])
def test_locator_finds_the_object(preset, among, least, seed, corner, scale):
    image, box = pasted_scene(seed, corner, scale)
    located = locator(preset)([image])[0]
    assert box_iou(located.boxes, box[None])[:among].max() > least
    assert located.scores.diff().max() <= 0
    assert located.boxes.dtype == torch.float32
    assert (box_iou(located.boxes, located.boxes) > 0.5).sum() == len(located.boxes), "boxes are distinct"


def test_located_box_moves_with_the_object():
    centres = []
    for corner in ((10, 40), (100, 40), (100, 10)):
        image, box = pasted_scene(5, corner, 0.8)
        best = locator()([image])[0].boxes[0]
        assert box_iou(best[None], box[None]) > 0.6
        centres.append(0.5 * (best[:2] + best[2:]))
    for shift, expected in zip(torch.stack(centres).diff(dim=0).tolist(), [(90, 0), (0, -30)], strict=True):
        assert shift == pytest.approx(expected, abs=10)


def test_located_scores_are_lower_without_the_object():
    with_it = [locator()([pasted_scene(seed, (40, 30), 0.9)[0]])[0].scores[0] for seed in (0, 1, 3)]
    without = [locator()([clutter(7 + k)])[0].scores[0] for k in range(3)]
    assert min(with_it) > max(without)


def test_scores_are_relative_to_the_view_elsewhere_in_the_photograph():
    """Level and spread of a view's similarity do not matter."""
    generator = torch.Generator().manual_seed(3)
    K = len(locator()._templates.views)
    maps = [0.1 * torch.rand(K, *size, generator=generator) for size in ((15, 20), (21, 28))]
    fits, ratios = [torch.ones(K, dtype=torch.bool)] * 2, [(1.0, 1.0), (1.4, 1.4)]
    gain, level = 0.5 + torch.rand(2, K, 1, 1, generator=generator)
    plain = locator()._peaks(maps, fits, ratios)
    biased = locator()._peaks([gain * m + level for m in maps], fits, ratios)
    assert torch.equal(biased.views, plain.views)
    assert torch.allclose(biased.scores, plain.scores, atol=1e-4)
    every = torch.cat([m.flatten(1) for m in maps], dim=1)
    z = (every - every.mean(dim=1, keepdim=True)) / every.std(dim=1, keepdim=True)
    assert float(plain.scores[0]) == pytest.approx(float(z.max()), rel=1e-4)


def test_locator_is_independent_of_batch_dtype_and_grey_channels():
    images = [pasted_scene(0, (10, 20), 0.8)[0], pasted_scene(1, (60, 30), 0.8)[0]]
    both, alone = locator()(images), locator()(images[1:])
    assert torch.equal(both[1].boxes, alone[0].boxes)
    assert torch.equal(both[1].scores, alone[0].scores)
    as_bytes, grey = (images[0] * 255).round().to(torch.uint8), images[0].mean(dim=0, keepdim=True)
    for one, other in ((as_bytes, as_bytes.float() / 255), (grey, grey.expand(3, -1, -1))):
        assert torch.equal(locator()([one])[0].boxes, locator()([other])[0].boxes)


def test_distance_limits_sizes():
    image, box, T = scene(1)
    true = float(T[2, 3])
    within = locator()([image], camera_matrices=[CAMERA], distance=(0.85 * true, 1.15 * true))[0]
    assert box_iou(within.boxes[:2], box[None]).max() > 0.5
    side = (box[2:] - box[:2]).max()
    for factor in (0.5, 2.0):
        other = locator()([image], camera_matrices=[CAMERA], distance=(0.9 * factor * true, 1.1 * factor * true))[0]
        sides = (other.boxes[:, 2:] - other.boxes[:, :2]).amax(dim=1)
        assert 0.5 < float(sides.median() * factor / side) < 2.0, "nearer is larger"
    doubled = torch.diag(torch.tensor([2.0, 2.0, 1.0])).double() @ CAMERA
    same = locator()([image], camera_matrices=[doubled], distance=(1.7 * true, 2.3 * true))[0]
    assert torch.equal(same.boxes, within.boxes), "twice the focal length is half the distance"


def test_distance_limits_each_box_by_its_view():
    """To half a step of sizes, and what rounding a size to cells of 16 px adds."""
    image, _, T = scene(1)
    low, high = 0.95 * float(T[2, 3]), 1.05 * float(T[2, 3])
    located = locator()([image], camera_matrices=[CAMERA], distance=(low, high))[0]
    boxes, views = bank().boxes[located.views], located.views
    sides = (boxes[:, 2:] - boxes[:, :2]).amax(dim=1) * bank().distances[views]
    away = sides * float(CAMERA[0, 0]) / (located.boxes[:, 2:] - located.boxes[:, :2]).amax(dim=1)
    assert len(away) > 5
    assert float(away.min()) > low / 2.0**0.25 * 0.9
    assert float(away.max()) < high * 2.0**0.25 * 1.1


def test_locator_rejects_bad_distances_images_and_settings():
    for distance in ((0.0, 1.0), (2.0, 1.0), (-1.0, 1.0), (1.0, float("inf")), (float("nan"), 1.0)):
        with pytest.raises(InvalidInputError, match="distance: expected 0 < NEAR <= FAR"):
            locator()([torch.rand(3, 60, 80)], camera_matrices=[CAMERA], distance=distance)
    with pytest.raises(InvalidInputError, match="distance: needs the camera matrix"):
        locator()([torch.rand(3, 60, 80)], distance=(1.0, 2.0))
    for wrong in (torch.rand(2, 60, 80), torch.rand(60, 80), torch.rand(3, 0, 80)):
        with pytest.raises(InvalidInputError, match="images: expected"):
            locator()([wrong])
    for settings, message in (({"min_size": 0.0}, "min_size"), ({"views": 0}, "views, proposals")):
        with pytest.raises(InvalidInputError, match=message):
            cr.pipeline.LocateSettings(**settings)


def test_locate_pads_photographs_with_fewer_boxes():
    images = [pasted_scene(0, (10, 20), 0.8)[0], torch.full((3, 120, 160), 0.5)]
    boxes, scores = cr.locate(truck_bank().pipeline, truck_bank(), images)
    assert boxes.shape[:2] == scores.shape
    assert len(scores) == 2
    assert torch.equal(boxes.isnan().all(dim=2), scores == -torch.inf)
    assert cr.locate(truck_bank().pipeline, truck_bank(), [])[0].shape == (0, 0, 4)


def test_locator_is_independent_of_resolution():
    image, box = pasted_scene(3, (40, 10), 1.1)
    large = F.interpolate(image[None], scale_factor=3, mode="bilinear")[0]
    best, best_large = (locator()([picture])[0].boxes[:1] for picture in (image, large))
    assert box_iou(best, (best_large + 0.5) / 3 - 0.5) > 0.7
    assert box_iou(best, box[None]) > 0.4


def test_boxes_of_peaks_are_exact():
    """The box of a peak is that of the view's projected hull, scaled and shifted with the template."""
    views = locator()._templates.views
    describer = ViewDescriber(example_mesh(), replace(bank().settings, image_size=96))
    T, K, _ = describer.cameras(bank().rotations[views], bank().distances[views])
    drawn = projected_boxes(describer.hull, T, K)
    for k, i, j, ratio in ((0, 8, 11, (1.0, 1.0)), (3, 5, 9, (0.5, 0.4)), (5, 9, 3, (1.5, 1.6))):
        similarity = torch.zeros(len(views), 15, 20)
        similarity[k, i, j] = 1.0
        best = locator()._peaks([similarity], [torch.ones(len(views), dtype=torch.bool)], [ratio])
        # The template's centre, 47.5 px, is 8 j px from the left border of the resized photograph.
        centre = torch.tensor([8.0 * j, 8.0 * i] * 2, dtype=torch.float64)
        expected = (drawn[k] - 47.5 + centre) / torch.tensor(ratio * 2, dtype=torch.float64) - 0.5
        torch.testing.assert_close(best.boxes[0].double(), expected, rtol=0, atol=0.01)
        assert int(best.views[0]) == int(views[k])


@pytest.mark.parametrize(("shape", "least"), [((60, 80), 32.0), ((20, 24), 24.0), ((900, 1200), None)])
def test_smallest_size(shape, least):
    """32 px in small photographs, at most the whole photograph; a fraction of the longer side in large ones."""
    least = 1200 * locator().settings.min_size if least is None else least
    scales = locator()._scales(torch.zeros(3, *shape), None, None, 80.0)
    assert 80.0 / max(scales) == pytest.approx(least)
