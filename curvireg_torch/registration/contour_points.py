"""The two sides of the contour stage: contours of a rendered mesh as 3D points, and a photograph's edges."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..descriptors import field_points
from ..filters import depth_curvilinear_saliency
from ..filters.curvilinear import fill_depth
from ..filters.derivatives import central_gradient, smooth

__all__ = ["ContourPoints", "EdgeField", "contour_points"]

OCCLUDING, CREASES = 256, 128
"""Points per view: about every second pixel of an object that fills a crop of 128 px, every fourth at 256 px."""

JUMP = 0.05
"""Object radii by which depth jumps at an occluding contour."""

CREASE_SHARE = 0.02
"""Share of the pixels that may be creases."""

CREASE = 0.1
"""Curvature in 1/px, smoothed by 1 px, of a crease: edges between faces that differ by 15 degrees or more."""


@dataclass(frozen=True)
class ContourPoints:
    """Points on the contours of N views.

    Attributes:
        model: (N, P, 3) float64 in model units, always on the nearer surface.
        normals: (N, P, 2) float64 unit vectors across the contour in the image, sign free.
        valid: (N, P) bool; the rest is padding.
    """

    model: Tensor
    normals: Tensor
    valid: Tensor

    def __getitem__(self, index: Tensor) -> "ContourPoints":
        return ContourPoints(self.model[index], self.normals[index], self.valid[index])

    @staticmethod
    def cat(parts: Sequence["ContourPoints"]) -> "ContourPoints":
        return ContourPoints(
            torch.cat([p.model for p in parts]),
            torch.cat([p.normals for p in parts]),
            torch.cat([p.valid for p in parts]),
        )


def contour_points(depth: Tensor, T_cam_from_model: Tensor, camera_matrix: Tensor, *, radius: float) -> ContourPoints:
    """Occluding contours and creases of depth views, back-projected onto the mesh.

    An occluding contour lies between two neighbouring pixels whose depth jumps (curvilinear saliency peaks on both
    sides of a jump, never on it): half way between them on average, at the depth of the nearer one. Creases are maxima
    of :func:`depth_curvilinear_saliency` away from jumps; bent surfaces have none. Of each kind a fixed random sample
    is kept.

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
    H, W = depth.shape[-2:]
    K = camera_matrix.expand(len(depth), 3, 3)
    seen = depth > 0
    z = torch.where(seen, depth, depth.amax(dim=(1, 2, 3), keepdim=True) + 4.0 * radius)
    slope = torch.cat(central_gradient(smooth(fill_depth(depth, None, None), 1.0)), dim=1)
    beside, jumps = torch.zeros_like(seen), []
    for dim in (-1, -2):
        a, b = _ends(z, dim)
        change = (b - a).abs().diff(dim=dim)
        # What exceeds the steps before and behind is no steep face.
        first, last = ((1, 0), (0, 1)) if dim == -1 else ((0, 0, 1, 0), (0, 0, 0, 1))
        jump = F.pad(change > JUMP * radius, first) | F.pad(change < -JUMP * radius, last)
        beside |= F.pad(jump, first) | F.pad(jump, last)
        jumps.append(jump.flatten(1))
    # Depth in px: saliency is then a curvature in 1 / px, and a threshold has a meaning.
    scale = K[:, 0, 0].view(-1, 1, 1, 1) / z.amax(dim=(1, 2, 3), keepdim=True)
    field = depth_curvilinear_saliency(depth * scale.float(), depth_scale=1.0)
    creases = field_points(field * ~(_widened(beside) | ~seen), fraction=CREASE_SHARE, threshold=CREASE)
    pixel = torch.arange(H * W).view(H, W)
    neighbours = [torch.stack([x.flatten() for x in _ends(pixel, dim)]) for dim in (-1, -2)]
    samples = [
        _sample(torch.cat(jumps, dim=1), torch.cat(neighbours, dim=1), z, slope, OCCLUDING),
        _sample(creases.flatten(1), pixel.view(1, -1), z, field, CREASES),
    ]
    uv, z, n, valid = (torch.cat(parts, dim=1) for parts in zip(*samples, strict=True))
    rays = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1) @ torch.linalg.inv(K).mT
    model = (rays * z[..., None] - T_cam_from_model[:, None, :3, 3]) @ T_cam_from_model[:, :3, :3]
    length = torch.linalg.vector_norm(n, dim=-1)
    return ContourPoints(model, n / length.clamp(min=1e-12)[..., None], valid & (length > 0))


