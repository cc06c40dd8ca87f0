"""Light, shadows and highlights."""

import numpy as np
import pytest

from curvireg_torch.rendering.embree import RayScene
from curvireg_torch.training.scenes.light import SHADOW, Lamp, Light, random_light, shade_points

UP = np.array([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def room():
    """A wall at z = 4 that faces the camera, and a small plate at z = 3 in front of its left half."""
    wall = [(-9, -9, 4), (9, -9, 4), (9, 9, 4), (-9, 9, 4)]
    plate = [(-2, -1, 3), (-1, -1, 3), (-1, 1, 3), (-2, 1, 3)]
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    return RayScene(np.array(wall + plate, float), np.array(faces))


def shine(room, light, points, *, gloss=0.0):
    n = len(points)
    normal = np.tile((0, 0, -1.0), (n, 1))
    return shade_points(room, points, normal, np.full((n, 3), 0.5), np.full(n, gloss), np.full(n, 50.0), light)


def lamp(*, shadows, towards=(0, 0, -1.0)):
    return Light(UP, (0.0, 0.0), np.ones(3), (Lamp(np.array(towards), np.full(3, 0.8), shadows),), None)


def test_shade_points_casts_shadows(room):
    behind, beside = np.array([[-1.5, 0, 4.0]]), np.array([[1.5, 0, 4.0]])
    assert shine(room, lamp(shadows=True), beside) == pytest.approx(0.5 * 0.8)
    assert shine(room, lamp(shadows=True), behind) == pytest.approx(SHADOW * 0.5 * 0.8)
    assert shine(room, lamp(shadows=False), behind) == pytest.approx(0.5 * 0.8)


def test_shade_points_follows_the_cosine(room):
    point = np.array([[1.5, 0, 4.0]])
    oblique = np.array([0.8, 0, -0.6])
    assert shine(room, lamp(shadows=False, towards=oblique), point) == pytest.approx(0.6 * 0.5 * 0.8)
    assert shine(room, lamp(shadows=False, towards=(0, 0, 1.0)), point) == pytest.approx(0.0)


def test_shade_points_highlights_the_mirror_direction(room):
    straight, aside = np.array([[0, 0, 4.0]]), np.array([[3.0, 0, 4.0]])
    light = lamp(shadows=False)
    added = [shine(room, light, p, gloss=0.5) - shine(room, light, p) for p in (straight, aside)]
    assert added[0] == pytest.approx(0.5 * 0.8)
    assert (added[1] < 0.1 * added[0]).all()


def test_shade_points_sky_is_brighter_above(room):
    light = Light(UP, (0.4, 0.2), np.array([1.0, 0.9, 0.8]), (), None)
    points, colour = np.array([[0, 0, 4.0]] * 2), np.ones((2, 3))
    normal = np.stack([UP, -UP])
    radiance = shade_points(room, points, normal, colour, np.zeros(2), np.ones(2), light)
    assert radiance == pytest.approx(np.array([[0.6], [0.2]]) * [1.0, 0.9, 0.8])


def test_random_light_draws_lamps_mostly_above_and_in_front():
    rng = np.random.default_rng(0)
    lamps = [lamp for _ in range(300) for lamp in random_light(UP, rng).lamps]
    assert 0.5 < np.mean([lamp.shadows for lamp in lamps]) < 0.7
    towards = np.stack([lamp.towards for lamp in lamps])
    assert np.allclose(np.linalg.norm(towards, axis=1), 1.0)
    assert towards[:, 2].mean() < -0.2
    assert towards[:, 1].mean() < -0.2
