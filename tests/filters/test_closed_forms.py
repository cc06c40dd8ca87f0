"""Layers on surfaces, edges, lines and ramps with known results."""

import math
from functools import partial

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import filters
from curvireg_torch.filters.focus import MODES
from curvireg_torch.geometry import camera_matrix
from tests._support import double, seeded

from .layer_cases import LAYERS, cylinder, grid, plane, sphere

SIZES = (33, 65, 129)


def _saliency(depth, **options):
    """CS without smoothing or rescaling, depth in px."""
    return filters.depth_curvilinear_saliency(depth, sigma=0.0, depth_scale=1.0, **options)


def _round_error(size, make, want):
    """Error of the CS of a sphere or cylinder, relative to 1 / radius."""
    radius = 0.75 * size
    x, y = grid(size)
    inside = (x**2 + y**2).sqrt() < 0.4 * size
    return float(
        (_saliency(make(size, radius, 2 * radius)).norm(dim=1)[0] * radius - want)[inside]
        .abs()
        .max()
    )


def _saddle_error(size):
    """kappa1 - kappa2 of z = (x^2 - y^2) / (2 a) + (x^4 - y^4) / (8 a^3), whose curvatures at 0 are
    those of the saddle."""
    a = 0.5 * size
    x, y = grid(size)
    z = (3 * size + (x**2 - y**2) / (2 * a) + (x**4 - y**4) / (8 * a**3))[None, None]
    centre = size // 2
    return abs(float(_saliency(z)[0, :, centre, centre].norm()) * a / 2.0 - 1.0)


def test_depth_curvilinear_saliency_converges_with_order_two():
    rounds = (
        partial(_round_error, make=sphere, want=0.0),
        partial(_round_error, make=cylinder, want=1.0),
    )
    for error in (*rounds, _saddle_error):
        errors = torch.tensor([error(size) for size in SIZES])
        orders = -errors.log().diff() / torch.tensor(SIZES).log().diff()
        assert errors[-1] < 1e-3
        assert ((orders > 1.8) & (orders < 2.3)).all()


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.5, 0.0), (0.3, -2.0)])
def test_depth_layers_are_zero_on_a_plane_up_to_the_border(sigma, slopes):
    depth = plane(33, *slopes, distance=200.0)
    for layer in (
        filters.depth_curvilinear_saliency,
        partial(filters.depth_curvilinear_saliency, formula="paper"),
        filters.hessian_frobenius_norm,
        filters.average_shading_gradient,
    ):
        for depth_scale in (1.0, None):
            assert layer(depth, sigma=sigma, depth_scale=depth_scale).abs().max() < 1e-9
    assert filters.apparent_ridges(depth, sigma=sigma, maxima=False).abs().max() < 1e-9


def test_depth_layers_put_the_background_a_quarter_of_the_range_behind_the_object():
    depth = sphere(33, 12.0, 50.0)
    near = float(depth[depth > 0].min())
    far = float(depth.max())
    filled = torch.where(depth > 0, depth, near + 1.25 * (far - near))
    camera = {"camera_matrix": camera_matrix(60.0, 60.0, 16.0, 16.0)}
    for layer, options, filled_options in (
        (filters.hessian_frobenius_norm, {}, {"depth_scale": 1.0 / (far - near)}),
        (filters.average_shading_gradient, camera, camera),
    ):  # compare lengths, since signs are arbitrary
        assert_close(
            layer(depth, **options).norm(dim=1), layer(filled, **filled_options).norm(dim=1)
        )


def test_average_shading_gradient_of_a_sphere():
    """N = (x, y, .) / r, so |N_x|^2 + |N_y|^2 = (2 + rho^2 / (r^2 - rho^2)) / r^2."""
    radius = 60.0
    x, y = grid(65)
    field = filters.average_shading_gradient(sphere(65, radius, 100.0), sigma=0.0, depth_scale=1.0)
    rho2 = x**2 + y**2
    want = (
        math.sqrt(math.pi / 3.0)
        * ((2.0 + rho2 / (radius**2 - rho2).clamp(min=1.0)) / radius**2).sqrt()
    )
    inside = rho2 < 25.0**2
    assert_close(field.norm(dim=1)[0][inside], want[inside], rtol=2e-3, atol=0.0)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_perspective_layers_on_an_off_axis_sphere_with_two_focal_lengths_in_any_unit(unit):
    """fx != fy and cx != cy: the normal (point - centre) / radius is differentiated numerically."""
    H = 49
    W = 61
    d = 5.0
    r = 2.0
    camera = camera_matrix(130.0, 90.0, 24.0, 31.0)

    def surface(u, v):
        """Depth and normals (3, ...) at pixels u, v, of a sphere around (0.2, -0.1, d)."""
        ray = torch.stack([(u - 24.0) / 130.0, (v - 31.0) / 90.0, torch.ones_like(u)])
        centre = double([0.2, -0.1, d]).view(3, 1, 1)
        a = (ray * ray).sum(0)
        b = (ray * centre).sum(0)
        z = (b - (b * b - a * ((centre * centre).sum() - r * r)).sqrt()) / a
        return z, (z * ray - centre) / r

    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (H, W)), indexing="ij")
    step = 1e-4
    nx = (surface(u + step, v)[1] - surface(u - step, v)[1]) / (2 * step)
    ny = (surface(u, v + step)[1] - surface(u, v - step)[1]) / (2 * step)
    depth = unit * surface(u, v)[0][None, None]
    want = math.sqrt(math.pi / 3.0) * ((nx * nx).sum(0) + (ny * ny).sum(0)).sqrt()
    inner = (slice(2, -2), slice(2, -2))
    got = filters.average_shading_gradient(depth, sigma=0.0, camera_matrix=camera)[0].norm(dim=0)
    assert_close(got[inner], want[inner], rtol=5e-3, atol=0.0)
    q1 = torch.linalg.svdvals(torch.stack([nx, ny], dim=-1).permute(1, 2, 0, 3))[..., 0]
    ridges = filters.apparent_ridges(depth, sigma=0.0, camera_matrix=camera, maxima=False)[0].norm(
        dim=0
    )
    assert_close(ridges[inner], q1[inner], rtol=5e-3, atol=0.0)


