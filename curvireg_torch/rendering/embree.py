"""Depth by ray casting with embree: needs no GPU, no driver, no display."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch import Tensor

from ..geometry.mesh import mesh_centre, mesh_radius
from .base import check_render_arguments

__all__ = ["EmbreeRenderer"]

_MISS = 1e30  # embreex returns 1e37 where a ray hits nothing
_NEAREST = 1e-3  # rays start no closer than this many object radii before the camera


class EmbreeRenderer:
    """One ray through each pixel's centre; views are shared among threads.

    Thread-safe (rays only read the scene). A fork or another process needs its own renderer.
    """

    name = "embree"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        # Embree computes in float32: centre the object and scale it to radius 1.
        self._centre = mesh_centre(mesh).numpy()
        self._radius = mesh_radius(mesh)
        vertices = (np.asarray(mesh.vertices) - self._centre) / self._radius
        self._corners = np.array(np.meshgrid(*zip(vertices.min(0), vertices.max(0), strict=True))).reshape(3, -1).T
        self._scene = EmbreeScene()
        TriangleMesh(scene=self._scene, vertices=vertices.astype(np.float32), indices=np.asarray(mesh.faces, np.int32))

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        out = np.zeros((len(T), 1, *size), dtype=np.float32)

        def one(i: int) -> None:
            self._render_view(T[i].numpy(), K[i].numpy(), out[i, 0], orthographic)

        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            list(pool.map(one, range(len(T))))
        return torch.from_numpy(out)

    def _render_view(self, T: np.ndarray, K: np.ndarray, out: np.ndarray, orthographic: bool) -> None:
        R = T[:3, :3]
        t = (T[:3, 3] + R @ self._centre) / self._radius  # centre of the object in the camera, in radii
        corners = self._corners @ R.T + t
        near = corners[:, 2].min()
        if corners[:, 2].max() <= _NEAREST and not orthographic:
            return  # wholly behind the camera
        rows, columns = self._window(corners, K, out.shape, orthographic)
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return
        u, v = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
        y = (v - K[1, 2]) / K[1, 1]
        x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
        pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
        # Rays start at the plane z = near: no digits are spent on the way to a distant object.
        if orthographic:
            near -= 1.0
            starts = pixels @ R[:2] / self._radius + (near * R[2] - R.T @ t)
            directions = np.broadcast_to(R[2], starts.shape)
        else:
            near = max(near - 1e-3, _NEAREST)
            directions = pixels @ R[:2] + R[2]
            starts = near * directions - R.T @ t
        along = self._scene.run(
            np.ascontiguousarray(starts, np.float32), np.ascontiguousarray(directions, np.float32), query="DISTANCE"
        ).reshape(u.shape)
        depth = np.where(along < _MISS, (along + near) * self._radius, 0.0)
        out[rows, columns] = np.maximum(depth, 0.0)

    def _window(
        self, corners: np.ndarray, K: np.ndarray, size: tuple[int, ...], orthographic: bool
    ) -> tuple[slice, slice]:
        """Rows and columns that the object's box, projected, can touch."""
        H, W = size
        if orthographic:
            xy = corners[:, :2] * self._radius
        elif corners[:, 2].min() <= _NEAREST:
            return slice(0, H), slice(0, W)  # the box passes the camera's plane: no finite projection
        else:
            xy = corners[:, :2] / corners[:, 2:]
        uv = xy @ K[:2, :2].T + K[:2, 2]
        low = np.clip(np.floor(uv.min(axis=0)), 0, (W, H)).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, (W, H)).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])
