"""Depth through OpenGL with pyrender, off screen by EGL."""

import atexit
import os
import threading
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..errors import RenderingError
from ..geometry.conversions import opencv_from_opengl, opengl_projection
from ..mesh.mesh import box_corners, mesh_centre, mesh_radius
from .protocol import NEAREST, check_render_arguments

__all__ = ["PyrenderRenderer"]

_lock = threading.Lock()
_context: tuple[int, Any] | None = None


def _offscreen() -> Any:
    """The only OffscreenRenderer of this process: a second one fails under EGL, and none survives a fork."""
    global _context
    if _context is not None and _context[0] != os.getpid():
        raise RenderingError(
            "renderer 'pyrender' was used before this process was forked, which OpenGL does not survive; start "
            "processes by 'spawn', or use renderer='embree'"
        )
    if _context is None:
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        with suppress(ImportError):
            # Mesa and triton (torch.compile) each load an LLVM: if Mesa's is loaded first, the process crashes.
            import_module("triton")
        try:
            import pyrender

            _context = (os.getpid(), pyrender.OffscreenRenderer(64, 64))
            atexit.register(_release)
        except Exception as error:  # PyOpenGL raises anything
            reason = f"renderer 'pyrender' needs OpenGL through EGL ({type(error).__name__}: {error})"
            raise RenderingError(f"{reason}; install the system's libegl1, or use renderer='embree'") from error
    return _context[1]


def _unbind(offscreen: Any) -> None:
    """Unbind the context from this thread, so that others can bind it; pyrender's make_uncurrent does nothing."""
    from OpenGL import EGL

    display = getattr(offscreen._platform, "_egl_display", None)
    if display is not None:
        EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)


def _release() -> None:
    """Delete the context at the end of the process that created it."""
    global _context
    if _context is not None and _context[0] == os.getpid():
        _context[1].delete()
    _context = None


def _camera(P: np.ndarray, near: float, far: float) -> Any:
    import pyrender

    class ProjectionCamera(pyrender.Camera):  # type: ignore[misc]
        """A camera given by its OpenGL projection matrix."""

        def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> np.ndarray:
            return P

    return ProjectionCamera(znear=near, zfar=far)


class PyrenderRenderer:
    """Draws into the process's only EGL context, one view at a time; a lock makes it thread-safe.

    It works around defects of pyrender 0.1.45. The framebuffer takes four samples per pixel and resolves depth to one
    that is off the centre; segmentation mode avoids that, but always culls back faces, so faces are drawn in both
    orientations. Orthographic depth is returned through the perspective formula, which is inverted here. Depth has 24
    bits: for a camera inside the object's box, the far end is less exact than with the other backends.
    """

    name = "pyrender"

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._centre, self._radius = mesh_centre(mesh), mesh_radius(mesh)
        self._corners = (box_corners(mesh) - self._centre) / self._radius
        with _lock:
            _unbind(_offscreen())
            import pyrender

            positions = ((np.asarray(mesh.vertices) - self._centre.numpy()) / self._radius).astype(np.float32)
            faces = np.asarray(mesh.faces, np.uint32)
            both_sides = np.concatenate([faces, faces[:, ::-1]])
            primitive = pyrender.Primitive(positions=positions, indices=both_sides, mode=4)
            self._scene = pyrender.Scene(bg_color=np.zeros(4))
            self._node = self._scene.add(pyrender.Mesh([primitive]))
            self._flags = pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SEG

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
        out = np.zeros((len(T), 1, *size), dtype=np.float32)
        with _lock:
            offscreen = _offscreen()
            offscreen.viewport_height, offscreen.viewport_width = size
            try:
                for i in range(len(T)):
                    self._render_view(offscreen, T[i], K[i], out[i, 0], orthographic)
            finally:
                _unbind(offscreen)
        return torch.from_numpy(out)

    def _render_view(self, offscreen: Any, T: Tensor, K: Tensor, out: np.ndarray, orthographic: bool) -> None:
        cam_from_model = T.clone()  # in radii, with the origin at the object's centre
        cam_from_model[:3, 3] = (T[:3, 3] + T[:3, :3] @ self._centre) / self._radius
        # A tight clip range spends all 24 bits of depth on the object.
        z = self._corners @ cam_from_model[2, :3] + cam_from_model[2, 3]
        near, far = max(float(z.min()) - 1e-3, NEAREST), float(z.max()) + 1e-3
        if far - 1e-3 <= near:
            return  # entirely behind the camera
        K, shift = K.clone(), 0.0
        if orthographic:
            # Pyrender treats depth as perspective, 2 f n / (f + n - ndc (f - n)). Move the object to where the inverse
            # of that formula is precise.
            shift = 2.0 - near
            cam_from_model[2, 3] += shift
            near, far = near + shift, far + shift
            K[:2, :2] *= self._radius
        P = opengl_projection(K, (out.shape[0], out.shape[1]), near=near, far=far, orthographic=orthographic)
        camera = self._scene.add(_camera(P.numpy(), near, far))
        try:
            self._scene.set_pose(camera, torch.linalg.inv(opencv_from_opengl(cam_from_model)).numpy())
            depth = offscreen.render(self._scene, flags=self._flags, seg_node_map={self._node: (255, 255, 255)})
        finally:
            self._scene.remove_node(camera)
        visible = depth > 0
        if orthographic:
            ndc = (far + near - 2 * near * far / np.where(visible, depth, 1.0)) / (far - near)
            depth = np.asarray(0.5 * (ndc * (far - near) + far + near) - shift)
        out[:] = np.where(visible, depth * self._radius, 0.0)
