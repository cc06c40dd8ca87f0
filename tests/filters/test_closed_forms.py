"""Surfaces and edges whose answer is known."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from curvireg_torch import filters

from .layer_cases import cylinder, grid, plane, sphere

SIZES = (33, 65, 129)


def _saliency(depth: Tensor, **options: object) -> Tensor:
    """CS without smoothing or rescaling, depth in px."""
    return filters.depth_curvilinear_saliency(depth, sigma=0.0, depth_scale=1.0, **options)


def _sphere_error(size: int) -> float:
    radius = 0.75 * size
    x, y = grid(size)
    inside = x**2 + y**2 < (0.4 * size) ** 2
    return float((_saliency(sphere(size, radius, 2 * radius)).norm(dim=1)[0] * radius)[inside].max())


def _cylinder_error(size: int) -> float:
    radius = 0.75 * size
    x, _ = grid(size)
    inside = x.abs() < 0.4 * size
    relative = _saliency(cylinder(size, radius, 2 * radius)).norm(dim=1)[0] * radius
    return float((relative - 1.0)[inside].abs().max())


def _saddle_error(size: int) -> float:
    """kappa1 - kappa2 of z = (x^2 - y^2) / (2 a) + (x^4 - y^4) / (8 a^3), whose curvatures at 0 are those of the
    saddle."""
    a = 0.5 * size
    x, y = grid(size)
    z = (3 * size + (x**2 - y**2) / (2 * a) + (x**4 - y**4) / (8 * a**3))[None, None]
    centre = size // 2
    return abs(float(_saliency(z)[0, :, centre, centre].norm()) * a / 2.0 - 1.0)


@pytest.mark.parametrize("error", [_sphere_error, _cylinder_error, _saddle_error])
def test_curvilinear_saliency_converges_with_order_two(error: Callable[[int], float]) -> None:
    errors = [error(size) for size in SIZES]
    orders = [
        math.log(e1 / e2) / math.log(s2 / s1)
        for e1, e2, s1, s2 in zip(errors, errors[1:], SIZES, SIZES[1:], strict=False)
    ]
    print(f"{error.__name__}: errors {errors}, orders {[round(o, 2) for o in orders]}")
    assert errors[-1] < 1e-3
    assert all(1.8 < order < 2.3 for order in orders)


@pytest.mark.parametrize("formula", ["geometric", "paper"])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.5, 0.0), (0.3, -2.0)])
def test_a_plane_has_no_saliency(formula: str, slopes: tuple[float, float]) -> None:
    field = _saliency(plane(33, *slopes, distance=200.0), formula=formula)[..., 1:-1, 1:-1]
    assert float(field.abs().max()) < 1e-9


@pytest.mark.parametrize("sigma", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("slopes", [(0.5, 0.0), (0.3, -2.0)])
def test_a_plane_is_flat_up_to_the_border(sigma: float, slopes: tuple[float, float]) -> None:
    depth = plane(33, *slopes, distance=200.0)
    for layer in (
        filters.depth_curvilinear_saliency,
        filters.hessian_frobenius_norm,
        filters.average_shading_gradient,
    ):
        for depth_scale in (1.0, None):
            assert float(layer(depth, sigma=sigma, depth_scale=depth_scale).abs().max()) < 1e-9
    assert float(filters.apparent_ridges(depth, sigma=sigma, maxima=False).abs().max()) < 1e-9


def test_both_formulas_differ_by_the_metric_alone() -> None:
    depth = cylinder(65, 60.0, 100.0)
    geometric, paper = (_saliency(depth, formula=f).norm(dim=1)[0] for f in ("geometric", "paper"))
    slope = 0.5 * (depth[0, 0, :, 2:] - depth[0, 0, :, :-2])
    ratio = slope.abs() * (1 + slope**2) ** 1.5
    torch.testing.assert_close(paper[1:-1, 1:-1], (geometric[:, 1:-1] * ratio)[1:-1], rtol=1e-9, atol=1e-12)


def test_the_direction_is_that_of_the_larger_curvature() -> None:
    field = _saliency(cylinder(33, 40.0, 100.0))[0, :, 5:-5, 5:-5]
    assert float(field[1].abs().max()) < 1e-9 * float(field[0].abs().min())


def test_with_unit_range_the_vector_points_across_an_occluding_contour() -> None:
    depth = sphere(129, 40.0, 100.0)
    x, y = grid(129)
    r = (x**2 + y**2).sqrt()
    rim = (r - 40.0).abs() < 1.0
    field = filters.depth_curvilinear_saliency(depth, sigma=1.0)[0]
    radial = (field[0] * x + field[1] * y).abs() / (field.norm(dim=0) * r).clamp(min=1e-12)
    assert float(radial[rim].median()) > 0.95


def test_missing_depth_is_background_however_it_is_written() -> None:
    depth = sphere(33, 12.0, 50.0)
    missing = depth == 0
    want = filters.depth_curvilinear_saliency(depth)
    for value in (-1.0, math.inf, -math.inf, math.nan):
        torch.testing.assert_close(filters.depth_curvilinear_saliency(depth.masked_fill(missing, value)), want)
    full = depth.masked_fill(missing, 7.0)
    torch.testing.assert_close(filters.depth_curvilinear_saliency(full, ~missing), want)


def test_the_background_lies_a_quarter_of_the_range_behind_the_object() -> None:
    """As if depth had been seen there, with and without a camera."""
    depth = sphere(33, 12.0, 50.0)
    near, far = float(depth[depth > 0].min()), float(depth.max())
    seen, camera = torch.where(depth > 0, depth, near + 1.25 * (far - near)), {"camera_matrix": _camera(60.0, 33)}
    for layer, options, as_seen in (
        (filters.hessian_frobenius_norm, {}, {"depth_scale": 1.0 / (far - near)}),
        (filters.average_shading_gradient, camera, camera),
    ):  # lengths: the sign is free
        torch.testing.assert_close(layer(depth, **options).norm(dim=1), layer(seen, **as_seen).norm(dim=1))


def test_average_shading_gradient_of_a_sphere() -> None:
    """N = (x, y, .) / r, so |N_x|^2 + |N_y|^2 = (2 + rho^2 / (r^2 - rho^2)) / r^2."""
    radius = 60.0
    x, y = grid(65)
    field = filters.average_shading_gradient(sphere(65, radius, 100.0), sigma=0.0, depth_scale=1.0)
    rho2 = x**2 + y**2
    want = math.sqrt(math.pi / 3.0) * ((2.0 + rho2 / (radius**2 - rho2).clamp(min=1.0)) / radius**2).sqrt()
    inside = rho2 < 25.0**2
    torch.testing.assert_close(field.norm(dim=1)[0][inside], want[inside], rtol=2e-3, atol=0.0)


def _camera(focal: float, size: int) -> Tensor:
    c = (size - 1) / 2
    return torch.tensor([[focal, 0.0, c], [0.0, focal, c], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_a_slanted_plane_under_perspective_has_one_normal() -> None:
    """n . X = d gives Z = d / (n . K^-1 (u, v, 1)), curved as a graph, flat as a surface."""
    size, focal = 65, 80.0
    x, y = grid(size)
    depth = (3.0 / (1.0 + 0.4 * x / focal - 0.3 * y / focal))[None, None]
    options = {"sigma": 0.0, "camera_matrix": _camera(focal, size)}
    flat = filters.average_shading_gradient(depth, **options)[..., 1:-1, 1:-1]
    ridges = filters.apparent_ridges(depth, maxima=False, **options)[..., 1:-1, 1:-1]
    graph = filters.average_shading_gradient(depth, sigma=0.0)[..., 1:-1, 1:-1]
    assert float(flat.abs().max()) < 0.02 * float(graph.abs().max())
    assert float(ridges.abs().max()) < 0.02 * float(graph.abs().max())


def test_perspective_normals_of_a_sphere_whatever_the_unit_of_depth() -> None:
    """At the nearest point of a sphere of radius r at distance d a pixel is a step of (d - r) / f along it."""
    size, focal, d, r = 65, 120.0, 5.0, 2.0
    x, y = grid(size)
    ray2 = 1.0 + (x**2 + y**2) / focal**2
    root = (d**2 - ray2 * (d**2 - r**2)).clamp(min=0.0)
    depth = torch.where(root > 0, (d - root.sqrt()) / ray2, 0.0)[None, None]
    want = math.sqrt(math.pi / 3.0) * math.sqrt(2.0) / r * (d - r) / focal
    for unit in (1.0, 1000.0):
        field = filters.average_shading_gradient(unit * depth, sigma=0.0, camera_matrix=_camera(focal, size))
        assert float(field[0, :, 32, 32].norm()) == pytest.approx(want, rel=1e-3)


def test_a_sphere_beside_the_axis_of_a_camera_of_two_focal_lengths() -> None:
    """fx != fy and cx != cy: the normal is (point - centre) / radius, differentiated by differences of its own."""
    H, W, d, r = 49, 61, 5.0, 2.0
    camera = torch.tensor([[130.0, 0.0, 24.0], [0.0, 90.0, 31.0], [0.0, 0.0, 1.0]], dtype=torch.float64)

    def surface(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Depth and normals (3, ...) at pixels u, v, of a sphere around (0.2, -0.1, d)."""
        ray = torch.stack([(u - 24.0) / 130.0, (v - 31.0) / 90.0, torch.ones_like(u)])
        centre = torch.tensor([0.2, -0.1, d], dtype=torch.float64).view(3, 1, 1)
        a, b = (ray * ray).sum(0), (ray * centre).sum(0)
        z = (b - (b * b - a * ((centre * centre).sum() - r * r)).sqrt()) / a
        return z, (z * ray - centre) / r

    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (H, W)), indexing="ij")
    step = 1e-4
    nx = (surface(u + step, v)[1] - surface(u - step, v)[1]) / (2 * step)
    ny = (surface(u, v + step)[1] - surface(u, v - step)[1]) / (2 * step)
    depth = surface(u, v)[0][None, None]
    want = math.sqrt(math.pi / 3.0) * ((nx * nx).sum(0) + (ny * ny).sum(0)).sqrt()
    inner = (slice(2, -2), slice(2, -2))
    got = filters.average_shading_gradient(depth, sigma=0.0, camera_matrix=camera)[0].norm(dim=0)
    torch.testing.assert_close(got[inner], want[inner], rtol=5e-3, atol=0.0)
    q1 = torch.linalg.svdvals(torch.stack([nx, ny], dim=-1).permute(1, 2, 0, 3))[..., 0]
    ridges = filters.apparent_ridges(depth, sigma=0.0, camera_matrix=camera, maxima=False)[0].norm(dim=0)
    torch.testing.assert_close(ridges[inner], q1[inner], rtol=5e-3, atol=0.0)


