"""What is said about a given pose at which the mesh is not in the photograph."""

import pytest
import torch

from curvireg_torch.registration.photograph import MIN_BOX_SIDE
from curvireg_torch.registration.refinement import INVERSE, OPENGL, why_outside
from tests._support import double, eye

SIZE = (180, 240)
K = double([[260.0, 0, 119.5], [0, 260, 89.5], [0, 0, 1]])


def pose(*translation):
    T = eye(4)
    T[:3, 3] = double(translation)
    return T


@pytest.mark.parametrize("scale", [1.0, 1000.0, 0.001])  # a mesh in m, in mm, and in km
def test_the_likely_mistake_is_named(scale):
    hull = (
        scale
        * 0.05
        * (torch.rand(20, 3, generator=torch.manual_seed(0), dtype=torch.float64) - 0.5)
    )
    flip = torch.diag(double([1.0, -1.0, -1.0, 1.0]))
    right = pose(0.02 * scale, 0.01 * scale, 0.4 * scale)
    for factor, words in (
        (0.001, "1000 times too small, as metres"),
        (1000.0, "1000 times too large, as mm"),
    ):
        wrong = right.clone()
        wrong[:3, 3] *= factor
        assert f"{words} beside a mesh in m" in str(why_outside(hull, wrong, K, SIZE))
        message = str(why_outside(hull, flip @ wrong, K, SIZE))
        assert message.startswith(OPENGL)
        assert words in message
    mirrored = why_outside(hull, flip @ right, K, SIZE)
    assert (str(mirrored), mirrored.kind) == (OPENGL, "opengl")
    assert why_outside(hull, pose(5.0 * scale, 0.0, 0.4 * scale), K, SIZE) is None
    assert why_outside(hull, pose(5.0 * scale, 0.0, -0.4 * scale), K, SIZE) is None


@pytest.mark.parametrize("is_opengl", [False, True])
def test_the_pose_of_the_camera_in_the_object_is_named(is_opengl):
    hull = 0.05 * (torch.rand(20, 3, generator=torch.manual_seed(0), dtype=torch.float64) - 0.5)
    quarter = double([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    right = pose(0.02, 0.01, 0.4)
    right[:3, :3] = quarter
    flip = torch.diag(double([1.0, -1.0, -1.0, 1.0]))
    wrong = torch.linalg.inv(flip @ right if is_opengl else right)
    message = str(why_outside(hull, wrong, K, SIZE))
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
    wrong = right.clone()
    wrong[:3, 3] *= 1000.0
    error = why_outside(plate, wrong, K, SIZE)
    assert (error is not None) == named