def _ends(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """All but the last, and all but the first along ``dim``."""
    n = x.shape[dim] - 1
    return x.narrow(dim, 0, n), x.narrow(dim, 1, n)


def _widened(mask: Tensor) -> Tensor:
    """What is true within a square of 9 px."""
    for dim in (-1, -2):
        for shift in (1, 3):
            n, wide = mask.shape[dim] - shift, mask.clone()
            wide.narrow(dim, 0, n).logical_or_(mask.narrow(dim, shift, n))
            wide.narrow(dim, shift, n).logical_or_(mask.narrow(dim, 0, n))
            mask = wide
    return mask


def _sample(found: Tensor, pixels: Tensor, depth: Tensor, normals: Tensor, count: int) -> tuple[Tensor, ...]:
    """``count`` of the (N, M) found ones of M places, each the middle of (k, M) pixels: uv (N, P, 2), the nearer depth
    (N, P), normal (N, P, 2), valid (N, P)."""
    best, index = torch.where(found, _random(found.shape[1]), -1.0).topk(min(count, found.shape[1]), dim=1)
    of, W = pixels[:, index], depth.shape[-1]  # (k, N, P)
    z = torch.stack([depth.flatten(1).gather(1, i) for i in of]).amin(dim=0)
    n = torch.stack([normals.flatten(2).gather(2, i[:, None].expand(-1, 2, -1)) for i in of]).mean(dim=0)
    return torch.stack([of % W, of // W], dim=-1).double().mean(dim=0), z.double(), n.mT.double(), best >= 0


@functools.cache
def _random(count: int) -> Tensor:
    """(count,) the same numbers each time."""
    return torch.rand(count, generator=torch.Generator().manual_seed(0))


class EdgeField:
    """Edges of crops of photographs, to be looked for along normals.

    Args:
        crops: (B, C, S, S), C = 1 or 3, in [0, 1]. With colours the strongest channel counts.
    """

    def __init__(self, crops: Tensor) -> None:
        gx, gy = central_gradient(smooth(crops, 1.0))
        self._gradient = torch.stack([gx, gy], dim=2).flatten(1, 2)
        self._level = self._gradient.square().sum(dim=1).mean(dim=(1, 2)).sqrt().clamp(min=1e-6)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, photograph: Tensor) -> Tensor:
        """How strongly the picture changes across a contour at places beside it.

        With g the gradient and c = ``|n . g| / |g|``, r = ``|n . g| c^4`` is compared with the crop's mean gradient m:
        the strength is r / (r + m): halved where they differ by 33 degrees, 0 outside the crop.

        Args:
            uv, normals: (N, P, 2) pixels of the crops, and unit vectors.
            offsets: (L,) px along the normals.
            photograph: (N,) indices of the crops.

        Returns:
            (N, P, L) float64 in [0, 1).
        """
        S = self._gradient.shape[-1]
        grid = ((2.0 * (uv[:, :, None] + offsets[:, None] * normals[:, :, None]) + 1.0) / S - 1.0).float()
        gradient = grid.new_empty(len(uv), self._gradient.shape[1], *grid.shape[1:3])
        for b in photograph.unique().tolist():  # expanded, a crop need not be copied for every pose
            own = (photograph == b).nonzero()[:, 0]
            crop = self._gradient[b].expand(len(own), -1, -1, -1)
            gradient[own] = F.grid_sample(crop, grid[own], align_corners=False)
        gx, gy = gradient[:, 0::2], gradient[:, 1::2]
        nx, ny = normals.to(gx.dtype)[:, None, :, None].unbind(-1)
        across = (gx * nx + gy * ny).abs()
        cosine = across * (gx * gx + gy * gy).clamp(min=1e-20).rsqrt()
        r = (across * cosine.square().square()).amax(dim=1)
        return (r / (r + self._level[photograph, None, None])).double()
