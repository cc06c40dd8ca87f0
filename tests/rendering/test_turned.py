"""Views that turn about the optical axis: one picture of each direction gives what rendering each would."""

import math

import pytest
import torch
from torch import Tensor

from curvireg_torch.geometry import mesh_centre, mesh_radius, transform, uniform_views
from curvireg_torch.rendering import DepthRenderer, make_renderer
from curvireg_torch.rendering.turned import FEWEST, render_views

from .scenes import interior, smooth
from .test_parity import MESHES

SIZE = (96, 128)


class Counting:
    """A renderer that counts the views asked of it."""

    def __init__(self, renderer: DepthRenderer) -> None:
        self.name, self._renderer, self.views = renderer.name, renderer, 0

    def render(self, T: Tensor, K: Tensor, size: tuple[int, int], *, orthographic: bool = False) -> Tensor:
        self.views += len(T)
        return self._renderer.render(T, K, size, orthographic=orthographic)


def turns(count: int, directions: int, radius: float, centre: Tensor, *, orthographic: bool) -> tuple[Tensor, Tensor]:
    """Directions x turns in random order, the object off the axis; every view has a camera of its own."""
    generator = torch.Generator().manual_seed(3)
    R = uniform_views(directions).rotations.double().repeat_interleave(count, 0)
    t = torch.tensor([0.2, -0.1, 4.5], dtype=torch.float64).expand(len(R), 3) * radius
    angle = torch.rand(len(R), generator=generator, dtype=torch.float64) * 2 * math.pi
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    Rz = torch.stack([angle.cos(), -angle.sin(), zero, angle.sin(), angle.cos(), zero, zero, zero, one], 1)
    Rz = Rz.view(-1, 3, 3)
    T = transform(Rz @ R, (Rz @ (t - (R @ centre))[..., None])[..., 0])
    K = torch.eye(3, dtype=torch.float64).repeat(len(R), 1, 1)
    f = (40.0 / radius if orthographic else 180.0) * (0.9 + 0.2 * torch.rand(len(R), generator=generator).double())
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 1] = f, 1.1 * f, 0.05 * f
    K[:, :2, 2] = torch.tensor([63.0, 47.0]) + 4 * torch.rand(len(R), 2, generator=generator).double()
    order = torch.randperm(len(R), generator=generator)
    return T[order], K[order]


def rim(depth: Tensor) -> int:
    """Pixels of silhouettes that border on background."""
    mask = (depth > 0).float()
    return int((mask - (-torch.nn.functional.max_pool2d(-mask, 3, 1, 1))).sum())


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("name", MESHES)
def test_turned_views_are_those_rendered_but_at_contours(name: str, orthographic: bool) -> None:
    mesh = MESHES[name]()
    radius, centre = mesh_radius(mesh), mesh_centre(mesh)
    T, K = turns(12, 3, radius, centre, orthographic=orthographic)
    renderer = Counting(make_renderer(mesh, "embree"))
    found = render_views(renderer, T, K, SIZE, orthographic=orthographic)
    assert renderer.views == 3
    expected = renderer.render(T, K, SIZE, orthographic=orthographic)
    inside = interior(expected, found)
    assert int(((expected > 0) != (found > 0))[inside].sum()) == 0
    even = inside & (expected > 0) & smooth(expected, bend=0.01 * radius)
    assert even.sum() > 9_000
    error = (expected - found)[even].abs() / radius
    assert float(error.median()) <= (1e-6 if name == "parts" else 1e-4)
    assert float(error.quantile(0.99)) <= 2e-3
    differing = int(((expected > 0) != (found > 0)).sum())
    shifted = K.clone()
    shifted[:, :2, 2] += 0.25
    jittered = renderer.render(T, shifted, SIZE, orthographic=orthographic)
    assert differing <= 0.12 * rim(expected)
    assert differing <= int(((expected > 0) != (jittered > 0)).sum())


def test_torch_renderer_turns_too() -> None:
    mesh = MESHES["parts"]()
    T, K = turns(FEWEST, 2, mesh_radius(mesh), mesh_centre(mesh), orthographic=False)
    a, b = (render_views(make_renderer(mesh, backend), T, K, SIZE) for backend in ("embree", "torch"))
    assert int(((a > 0) != (b > 0)).sum()) <= 40
    both = (a > 0) & (b > 0)
    assert float((a - b)[both].abs().quantile(0.99)) <= 1e-5 * mesh_radius(mesh)


def test_few_turns_and_other_places_are_rendered_one_by_one() -> None:
    mesh = MESHES["parts"]()
    radius = mesh_radius(mesh)
    renderer = Counting(make_renderer(mesh, "embree"))
    T, K = turns(FEWEST, 2, radius, mesh_centre(mesh), orthographic=False)
    few = T.clone()
    few[: len(T) // 2, 2, 3] += 0.01 * radius * torch.arange(1, len(T) // 2 + 1)  # each farther than the last
    few = torch.cat([few, T[-1:]])  # seen twice
    K = torch.cat([K, K[-1:]])
    expected = renderer.render(few, K, SIZE)
    renderer.views = 0
    assert torch.equal(render_views(renderer, few, K, SIZE), expected)
    assert renderer.views == len(few)
    mixed = torch.cat([T, few[:3]])
    renderer.views = 0
    found = render_views(renderer, mixed, torch.cat([K[: len(T)], K[:3]]), SIZE)
    assert renderer.views == 2 + 3
    assert torch.equal(found[-3:], renderer.render(few[:3], K[:3], SIZE))
    assert render_views(renderer, T[:0], K[:0], SIZE).shape == (0, 1, *SIZE)


def test_nothing_in_sight_and_the_camera_inside() -> None:
    mesh = MESHES["parts"]()
    radius = mesh_radius(mesh)
    renderer = make_renderer(mesh, "embree")
    T, K = turns(FEWEST, 1, radius, mesh_centre(mesh), orthographic=False)
    behind = T.clone()
    behind[:, 2, 3] -= 20 * radius
    assert bool((render_views(renderer, behind, K, SIZE) == 0).all())
    near = T.clone()
    near[:, :3, 3] -= 4.5 * radius * torch.tensor([0.0, 0.0, 1.0])  # in the midst of the object
    a, b = render_views(renderer, near, K, SIZE), renderer.render(near, K, SIZE)
    assert float(((a > 0) != (b > 0)).float().mean()) < 0.02
    both = (a > 0) & (b > 0)
    assert both.any()
    assert bool((a[both] <= 1.001 * b.max()).all())


def test_one_wide_view_asks_for_no_huge_picture() -> None:
    # One camera that looks a thousand times closer than the others would need a picture of 10^5 px across.
    mesh = MESHES["parts"]()
    renderer = make_renderer(mesh, "embree")
    T, K = turns(FEWEST, 1, mesh_radius(mesh), mesh_centre(mesh), orthographic=False)
    K[0, :2, :2] *= 1000.0
    assert torch.equal(render_views(renderer, T, K, SIZE), renderer.render(T, K, SIZE))
