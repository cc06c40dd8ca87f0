"""Depth by a z-buffer on any device of torch, many views at a time."""

import torch
import trimesh
from torch import Tensor

from ..mesh.mesh import Mesh
from ..utils.aliases import Size
from .embree import EmbreeRenderer
from .renderer import NEAREST

FRAGMENTS_AT_A_TIME = 2**24
"""Pixels of the boxes around triangles that are tested together, about 100 bytes each."""

# Barycentric coordinate down to which a pixel beside a triangle belongs to it: no gaps between them
BESIDE_TRIANGLE = 1e-5


class DeviceRenderer(EmbreeRenderer):
    """Draws every triangle into the pixels of its box in the image, on one device. Views that the
    object's near side or the camera plane cuts, and parallel projections, are drawn by ray casting
    on the CPU.

    Args:
        mesh: a clean mesh, see :func:`curvireg_torch.load_mesh`.
        device: of the depth images.
    """

    name = "torch"

    def __init__(self, mesh: Mesh | trimesh.Trimesh, device: torch.device | str) -> None:
        super().__init__(mesh)
        self._device = torch.device(device)
        self._vertices = torch.from_numpy(self._scaled(mesh.vertices)).to(self._device)
        self._faces = torch.tensor(mesh.faces, dtype=torch.long).to(self._device)

    def _depth(self, T: Tensor, K: Tensor, size: Size, orthographic: bool) -> Tensor:
        if orthographic:
            return super()._depth(T, K, size, orthographic).to(self._device)
        poses = T.to(self._device)
        points = self._vertices @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
        z = points[..., 2]
        depth = _drawn(_projected(points, K.to(self._device)), z, self._faces, size)
        is_cut = ((z.amin(dim=1) <= NEAREST) & (z.amax(dim=1) > NEAREST)).cpu()
        if is_cut.any():
            rays = super()._depth(T[is_cut], K[is_cut], size, orthographic)
            depth[is_cut.to(self._device)] = rays.to(self._device)
        return depth


def _projected(points: Tensor, K: Tensor) -> Tensor:
    """(N, V, 2) pixels of points (N, V, 3) in the cameras' frames."""
    xy = points[..., :2] / points[..., 2:].clamp(min=NEAREST)
    return xy * K.diagonal(dim1=1, dim2=2)[:, None, :2] + K[:, None, :2, 2]


def _drawn(pixels: Tensor, z: Tensor, faces: Tensor, size: Size) -> Tensor:
    """(N, 1, H, W) float32 depth of N views with vertices at (N, V, 2) px and depths (N, V)."""
    H, W = size
    corners = pixels[:, faces]  # (N, F, 3, 2)
    heights = z[:, faces]
    end = torch.tensor([W - 1, H - 1], dtype=pixels.dtype, device=pixels.device)
    # outside by a pixel at most, so that whole numbers hold them
    first_pixel = torch.minimum(corners.amin(dim=2).ceil().clamp(min=0), end + 1)
    last_pixel = torch.minimum(corners.amax(dim=2).floor(), end).clamp(min=-1.0)
    is_visible = (heights > NEAREST).all(dim=2, keepdim=True)
    sides = is_visible * (last_pixel - first_pixel + 1).clamp(min=0).long()
    most = max(sides.prod(dim=2).sum(dim=1).tolist(), default=0)
    at_a_time = max(1, FRAGMENTS_AT_A_TIME // max(1, most))
    triangles = (first_pixel.long(), sides, _planes(corners, heights))
    parts = zip(*(each.split(at_a_time) for each in triangles), strict=True)
    inverse = torch.cat([_inverse_depth(a, b, c, size) for a, b, c in parts])
    return torch.where(inverse > 0, 1.0 / inverse, 0.0)


def _planes(corners: Tensor, z: Tensor) -> Tensor:
    """(N, F, 9) float32 for the triangles with corners (N, F, 3, 2) px and depths (N, F, 3): its
    first corner (2), what multiplies the distance from it to give the second and the third
    barycentric coordinate (2 x 2), and the inverse depth, which is linear in them, at the first
    corner, and by how much the others have more."""
    a, b, c = corners.unbind(dim=2)
    ux, uy = (b - a).unbind(-1)
    vx, vy = (c - a).unbind(-1)
    area = ux * vy - uy * vx
    scale = torch.where(area.abs() > 1e-9, 1.0 / area, torch.nan)  # no pixel: seen from the side
    second = torch.stack([scale * vy, -scale * vx], dim=-1)
    third = torch.stack([-scale * uy, scale * ux], dim=-1)
    height = 1.0 / z.clamp(min=NEAREST)
    slopes = height[..., 1:] - height[..., :1]
    return torch.cat([a, second, third, height[..., :1], slopes], dim=-1).float()


def _inverse_depth(low: Tensor, sides: Tensor, planes: Tensor, size: Size) -> Tensor:
    """(N, 1, H, W) inverse depth, 0 for none, of triangles in N views: the first pixels of their
    boxes (N, F, 2), the boxes' sides (N, F, 2) and :func:`_planes` (N, F, 9)."""
    H, W = size
    N, F, _ = sides.shape
    count = sides.prod(dim=2).flatten()
    triangle = torch.arange(N * F, device=count.device).repeat_interleave(count)
    start = count.cumsum(dim=0) - count
    place = torch.arange(len(triangle), device=count.device) - start[triangle]
    width = sides[..., 0].flatten()[triangle]
    left, top = low.flatten(0, 1)[triangle].unbind(1)
    x = left + place % width
    y = top + place // width
    corner, across, down, heights = planes.flatten(0, 1)[triangle].split([2, 2, 2, 3], dim=1)
    from_corner = torch.stack([x, y], dim=1) - corner
    second = (from_corner * across).sum(dim=1)
    third = (from_corner * down).sum(dim=1)
    least = torch.minimum(torch.minimum(second, third), 1.0 - second - third)
    inverse = heights[:, 0] + second * heights[:, 1] + third * heights[:, 2]
    inverse = torch.where(least >= -BESIDE_TRIANGLE, inverse, 0.0)
    pixel = (triangle // F * H + y) * W + x
    buffer = inverse.new_zeros(N * H * W)
    return buffer.scatter_reduce_(0, pixel, inverse, "amax").view(N, 1, H, W)
