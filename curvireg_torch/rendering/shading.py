"""Grey pictures of depth views: Lambertian shading before a white background."""

import torch
from torch import Tensor

from ..utils.checks import check_camera_matrix, check_image, check_tensor

__all__ = ["shade"]

AMBIENT, LIT = 0.3, 0.9
"""Grey levels of a surface seen edge on and face on; the background is 1."""


def shade(depth: Tensor, camera_matrix: Tensor, *, orthographic: bool = False) -> Tensor:
    """Lambertian shading with a light at the camera: grey 0.3 edge on to 0.9 face on, background 1.

    Normals come from neighbouring pixels and are exact for planes. Of the two neighbours along an axis, the one nearer
    in depth is used, so that creases and contours stay sharp.

    Args:
        depth: (N, 1, H, W) z-depth, 0 = background; the result has its shape and dtype.
        camera_matrix: (N, 3, 3) or (3, 3) in px, without skew.
        orthographic: parallel projection; fx, fy are then px per unit of depth.

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
    visible = z > 0
    fx, fy, cx, cy = (camera_matrix.to(z)[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    # Across a plane, inverse depth is linear in pixel coordinates; under parallel projection, depth is.
    s = torch.where(visible, z if orthographic else 1.0 / z, torch.inf)
    su, sv = _slope(s, -1), _slope(s, -2)
    if orthographic:
        x, y, n = fx * su, fy * sv, torch.ones_like(s)
        cosine = n / (x * x + y * y + n).sqrt()
    else:
        u = torch.arange(z.shape[-1], device=z.device, dtype=z.dtype) - cx
        v = torch.arange(z.shape[-2], device=z.device, dtype=z.dtype)[:, None] - cy
        x, y, n = fx * su, fy * sv, s - u * su - v * sv
        # The product of the normal (x, y, n) with the pixel's ray (u / fx, v / fy, 1) is s.
        ray = ((u / fx).square() + (v / fy).square() + 1.0).sqrt()
        cosine = s / (ray * (x * x + y * y + n * n).sqrt())
    return torch.where(visible, AMBIENT + (LIT - AMBIENT) * cosine, 1.0).to(depth.dtype)


def _slope(s: Tensor, dim: int) -> Tensor:
    """Difference per px along ``dim`` to the neighbour nearer in depth; 0 if neither neighbour is on the surface."""
    step = s.diff(dim=dim).nan_to_num(torch.inf, torch.inf, torch.inf)  # inf beside the background
    edge = torch.full_like(s.narrow(dim, 0, 1), torch.inf)
    before, after = torch.cat([edge, step], dim), torch.cat([step, edge], dim)
    slope = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(slope.isinf(), 0.0, slope)
