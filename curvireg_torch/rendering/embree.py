"""Depth by ray casting with embree: needs no GPU, no driver, no display."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch import Tensor

from ..geometry.mesh import box_corners, extreme_points, mesh_centre, mesh_radius
from .base import NEAREST, check_render_arguments

__all__ = ["EmbreeRenderer", "RayScene"]

_MISS = 1e30  # embreex returns 1e37 where a ray hits nothing
_HULL = 200_000  # vertices up to which a convex hull takes less time than it saves
_OUTLINE = 4096  # points of a convex hull that are worth projecting in every view
_DRAWABLE = 16000  # px, as far as OpenCV draws polygons


class RayScene:
    """Triangles that rays are cast at.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._scene = EmbreeScene()
        TriangleMesh(scene=self._scene, vertices=vertices.astype(np.float32), indices=np.asarray(faces, np.int32))

    def distance(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) lengths along (N, 3) rays to what they hit first, in units of the directions; inf for nothing."""
        along = self._scene.run(_float32(origins), _float32(directions), query="DISTANCE")
        return np.where(along < _MISS, along, np.inf)

    def hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """:meth:`distance`, the triangle hit (N,), and its normal (N, 3), neither of unit length nor of known sign."""
        found = self._scene.run(_float32(origins), _float32(directions), query="INTERSECT", output=True)
        return np.where(found["tfar"] < _MISS, found["tfar"], np.inf), found["primID"], found["Ng"]

    def blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) bool: whether rays hit anything."""
        return np.asarray(self._scene.run(_float32(origins), _float32(directions), query="OCCLUDED") >= 0)


def _float32(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x, np.float32)


class EmbreeRenderer:
    """One ray through each pixel's centre; views are shared among threads.

    Thread-safe, since rays only read the scene, and fork-safe. Cannot be pickled: a spawned process makes its own.
    """

    name = "embree"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        # Embree computes in float32: centre the object and scale it to radius 1.
        self._centre = mesh_centre(mesh).numpy()
        self._radius = mesh_radius(mesh)
        vertices = (np.asarray(mesh.vertices) - self._centre) / self._radius
        outline = extreme_points(mesh) if len(vertices) <= _HULL else box_corners(mesh)
        outline = outline if len(outline) <= _OUTLINE else box_corners(mesh)
        self._outline = (outline.numpy() - self._centre) / self._radius
        self._scene = RayScene(vertices, mesh.faces)

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
        outline = self._outline @ R.T + t
        if outline[:, 2].max() <= NEAREST:
            return  # wholly behind the camera
        # Rays start at the plane z = near: no digits are spent on the way to a distant object.
        near = max(outline[:, 2].min() - 1e-3, NEAREST)
        v, u = self._pixels(outline, K, out.shape, orthographic)
        y = (v - K[1, 2]) / K[1, 1]
        x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
        if orthographic:
            starts = np.stack([x, y], 1) @ R[:2] / self._radius + (near * R[2] - R.T @ t)
            directions = np.broadcast_to(R[2], starts.shape)
        else:
            directions = np.stack([x, y], 1) @ R[:2] + R[2]
            starts = near * directions - R.T @ t
        along = self._scene.distance(starts, directions)
        out[v, u] = np.where(np.isfinite(along), (along + near) * self._radius, 0.0)

    def _pixels(
        self, outline: np.ndarray, K: np.ndarray, size: tuple[int, ...], orthographic: bool
    ) -> tuple[np.ndarray, ...]:
        """Rows and columns of the pixels inside the outline's projection, with a rim of a pixel."""
        mask = np.ones(size, dtype=np.uint8)
        if orthographic:
            xy = outline[:, :2] * self._radius
        elif outline[:, 2].min() > NEAREST:
            xy = outline[:, :2] / outline[:, 2:]
        else:
            return np.nonzero(mask)  # it passes the camera's plane: no finite projection
        uv = xy @ K[:2, :2].T + K[:2, 2]
        if np.abs(uv).max() < _DRAWABLE:
            mask[:] = 0
            cv2.fillConvexPoly(mask, cv2.convexHull(np.round(uv).astype(np.int32)), 1)
            mask = cv2.dilate(mask, np.ones((3, 3), np.uint8))
        return np.nonzero(mask)
