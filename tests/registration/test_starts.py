"""What is said about a given pose at which the mesh is not in the photograph."""

import pytest
import torch

from curvireg_torch.registration.photograph import MIN_BOX_SIDE
from curvireg_torch.registration.refinement import INVERSE, OPENGL, why_outside
from tests._support import double, eye, uniform

SIZE = (180, 240)
K = double([[260.0, 0, 119.5], [0, 260, 89.5], [0, 0, 1]])


def pose(*translation):
    T = eye(4)
    T[:3, 3] = double(translation)
    return T


HULL = 0.05 * (uniform(20, 3) - 0.5)
FLIP = torch.diag(double([1.0, -1.0, -1.0, 1.0]))


def said(T, hull=HULL):
    """What is said of a pose, and nothing of one without a likely mistake."""
    return str(why_outside(hull, T, K, SIZE) or "")


@pytest.mark.parametrize("scale", [1.0, 1000.0, 0.001])  # a mesh in m, in mm, and in km
def test_the_likely_mistake_is_named(scale):
    hull = scale * HULL
    right = pose(0.02 * scale, 0.01 * scale, 0.4 * scale)
    for factor, words in (
        (0.001, "1000 times too small, as metres"),
        (1000.0, "1000 times too large, as mm"),
    ):
        wrong = right.clone()
        wrong[:3, 3] *= factor
        assert f"{words} beside a mesh in m" in said(wrong, hull)
        message = said(FLIP @ wrong, hull)
        assert message.startswith(OPENGL)
        assert words in message
    mirrored = why_outside(hull, FLIP @ right, K, SIZE)
    assert (str(mirrored), mirrored.kind) == (OPENGL, "opengl")
    for z in (0.4, -0.4):
        assert not said(pose(5.0 * scale, 0.0, z * scale), hull)


@pytest.mark.parametrize("is_opengl", [False, True])
def test_the_pose_of_the_camera_in_the_object_is_named(is_opengl):
    right = pose(0.02, 0.01, 0.4)
    right[:3, :3] = double([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    message = said(torch.linalg.inv(FLIP @ right if is_opengl else right))
    assert message.startswith(INVERSE)
    assert ("OpenGL" in message) == is_opengl


@pytest.mark.parametrize(
    ("side", "centre", "named"),
    [
        (100.0, (119.5, 89.5), True),
        (2 * max(SIZE) - 1.0, (119.5, 89.5), True),
        (2 * max(SIZE) + 1.0, (119.5, 89.5), False),
        (MIN_BOX_SIDE + 0.1, (119.5, 89.5), True),
        (MIN_BOX_SIDE - 0.1, (119.5, 89.5), False),
        (100.0, (1.0, 89.5), True),
        (100.0, (-1.0, 89.5), False),
        (100.0, (119.5, -1.0), False),
        (100.0, (239.0, 179.0), True),
        (100.0, (241.0, 89.5), False),
        (100.0, (119.5, 181.0), False),
    ],
)
def test_a_mistake_is_named_if_without_it_the_mesh_fills_a_sensible_part(side, centre, named):
    """A plate, whose box has this side and centre in px once its translation is divided by 1000."""
    plate = 0.05 * double([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    z = 260.0 * 0.1 / side
    right = pose(*((torch.tensor(centre) - K[:2, 2]) * z / 260.0).tolist(), z)
    right[:3, 3] *= 1000.0
    assert bool(said(right, plate)) == named
