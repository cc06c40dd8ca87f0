"""Both sides of the contour fit: 3D contour points of a rendered mesh, and edges of a photograph."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor

from ...features import field_points
from ...filters import depth_curvilinear_saliency
from ...filters.curvilinear import fill_depth
from ...filters.derivatives import central_gradient, smooth

__all__ = ["ContourPoints", "EdgeField", "contour_points"]

OCCLUDING, CREASES = 256, 128
"""Points per view: about every second contour pixel in a crop of 128 px, every fourth at 256 px."""

JUMP = 0.05
"""Depth discontinuity at an occluding contour, in object radii."""

SURROUNDINGS = 8
"""Pixels around the object that are looked at: more than its contours depend on, by smoothing and differences."""

CREASE_FRACTION = 0.02
"""Largest fraction of the pixels that are creases."""

CREASE = 0.1
"""Curvature of a crease in 1/px, smoothed by 1 px: faces that meet at 15 degrees or more."""


@dataclass(frozen=True)
class ContourPoints:
    """Points (N, P, 3) on the contours of N views, float64 in model units, with unit ``normals`` (N, P, 2) across the
    contour in the image; False in ``valid`` (N, P) marks padding. ``outline`` (N, P) marks points with the background
    beside them, whose normals point outward; other normals have either sign."""

    model: Tensor
    normals: Tensor
    valid: Tensor
    outline: Tensor

    def __getitem__(self, index: Tensor) -> "ContourPoints":
        return ContourPoints(*(getattr(self, f.name)[index] for f in fields(ContourPoints)))

    @staticmethod
    def cat(parts: Sequence["ContourPoints"]) -> "ContourPoints":
        return ContourPoints(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(ContourPoints)))


def contour_points(depth: Tensor, T_cam_from_model: Tensor, camera_matrix: Tensor, *, radius: float) -> ContourPoints:
    """Occluding contours and creases of depth views, back-projected onto the mesh.

    An occluding contour lies half-way between two neighbouring pixels at a depth discontinuity, at the depth of the
    nearer one. Creases are maxima of :func:`depth_curvilinear_saliency` away from discontinuities. A fixed random
    sample of each kind is returned.

    Args:
        depth: (N, 1, H, W) z-depth, 0 = background.
        T_cam_from_model: (N, 4, 4) float64.
        camera_matrix: (N, 3, 3) or (3, 3) float64.
        radius: of the object, in model units.

    Example:
        >>> depth = torch.zeros(1, 1, 32, 32)
        >>> depth[..., 8:24, 8:24] = 5.0                                            # a square, 16 px wide
        >>> K = torch.tensor([[32.0, 0, 15.5], [0, 32.0, 15.5], [0, 0, 1]], dtype=torch.float64)
        >>> points = contour_points(depth, torch.eye(4, dtype=torch.float64)[None], K, radius=1.0)
        >>> int(points.valid.sum()), points.model[points.valid][:, :2].abs().amax(dim=1).unique().tolist()
        (64, [1.25])
    """
    size, (rows, columns) = depth.shape[-2:], _window(depth > 0)
    depth = depth[..., rows, columns]
    K = camera_matrix.expand(len(depth), 3, 3)
    seen = depth > 0
    background = depth.amax(dim=(1, 2, 3), keepdim=True) + 4.0 * radius
    z = torch.where(seen, depth, background)
    slope = torch.cat(central_gradient(smooth(fill_depth(depth, None, None), 1.0)), dim=1)
    beside, jumps = torch.zeros_like(seen), []
    for dim in (-1, -2):
        a, b = _ends(z, dim)
        change = (b - a).abs().diff(dim=dim)
        # A depth step counts where it exceeds a neighbouring one; on a steep face all steps are equal.
        first, last = ((1, 0), (0, 1)) if dim == -1 else ((0, 0, 1, 0), (0, 0, 0, 1))
        jump = F.pad(change > JUMP * radius, first) | F.pad(change < -JUMP * radius, last)
        beside |= F.pad(jump, first) | F.pad(jump, last)
        jumps.append(jump.flatten(1))
    # With depth in px, saliency is a curvature in 1 / px, to which a fixed threshold applies.
    scale = K[:, 0, 0].view(-1, 1, 1, 1) / z.amax(dim=(1, 2, 3), keepdim=True)
    field = depth_curvilinear_saliency(depth * scale.float(), depth_scale=1.0)
    pixel = torch.arange(depth.shape[-2:].numel()).view(depth.shape[-2:])
    fraction = min(1.0, CREASE_FRACTION * math.prod(size) / pixel.numel())
    creases = field_points(field * ~(_dilated(beside) | ~seen), fraction=fraction, threshold=CREASE)
    neighbours = [torch.stack([x.flatten() for x in _ends(pixel, dim)]) for dim in (-1, -2)]
    at_pixels, between = _random(*size)
    at_pixels = at_pixels[rows, columns].flatten()
    order = torch.cat([_ends(x[rows, columns], dim)[0].flatten() for x, dim in zip(between, (-1, -2), strict=True)])
    samples = [
        _sample(torch.cat(jumps, dim=1), torch.cat(neighbours, dim=1), order, z, background, slope, OCCLUDING),
        _sample(creases.flatten(1), pixel.view(1, -1), at_pixels, z, background, field, CREASES),
    ]
    uv, z, n, valid, outline = (torch.cat(parts, dim=1) for parts in zip(*samples, strict=True))
    uv += torch.tensor([columns.start, rows.start])
    rays = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1) @ torch.linalg.inv(K).mT
    model = (rays * z[..., None] - T_cam_from_model[:, None, :3, 3]) @ T_cam_from_model[:, :3, :3]
    length = torch.linalg.vector_norm(n, dim=-1)
    valid = valid & (length > 0)
    return ContourPoints(model, n / length.clamp(min=1e-12)[..., None], valid, valid & outline)


def _window(seen: Tensor) -> tuple[slice, slice]:
    """Rows and columns of (N, 1, H, W) masks with all True pixels and what surrounds them; all if there are none."""
    H, W = seen.shape[-2:]
    if not bool(seen.any()):
        return slice(0, H), slice(0, W)
    any_view = seen.any(dim=0)[0]
    rows, columns = (any_view.any(dim=dim).nonzero()[:, 0] for dim in (1, 0))
    return (
        slice(max(0, int(rows[0]) - SURROUNDINGS), min(H, int(rows[-1]) + SURROUNDINGS + 1)),
        slice(max(0, int(columns[0]) - SURROUNDINGS), min(W, int(columns[-1]) + SURROUNDINGS + 1)),
    )


def _ends(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """All but the last, and all but the first along ``dim``."""
    n = x.shape[dim] - 1
    return x.narrow(dim, 0, n), x.narrow(dim, 1, n)


def _dilated(mask: Tensor) -> Tensor:
    """Dilation by a square of 9 px."""
    for dim in (-1, -2):
        for shift in (1, 3):
            n, wide = mask.shape[dim] - shift, mask.clone()
            wide.narrow(dim, 0, n).logical_or_(mask.narrow(dim, shift, n))
            wide.narrow(dim, shift, n).logical_or_(mask.narrow(dim, 0, n))
            mask = wide
    return mask


def _sample(
    mask: Tensor, pixels: Tensor, order: Tensor, depth: Tensor, background: Tensor, normals: Tensor, count: int
) -> tuple[Tensor, ...]:
    """uv, nearer depth, normal, valid and whether the ``background`` (N, 1, 1, 1) is beside it, (N, P, ...), of the
    ``count`` entries of ``mask`` (N, M) that come first by ``order`` (M,), means of ``pixels``."""
    if (missing := count - mask.shape[1]) > 0:  # all views have as many points
        mask, pixels, order = (F.pad(x, (0, missing)) for x in (mask, pixels, order))
    best, index = torch.where(mask, order, -1.0).topk(count, dim=1)
    of, W = pixels[:, index], depth.shape[-1]  # (k, N, P)
    ends = torch.stack([depth.flatten(1).gather(1, i) for i in of])
    outline = (ends == background.view(-1, 1)).any(dim=0)
    n = torch.stack([normals.flatten(2).gather(2, i[:, None].expand(-1, 2, -1)) for i in of]).mean(dim=0)
    uv = torch.stack([of % W, of // W], dim=-1).double().mean(dim=0)
    return uv, ends.amin(dim=0).double(), n.mT.double(), best >= 0, outline


@functools.cache
def _random(H: int, W: int) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Numbers (H, W) of the pixels, and of the gaps to the right of them and below; the same in every call."""

    def numbers(count: int) -> Tensor:
        return torch.rand(count, generator=torch.Generator().manual_seed(0))

    right, below = numbers(H * (W - 1) + (H - 1) * W).split([H * (W - 1), (H - 1) * W])
    return numbers(H * W).view(H, W), (F.pad(right.view(H, W - 1), (0, 1)), F.pad(below.view(H - 1, W), (0, 0, 0, 1)))


