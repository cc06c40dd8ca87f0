"""Scenes are drawn first and rendered after."""

import dataclasses

import numpy as np
import pytest

from curvireg_torch.scenes import random_shape
from curvireg_torch.scenes.arrangement import arrange
from curvireg_torch.scenes.scene import make_scene, photograph


@pytest.fixture(scope="module")
def drawn():
    shape, other = (random_shape(np.random.default_rng(k), "chair") for k in (1, 2))
    return arrange(shape, [other, other], np.random.default_rng(7), size=48, upright=1.0)


def test_a_scene_is_its_arrangement_photographed():
    shape = random_shape(np.random.default_rng(1), "table")
    rng = np.random.default_rng(5)
    apart = photograph(arrange(shape, [], rng, size=32), rng)
    whole = make_scene(shape, [], np.random.default_rng(5), size=32)
    assert np.array_equal(apart.image, whole.image)
    assert np.array_equal(apart.depth, whole.depth)


def test_rendering_draws_nothing(drawn):
    """The camera's faults apart, an arrangement has one picture."""
    one, same = (photograph(drawn, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one.image, same.image)


def test_parts_of_an_arrangement_can_be_exchanged(drawn):
    """Another light changes the picture and leaves the truth; without clutter more of the object is seen, not less."""
    before = photograph(drawn, np.random.default_rng(3))
    dark = dataclasses.replace(drawn.light, lamps=(), sky=(0.5, 0.0), mirrored=None)
    after = photograph(dataclasses.replace(drawn, light=dark), np.random.default_rng(3))
    assert not np.array_equal(before.image, after.image)
    assert np.array_equal(before.depth, after.depth)
    assert np.array_equal(before.visible, after.visible)
    alone = photograph(dataclasses.replace(drawn, things=drawn.things[:1]), np.random.default_rng(3))
    assert (alone.visible | ~before.visible).all()
