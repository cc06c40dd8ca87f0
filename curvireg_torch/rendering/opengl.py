"""Depth through OpenGL with pyrender, off screen by EGL."""

import os
import threading
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..errors import RenderingError
from ..geometry.mesh import mesh_centre, mesh_radius
from .base import check_render_arguments

__all__ = ["PyrenderRenderer"]

_lock = threading.Lock()
_context: tuple[int, Any] | None = None


def _offscreen() -> Any:
    """The process's one OffscreenRenderer: a second one fails under EGL, and none survives a fork."""
    global _context
    if _context is None or _context[0] != os.getpid():
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        try:
            import pyrender

            _context = (os.getpid(), pyrender.OffscreenRenderer(64, 64))
        except Exception as error:  # PyOpenGL raises whatever its loader met
            raise RenderingError(
                f"renderer 'pyrender' needs OpenGL through EGL ({type(error).__name__}: {error}); "
                "install the system's libegl1, or use renderer='embree'"
            ) from error
    return _context[1]


def _camera(P: np.ndarray, near: float, far: float) -> Any:
    import pyrender

    class ProjectionCamera(pyrender.Camera):  # type: ignore[misc]
        """A camera given by its OpenGL projection matrix."""

        def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> np.ndarray:
            return P

    return ProjectionCamera(znear=near, zfar=far)


class PyrenderRenderer:
    """Draws into the process's one EGL context, one view at a time, behind a lock: thread-safe.

    Two defects of pyrender 0.1.45 are worked around. Its framebuffer takes four samples a pixel and resolves depth to
    one of them, off the centre: segmentation mode switches that off. Orthographic depth comes back through the
    perspective formula: it is inverted here.
    """

    name = "pyrender"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._centre = mesh_centre(mesh).numpy()
        self._radius = mesh_radius(mesh)
        with _lock:
            _offscreen()
            import pyrender

            positions = ((np.asarray(mesh.vertices) - self._centre) / self._radius).astype(np.float32)
            primitive = pyrender.Primitive(positions=positions, indices=np.asarray(mesh.faces, np.uint32), mode=4)
            self._scene = pyrender.Scene(bg_color=np.zeros(4))
            self._node = self._scene.add(pyrender.Mesh([primitive]))
            self._flags = (
                pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SEG | pyrender.RenderFlags.SKIP_CULL_FACES
            )

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        out = np.zeros((len(T), 1, *size), dtype=np.float32)
        with _lock:
            offscreen = _offscreen()
            offscreen.viewport_height, offscreen.viewport_width = size
            for i in range(len(T)):
                self._render_view(offscreen, T[i].numpy(), K[i].numpy(), out[i, 0], orthographic)
        return torch.from_numpy(out)

    def _render_view(self, offscreen: Any, T: np.ndarray, K: np.ndarray, out: np.ndarray, orthographic: bool) -> None:
        H, W = out.shape
        t = (T[:3, 3] + T[:3, :3] @ self._centre) / self._radius
        # The clip range hugs the object: 24 bits of depth are spent on it alone.
        near, far = t[2] - 1.001, t[2] + 1.001
        if not orthographic:
            near = max(near, 1e-3)
            if far <= near:
                return
        fx, fy, skew = K[0, 0], K[1, 1], K[0, 1]
        cx, cy = K[0, 2] + 0.5, K[1, 2] + 0.5  # OpenGL counts from the corner of the pixel
        # Rows: clip x, clip y, clip z, clip w of an OpenCV camera point (x, y, z, 1); OpenGL's image runs upwards.
        P = np.zeros((4, 4))
        if orthographic:
            s = self._radius
            P[0] = 2 * fx * s / W, 2 * skew * s / W, 0, 2 * cx / W - 1
            P[1] = 0, -2 * fy * s / H, 0, 1 - 2 * cy / H
            P[2] = 0, 0, 2 / (far - near), -(far + near) / (far - near)
            P[3, 3] = 1
        else:
            P[0] = 2 * fx / W, 2 * skew / W, 2 * cx / W - 1, 0
            P[1] = 0, -2 * fy / H, 1 - 2 * cy / H, 0
            P[2] = 0, 0, (far + near) / (far - near), -2 * far * near / (far - near)
            P[3, 2] = 1
        camera = self._scene.add(_camera(P, near, far))
        try:
            model_from_cam = np.eye(4)
            model_from_cam[:3, :3] = T[:3, :3].T
            model_from_cam[:3, 3] = -T[:3, :3].T @ t
            self._scene.set_pose(camera, model_from_cam)
            depth = offscreen.render(self._scene, flags=self._flags, seg_node_map={self._node: (255, 255, 255)})
        finally:
            self._scene.remove_node(camera)
        if orthographic:
            seen = depth > 0
            ndc = (far + near - 2 * near * far / np.where(seen, depth, 1.0)) / (far - near)
            depth = np.where(seen, 0.5 * (ndc * (far - near) + far + near), 0.0)
        out[:] = np.maximum(depth * self._radius, 0.0)
