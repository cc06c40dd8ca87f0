"""What is said about a given pose at which the mesh is not in the photograph."""

import pytest
import torch

from curvireg_torch.registration.starts import OPENGL, why_outside

SIZE = (180, 240)
K = torch.tensor([[260.0, 0, 119.5], [0, 260, 89.5], [0, 0, 1]], dtype=torch.float64)


def pose(*translation):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor(translation, dtype=torch.float64)
    return T


@pytest.mark.parametrize("scale", [1.0, 1000.0, 0.001])  # a mesh in m, in mm, and in km
def test_the_likely_mistake_is_named(scale):
    hull = (
        scale
        * 0.05
        * (torch.rand(20, 3, generator=torch.manual_seed(0), dtype=torch.float64) - 0.5)
    )
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
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
