"""Depth by a z-buffer on any device of torch, many views at a time."""

from typing import NamedTuple

import torch
import trimesh
from torch import Tensor

from ..mesh.mesh import Mesh, mesh_centre, mesh_radius
from .embree import EmbreeRenderer
from .renderer import NEAREST, check_render_arguments

FRAGMENTS_AT_A_TIME = 2**24
"""Pixels of the boxes around triangles that are tested together, about 100 bytes each."""

# Barycentric coordinate down to which a pixel beside a triangle belongs to it: no gaps between them
BESIDE_TRIANGLE = 1e-5


class DeviceRenderer:
    """Draws every triangle into the pixels of its box in the image, on one device. Views that the
    object's near side or the camera plane cuts are drawn by ray casting on the CPU.

    Args:
        mesh: a clean mesh, see :func:`curvireg_torch.load_mesh`.
        device: of the depth images.
    """

    name = "torch"

    def __init__(self, mesh: Mesh | trimesh.Trimesh, device: torch.device | str) -> None:
        self._mesh = mesh
        self._device = torch.device(device)
        self._radius = mesh_radius(mesh)
        self._centre = mesh_centre(mesh)
        vertices = (torch.tensor(mesh.vertices) - self._centre) / self._radius
        self._vertices = vertices.to(self._device)
        self._faces = torch.tensor(mesh.faces, dtype=torch.long).to(self._device)

    def render(
        self,
        T_cam_from_model: Tensor,
        camera_matrix: Tensor,
        size: tuple[int, int],
        *,
        orthographic: bool = False,
    ) -> Tensor:
        """See :class:`.DepthRenderer`; the depth is on this device."""
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        position = (T[:, :3, :3] @ self._centre + T[:, :3, 3]) / self._radius
        R = T[:, :3, :3].to(self._device)
        points = self._vertices @ R.mT + position[:, None].to(self._device)
        z = points[..., 2]
        pixels = _projected(points, K.to(self._device), self._radius, orthographic)
        depth = self._radius * _drawn(pixels, z, self._faces, size, orthographic)
        is_cut = (z.amin(dim=1) <= NEAREST) & (z.amax(dim=1) > NEAREST)
        cut = is_cut.nonzero()[:, 0].cpu()
        if len(cut):
            rays = EmbreeRenderer(self._mesh)
            part = rays.render(T[cut], K[cut], size, orthographic=orthographic)
            depth[cut.to(self._device)] = part.to(self._device)
        return depth


def _projected(points: Tensor, K: Tensor, radius: float, orthographic: bool) -> Tensor:
    """(N, V, 2) float64 pixels of points (N, V, 3) in radii in the cameras' frames."""
    z = points[..., 2:].clamp(min=NEAREST)
    xy = radius * points[..., :2] if orthographic else points[..., :2] / z
    focal_lengths = torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=1)
    return xy * focal_lengths[:, None] + K[:, None, :2, 2]


def _drawn(
    pixels: Tensor, z: Tensor, faces: Tensor, size: tuple[int, int], orthographic: bool
) -> Tensor:
    """(N, 1, H, W) float32 depth of N views with vertices at (N, V, 2) px and depths (N, V)."""
    H, W = size
    N = len(pixels)
    buffer = torch.zeros(N * H * W, dtype=torch.float32, device=pixels.device)
    corners = pixels[:, faces]  # (N, F, 3, 2)
    heights = z[:, faces]
    end = torch.tensor([W - 1, H - 1], dtype=pixels.dtype, device=pixels.device)
    # outside by a pixel at most, so that whole numbers hold them
    first_pixel = corners.amin(dim=2).ceil()
    last_pixel = corners.amax(dim=2).floor()
    low = torch.minimum(first_pixel.clamp(min=0), end + 1).long()
    high = torch.minimum(last_pixel, end).clamp(min=-1.0).long()
    sides = (high - low + 1).clamp(min=0)
    is_visible = (heights > NEAREST).all(dim=2)
    count = sides.prod(dim=2) * is_visible
    planes = _planes(corners, heights, orthographic)
    for first, last in _groups(count.sum(dim=1).tolist(), FRAGMENTS_AT_A_TIME):
        views = slice(first, last)
        some = _Triangles(low[views], sides[views], count[views], planes[views])
        _draw(buffer, first, some, size, orthographic)
    nearest = buffer.view(N, 1, H, W)
    drawn = nearest > 0
    return torch.where(drawn, 1.0 / nearest.where(drawn, torch.ones_like(nearest)), 0.0)


