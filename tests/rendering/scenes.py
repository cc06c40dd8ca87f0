"""Cameras and checks that the renderers' tests share."""

import functools

import pytest
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from curvireg_torch.errors import RenderingError
from curvireg_torch.geometry import transform, uniform_views
from curvireg_torch.rendering import make_renderer

BACKENDS = ("embree", "pyrender", "torch")


@functools.cache
def _works(backend: str) -> bool:
    try:
        make_renderer(trimesh.creation.box(), backend)
    except RenderingError:
        return False
    return True


def require(*backends: str) -> None:
    """Skip where a backend has no driver; only pyrender needs one."""
    for backend in backends:
        if backend == "pyrender" and not _works(backend):
            pytest.skip("pyrender needs EGL")


def camera(
    count: int, *, radius: float = 1.0, centre: Tensor | None = None, orthographic: bool = False
) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Views from all around by an off-centre camera with oblong pixels and a wide image, object partly outside."""
    R = uniform_views(count).rotations.double()
    centre = torch.zeros(3, dtype=torch.float64) if centre is None else centre
    t = -(R @ centre)
    t[:, 2] += 4.0 * radius
    f = 60.0 / radius if orthographic else 240.0
    K = torch.tensor([[f, 0.0, 70.3], [0, 1.1 * f, 51.8], [0, 0, 1]], dtype=torch.float64)
    return transform(R, t), K, (108, 154)


def interior(a: Tensor, b: Tensor) -> Tensor:
    """Pixels whose eight neighbours are all object or all background in both images."""
    uniform = torch.ones_like(a, dtype=torch.bool)
    for depth in (a, b):
        mask = (depth > 0).float()
        uniform &= F.max_pool2d(mask, 3, 1, 1) == -F.max_pool2d(-mask, 3, 1, 1)
    return uniform


def smooth(depth: Tensor, *, bend: float) -> Tensor:
    """Pixels around which second differences of depth stay below ``bend``: no crease, no occlusion."""
    padded = F.pad(depth, (1, 1, 1, 1), mode="replicate")
    H, W = depth.shape[-2:]
    worst = torch.zeros_like(depth)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one = padded[..., 1 + dy : 1 + dy + H, 1 + dx : 1 + dx + W]
        two = padded[..., 1 - dy : 1 - dy + H, 1 - dx : 1 - dx + W]
        worst = torch.maximum(worst, (one + two - 2 * depth).abs())
    return F.max_pool2d(worst, 3, 1, 1) < bend
