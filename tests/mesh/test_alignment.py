import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from curvireg_torch.mesh.alignment import are_near, axis_of, rigid_step

TURN = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
SHIFT = np.array([0.01, 0.02, -0.01])


def grid(*counts):
    """Points (N, 3) that are far from one another, compared with ``SHIFT``."""
    axes = [np.arange(float(count)) for count in counts]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("counts", [(4, 5, 3), (4, 5, 1), (4, 1, 5), (1, 4, 5), (5, 4, 1)])
def test_a_step_is_the_motion_to_the_nearest_points(counts):
    surface = grid(*counts)
    points = (surface - SHIFT) @ TURN  # of which the motion makes the surface
    R, t, away = rigid_step(cKDTree(surface), points, points, 1.0)
    assert_allclose(R, TURN, atol=1e-12)  # no reflection of a plane
    assert_allclose(t, SHIFT, atol=1e-12)
    assert away == pytest.approx(np.linalg.norm(points - surface, axis=1).mean())


def test_a_step_trusts_the_nearest_points():
    surface = grid(4, 5, 3)
    points = (surface - SHIFT) @ TURN
    points[::10] += 0.3
    R, t, _ = rigid_step(cKDTree(surface), points, points, 0.8)
    assert_allclose(R, TURN, atol=1e-12)
    assert_allclose(t, SHIFT, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_axis_of_a_motion_stays_in_place_and_points_as_asked(sign):
    direction = np.array([2.0, -1.0, 2.0]) / 3.0
    point = np.array([1.0, 0.0, -1.0])  # across the direction
    R = Rotation.from_rotvec(1.2 * direction).as_matrix()
    axis, place = axis_of(R, point - R @ point, sign * np.array([1.0, 0.2, 0.1]))
    assert_allclose(axis, sign * direction, atol=1e-12)
    assert_allclose(place, point, atol=1e-12)


def test_points_are_near_within_the_tolerance():
    points = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    assert are_near(cKDTree(np.zeros((1, 3))), points, 0.2).tolist() == [True, False]
