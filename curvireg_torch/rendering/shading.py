"""Depth views as grey pictures, lit as a plain object before a white wall would be."""

import torch
from torch import Tensor

from ..utils.checks import check_camera_matrix, check_image, check_tensor

__all__ = ["shade"]

AMBIENT, LIT = 0.3, 0.9
"""Grey of a surface seen edge on and face on; what is behind is 1."""


def shade(depth: Tensor, camera_matrix: Tensor, *, orthographic: bool = False) -> Tensor:
    """Lambert's law under a lamp beside the camera: grey 0.3 edge on to 0.9 face on, before white.

    Normals come from neighbouring pixels of the surface, exactly for planes; of the two neighbours of an axis the one
    nearer in depth counts, so that creases and contours stay sharp.

    Args:
        depth: (N, 1, H, W) z-depth, 0 = background.
        camera_matrix: (N, 3, 3) or (3, 3) in px, without skew.
        orthographic: parallel projection; fx, fy are then px per unit of depth.

    Returns:
        (N, 1, H, W) in [0, 1], dtype of ``depth``.

    Raises:
        InvalidInputError: wrong shapes or dtypes.

    Example:
        >>> K = torch.tensor([[100.0, 0, 15.5], [0, 100.0, 15.5], [0, 0, 1]])
        >>> wall = torch.full((1, 1, 32, 32), 5.0)
        >>> round(float(shade(wall, K)[0, 0, 16, 16]), 2)
        0.9
    """
    check_image(depth, "depth")
    if camera_matrix.ndim == 2:
        camera_matrix = camera_matrix.expand(depth.shape[0], -1, -1)
    check_tensor(camera_matrix, "camera_matrix", (depth.shape[0], 3, 3))
    check_camera_matrix(camera_matrix)
    z = depth.float()
    seen = z > 0
    fx, fy, cx, cy = (camera_matrix.to(z)[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    # What is linear in the pixels of a plane: the inverse depth, or under parallel projection the depth.
    s = torch.where(seen, z if orthographic else 1.0 / z, torch.inf)
    su, sv = _slope(s, -1), _slope(s, -2)
    if orthographic:
        x, y, n = fx * su, fy * sv, torch.ones_like(s)
        cosine = n / (x * x + y * y + n).sqrt()
    else:
        v, u = torch.meshgrid(
            torch.arange(z.shape[-2], device=z.device, dtype=z.dtype),
            torch.arange(z.shape[-1], device=z.device, dtype=z.dtype),
            indexing="ij",
        )
        u, v = u - cx, v - cy
        x, y, n = fx * su, fy * sv, s - u * su - v * sv
        # Its product with the pixel's ray (u / fx, v / fy, 1) is s itself.
        ray = ((u / fx).square() + (v / fy).square() + 1.0).sqrt()
        cosine = s / (ray * (x * x + y * y + n * n).sqrt())
    return torch.where(seen, AMBIENT + (LIT - AMBIENT) * cosine, 1.0).to(depth.dtype)


def _slope(s: Tensor, dim: int) -> Tensor:
    """Difference per px along ``dim`` to the nearer of both neighbours; 0 where neither is on the surface."""
    step = s.diff(dim=dim).nan_to_num(torch.inf, torch.inf, torch.inf)  # inf: the background on one side
    edge = torch.full_like(s.narrow(dim, 0, 1), torch.inf)
    before, after = torch.cat([edge, step], dim), torch.cat([step, edge], dim)
    slope = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(slope.isinf(), 0.0, slope)
