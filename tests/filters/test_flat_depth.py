"""A surface parallel to the image has no depth range, even where rounding gives it one."""

import math

import pytest
import torch
import trimesh
from torch import Tensor

from curvireg_torch import filters, render_depth
from curvireg_torch.geometry import rotation_from_viewpoint

CAMERA = torch.tensor([[137.3, 0.0, 47.5], [0.0, 137.3, 47.5], [0.0, 0.0, 1.0]])
FIELDS = {
    "cs": filters.depth_curvilinear_saliency,
    "asg": filters.average_shading_gradient,
    "hfn": filters.hessian_frobenius_norm,
    "asg-perspective": lambda depth: filters.average_shading_gradient(depth, camera_matrix=CAMERA.to(depth)),
}


def cosine(a: Tensor, b: Tensor) -> float:
    """Cosine similarity of two vector fields with arbitrary sign at each pixel."""
    a, b = a.double(), b.double()
    return float((a * b).sum(dim=1).abs().sum() / (a.norm() * b.norm()))


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("distance", [0.3, 5.0, 4e6])
def test_depth_layers_ignore_noise_of_one_ulp(field: str, distance: float) -> None:
    depth = torch.zeros(2, 1, 96, 96)
    depth[..., 30:70, 25:75] = distance
    noisy = depth.nextafter(torch.tensor(math.inf)).where(
        (torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) < 0.5) & (depth > 0), depth
    )
    assert cosine(FIELDS[field](noisy), FIELDS[field](depth)) > 0.9999


@pytest.mark.parametrize(("renderer", "elevation", "distance"), [("torch", 0.0, 1.3), ("embree", 90.0, 2.1)])
def test_depth_curvilinear_saliency_of_a_rendered_frontal_face(
    renderer: str, elevation: float, distance: float
) -> None:
    """At these poses the renderers round differently from pixel to pixel."""
    mesh = trimesh.creation.box((1.0, 0.7, 0.2)).subdivide()
    T = torch.eye(4)
    if elevation:
        T[:3, :3] = rotation_from_viewpoint(0.0, elevation)
    T[2, 3] = distance
    depth = render_depth(mesh, T[None], CAMERA, (96, 96), renderer=renderer)
    assert int((depth > 0).sum()) > 1000
    flat = torch.where(depth > 0, depth[depth > 0].median(), depth)
    rendered, exact = (filters.depth_curvilinear_saliency(z) for z in (depth, flat))
    assert cosine(rendered, exact) > 0.9999


def test_depth_curvilinear_saliency_stretches_a_small_range_above_rounding() -> None:
    x = torch.linspace(0.0, 1.0, 64, dtype=torch.float64).square().expand(1, 1, 64, 64)
    far, near = (filters.depth_curvilinear_saliency(offset + x) for offset in (2e5, 10.0))
    assert cosine(far, near) > 0.9999
    torch.testing.assert_close(far.norm(dim=1).amax(), near.norm(dim=1).amax(), rtol=1e-3, atol=0.0)
