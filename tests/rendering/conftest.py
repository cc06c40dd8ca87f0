"""Backends, cameras and pixel masks that the renderers' tests share."""

import functools

import pytest
import torch
import torch.nn.functional as F
import trimesh

from curvireg_torch.errors import RenderingError
from curvireg_torch.geometry import camera_matrix, transform, uniform_views
from curvireg_torch.rendering import make_renderer

BACKENDS = ("auto", "embree", "pyrender")


@functools.cache
def _works(backend):
    try:
        make_renderer(trimesh.creation.box(), backend)
    except RenderingError:
        return False
    return True


def require(*backends, orthographic=False):
    """Skip where pyrender has no driver, and its parallel projection, which it lacks."""
    if "pyrender" in backends and (orthographic or not _works("pyrender")):
        pytest.skip("pyrender needs EGL, and draws in perspective")


@pytest.fixture(params=BACKENDS)
def backend(request):
    require(request.param)
    return str(request.param)


@pytest.fixture(params=[False, True], ids=["perspective", "orthographic"])
def orthographic(request):
    if "backend" in request.fixturenames:
        require(request.getfixturevalue("backend"), orthographic=request.param)
    return bool(request.param)


def camera(count, *, radius=1.0, centre=None, orthographic=False):
    """Views from all around: off-centre camera, rectangular pixels, wide image, object partly
    outside."""
    R = uniform_views(count).rotations.double()
    centre = torch.zeros(3, dtype=torch.float64) if centre is None else centre
    t = -(R @ centre)
    t[:, 2] += 4.0 * radius
    f = 60.0 / radius if orthographic else 240.0
    return transform(R, t), camera_matrix(f, 1.1 * f, 70.3, 51.8), (108, 154)


def pixel_grid(size):
    """(H, W, 3) homogeneous pixel coordinates, float64."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1)


def interior(a, b):
    """Pixels whose eight neighbours are all object or all background in both images."""
    uniform = torch.ones_like(a, dtype=torch.bool)
    for depth in (a, b):
        mask = (depth > 0).float()
        uniform &= F.max_pool2d(mask, 3, 1, 1) == -F.max_pool2d(-mask, 3, 1, 1)
    return uniform


def smooth(depth, *, bend):
    """Pixels around which second differences of depth stay below ``bend``: no crease, no
    occlusion."""
    padded = F.pad(depth, (1, 1, 1, 1), mode="replicate")
    H, W = depth.shape[-2:]
    worst = torch.zeros_like(depth)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = padded[..., 1 + dy : 1 + dy + H, 1 + dx : 1 + dx + W]
        b = padded[..., 1 - dy : 1 - dy + H, 1 - dx : 1 - dx + W]
        worst = torch.maximum(worst, (a + b - 2 * depth).abs())
    return F.max_pool2d(worst, 3, 1, 1) < bend
