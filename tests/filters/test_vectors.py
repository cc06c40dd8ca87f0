"""The dominant eigenvector against LAPACK, and non-maximum suppression along a direction."""

import pytest
import torch

from curvireg_torch.filters.curvilinear import dominant_eigenvector, scaled_direction
from curvireg_torch.filters.operations import is_directional_maximum


def matrices() -> torch.Tensor:
    """(N, 2, 2) with real eigenvalues: adj(I_P) H_Z of random surfaces, and the boundaries between branches."""
    g = torch.Generator().manual_seed(0)
    slope, h = (2 * torch.randn(500, n, generator=g, dtype=torch.float64) for n in (2, 3))
    across = torch.stack([slope[:, 1], -slope[:, 0]], dim=1)
    adjugate = torch.eye(2, dtype=torch.float64) + across[:, :, None] * across[:, None]
    general = adjugate @ h[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    special = [
        [[-1, 2], [2, -1]],  # equal diagonal, negative trace: a diagonal ridge
        [[1, 2], [2, 1]],
        [[-1, 2], [2, 1]],  # trace 0
        [[1, -2], [-2, -1]],
        [[0, 3], [0, 1]],  # triangular
        [[0, 0], [3, -1]],
        [[2, 3], [0, -1]],
        [[0, 0], [0, -5]],
        [[-5, 0], [0, 0]],
    ]
    return torch.cat([general, torch.tensor(special, dtype=torch.float64)])


def test_dominant_eigenvector_against_lapack() -> None:
    m = matrices()
    planes = [m[:, i, j].view(-1, 1, 1, 1) for i in range(2) for j in range(2)]
    vx, vy, half_gap = dominant_eigenvector(*planes)
    v = torch.cat(scaled_direction(torch.ones_like(vx), vx, vy), dim=1)[:, :, 0, 0]
    values = torch.linalg.eigvals(m).real
    torch.testing.assert_close(2 * half_gap.flatten(), values.amax(dim=1) - values.amin(dim=1))
    torch.testing.assert_close(v.norm(dim=1), torch.ones(len(m), dtype=torch.float64))
    rayleigh = (m @ v[:, :, None])[:, :, 0]
    value = (rayleigh * v).sum(dim=1)
    torch.testing.assert_close(rayleigh, value[:, None] * v, atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(value.abs(), values.abs().amax(dim=1))


def test_dominant_eigenvector_is_zero_for_equal_eigenvalues() -> None:
    planes = [torch.full((1, 1, 1, 1), x) for x in (3.0, 0.0, 0.0, 3.0)]
    assert [float(x) for x in dominant_eigenvector(*planes)] == [0.0, 0.0, 0.0]
    assert [float(x) for x in scaled_direction(torch.ones(1), torch.zeros(1), torch.zeros(1))] == [0.0, 0.0]


@pytest.mark.parametrize("angle", [0.0, 22.0, 23.0, 45.0, 67.0, 68.0, 90.0, 112.0, 113.0, 135.0, 157.0, 158.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_is_directional_maximum_rounds_directions_to_45_degrees(angle: float, sign: float) -> None:
    """Only the two neighbours on the rounded axis count."""
    axis = [(1, 0), (1, 1), (0, 1), (-1, 1)][round(angle / 45.0) % 4]
    length = torch.full((1, 1, 3, 3), 2.0)
    length[..., 1, 1] = 1.0
    radians = torch.deg2rad(torch.tensor(angle))
    x, y = (sign * f(radians).expand(1, 1, 3, 3) for f in (torch.cos, torch.sin))
    assert not bool(is_directional_maximum(length, x, y)[0, 0, 1, 1])
    for side in (1, -1):
        length[..., 1 + side * axis[1], 1 + side * axis[0]] = 0.5
    assert bool(is_directional_maximum(length, x, y)[0, 0, 1, 1])
