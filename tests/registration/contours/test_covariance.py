"""The covariance of the contour fit: closed forms, injected noise, and what contours do not determine."""

import pytest
import torch
import torch.nn.functional as F
import trimesh

from curvireg_torch.geometry import axis_angle_from_rotation, rotation_from_axis_angle
from curvireg_torch.geometry.cameras import project_points, transform
from curvireg_torch.mesh.mesh import mesh_centre
from curvireg_torch.registration.calibration import COVARIANCE_SCALE as SCALE
from curvireg_torch.registration.contours.covariance import CELL, POINT, SHARED, pose_covariance
from curvireg_torch.registration.contours.descent import Matches, apply_twist, project
from curvireg_torch.registration.contours.points import ContourPoints
from tests.registration.contours.common import K, cube, fitted, pose, silhouette


def cloud(count: int) -> tuple[ContourPoints, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points in a cube with random normals, a pose, the cube's centre, and the derivatives along the normals."""
    generator = torch.Generator().manual_seed(0)
    T, centre = pose([0.3, -0.5, 0.2], [-1.6, -0.4, 6.0])[None], torch.tensor([2.0, 0.5, 0.6], dtype=torch.float64)
    model = centre + 2.0 * torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 1.0
    normals = F.normalize(torch.randn(1, count, 2, generator=generator, dtype=torch.float64), dim=-1)
    J = (normals[..., None, :] @ project(model, T, K[None], centre)[1])[..., 0, :]
    everywhere = torch.ones(1, count, dtype=torch.bool)
    return ContourPoints(model, normals, everywhere, everywhere), T, centre, J


def test_covariance_in_closed_form():
    """Directly in (w, e), from autograd's derivative of R = exp([w]x) R0, t = t0 + e."""
    points, T, centre, J = cloud(60)
    generator = torch.Generator().manual_seed(1)
    W, d = (torch.rand(1, 60, 1, generator=generator, dtype=torch.float64) for _ in range(2))
    C, known = pose_covariance(Matches(J, d, W), points, T, K[None], centre, radius=1.7)
    assert int(known) == 6

    def pixels(step: torch.Tensor) -> torch.Tensor:
        R = rotation_from_axis_angle(step[None, :3])[0] @ T[0, :3, :3]
        return project_points(points.model[0], transform(R, T[0, :3, 3] + step[3:]), K)

    derivative = torch.autograd.functional.jacobian(pixels, torch.full((6,), 1e-7, dtype=torch.float64))
    rows, w, r = (points.normals[0, :, None] @ derivative)[:, 0], W[0], d[0]
    B = rows.T @ (w * w * rows) * (POINT**2 + SHARED * float((w * r * r).sum() / w.sum()))
    cells = (project_points(points.model[0], T[0], K) / CELL).floor()
    for cell in cells.unique(dim=0):
        g = (w * r * rows)[(cells == cell).all(dim=1)].sum(dim=0)
        B += g[:, None] * g
    inverse = torch.linalg.inv(rows.T @ (w * rows))
    torch.testing.assert_close(C[0], SCALE * inverse @ B @ inverse, rtol=1e-3, atol=1e-9)


def test_covariance_covers_injected_noise():
    """Independent noise of 0.6 px on the distances: least squares spreads no more than the covariance says."""
    points, T, centre, J = cloud(200)
    d = 0.6 * torch.randn(400, 200, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    estimates = (torch.linalg.pinv(J) @ d)[..., 0]  # rotation about the centre and its translation
    T400 = T.expand(400, 4, 4)
    ends = apply_twist(T400, estimates, centre)
    off = torch.cat([axis_angle_from_rotation(ends[:, :3, :3] @ T[:, :3, :3].mT), ends[:, :3, 3] - T[:, :3, 3]], dim=1)
    several = points[torch.zeros(400, dtype=torch.long)]
    matches = Matches(J.expand(400, -1, -1), d - J @ estimates[..., None], torch.ones_like(d))
    C, _ = pose_covariance(matches, several, T400, K.expand(400, 3, 3), centre, radius=1.7)
    # The mean covariance is the spread times the allowance for correlated errors.
    allowed = SCALE * (POINT**2 / 0.36 + SHARED + 1)
    ratio = C.mean(dim=0).diagonal() / torch.cov(off.T).diagonal()
    assert float(ratio.min()) > 0.8 * (allowed - SCALE)
    assert float(ratio.max()) < 1.25 * allowed


def silhouette_fit(mesh: trimesh.Trimesh, axis_angle: list[float]):
    T = pose(axis_angle, [0.1, 0.0, 8.0])
    off = torch.tensor([[0.0, 0.0, 0.0, 0.1, 0.1, 0.2]], dtype=torch.float64)
    return T, fitted(silhouette(mesh, T), apply_twist(T[None], off, mesh_centre(mesh)), mesh=mesh)


def test_covariance_of_a_sphere_has_unknown_rotation():
    T, fit = silhouette_fit(trimesh.creation.icosphere(subdivisions=4, radius=0.7), [0.0, 0.0, 0.0])
    assert float((fit.transform[0, :3, 3] - T[:3, 3]).norm()) < 0.08
    assert int(fit.observable) == 3
    deviation = fit.covariance[0].diagonal().sqrt()
    assert float(deviation[:3].min()) > 1.0  # rad
    assert float(deviation[3:].max()) < 0.5  # of a distance of 8


@pytest.mark.parametrize("axis_angle", [[1.0, 0.3, 0.2], [1.9, -0.4, 0.3]])
def test_covariance_of_a_cylinder_has_unknown_rotation_about_its_axis(axis_angle):
    T, fit = silhouette_fit(trimesh.creation.cylinder(0.5, 1.4, sections=96), axis_angle)
    assert 4 <= int(fit.observable) <= 5
    C = fit.covariance[0, :3, :3]
    axis = fit.transform[0, :3, 2]
    assert float(axis @ T[:3, 2]) > 0.995
    assert float((axis @ C @ axis).sqrt()) > 1.0
    assert float(torch.linalg.eigvalsh(C)[0].sqrt()) < 0.2  # other rotations are known


def test_covariance_of_a_cube_is_known_in_all_directions():
    _, fit = silhouette_fit(cube(), [0.4, 0.5, 0.1])
    assert int(fit.observable) == 6
    assert float(fit.covariance[0].diagonal().sqrt()[:3].max()) < 0.35


def test_covariance_without_matches_is_nan():
    points, T, centre, J = cloud(20)
    zero = torch.zeros(1, 20, 1, dtype=torch.float64)
    C, known = pose_covariance(Matches(0.0 * J, zero, zero), points, T, K[None], centre, radius=1.0)
    assert bool(C.isnan().all())
    assert int(known) == 0
