"""Least squares over poses: derivatives, bounded steps, the covariance in closed form and against
injected noise."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
import trimesh
from torch.testing import assert_close

from curvireg_torch.calibration import COVARIANCE_SCALE
from curvireg_torch.fitting import least_squares as ls
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.cameras import project_points, transform
from curvireg_torch.mesh.mesh import mesh_centre
from curvireg_torch.rendering.contours import ContourPoints
from tests._support import double, eye, seeded, skip_unless_products_are_exact, uniform, zeros
from tests.fitting.cube import K, fitted, pose, random_points, silhouette

ZERO = double([0.0, 0.0, 0.0])
CAMERAS = K[None]
AHEAD = pose([0.0, 0.0, 0.0], [0.0, 0.0, 6.0])[None]
TINY = torch.full((6,), 1e-7, dtype=torch.float64)
"""Not zero, where the angle of an axis-angle vector is not differentiable."""


def test_project_and_its_derivative():
    points = uniform(1, 7, 3)
    normals = uniform(1, 7, 2)
    T = pose([0.3, -0.5, 0.2], [0.1, 0.2, 4.0])[None]
    centre = double([0.4, 0.5, 0.6])

    def moved(step):
        uv, _ = ls.project(points, normals, ls.apply_twist(T, step[None], centre), CAMERAS, centre)
        return (uv * normals).sum(dim=-1)[0]

    expected = torch.autograd.functional.jacobian(moved, TINY)
    uv, derivative = ls.project(points, normals, T, CAMERAS, centre)
    assert_close(uv[0], project_points(points[0], T[0], K))
    assert_close(ls.pixels(points, T, CAMERAS), uv)
    assert_close(derivative[0], expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("rotation", "translation", "fraction"),
    [
        ([0.1, 0, 0], [0, 0, 0.05], 1.0),
        ([0, 0.3, 0.4], [0, 0, 0.01], 0.4),
        ([0.1, 0, 0], [0.3, 0, 0.4], 0.2),
    ],
)
@pytest.mark.parametrize("behind", [0.5, 4.0])
def test_long_steps_are_shortened(rotation, translation, fraction, behind):
    """Translations are given as fractions of the distance of the centre, which lies some units
    behind the origin."""
    centre = double([0.0, 0.0, behind])
    step = double([[*rotation, *((6.0 + behind) * t for t in translation)]])
    found = ls.least_squares_step(eye(6)[None], step[..., None], AHEAD, centre, 0.0)
    assert_close(found, fraction * step)


def test_damping_shortens_each_direction_alike():
    A = torch.diag(double([1.0, 100.0, 1e4, 1.0, 1.0, 1.0]))[None]
    units = torch.diag(double([1.0, 1.0, 1.0, 1e-12, 1e-12, 1e-12]))
    for unit in (eye(6), units):
        in_units = unit @ A @ unit
        b = unit @ A @ torch.ones(1, 6, 1, dtype=torch.float64)
        x = ls.damped_solution(in_units, b, 0.25)
        assert_close(x @ unit, torch.full((1, 6), 0.8, dtype=torch.float64))
    assert ls.damped_solution(0 * A, zeros(1, 6, 1), 0.01).tolist() == [[0.0] * 6]


def test_points_need_a_minimum_of_matches():
    truth = pose([0.02, 0.0, 0.01], [0.05, 0.0, 6.1])[None]
    points = uniform(1, 20, 3) - 0.5
    uv = ls.pixels(points, truth, CAMERAS)
    for count, expected in ((ls.MIN_MATCHES - 1, AHEAD), (ls.MIN_MATCHES, truth)):
        weight = (torch.arange(20) < count).double()[None]
        matches = ls.PointMatches(points, uv, weight)
        found = ls.fit_points(matches, AHEAD, CAMERAS, ZERO, [8.0] * 8)
        assert_close(found, expected, rtol=0, atol=1e-6)


def test_inlier_ratio_counts_all_points():
    points = uniform(1, 10, 3) - 0.5
    uv = ls.pixels(points, AHEAD, CAMERAS)
    uv[:, :2] += 500.0
    uv[:, 2, 0] += 2.0
    weight = torch.ones(1, 10)
    weight[:, 3:5] = 0.0  # not found
    ratio = ls.PointMatches(points, uv, weight).inlier_ratio(AHEAD, CAMERAS)
    assert ratio == pytest.approx((5 + 0.25) / 10, abs=1e-4)


def test_matches_are_measured_along_x_and_y_of_the_image():
    """Of three points, one 0.5 px too far to the right in the image, and one 1 px too low."""
    T = pose([0.1, 0.2, 0.0], [0.0, 0.0, 6.0])[None]
    points = uniform(1, 3, 3) - 0.5
    uv = ls.pixels(points, T, CAMERAS)
    uv[0, 0, 0] += 0.5
    uv[0, 2, 1] += 1.0
    matches = ls.PointMatches(points, uv, double([[1.0, 0.5, 1.0]]))
    found = matches.measurements(T, CAMERAS, ZERO, 2.0)
    assert_close(found.distance.flatten(), double([0.5, 0.0, 0.0, 0.0, 0.0, 1.0]))
    robust = double([(1 + 1 / 16) ** -2, 0.5, (1 + 1 / 4) ** -2])
    assert_close(found.weight.flatten(), robust.repeat_interleave(2))
    scaled = matches.scaled(0.3).measurements(T, CAMERAS, ZERO, 2.0)
    assert_close(scaled.weight, 0.3 * found.weight)
    for row, axis in ((2, (1.0, 0.0)), (3, (0.0, 1.0))):
        normal = double(axis).expand(1, 1, 2)
        _, J = ls.project(points[:, 1:2], normal, T, CAMERAS, ZERO)
        assert_close(found.J[:, row], J[:, 0])


def test_nearest_rigid_pose_is_orthogonal():
    T = pose([0.3, -0.2, 0.5], [1.0, 2.0, 3.0])[None]
    drifted = T.clone()
    drifted[:, :3, :3] *= 1.001
    assert_close(ls.nearest_rigid(drifted), T)


def cloud(count):
    """Points in a cube with random normals, a pose, the cube's centre, and the derivatives along
    the normals."""
    T = pose([0.3, -0.5, 0.2], [-1.6, -0.4, 6.0])[None]
    centre = double([2.0, 0.5, 0.6])
    model, normals = random_points(count, centre)
    _, J = ls.project(model, normals, T, CAMERAS, centre)
    everywhere = torch.ones(1, count, dtype=torch.bool)
    return ContourPoints(model, normals, everywhere, everywhere), T, centre, J


def covariance_of(points, T, centre, J, d, W, radius=1.7):
    """The covariance of a pose from distances ``d`` and weights ``W``, and the known directions."""
    measured = ls.Measurements(J, d, W)
    return ls.pose_covariance(measured, points, T, CAMERAS, centre, radius=radius)


def test_covariance_in_closed_form():
    """Directly in (w, e), from autograd's derivative of R = exp([w]x) R0, t = t0 + e."""
    points, T, centre, J = cloud(60)
    W, d = uniform(2, 1, 60, 1, seed=1)
    C, known = covariance_of(points, T, centre, J, d, W)
    assert int(known) == 6

    def moved(step):
        R = rotation_from_axis_angle(step[None, :3])[0] @ T[0, :3, :3]
        return project_points(points.model[0], transform(R, T[0, :3, 3] + step[3:]), K)

    derivative = torch.autograd.functional.jacobian(moved, TINY)
    rows = (points.normals[0, :, None] @ derivative)[:, 0]
    w = W[0]
    r = d[0]
    shared = ls.SHARED_ERROR * float((w * r * r).sum() / w.sum())
    B = rows.T @ (w * w * rows) * (ls.POINT_ERROR**2 + shared)
    cells = (project_points(points.model[0], T[0], K) / ls.CELL_SIDE).floor()
    for cell in cells.unique(dim=0):
        g = (w * r * rows)[(cells == cell).all(dim=1)].sum(dim=0)
        B += g[:, None] * g
    inverse = torch.linalg.inv(rows.T @ (w * rows))
    assert_close(C[0], COVARIANCE_SCALE * inverse @ B @ inverse, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(("factor", "known"), [(0.95, False), (1.05, True)])
def test_covariance_needs_a_minimum_of_weight(factor, known):
    d = torch.full((1, 60, 1), 0.1, dtype=torch.float64)
    C, directions = covariance_of(*cloud(60), d, factor * d)
    assert bool(C.isfinite().all()) == bool(directions > 0) == known


@pytest.mark.parametrize("axis_angle", [[1.0, 0.3, 0.2], [1.9, -0.4, 0.3]])
def test_covariance_of_a_cylinder_has_unknown_rotation_about_its_axis(axis_angle):
    mesh = trimesh.creation.cylinder(0.5, 1.4, sections=96)
    T = pose(axis_angle, [0.1, 0.0, 8.0])
    off = double([[0.0, 0.0, 0.0, 0.1, 0.1, 0.2]])
    fit = fitted(silhouette(mesh, T), ls.apply_twist(T[None], off, mesh_centre(mesh)), mesh=mesh)
    assert 4 <= int(fit.observable) <= 5
    C = fit.covariance[0, :3, :3]
    axis = fit.transform[0, :3, 2]
    # The rim of the near lid, which a silhouette does not show, pulls towards the outline.
    assert float(axis @ T[:3, 2]) > 0.985
    assert (axis @ C @ axis).sqrt() > 1.0
    assert torch.linalg.eigvalsh(C)[0].sqrt() < 0.2  # other rotations are known


@pytest.mark.parametrize("unit", [1e-3, 80.0])
@pytest.mark.parametrize("across", [False, True])
def test_covariance_follows_the_unit_of_the_mesh(unit, across):
    """Also of what is unknown: with normals along x alone, the translation along y."""
    points, T, centre, J = cloud(60)
    if across:
        points = replace(points, normals=double([1.0, 0.0]).expand(1, 60, 2))
        _, J = ls.project(points.model, points.normals, T, CAMERAS, centre)
    W, d = uniform(2, 1, 60, 1, seed=1)
    C, known = covariance_of(points, T, centre, J, d, W)
    scaled = T.clone()
    scaled[:, :3, 3] *= unit
    S = double([1.0, 1.0, 1.0, unit, unit, unit])
    larger = replace(points, model=unit * points.model)
    found, directions = covariance_of(larger, scaled, unit * centre, J / S, d, W, 1.7 * unit)
    assert int(directions) == int(known)
    assert (int(known) < 6) == across
    assert_close(found / S[:, None] / S, C, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(("radius", "expected"), [(1.0, 6), (6.0, 6), (8.0, 4)])
def test_directions_are_known_where_errors_of_points_and_normals_tell_less(radius, expected):
    """Against the definition: what 0.05 rad of a normal, and 0.05 radii along the line of sight,
    change in the derivatives."""
    points, T, centre, J = cloud(60)
    W = torch.full((1, 60, 1), 0.5, dtype=torch.float64)
    _, known = covariance_of(points, T, centre, J, W, W, radius)
    small = 1e-6
    n = points.normals
    turned = n + small * torch.stack([-n[..., 1], n[..., 0]], dim=-1)
    _, by_normal = ls.project(points.model, turned, T, CAMERAS, centre)
    seen = (points.model @ T[:, :3, :3].mT + T[:, None, :3, 3])[0]
    ray = F.normalize(seen, dim=-1)
    arms = (points.model[0] - centre) @ T[0, :3, :3].T
    by_rotation = torch.linalg.cross(arms + small * ray, J[0, :, 3:])
    along_sight = (by_rotation - J[0, :, :3]) / small
    E_normal = (by_normal - J)[0] / small
    E_sight = F.pad(along_sight, (0, 3))
    E = 0.05**2 * E_normal.T @ (0.5 * E_normal)
    E = E + (0.05 * radius) ** 2 * E_sight.T @ (0.5 * E_sight)
    A = J[0].T @ (0.5 * J[0])
    share = torch.linalg.eigvals(torch.linalg.solve(A + E, A)).real
    assert int(known) == int((share > 0.75).sum()) == expected


@pytest.mark.parametrize("unknowns", [6, 7, 8])
def test_products_of_a_pose_do_not_depend_on_the_batch(unknowns):
    skip_unless_products_are_exact()
    generator = seeded(0)
    J = torch.randn(5, 96, unknowns, generator=generator)
    distance, weight = torch.rand(2, 5, 96, 1, generator=generator)
    change = torch.randn(5, unknowns, generator=generator)
    measured = ls.Measurements(J, distance, weight)
    A, b = measured.equations()
    assert_close(A, (weight * J).mT @ J)
    assert_close(b, (weight * J).mT @ distance)
    shifts = ls.shifts(J, change)
    assert_close(shifts, J @ change[..., None])
    for n in range(5):
        for of_pose, of_batch in zip(measured[n : n + 1].equations(), (A, b), strict=True):
            assert of_pose[0].equal(of_batch[n])
        assert ls.shifts(J[n : n + 1], change[n : n + 1])[0].equal(shifts[n])