def test_hessian_frobenius_norm_of_a_quadratic():
    x, y = grid(33)
    z = (900.0 + 0.5 * x**2 + 2.0 * x * y - 1.5 * y**2)[None, None]
    field = filters.hessian_frobenius_norm(z, sigma=0.0, depth_scale=1.0)[0, :, 1:-1, 1:-1]
    assert_close(field.norm(dim=0), torch.full_like(field[0], math.sqrt(1 + 8 + 9)))
    values, vectors = torch.linalg.eigh(double([[1.0, 2.0], [2.0, -3.0]]))
    along = vectors[:, values.abs().argmax()]
    assert_close((field[:, 3, 3] / field[:, 3, 3].norm()).abs(), along.abs())


def test_apparent_ridges_of_a_cylinder_and_a_roof():
    """Across a cylinder the normal changes by 1 / (r cos) per px; on a roof it changes only at the
    edge."""
    radius = 60.0
    x, _ = grid(65)
    field = filters.apparent_ridges(
        cylinder(65, radius, 100.0), sigma=0.0, depth_scale=1.0, maxima=False
    )[0]
    want = 1.0 / (radius**2 - x**2).sqrt()
    inside = x.abs() < 28
    assert_close(field.norm(dim=0)[inside], want[inside], rtol=2e-3, atol=0.0)
    roof = (100.0 + (x - 4).abs() * 0.5)[None, None]
    ridge = (
        filters.apparent_ridges(roof, sigma=1.0, depth_scale=1.0)[0, :, 3:-3, 3:-3].norm(dim=0)
        > 1e-6
    )
    assert ridge.sum(dim=0).nonzero().flatten().tolist() == [32 + 4 - 3]


@pytest.mark.parametrize("name", ["cs", "asg", "hfn", "asg-perspective"])
@pytest.mark.parametrize("distance", [0.3, 5.0, 4e6])
def test_depth_layers_ignore_noise_of_one_ulp(name, distance):
    """A surface parallel to the image has no depth range, even where rounding gives it one."""
    depth = torch.zeros(2, 1, 96, 96)
    depth[..., 30:70, 25:75] = distance
    half = torch.rand(depth.shape, generator=seeded(0)) < 0.5
    noisy = depth.nextafter(torch.tensor(math.inf)).where(half & (depth > 0), depth)
    # the sign of each vector is arbitrary
    a, b = (LAYERS[name](each).double() for each in (noisy, depth))
    assert ((a * b).sum(dim=1).abs().sum() / (a.norm() * b.norm())) > 0.9999


@pytest.mark.parametrize("angle", [0.0, 15.0, 30.0, 45.0, 60.0])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("blur", [1.0, 1.5, 2.0, 3.0, 4.0])
def test_edge_blur_in_all_directions(angle, mode, blur):
    """At the middle of a blurred step, whose normal has the angle."""
    x, y = grid(81)
    across = math.cos(math.radians(angle)) * x + math.sin(math.radians(angle)) * y
    edge = 0.5 * (1.0 + torch.erf(across / (blur * math.sqrt(2.0))))
    estimates = filters.edge_blur(edge[None, None], mode=mode)[0, :, 40, 40]
    assert estimates.tolist() == pytest.approx([blur] * 4, rel=0.015)
    assert (estimates > 0.999 * blur).all()  # the focus 1/s does not exceed 1/blur


def test_multiscale_focus_curves_leave_weak_edges_out():
    """Of a tenth of the strongest edge's contrast, not of a quarter: CS is a square."""
    x, _ = grid(161)
    image = sum(
        contrast * torch.erf((x - middle) / (2.0 * math.sqrt(2.0)))
        for middle, contrast in ((-50.0, 0.3), (0.0, 0.075), (50.0, 0.03))
    )
    field = filters.multiscale_focus_curves(0.5 + image[None, None])[0, :, 80].norm(dim=0)
    assert (field[[30, 80, 130]] > 0).tolist() == [True, True, False]


@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0])
def test_principal_curvature_image_points_across_a_line(angle):
    x, y = grid(81)
    normal = double([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    line = 1.0 - torch.exp(-0.5 * ((normal[0] * x + normal[1] * y) / 2.0) ** 2)
    vector = filters.principal_curvature_image(line[None, None])[0, :, 40, 40].double()
    assert vector.norm() == pytest.approx(2.8**2 * 2 / (4 + 2.8**2) ** 1.5, rel=0.03)
    assert abs(vector @ normal) > 0.999 * vector.norm()
