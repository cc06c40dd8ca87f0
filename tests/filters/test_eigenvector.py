"""The closed form of the dominant eigenvector against LAPACK's."""

import torch

from curvireg_torch.filters.curvilinear import dominant_eigenvector, scaled_direction


def matrices() -> torch.Tensor:
    """(N, 2, 2) with real eigenvalues: adj(I_P) H_Z of random surfaces, and the places where a branch turns."""
    g = torch.Generator().manual_seed(0)
    slope, h = (2 * torch.randn(500, n, generator=g, dtype=torch.float64) for n in (2, 3))
    across = torch.stack([slope[:, 1], -slope[:, 0]], dim=1)
    adjugate = torch.eye(2, dtype=torch.float64) + across[:, :, None] * across[:, None]
    general = adjugate @ h[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    special = [
        [[-1, 2], [2, -1]],  # no gap, negative trace: a diagonal ridge
        [[1, 2], [2, 1]],
        [[-1, 2], [2, 1]],  # no trace
        [[1, -2], [-2, -1]],
        [[0, 3], [0, 1]],  # triangular
        [[0, 0], [3, -1]],
        [[2, 3], [0, -1]],
        [[0, 0], [0, -5]],
        [[-5, 0], [0, 0]],
    ]
    return torch.cat([general, torch.tensor(special, dtype=torch.float64)])


def test_eigenvector_and_gap_are_those_of_lapack() -> None:
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


def test_no_direction_where_the_eigenvalues_agree() -> None:
    planes = [torch.full((1, 1, 1, 1), x) for x in (3.0, 0.0, 0.0, 3.0)]
    assert [float(x) for x in dominant_eigenvector(*planes)] == [0.0, 0.0, 0.0]
    assert [float(x) for x in scaled_direction(torch.ones(1), torch.zeros(1), torch.zeros(1))] == [0.0, 0.0]
