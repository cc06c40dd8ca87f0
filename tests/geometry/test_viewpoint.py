import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch import geometry as g


def test_viewpoint_from_rotation_inverts_rotation_from_viewpoint() -> None:
    R = torch.from_numpy(Rotation.random(500, random_state=0).as_matrix())
    a, e, t = g.viewpoint_from_rotation(R)
    assert bool(((a >= 0) & (a < 360) & (e.abs() <= 90) & (t >= -180) & (t < 180)).all())
    torch.testing.assert_close(g.rotation_from_viewpoint(a, e, t), R, rtol=0, atol=1e-12)


@pytest.mark.parametrize("elevation", [90.0, -90.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_viewpoint_from_rotation_has_theta_0_at_the_poles(elevation: float, dtype: torch.dtype) -> None:
    azimuth = torch.tensor([0.0, 30.0, 200.0, 359.0], dtype=dtype)
    R = g.rotation_from_viewpoint(azimuth, elevation, 20.0)
    a, e, t = g.viewpoint_from_rotation(R)
    assert t.tolist() == [0.0] * 4
    torch.testing.assert_close(e, torch.full_like(e, elevation), rtol=0, atol=1e-3)
    torch.testing.assert_close(g.rotation_from_viewpoint(a, e, t), R, rtol=0, atol=2e-6)


@pytest.mark.parametrize("elevation", [90.0, -90.0])
@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-6, 1e-5, 1e-3])
def test_viewpoint_from_rotation_is_accurate_in_float32_near_the_poles(elevation: float, noise: float) -> None:
    """Rotations from an optimiser are rounded, and so not exact."""
    generator = torch.Generator().manual_seed(0)
    azimuth, theta = (360.0 * torch.rand(50, 20, generator=generator, dtype=torch.float64) for _ in range(2))
    exact = g.rotation_from_viewpoint(azimuth, elevation, theta)
    perturbation = torch.randn(exact.shape[:-1], generator=generator, dtype=torch.float64) * noise
    tilt = torch.from_numpy(Rotation.from_rotvec(perturbation.view(-1, 3).numpy()).as_matrix()).view(exact.shape)
    rounded = (tilt @ exact).float() + 5e-7 * torch.randn(exact.shape, generator=generator)
    back = g.rotation_from_viewpoint(*g.viewpoint_from_rotation(rounded))
    assert back.shape == rounded.shape
    assert math.radians(float(g.rotation_error(back.double(), rounded.double()).max())) < 5e-5


def test_viewpoint_from_rotation_has_finite_gradients_near_the_poles() -> None:
    R = g.rotation_from_viewpoint(torch.tensor([30.0, 200.0, 10.0]), torch.tensor([89.999, -89.99, 0.0]), 20.0)
    R.requires_grad_()
    sum(angle.sum() for angle in g.viewpoint_from_rotation(R)).backward()
    assert bool(R.grad.isfinite().all())


def test_viewpoint_from_rotation_wraps_angles() -> None:
    R = g.rotation_from_viewpoint(torch.tensor([-1e-9, 720.0]), 0.0, torch.tensor([180.0, -180.0]))
    a, _, t = g.viewpoint_from_rotation(R)
    assert bool((a < 360).all())
    torch.testing.assert_close(t.abs(), torch.full_like(t, 180.0), rtol=0, atol=1e-4)
    assert bool((t < 180).all())


def test_rotation_from_viewpoint_promotes_and_broadcasts() -> None:
    R = g.rotation_from_viewpoint(torch.tensor([10, 20]), 5, torch.tensor([[1.0], [2.0]], dtype=torch.float64))
    assert R.shape == (2, 2, 3, 3)
    assert R.dtype == torch.float64
    torch.testing.assert_close(R[1, 0], g.rotation_from_viewpoint(*(torch.tensor(v).double() for v in (10, 5, 2))))
    assert g.rotation_from_viewpoint(10, 5).dtype == torch.float32


def test_rotation_error_agrees_with_scipy() -> None:
    A = Rotation.random(60, random_state=1)
    differences = Rotation.from_rotvec([[0, 0, v] for v in (0.0, 1e-9, 1e-4, 1.0, 3.0, math.pi)] * 10)
    B = A * differences
    ours = g.rotation_error(torch.from_numpy(A.as_matrix()), torch.from_numpy(B.as_matrix()))
    expected = torch.rad2deg(torch.from_numpy((A.inv() * B).magnitude()))
    torch.testing.assert_close(ours, expected, rtol=0, atol=1e-5)
    small = ours[expected < 1e-6]
    torch.testing.assert_close(small, expected[expected < 1e-6], rtol=0.02, atol=1e-12)
    assert g.rotation_error(torch.eye(3).expand(4, 1, 3, 3), torch.eye(3).expand(5, 3, 3)).shape == (4, 5)