@pytest.mark.parametrize("radius", [60.0, 6000.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_apparent_ridges_know_the_curvature_of_an_umbilic(radius: float, dtype: torch.dtype) -> None:
    """At the vertex of a paraboloid the normal turns alike in all directions, by 1 / r per px."""
    x, y = grid(33)
    bowl = ((x**2 + y**2) / (2 * radius) + 1.0)[None, None].to(dtype)
    field = filters.apparent_ridges(bowl, sigma=0.0, depth_scale=1.0, maxima=False)[0, :, 16, 16]
    assert float(field.norm()) * radius == pytest.approx(1.0, rel=5e-3)


def test_hessian_frobenius_norm_of_a_quadratic() -> None:
    x, y = grid(33)
    z = (900.0 + 0.5 * x**2 + 2.0 * x * y - 1.5 * y**2)[None, None]
    field = filters.hessian_frobenius_norm(z, sigma=0.0, depth_scale=1.0)[0, :, 1:-1, 1:-1]
    torch.testing.assert_close(field.norm(dim=0), torch.full_like(field[0], math.sqrt(1 + 8 + 9)))
    values, vectors = torch.linalg.eigh(torch.tensor([[1.0, 2.0], [2.0, -3.0]], dtype=torch.float64))
    along = vectors[:, values.abs().argmax()]
    torch.testing.assert_close((field[:, 3, 3] / field[:, 3, 3].norm()).abs(), along.abs())


def test_apparent_ridges_of_a_cylinder_and_a_roof() -> None:
    """On a cylinder the normal turns by 1 / (r cos) per px across it; on a roof it turns at the edge alone."""
    radius = 60.0
    x, _ = grid(65)
    field = filters.apparent_ridges(cylinder(65, radius, 100.0), sigma=0.0, depth_scale=1.0, maxima=False)[0]
    want = 1.0 / (radius**2 - x**2).sqrt()
    inside = x.abs() < 28
    torch.testing.assert_close(field.norm(dim=0)[inside], want[inside], rtol=2e-3, atol=0.0)
    roof = (100.0 + (x - 4).abs() * 0.5)[None, None]
    ridge = filters.apparent_ridges(roof, sigma=1.0, depth_scale=1.0)[0, :, 3:-3, 3:-3].norm(dim=0) > 1e-6
    assert ridge.sum(dim=0).nonzero().flatten().tolist() == [32 + 4 - 3]


def _edge(sigma: float, offset: float, size: int = 81) -> Tensor:
    x, _ = grid(size)
    return (0.2 + 0.6 * 0.5 * (1.0 + torch.erf((x - offset) / (sigma * math.sqrt(2.0)))))[None, None]


@pytest.mark.parametrize("mode", ["reblur-image", "reblur-saliency"])
@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("transposed", [False, True])
def test_blur_of_a_step_edge_through_a_pixel_centre(mode: str, sigma: float, transposed: bool) -> None:
    image = _edge(sigma, 0.0)
    blur = filters.edge_blur(image.mT if transposed else image, mode=mode)[0, :, 40, 40]
    torch.testing.assert_close(blur, torch.full_like(blur, sigma), rtol=0.02, atol=0.0)


def test_focus_curves_rank_edges_by_sharpness() -> None:
    x, _ = grid(121)
    sharp, blurred = (torch.erf((x - c) / (s * math.sqrt(2.0))) for c, s in ((-30.0, 1.0), (30.0, 3.0)))
    field = filters.multiscale_focus_curves((0.5 + 0.2 * (sharp - blurred))[None, None], saliency_weight=False)
    focus = field[0, :, 60].norm(dim=0)
    assert float(1 / focus[30]) == pytest.approx(math.sqrt(1 + 1), rel=0.03)  # the smoothing of 1 px is part of it
    assert float(1 / focus[90]) == pytest.approx(math.sqrt(9 + 1), rel=0.03)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0, 3.0])
