"""A z-buffer written in torch: runs on any device and is the reference for the other backends."""

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..mesh.mesh import mesh_centre, mesh_radius
from ..utils.threads import map_on_threads
from .protocol import NEAREST, check_render_arguments

__all__ = ["TorchRenderer"]

# On a CPU, where threads take a view each and caches are small, and on other devices:
_PAIRS = 2**20, 2**24  # (triangle, pixel) pairs in memory at a time, about 60 bytes each
_TRIANGLES = 2**18, 2**21  # triangles x views set up at a time, about 400 bytes each
_TOLERANCE = 1e-5  # barycentric tolerance outside a triangle, which closes seams that rounding opens


class TorchRenderer:
    """Tests every pixel's centre against every triangle whose box contains it, in chunks; the nearest one wins.

    Edge functions are formed from homogeneous points, so that no triangle needs clipping. They are set up in float64
    (float32 on devices without it) at a pixel next to the triangle, and evaluated in float32.

    Thread-safe. In a forked process torch hangs with more than one thread: call ``torch.set_num_threads(1)`` there
    first, as the workers of a ``DataLoader`` do.
    """

    name = "torch"

    def __init__(self, mesh: trimesh.Trimesh, *, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self._setup_dtype = torch.float32 if self.device.type == "mps" else torch.float64
        self._centre, self._radius = mesh_centre(mesh), mesh_radius(mesh)
        vertices = (np.asarray(mesh.vertices) - self._centre.numpy()) / self._radius
        self._vertices = torch.from_numpy(vertices).to(self.device, self._setup_dtype)
        self._faces = torch.from_numpy(np.array(mesh.faces, dtype=np.int64)).to(self.device)
        on_accelerator = self.device.type != "cpu"
        self._pairs, self._triangles = _PAIRS[on_accelerator], _TRIANGLES[on_accelerator]
        self._views = max(1, self._triangles // len(self._faces)) if on_accelerator else 1

    @torch.no_grad()
    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        R = T[:, :3, :3]
        t = (T[:, :3, 3] + R @ self._centre) / self._radius
        K = K.clone()
        if orthographic:
            K[:, :2, :2] *= self._radius
        R, t, K = (x.to(self.device, self._setup_dtype) for x in (R, t, K))
        H, W = size
        depth = torch.full((len(T), H * W), torch.inf, device=self.device)

        @torch.no_grad()
        def draw(i: int) -> None:
            part = slice(i, i + self._views)
            for faces in self._faces.split(self._triangles):
                self._draw(depth[part].view(-1), faces, R[part], t[part], K[part], size, orthographic)

        map_on_threads(draw, range(0, len(T), self._views), device=self.device)
        depth = torch.where(depth.isfinite(), (depth + t[:, 2:].float()) * self._radius, 0.0)
        return depth.view(-1, 1, H, W)

    def _draw(
        self, depth: Tensor, faces: Tensor, R: Tensor, t: Tensor, K: Tensor, size: tuple[int, int], orthographic: bool
    ) -> None:
        """Draw faces as n views see them: lower (n * H * W,) depths, which are relative to the z of t."""
        H, W = size
        rotated = self._vertices @ R.mT  # (n, V, 3) relative to the object's centre
        camera = rotated + t[:, None]
        # Homogeneous pixels: K (x, y, z) or, orthographic, K (x, y, 1).
        ray = torch.cat([camera[..., :2], torch.ones_like(camera[..., :1])], -1) if orthographic else camera
        q = (ray @ K.mT)[:, faces]  # (n, F, 3 corners, 3)
        low, high = self._windows(q, camera[..., 2][:, faces], size)
        extent = (high - low).clamp(min=0)
        count = (extent[..., 0] * extent[..., 1]).flatten()
        used = count.nonzero()[:, 0]
        if len(used) == 0:
            return
        count, low, extent = count[used], low.view(-1, 2)[used], extent.view(-1, 2)[used]
        first = (used // len(faces)) * (H * W) + low[:, 1] * W + low[:, 0]
        z = rotated[..., 2][:, faces].view(-1, 3)[used]
        edges = self._edges(q.view(-1, 3, 3)[used], low)
        # One row per triangle: three edge functions as (value at the window's corner, step per column, step per row)
        # and three relative depths.
        table = torch.cat([edges.flatten(1), z], 1).float()
        near = (NEAREST - t[:, 2].float())[used // len(faces)]
        width, ends = extent[:, 0], count.cumsum(0)
        pairs = int(ends[-1])
        for start in range(0, pairs, self._pairs):
            stop = min(start + self._pairs, pairs)
            a = int(torch.searchsorted(ends, start, right=True))
            b = int(torch.searchsorted(ends, stop, right=False)) + 1
            repeats = ends[a:b].clamp(max=stop) - (ends[a:b] - count[a:b]).clamp(min=start)
            chunk = torch.arange(a, b, device=depth.device)
            triangle = torch.repeat_interleave(chunk, repeats, output_size=stop - start)
            offset = torch.arange(start, stop, device=depth.device) - (ends - count)[triangle]
            column, row = offset % width[triangle], torch.div(offset, width[triangle], rounding_mode="floor")
            values = table[triangle]
            x, y = column.float(), row.float()
            e = [values[:, 3 * i] + values[:, 3 * i + 1] * x + values[:, 3 * i + 2] * y for i in range(3)]
            total = e[0] + e[1] + e[2]
            inside = (torch.minimum(torch.minimum(e[0], e[1]), e[2]) >= -_TOLERANCE * total) & (total > 0)
            hit = inside.nonzero()[:, 0]
            triangle = triangle[hit]
            z = sum((e[i][hit] * values[hit, 9 + i] for i in range(3)), start=torch.zeros_like(total[hit]))
            z = z / total[hit]
            visible = z >= near[triangle]
            pixel = first[triangle] + row[hit] * W + column[hit]
            depth.scatter_reduce_(0, pixel[visible], z[visible], "amin")

    def _windows(self, q: Tensor, z: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """First and one past the last pixel (n, F, 2) x, y that each triangle can cover."""
        H, W = size
        border = torch.tensor([W, H], dtype=q.dtype, device=q.device)
        uv = q[..., :2] / q[..., 2:]
        low, high = uv.amin(dim=2), uv.amax(dim=2)
        # Rounding must not lose a pixel whose centre is on the triangle's edge.
        low = torch.minimum((low - 1e-3).ceil().clamp(min=0), border).long()
        high = torch.minimum(((high + 1e-3).floor() + 1).clamp(min=0), border).long()
        crossing = (q[..., 2] <= 0).any(dim=2, keepdim=True)  # no finite projection: the whole image
        low = torch.where(crossing, 0, low)
        high = torch.where(crossing, border.long(), high)
        behind = (z < NEAREST).all(dim=2, keepdim=True)
        return low, torch.where(behind, low, high)

    def _edges(self, q: Tensor, corner: Tensor) -> Tensor:
        """(T, 3 edges, 3) value at the window's corner pixel, step per column, step per row; inside all are >= 0."""
        pixel = torch.cat([corner.to(q), torch.ones_like(q[:, 0, :1])], 1)
        # Corners relative to that pixel are small numbers, which avoids cancellation.
        local = q - pixel[:, None] * q[..., 2:]
        local[..., 2] = q[..., 2]
        normal = torch.linalg.cross(local[:, [1, 2, 0]], local[:, [2, 0, 1]])  # (T, 3, 3): columns are x, y, 1
        scale = normal.flatten(1).abs().amax(dim=1).clamp(min=torch.finfo(q.dtype).tiny)
        # Either side may face the camera; the sign of the volume between triangle and camera decides.
        facing = (local[:, 0] * normal[:, 0]).sum(dim=1).sign()
        normal = normal * (facing / scale)[:, None, None]
        edges: Tensor = normal[..., [2, 0, 1]]
        return edges
