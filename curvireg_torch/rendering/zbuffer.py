"""A z-buffer written in torch: runs on any device and is the reference for the other backends."""

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..mesh.mesh import mesh_centre, mesh_radius
from ..utils.threads import map_on_threads
from .depth import NEAREST, check_render_arguments

# Pairs of triangle and pixel in memory at a time, about 60 bytes each: on a CPU, whose caches are small, and on other
# devices
PAIRS = 2**20, 2**24
TOLERANCE = 1e-5  # Barycentric tolerance outside a triangle, which closes seams that rounding opens


class TorchRenderer:
    """Tests every pixel's centre against every triangle whose box contains it; the nearest one wins.

    Edge functions are formed from homogeneous points, so that no triangle needs clipping. They are set up in float64
    (float32 on devices without it) at a pixel next to the triangle, and evaluated in float32.

    Thread-safe. In a forked process torch hangs with more than one thread: call ``torch.set_num_threads(1)`` there
    first, as the workers of a ``DataLoader`` do.
    """

    name = "torch"

    def __init__(self, mesh: trimesh.Trimesh, *, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self._dtype = torch.float32 if self.device.type == "mps" else torch.float64
        self._centre, self._radius = mesh_centre(mesh), mesh_radius(mesh)
        vertices = (np.asarray(mesh.vertices) - self._centre.numpy()) / self._radius
        self._vertices = torch.from_numpy(vertices).to(self.device, self._dtype)
        self._faces = torch.from_numpy(np.array(mesh.faces, dtype=np.int64)).to(self.device)
        self._pairs = PAIRS[self.device.type != "cpu"]

    @torch.no_grad()
    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        R, K = T[:, :3, :3], K.clone()
        t = (T[:, :3, 3] + R @ self._centre) / self._radius
        if orthographic:
            K[:, :2, :2] *= self._radius
        R, t, K = (x.to(self.device, self._dtype) for x in (R, t, K))

        def draw(i: int) -> Tensor:
            return self._draw(R[i], t[i], K[i], size, orthographic)

        views = map_on_threads(draw, range(len(T)), device=self.device)
        return torch.stack(views)[:, None] if views else torch.zeros(0, 1, *size, device=self.device)

    def _draw(self, R: Tensor, t: Tensor, K: Tensor, size: tuple[int, int], orthographic: bool) -> Tensor:
        """(H, W) depth of one view."""
        H, W = size
        rotated = self._vertices @ R.T  # (V, 3) relative to the object's centre
        camera = rotated + t
        # Homogeneous pixels: K (x, y, z) or, orthographic, K (x, y, 1).
        ray = torch.cat([camera[:, :2], torch.ones_like(camera[:, :1])], 1) if orthographic else camera
        q, z = (ray @ K.T)[self._faces], camera[:, 2][self._faces]  # (F, 3 corners, 3), (F, 3)
        low, high = _windows(q, z, size)
        extent = (high - low).clamp(min=0)
        count = extent.prod(dim=1)
        used = count.nonzero()[:, 0]
        q, low, width, count = q[used], low[used], extent[used, 0], count[used]
        edges = _edges(q, low)
        # One row per triangle: three edge functions as (value at the window's corner, step per column, step per row)
        # and three depths relative to the object's centre.
        table = torch.cat([edges.flatten(1), rotated[:, 2][self._faces[used]]], 1).float()
        nearest = float(NEAREST - t[2])
        depth = torch.full((H * W,), torch.inf, device=self.device)
        chunk = (count.cumsum(0) - 1).div(self._pairs, rounding_mode="floor")
        lengths = chunk.unique_consecutive(return_counts=True)[1].tolist()
        for part in torch.arange(len(used), device=self.device).split(lengths):
            triangle = part.repeat_interleave(count[part])
            offset = torch.arange(len(triangle), device=self.device)
            offset -= (count[part].cumsum(0) - count[part])[triangle - part[0]]
            column, row = offset % width[triangle], offset.div(width[triangle], rounding_mode="floor")
            values, x, y = table[triangle], column.float(), row.float()
            e = torch.stack([values[:, k] + values[:, k + 1] * x + values[:, k + 2] * y for k in (0, 3, 6)])
            total = e.sum(dim=0)
            hit = ((e.amin(dim=0) >= -TOLERANCE * total) & (total > 0)).nonzero()[:, 0]
            z = (e[:, hit] * values[hit, 9:].T).sum(dim=0) / total[hit]
            pixel = (low[triangle, 1] + row) * W + low[triangle, 0] + column
            seen = z >= nearest
            depth.scatter_reduce_(0, pixel[hit][seen], z[seen], "amin")
        depth = torch.where(depth.isfinite(), (depth + t[2].float()) * self._radius, 0.0)
        return depth.view(H, W)


def _windows(q: Tensor, z: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """First and one past the last pixel (F, 2) x, y that each triangle can cover."""
    border = torch.tensor([size[1], size[0]], dtype=q.dtype, device=q.device)
    uv = q[..., :2] / q[..., 2:]
    # Rounding must not lose a pixel whose centre is on the triangle's edge.
    low = torch.minimum((uv.amin(dim=1) - 1e-3).ceil().clamp(min=0), border)
    high = torch.minimum(((uv.amax(dim=1) + 1e-3).floor() + 1).clamp(min=0), border)
    crossing = (q[..., 2] <= 0).any(dim=1, keepdim=True)  # no finite projection: the whole image
    low, high = low.masked_fill(crossing, 0), torch.where(crossing, border, high)
    behind = (z < NEAREST).all(dim=1, keepdim=True)
    return low.long(), torch.where(behind, low, high).long()


def _edges(q: Tensor, corner: Tensor) -> Tensor:
    """(T, 3 edges, 3) value at the window's corner pixel, step per column, step per row; inside all are >= 0."""
    pixel = torch.cat([corner.to(q), torch.ones_like(q[:, 0, :1])], 1)
    # Corners relative to that pixel are small numbers, which avoids cancellation.
    local = q - pixel[:, None] * q[..., 2:]
    local[..., 2] = q[..., 2]
    normal = torch.linalg.cross(local[:, [1, 2, 0]], local[:, [2, 0, 1]])  # (T, 3, 3): columns are x, y, 1
    scale = normal.flatten(1).abs().amax(dim=1).clamp(min=torch.finfo(q.dtype).tiny)
    # Either side may face the camera; the sign of the volume between triangle and camera decides.
    facing = (local[:, 0] * normal[:, 0]).sum(dim=1).sign()
    edges: Tensor = (normal * (facing / scale)[:, None, None])[..., [2, 0, 1]]
    return edges