def test_focus_curves_are_limited_by_the_smoothing_on_edges_only(sigma: float) -> None:
    step = (torch.arange(65.0) > 32).to(torch.float64).expand(1, 1, 65, 65)
    noise = torch.rand(1, 1, 65, 65, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    of_step, of_noise = (
        float(filters.multiscale_focus_curves(x, sigma=sigma, saliency_weight=0.0).norm(dim=1).max())
        for x in (step, noise)
    )
    assert 0.7 / sigma < of_step <= 1.0 / sigma
    assert of_noise == pytest.approx(1.0 / 0.6, rel=1e-3)


def test_image_gradient_and_saliency_of_a_ramp() -> None:
    x, y = grid(33)
    ramp = (0.03 * x - 0.04 * y)[None, None]
    inner = (..., slice(6, -6), slice(6, -6))
    gradient = filters.image_gradient(ramp)[inner]
    saliency = filters.image_curvilinear_saliency(ramp)[inner]
    want = torch.tensor([0.03, -0.04], dtype=torch.float64).view(1, 2, 1, 1).expand_as(gradient)
    torch.testing.assert_close(gradient, want)
    torch.testing.assert_close(saliency, want * 0.05)


def test_pci_finds_a_dark_line_with_the_largest_eigenvalue_and_a_bright_one_with_the_smallest() -> None:
    x, _ = grid(65)
    bright = torch.exp(-0.5 * (x / 2.0) ** 2)[None, None]
    for image, right, wrong in ((1 - bright, "largest", "smallest"), (bright, "smallest", "largest")):
        field = filters.principal_curvature_image(image, eigenvalue=right)[0, :, 32]
        other = filters.principal_curvature_image(image, eigenvalue=wrong)[0, :, 32]
        assert int(field.norm(dim=0).argmax()) == 32
        assert float(other[:, 32].norm()) < 1e-9
        # s^2 2 / (4 + s^2)^1.5 is largest at s = 2 sqrt 2: the scale of 2.8 px wins.
        assert float(field[:, 32].norm()) == pytest.approx(2.8**2 * 2 / (4 + 2.8**2) ** 1.5, rel=0.03)
        assert float(field[1, 32].abs()) < 1e-9


@pytest.mark.parametrize(("dtype", "ulp"), [(torch.float16, 2**-11), (torch.bfloat16, 2**-8)])
@pytest.mark.parametrize("sigma", [1.0, 8.0, torch.tensor(3.0)])
def test_smoothing_rounds_half_types_once(dtype: torch.dtype, ulp: float, sigma: float | Tensor) -> None:
    x = torch.rand(1, 2, 64, 64, generator=torch.Generator().manual_seed(0)).to(dtype)
    smooth = filters.gaussian_smooth(x, sigma)
    assert smooth.dtype == dtype
    exact = filters.gaussian_smooth(x.double(), sigma)
    assert float((smooth.double() - exact).abs().max()) <= 0.51 * ulp  # half a unit in the last place of 0.5 to 1


def test_pci_takes_the_direction_of_the_scale_that_won() -> None:
    """Length and direction together are those of the single scale with the largest curvature."""
    image = torch.rand(1, 1, 48, 48, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sigmas = (1.0, 2.0, 4.0)
    single = torch.cat([filters.principal_curvature_image(image, sigmas=[sigma]) for sigma in sigmas])
    winner = single.norm(dim=1).argmax(dim=0)
    assert len(winner.unique()) == 3
    best = single.gather(0, winner.expand(1, 2, -1, -1))
    found = filters.principal_curvature_image(image, sigmas=sigmas)
    torch.testing.assert_close((found * best).sum(dim=1).abs(), best.square().sum(dim=1))  # the sign is free