def _planes(corners: Tensor, z: Tensor, orthographic: bool) -> Tensor:
    """(N, F, 9) float32 for the triangles with corners (N, F, 3, 2) px and depths (N, F, 3): its
    first corner (2), what multiplies the distance from it to give the second and the third
    barycentric coordinate (2 x 2), and what is linear in them: the inverse depth, or the depth, at
    the first corner, and by how much the others have more."""
    a, b, c = corners.unbind(dim=2)
    u = b - a
    v = c - a
    ux, uy = u.unbind(-1)
    vx, vy = v.unbind(-1)
    area = ux * vy - uy * vx
    scale = torch.where(area.abs() > 1e-9, 1.0 / area, torch.nan)  # no pixel: seen from the side
    second = torch.stack([scale * vy, -scale * vx], dim=-1)
    third = torch.stack([-scale * uy, scale * ux], dim=-1)
    height = z if orthographic else 1.0 / z.clamp(min=NEAREST)
    slopes = height[..., 1:] - height[..., :1]
    return torch.cat([a, second, third, height[..., :1], slopes], dim=-1).float()


class _Triangles(NamedTuple):
    """Triangles in N views: the first pixels of their boxes (N, F, 2), the boxes' sides (N, F, 2),
    the numbers of their pixels (N, F), and :func:`_planes` (N, F, 9)."""

    low: Tensor
    sides: Tensor
    number: Tensor
    planes: Tensor


def _draw(
    buffer: Tensor, first: int, triangles: _Triangles, size: tuple[int, int], orthographic: bool
) -> None:
    """Draw some views, of which the ``first`` is given, into a buffer of inverse depth."""
    H, W = size
    n, F = triangles.number.shape
    count = triangles.number.flatten()
    triangle = torch.arange(n * F, device=count.device).repeat_interleave(count)
    start = count.cumsum(dim=0) - count
    place = torch.arange(len(triangle), device=count.device) - start[triangle]
    width = triangles.sides[..., 0].flatten()[triangle]
    left, top = triangles.low.flatten(0, 1)[triangle].unbind(1)
    x = left + place % width
    y = top + place // width
    plane = triangles.planes.flatten(0, 1)[triangle]
    x0, y0, second_x, second_y, third_x, third_y, height, second_slope, third_slope = plane.unbind(
        1
    )
    dx = x - x0
    dy = y - y0
    second = dx * second_x + dy * second_y
    third = dx * third_x + dy * third_y
    first_coordinate = 1.0 - second - third
    least = torch.minimum(torch.minimum(second, third), first_coordinate)
    value = height + second * second_slope + third * third_slope
    inverse = 1.0 / value if orthographic else value
    inverse = torch.where(least >= -BESIDE_TRIANGLE, inverse, 0.0)
    pixel = ((first + triangle // F) * H + y) * W + x
    buffer.scatter_reduce_(0, pixel, inverse, "amax")


def _groups(counts: list[int], most: int) -> list[tuple[int, int]]:
    """Ranges of consecutive items, the sum of whose counts is at most ``most``, or single ones."""
    groups = []
    first = 0
    total = 0
    for k, count in enumerate(counts):
        if k > first and total + count > most:
            groups.append((first, k))
            first = k
            total = 0
        total += count
    return [*groups, (first, len(counts))] if counts else []
