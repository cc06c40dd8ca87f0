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

from ..errors import InvalidInputError, RenderingError
from ..geometry.conversions import opencv_from_opengl
from ..mesh.mesh import Mesh, box_corners
from ..utils.aliases import Size
from .renderer import NEAREST, MeshRenderer

_lock = threading.Lock()
# The process that created the only OffscreenRenderer, and that: under EGL a second one fails, none
# survives a fork
_context: tuple[int, Any] | None = None


def _offscreen() -> Any:
    """The OffscreenRenderer, bound to no thread, so that any can bind it; pyrender's make_uncurrent
    does nothing."""
    global _context
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    with suppress(ImportError):
        # Mesa and triton (torch.compile) each load an LLVM: if Mesa's is loaded first, the process
        # crashes.
        import_module("triton")
    try:
        import pyrender
        from OpenGL import EGL

        if _context is None:
            _context = os.getpid(), pyrender.OffscreenRenderer(64, 64)
            atexit.register(_release)
        display = getattr(_context[1]._platform, "_egl_display", None)
    except Exception as error:  # PyOpenGL raises anything
        reason = f"renderer 'pyrender' needs OpenGL through EGL ({type(error).__name__}: {error})"
        raise RenderingError(
            f"{reason}; install the system's libegl1, or use renderer='embree'"
        ) from error
    if _context[0] != os.getpid():
        raise RenderingError(
            "renderer 'pyrender' was used before this process was forked, which OpenGL does not "
            "survive; start "
            "processes by 'spawn', or use renderer='embree'"
        )
    if display is not None:
        EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)
    return _context[1]


def _release() -> None:
    """Delete the context at the end of the process that created it."""
    global _context
    if _context is not None and _context[0] == os.getpid():
        _context[1].delete()
    _context = None


class PyrenderRenderer(MeshRenderer):
    """Draws perspective views into the process's only EGL context, one at a time; a lock makes it
    thread-safe. It works around a defect of pyrender 0.1.45: the framebuffer takes four samples per
    pixel and resolves depth to one that is off the centre; segmentation mode avoids that, but
    always culls back faces, so faces are drawn in both orientations. Depth has 24 bits: for a
    camera inside the object's box, the far end is less exact than elsewhere."""

    name = "pyrender"

    def __init__(self, mesh: Mesh | trimesh.Trimesh) -> None:
        super().__init__(mesh)
        self._corners = torch.from_numpy(self._scaled(box_corners(mesh)))
        with _lock:
            _offscreen()
            import pyrender

            positions = self._scaled(mesh.vertices).astype(np.float32)
            faces = np.asarray(mesh.faces, np.uint32)
            both_sides = np.concatenate([faces, faces[:, ::-1]])
            primitive = pyrender.Primitive(positions=positions, indices=both_sides, mode=4)
            self._scene = pyrender.Scene(bg_color=np.zeros(4))
            self._node = self._scene.add(pyrender.Mesh([primitive]))
            self._flags = pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SEG

    def _depth(self, T: Tensor, K: Tensor, size: Size, orthographic: bool) -> Tensor:
        if orthographic:
            raise InvalidInputError("renderer: 'pyrender' knows no parallel projection; use 'auto'")
        out = np.zeros((len(T), 1, *size), dtype=np.float32)
        with _lock:
            offscreen = _offscreen()
            offscreen.viewport_height, offscreen.viewport_width = size
            try:
                for i in range(len(T)):
                    out[i, 0] = self._draw(offscreen, T[i], K[i])
            finally:
                _offscreen()  # unbind it from this thread
        return torch.from_numpy(out)

    def _draw(self, offscreen: Any, T: Tensor, K: Tensor) -> Any:
        """(H, W) depth in radii."""
        import pyrender

        # A tight clip range spends all 24 bits of depth on the object.
        z = self._corners @ T[2, :3] + T[2, 3]
        near = max(float(z.min()) - 1e-3, NEAREST)
        far = float(z.max()) + 1e-3
        if far - 1e-3 <= near:
            return 0.0  # entirely behind the camera
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        # pixel (0, 0) of OpenGL begins at 0
        camera = pyrender.IntrinsicsCamera(fx, fy, cx + 0.5, cy + 0.5, znear=near, zfar=far)
        pose = torch.linalg.inv(opencv_from_opengl(T)).numpy()
        node = self._scene.add(camera, pose=pose)
        try:
            return offscreen.render(
                self._scene, flags=self._flags, seg_node_map={self._node: (255, 255, 255)}
            )
        finally:
            self._scene.remove_node(node)
