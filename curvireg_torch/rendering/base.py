"""The renderer protocol, backend selection, and :func:`render_depth`."""

import importlib.util
import threading
import warnings
from os import PathLike
from typing import Any, Protocol

import torch
import trimesh
from torch import Tensor

from ..errors import InvalidInputError, MissingDependencyError, RenderingError
from ..io.meshes.mesh import as_mesh
from ..utils.checks import check_camera_matrix, check_option, check_pose
from ..utils.choices import BACKENDS

__all__ = ["BACKENDS", "NEAREST", "DepthRenderer", "make_renderer", "render_depth"]

NEAREST = 1e-3
"""Surface nearer to the camera's plane than this many object radii, or behind it, is not seen."""


class DepthRenderer(Protocol):
    """Depth images of one mesh. Both sides of every face are seen; textures play no part."""

    name: str

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        """Render N views.

        Args:
            T_cam_from_model: (N, 4, 4) rigid transforms into the OpenCV camera.
            camera_matrix: (N, 3, 3) or (3, 3), without skew; see :func:`curvireg_torch.geometry.project_points`.
            size: (H, W) in px.
            orthographic: parallel projection along z; fx, fy are then px per model unit.

        Returns:
            (N, 1, H, W) float32 z-depth at the pixels' centres, in model units; 0 = background. On the renderer's
            device: the CPU, but for "torch".
        """
        ...


def make_renderer(
    mesh: trimesh.Trimesh, backend: str | DepthRenderer = "auto", *, device: torch.device | str = "cpu"
) -> DepthRenderer:
    """A renderer of ``mesh``; all agree, see ``docs/conventions.md``.

    - ``"embree"`` casts rays on the CPU and needs nothing but its wheel. Threads may share it, forked processes too.
    - ``"pyrender"`` draws through OpenGL and needs a system with EGL. Threads may share it and take turns; a process
      forked after its first use cannot (start processes by "spawn").
    - ``"torch"`` needs nothing and runs on any torch device. Threads may share it; forked processes must call
      ``torch.set_num_threads(1)`` first.
    - ``"auto"``: embree where it is installed (it asks for no driver, and minds neither threads nor forks), else
      pyrender where EGL works, else torch. Where one fails later on, the next takes over with a warning.

    Args:
        mesh: a clean mesh, from :func:`curvireg_torch.load_mesh`.
        backend: a name, or a renderer, which is returned as it is.
        device: where "torch" renders.

    Raises:
        InvalidInputError: unknown name.
        RenderingError, MissingDependencyError: the backend does not work here.
    """
    if not isinstance(backend, str):
        return backend
    check_option(backend, BACKENDS, "renderer")
    if backend == "auto":
        return _FirstThatWorks(mesh, device)
    if backend == "torch":
        from .zbuffer import TorchRenderer

        return TorchRenderer(mesh, device=device)
    if backend == "embree":
        try:
            from .embree import EmbreeRenderer
        except ImportError as error:
            raise MissingDependencyError(
                f"renderer 'embree' needs the package embreex ({error}): pip install embreex"
            ) from error
        return EmbreeRenderer(mesh)
    from .opengl import PyrenderRenderer

    return PyrenderRenderer(mesh)


class _FirstThatWorks:
    """The first backend that works, and the next from the moment it no longer does."""

    def __init__(self, mesh: trimesh.Trimesh, device: torch.device | str) -> None:
        self._mesh, self._device = mesh, device
        self._left = [b for b in BACKENDS[1:] if b != "embree" or importlib.util.find_spec("embreex")]
        self._lock = threading.Lock()
        self._renderer = self._next()
        self.name = self._renderer.name

    def _next(self) -> DepthRenderer:
        while True:
            try:
                return make_renderer(self._mesh, self._left.pop(0), device=self._device)
            except (RenderingError, MissingDependencyError):
                if not self._left:
                    raise

    @property
    def faces_at(self) -> Any:
        """That of the backend, where it has one, see :func:`render_colour`."""
        return getattr(self._renderer, "faces_at", None)

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        check_render_arguments(T_cam_from_model, camera_matrix, size)  # what fails below is the backend's fault
        while True:
            used = self._renderer
            try:
                return used.render(T_cam_from_model, camera_matrix, size, orthographic=orthographic)
            except Exception as error:  # drivers raise anything
                with self._lock:  # of several threads that met the same failure one replaces the backend
                    if used is self._renderer:
                        if not self._left:
                            raise
                        self._renderer = self._next()
                        self.name = self._renderer.name
                        warnings.warn(
                            f"renderer {used.name!r} failed ({type(error).__name__}: {error}); "
                            f"going on with {self.name!r}",
                            stacklevel=2,
                        )


def check_render_arguments(T: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """float64 CPU poses (N, 4, 4), rigid, and cameras (N, 3, 3), or a clear error: what every backend renders."""
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InvalidInputError(f"T_cam_from_model: expected shape (N, 4, 4), got {tuple(T.shape)}")
    if len(size) != 2 or min(size) < 1:
        raise InvalidInputError(f"size: expected (H, W) >= 1, got {size}")
    check_camera_matrix(K)
    if K.ndim == 3 and K.shape[0] not in (1, T.shape[0]):
        raise InvalidInputError(f"camera_matrix: expected one or {T.shape[0]} matrices, got {K.shape[0]}")
    check_pose(T, "T_cam_from_model")
    T = T.detach().to("cpu", torch.float64)
    return T, K.detach().to("cpu", torch.float64).expand(T.shape[0], 3, 3)


def render_depth(
    mesh: "trimesh.Trimesh | trimesh.Scene | str | PathLike[str]",
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    *,
    renderer: Any = "auto",
    orthographic: bool = False,
) -> Tensor:
    """Depth images of a mesh.

    Args:
        mesh: a mesh, a scene (all its parts, placed by their transforms) or the path of one.
        T_cam_from_model: (N, 4, 4) or (4, 4), rigid, model to OpenCV camera.
        camera_matrix: (N, 3, 3) or (3, 3) in px; pixel (0, 0) is the centre of the top-left pixel.
        size: (H, W).
        renderer: "auto", "embree", "pyrender" or "torch", see :func:`make_renderer`, or a :class:`DepthRenderer`.
        orthographic: parallel projection; fx, fy are then px per model unit.

    Returns:
        (N, 1, H, W) float32 z-depth in model units, 0 = background.

    Raises:
        InvalidInputError, MeshError, MissingFileError, RenderingError.

    Example:
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
        >>> T = torch.eye(4); T[2, 3] = 4.0
        >>> depth = render_depth(trimesh.creation.box((1.0, 1.0, 1.0)), T, K, (64, 64))
        >>> depth.shape, round(float(depth[0, 0, 32, 32]), 4)
        (torch.Size([1, 1, 64, 64]), 3.5)
    """
    if T_cam_from_model.ndim == 2:
        T_cam_from_model = T_cam_from_model[None]
    backend = make_renderer(as_mesh(mesh), renderer)
    try:
        return backend.render(T_cam_from_model, camera_matrix, size, orthographic=orthographic)
    except (InvalidInputError, RenderingError):
        raise
    except Exception as error:  # drivers raise anything
        raise RenderingError(
            f"renderer {backend.name!r} failed: {type(error).__name__}: {error}; try another renderer"
        ) from error
