"""Depth by OpenCV's z-buffer where that is faster than ray casting."""

import math
from functools import cached_property

import cv2
import numpy as np
import torch
import trimesh
from torch import Tensor

from ..mesh.mesh import box_corners, mesh_centre, mesh_radius
from ..utils.threads import for_each
from .depth import NEAREST, check_render_arguments
from .embree import EmbreeRenderer

__all__ = ["RasterRenderer"]

BESIDE = 1e-3
"""Space, in object radii, between the object and the planes between which OpenCV's z-buffer is precise."""


class RasterRenderer:
    """Draws into OpenCV's z-buffer, views in parallel on threads; rays take over where OpenCV is slower or wrong.

    The time of the z-buffer grows with the faces, that of ray casting with the pixels: it is used for meshes of fewer
    faces than the image has pixels. It does not clip faces that cross the near plane, and knows no parallel projection.

    Attributes:
        rays: a renderer of the same mesh by ray casting, built on first use.
    """

    name = "auto"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._mesh = mesh
        # OpenCV computes in float32, so the object is centred and scaled to radius 1.
        self._centre, self._radius = mesh_centre(mesh).numpy(), mesh_radius(mesh)
        self._corners = (box_corners(mesh).numpy() - self._centre) / self._radius
        vertices = (np.asarray(mesh.vertices) - self._centre) / self._radius
        self._vertices = np.ascontiguousarray(vertices, np.float32)[:, None]
        self._faces = np.array(mesh.faces, np.int32)[:, None]
        self._settings = cv2.TriangleRasterizeSettings()
        self._settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)

    @cached_property
    def rays(self) -> EmbreeRenderer:
        return EmbreeRenderer(self._mesh)

    def faces_at(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Tensor]:
        """See :meth:`EmbreeRenderer.faces_at`."""
        return self.rays.faces_at(T_cam_from_model, camera_matrix, size, orthographic=orthographic)

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        if orthographic or len(self._faces) > size[0] * size[1]:
            return self.rays.render(T_cam_from_model, camera_matrix, size, orthographic=orthographic)
        T, K = (x.numpy() for x in check_render_arguments(T_cam_from_model, camera_matrix, size))
        position = (T[:, :3, 3] + T[:, :3, :3] @ self._centre) / self._radius  # of the object's centre, in radii
        z = position[:, 2:] + T[:, 2, :3] @ self._corners.T
        near, far = z.min(axis=1) - BESIDE, z.max(axis=1) + BESIDE
        depth = np.zeros((len(T), 1, *size), np.float32)

        def draw(i: int) -> None:
            if near[i] > NEAREST:
                depth[i, 0] = self._draw(T[i, :3, :3], position[i], K[i], size, float(near[i]), float(far[i]))

        for_each(len(T), draw)
        if len(crossing := np.nonzero((near <= NEAREST) & (far > NEAREST))[0]):
            index = torch.from_numpy(crossing)
            K_crossing = torch.from_numpy(K[crossing])
            depth[crossing] = self.rays.render(T_cam_from_model[index], K_crossing, size).numpy()
        return torch.from_numpy(depth)

    def _draw(
        self, R: np.ndarray, t: np.ndarray, K: np.ndarray, size: tuple[int, int], near: float, far: float
    ) -> np.ndarray:
        """(H, W) depth of one view."""
        H, W = size
        # OpenCV's camera: axes of OpenGL, 90 degrees from the top to the bottom of the image, centred, square pixels.
        shear = np.array(
            [
                [2.0 * K[0, 0] / H, 0.0, (2.0 * K[0, 2] - (W - 1)) / H],
                [0.0, -2.0 * K[1, 1] / H, -(2.0 * K[1, 2] - (H - 1)) / H],
                [0.0, 0.0, -1.0],
            ]
        )
        camera = (shear @ np.column_stack([R, t])).astype(np.float32)
        z = np.full(size, far, np.float32)
        cv2.triangleRasterizeDepth(self._vertices, self._faces, z, camera, math.pi / 2.0, near, far, self._settings)
        background = z > far - 0.5 * BESIDE
        z *= np.float32(self._radius)
        z[background] = 0.0
        return z