class EdgeField:
    """Edges of image crops (B, C, S, S) in [0, 1]; the strongest of several channels counts."""

    def __init__(self, crops: Tensor) -> None:
        gx, gy = central_gradient(smooth(crops, 1.0))
        self._gradient = torch.stack([gx, gy], dim=2).flatten(1, 2)
        self._level = self._gradient.square().sum(dim=1).mean(dim=(1, 2)).sqrt().clamp(min=1e-6)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, image_index: Tensor) -> Tensor:
        """Strength of the image gradient across a contour, at offsets along its normals.

        With g the gradient, m the crop's root mean square gradient and c = ``|n . g| / |g|``, r = ``|n . g| c^4`` gives
        the strength r / (r + m). It is 0 outside the crop; c^4 is one half where n and g differ by 33 degrees.

        Args:
            uv, normals: (N, P, 2) pixels of the crops and unit vectors.
            offsets: (L,) px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float64 in [0, 1).
        """
        S = self._gradient.shape[-1]
        grid = ((2.0 * (uv[:, :, None] + offsets[:, None] * normals[:, :, None]) + 1.0) / S - 1.0).float()
        gradient = grid.new_empty(len(uv), self._gradient.shape[1], *grid.shape[1:3])
        for b in image_index.unique().tolist():  # an expanded crop is not copied for every pose
            mine = (image_index == b).nonzero()[:, 0]
            crop = self._gradient[b].expand(len(mine), -1, -1, -1)
            gradient[mine] = F.grid_sample(crop, grid[mine], align_corners=False)
        gx, gy = gradient[:, 0::2], gradient[:, 1::2]
        nx, ny = normals.to(gx.dtype)[:, None, :, None].unbind(-1)
        across = (gx * nx + gy * ny).abs()
        cosine = across * (gx * gx + gy * gy).clamp(min=1e-20).rsqrt()
        r = (across * cosine.square().square()).amax(dim=1)
        return (r / (r + self._level[image_index, None, None])).double()
