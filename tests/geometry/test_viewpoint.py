import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch import geometry as g
from curvireg_torch.geometry import (
    ViewSphere,
    paper_views,
    rotation_error,
    sample_views,
    uniform_views,
    up_rotation,
)
from curvireg_torch.geometry.viewpoint import angles_between
from curvireg_torch.utils.choices import UP_AXES
from tests._support import double, eye, refused, seeded, uniform
from tests._support.poses import rotations


@pytest.mark.parametrize(
    ("angles", "dtype"),
    [
        ((30, 20.0, 0), torch.float64),
        ((torch.tensor(30.0), 20.0, 0), torch.float32),
        ((double(30.0), 20.0, 0), torch.float64),
        ((torch.tensor(30), 20.0, 0), torch.float32),
        ((torch.tensor(30.0), double(20.0), 0), torch.float64),
        ((30, torch.tensor(20.0, dtype=torch.float16), 0.5), torch.float16),
    ],
)
def test_rotations_have_the_type_of_the_tensors_and_of_numbers_alone_float64(angles, dtype):
    R = g.rotation_from_viewpoint(*angles)
    assert R.dtype == dtype
    exact = g.rotation_from_viewpoint(*map(float, angles))
    assert_close(R.double(), exact, rtol=0, atol=4 * torch.finfo(dtype).eps)


def test_viewpoint_from_rotation_inverts_rotation_from_viewpoint():
    R = rotations(500, 0)
    a, e, t = g.viewpoint_from_rotation(R)
    assert ((a >= 0) & (a < 360) & (e.abs() <= 90) & (t >= -180) & (t < 180)).all()
    assert_close(g.rotation_from_viewpoint(a, e, t), R, rtol=0, atol=1e-12)
    R = g.rotation_from_viewpoint(torch.tensor([-1e-9, 720.0]), 0.0, torch.tensor([180.0, -180.0]))
    a, _, t = g.viewpoint_from_rotation(R)
    assert ((a < 360) & (t < 180)).all(), "angles are wrapped"
    assert_close(t.abs(), torch.full_like(t, 180.0), rtol=0, atol=1e-4)


@pytest.mark.parametrize("elevation", [90.0, -90.0])
@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-6, 1e-5, 1e-3])
def test_viewpoint_from_rotation_is_accurate_in_float32_near_the_poles(elevation, noise):
    """Rotations from an optimiser are rounded, and so not exact."""
    generator = seeded(0)
    azimuth, theta = 360.0 * uniform(2, 50, 20)
    exact = g.rotation_from_viewpoint(azimuth, elevation, theta)
    perturbation = torch.randn(exact.shape[:-1], generator=generator, dtype=torch.float64) * noise
    tilt = torch.from_numpy(
        Rotation.from_rotvec(perturbation.view(-1, 3).numpy()).as_matrix()
    ).view(exact.shape)
    rounded = (tilt @ exact).float() + 5e-7 * torch.randn(exact.shape, generator=generator)
    back = g.rotation_from_viewpoint(*g.viewpoint_from_rotation(rounded))
    assert back.shape == rounded.shape
    assert math.radians(float(g.rotation_error(back.double(), rounded.double()).max())) < 5e-5


def test_angles_of_all_pairs_are_those_of_the_nearest_symmetry():
    R = rotations(5, 1)
    others = rotations(7, 2)
    group = torch.from_numpy(Rotation.create_group("C4").as_matrix())
    plain = rotation_error(R[:, None], others[None])
    assert_close(angles_between(R, others), plain)
    nearest = rotation_error(R[:, None, None] @ group, others[None, :, None]).amin(dim=2)
    assert_close(angles_between(R, others, group), nearest)
    transforms = g.transform(group, torch.ones(4, 3).double())
    assert_close(angles_between(R, others, transforms), nearest)


def test_rotation_error_agrees_with_scipy():
    A = Rotation.random(60, random_state=1)
    differences = Rotation.from_rotvec(
        [[0, 0, v] for v in (0.0, 1e-9, 1e-4, 1.0, 3.0, math.pi)] * 10
    )
    B = A * differences
    ours = g.rotation_error(torch.from_numpy(A.as_matrix()), torch.from_numpy(B.as_matrix()))
    expected = torch.rad2deg(torch.from_numpy((A.inv() * B).magnitude()))
    assert_close(ours, expected, rtol=0, atol=1e-5)
    small = ours[expected < 1e-6]
    assert_close(small, expected[expected < 1e-6], rtol=0.02, atol=1e-12)
    assert g.rotation_error(
        torch.eye(3).expand(4, 1, 3, 3), torch.eye(3).expand(5, 3, 3)
    ).shape == (4, 5)


@pytest.mark.parametrize("count", [2, 5, 20, 100, 300, 700])
def test_uniform_views_has_the_stated_covering_radius(count):
    probes = torch.randn(100_000, 3, generator=seeded(0), dtype=torch.float64)
    probes = torch.nn.functional.normalize(torch.cat([probes, eye(3), -eye(3)]), dim=1)
    directions = -uniform_views(count).rotations[:, 2].double()
    nearest = torch.cat([(p @ directions.T).amax(1) for p in probes.split(20_000)])
    radius = math.degrees(math.acos(max(-1.0, float(nearest.min()))))
    assert 0.9 * 157 / math.sqrt(count) < radius <= 157 / math.sqrt(count)


def test_paper_views_is_the_grid_of_the_paper():
    views = paper_views()
    assert len(views) == 756
    assert sorted({round(float(d), 4) for d in views.distance}) == pytest.approx(
        [1.5, 3.0, 4.5, 6.0, 7.5, 9.0]
    )
    one_shell = views[views.distance == views.distance[0]]
    assert len(one_shell) == 126
    R = one_shell.rotations.double()
    # no view twice
    assert (rotation_error(R[:, None], R) + 9.0 * torch.eye(126)).min() > 3.0
    # Neighbours in elevation differ by 50 degrees about the camera's x axis.
    grid = one_shell.rotations.view(7, 18, 3, 3)
    assert torch.allclose(rotation_error(grid[1:], grid[:-1]), torch.tensor(50.0), atol=1e-3)
    step = grid[1:] @ grid[:-1].mT
    assert torch.allclose(step[..., 0, 0], torch.tensor(1.0), atol=1e-5)


def test_view_functions_refuse_invalid_options():
    one = torch.zeros(1)
    for call, match in (
        (lambda: ViewSphere(one, one, one, one + 1), "distances > 1"),
        (lambda: ViewSphere(one, one, torch.zeros(2), one + 2), "one shape"),
        (lambda: sample_views(azimuth_step=0), "azimuth_step"),
        (lambda: sample_views(elevations=[91]), "elevations"),
        (lambda: uniform_views(2.5), "count: expected an integer"),
        (
            lambda: sample_views(elevations=[float("nan")]),
            "elevations: expected at least one finite",
        ),
    ):
        with refused(match):
            call()


@pytest.mark.parametrize("up", UP_AXES)
def test_for_up_shows_the_same_views(up):
    assert (up_rotation("y").numpy() @ [0, 0, 1]).tolist() == [0, -1, 0], (
        "from glTF's front to that of PASCAL3D+"
    )
    views = cr.sample_views(azimuth_step=40, elevations=[-20, 30, 90], thetas=[0, 25])
    seen = views.for_up(up).rotations.double() @ up_rotation(up).T
    assert_close(seen, views.rotations.double(), rtol=0, atol=2e-6)
