"""The covariance of the contour stage: closed forms, injected noise, and what contours cannot know."""

import pytest
import torch
import torch.nn.functional as F
import trimesh

from curvireg_torch import camera_matrix
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_from_axis_angle
from curvireg_torch.geometry.cameras import project_points, transform
from curvireg_torch.io.meshes.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration.calibration import COVARIANCE_SCALE as SCALE
from curvireg_torch.registration.contours import covariance as contour_covariance
from curvireg_torch.registration.contours import fit_contours
from curvireg_torch.registration.contours.covariance import pose_covariance
from curvireg_torch.registration.contours.descent import Matches, apply_twist, project
from curvireg_torch.registration.contours.points import ContourPoints
from curvireg_torch.rendering import make_renderer

K = camera_matrix(300.0, 310.0, 63.5, 60.0, dtype=torch.float64)


def pose(turn: list[float], position: list[float]) -> torch.Tensor:
    return transform(
        rotation_from_axis_angle(torch.tensor(turn, dtype=torch.float64)), torch.tensor(position, dtype=torch.float64)
    )


def cloud(count: int) -> tuple[ContourPoints, torch.Tensor, torch.Tensor]:
    """Points in a cube with any normals, a pose, and the cube's centre."""
    generator = torch.Generator().manual_seed(0)
    T, centre = pose([0.3, -0.5, 0.2], [-1.6, -0.4, 6.0])[None], torch.tensor([2.0, 0.5, 0.6], dtype=torch.float64)
    points = centre + 2.0 * torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 1.0
    normals = F.normalize(torch.randn(1, count, 2, generator=generator, dtype=torch.float64), dim=-1)
    return ContourPoints(points, normals, torch.ones(1, count, dtype=torch.bool)), T, centre


def test_covariance_is_the_sandwich_of_turn_and_translation_of_the_origin():
    """Directly in (w, e), from autograd's derivative of R = exp([w]x) R0, t = t0 + e."""
    points, T, centre = cloud(60)
    generator = torch.Generator().manual_seed(1)
    W, d = (torch.rand(1, 60, 1, generator=generator, dtype=torch.float64) for _ in range(2))
    J = (points.normals[..., None, :] @ project(points.model, T, K[None], centre)[1])[..., 0, :]
    found, known = pose_covariance(Matches(J, d, W), points, T, K[None], centre, radius=1.7)
    assert int(known) == 6

    def pixels(step: torch.Tensor) -> torch.Tensor:
        R = rotation_from_axis_angle(step[None, :3])[0] @ T[0, :3, :3]
        return project_points(points.model[0], transform(R, T[0, :3, 3] + step[3:]), K)

    derivative = torch.autograd.functional.jacobian(pixels, torch.full((6,), 1e-7, dtype=torch.float64))
    rows, w, r = (points.normals[0, :, None] @ derivative)[:, 0], W[0], d[0]
    cells = (project_points(points.model[0], T[0], K) / contour_covariance.CELL).floor()
    B = (
        rows.T
        @ (w * w * rows)
        * (contour_covariance.POINT**2 + contour_covariance.SHARED * float((w * r * r).sum() / w.sum()))
    )
    for cell in cells.unique(dim=0):
        g = (w * r * rows)[(cells == cell).all(dim=1)].sum(dim=0)
        B += g[:, None] * g
    inverse = torch.linalg.inv(rows.T @ (w * rows))
    expected = SCALE * inverse @ B @ inverse
    torch.testing.assert_close(found[0], expected, rtol=1e-3, atol=1e-9)


def test_injected_noise_lies_within():
    """Distances with independent noise of 0.6 px: what least squares makes of it spreads no more than is said."""
    points, T, centre = cloud(200)
    J = (points.normals[..., None, :] @ project(points.model, T, K[None], centre)[1])[..., 0, :]
    d = 0.6 * torch.randn(400, 200, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    estimates = (torch.linalg.pinv(J) @ d)[..., 0]  # turn about the centre and its shift
    ends = apply_twist(T.expand(400, 4, 4), estimates, centre)
    off = torch.cat([axis_angle_from_rotation(ends[:, :3, :3] @ T[:, :3, :3].mT), ends[:, :3, 3] - T[:, :3, 3]], dim=1)
    several = ContourPoints(*(x.expand(400, *x.shape[1:]) for x in (points.model, points.normals, points.valid)))
    found, _ = pose_covariance(
        Matches(J.expand(400, -1, -1), d - J @ estimates[..., None], torch.ones_like(d)),
        several,
        T.expand(400, 4, 4),
        K.expand(400, 3, 3),
        centre,
        radius=1.7,
    )
    spread = torch.cov(off.T)
    # The mean covariance is the spread times what is allowed for errors that neighbours share.
    allowed = SCALE * (contour_covariance.POINT**2 / 0.36 + contour_covariance.SHARED + 1)
    ratio = found.mean(dim=0).diagonal() / spread.diagonal()
    assert float(ratio.min()) > 0.8 * (allowed - SCALE)
    assert float(ratio.max()) < 1.25 * allowed


def fitted(mesh: trimesh.Trimesh, turn: list[float]):
    T, centre = pose(turn, [0.1, 0.0, 8.0]), mesh_centre(mesh)
    renderer = make_renderer(mesh)
    image = (renderer.render(T[None], K, (128, 128))[0] > 0).float()
    off = torch.tensor([[0.0, 0.0, 0.0, 0.1, 0.1, 0.2]], dtype=torch.float64)
    box = torch.tensor([40.0, 36, 88, 84])
    return T, fit_contours(
        renderer, image, box, K, apply_twist(T[None], off, centre), centre=centre, radius=mesh_radius(mesh)
    )


def test_the_place_of_a_sphere_is_known_and_its_turns_are_not():
    T, fit = fitted(trimesh.creation.icosphere(subdivisions=4, radius=0.7), [0.0, 0.0, 0.0])
    assert float((fit.transform[0, :3, 3] - T[:3, 3]).norm()) < 0.08
    assert int(fit.observable) == 3
    deviation = fit.covariance[0].diagonal().sqrt()
    assert float(deviation[:3].min()) > 1.0  # rad
    assert float(deviation[3:].max()) < 0.5  # of a distance of 8


@pytest.mark.parametrize("turn", [[1.0, 0.3, 0.2], [1.9, -0.4, 0.3]])
def test_a_cylinder_turns_unknown_about_its_axis_alone(turn):
    T, fit = fitted(trimesh.creation.cylinder(0.5, 1.4, sections=96), turn)
    assert 4 <= int(fit.observable) <= 5
    C = fit.covariance[0, :3, :3]
    axis = fit.transform[0, :3, 2]
    assert float(axis @ T[:3, 2]) > 0.995
    assert float((axis @ C @ axis).sqrt()) > 1.0
    assert float(torch.linalg.eigvalsh(C)[0].sqrt()) < 0.2  # but not all of them


def test_a_box_is_known_all_around():
    _, fit = fitted(trimesh.creation.box((1.0, 1.4, 0.8)), [0.4, 0.5, 0.1])
    assert int(fit.observable) == 6
    assert float(fit.covariance[0].diagonal().sqrt()[:3].max()) < 0.35


def test_nothing_found_is_not_a_number():
    points, T, centre = cloud(20)
    zero = torch.zeros(1, 20, 1, dtype=torch.float64)
    C, known = pose_covariance(Matches(zero.expand(1, 20, 6), zero, zero), points, T, K[None], centre, radius=1.0)
    assert bool(C.isnan().all())
    assert int(known) == 0
