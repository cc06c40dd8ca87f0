"""Random arrangements and their rendering."""

import dataclasses

import numpy as np
import pytest

from curvireg_torch.training.scenes import random_shape
from curvireg_torch.training.scenes.arrangement import _crop_camera, arrange
from curvireg_torch.training.scenes.scene import render_scene


@pytest.fixture(scope="module")
def drawn():
    shape, other = (random_shape(np.random.default_rng(k), "chair") for k in (1, 2))
    return arrange(shape, [other, other], np.random.default_rng(7), size=48, upright=1.0)


@pytest.fixture(scope="module")
def before(drawn):
    return render_scene(drawn, np.random.default_rng(3))


def test_render_scene_with_other_light_or_without_clutter(drawn, before):
    """Light changes the image only; without clutter no part of the object becomes invisible."""
    assert np.array_equal(before.image, render_scene(drawn, np.random.default_rng(3)).image)
    dark = dataclasses.replace(drawn.light, lamps=(), sky=(0.5, 0.0), reflection=None)
    after = render_scene(dataclasses.replace(drawn, light=dark), np.random.default_rng(3))
    assert not np.array_equal(before.image, after.image)
    assert np.array_equal(before.depth, after.depth)
    assert np.array_equal(before.visible, after.visible)
    alone = render_scene(dataclasses.replace(drawn, shapes=drawn.shapes[:1]), np.random.default_rng(3))
    assert (alone.visible | ~before.visible).all()


def test_crop_camera_border_cuts_the_object():
    """10 to 45 % of the width or height are outside, up to the jitter of the box."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.7, 0.7) for z in (4.7, 5.3)])
    size, sides = 200, set()
    for seed in range(60):
        K, area = _crop_camera(corners, np.random.default_rng(seed), size)
        seen = corners @ K.T
        seen = seen[:, :2] / seen[:, 2:]
        low, high = seen.min(axis=0) + 0.5, seen.max(axis=0) + 0.5
        beyond = np.concatenate([(area[:2] - low) / (high - low), (high - area[2:]) / (high - low)])
        for side in np.flatnonzero(np.array(area) != (0, 0, size, size)):
            assert -0.1 < beyond[side] < 0.65
            sides.add(int(side))
            if beyond[side] < 0.02:
                sides.add(f"hardly {seed}")
    assert {0, 1, 2, 3} <= sides
    assert len(sides) <= 5


def test_render_scene_has_nothing_visible_outside_the_photo(drawn, before):
    """If the photograph ends in the middle of the object, only its depth continues."""
    half = render_scene(dataclasses.replace(drawn, photo_area=(24, 0, 48, 48)), np.random.default_rng(3))
    assert before.visible[:, :24].any()
    assert before.visible[:, 24:].any()
    assert not half.visible[:, :24].any()
    assert np.array_equal(half.visible[:, 24:], before.visible[:, 24:])
    assert np.array_equal(half.depth, before.depth)
