"""Renderers by name, and :func:`render_depth`."""

from collections.abc import Callable
from os import PathLike

import torch
import trimesh
from torch import Tensor

from ..errors import InvalidInputError, MissingDependencyError, RenderingError
from ..mesh.mesh import as_mesh
from ..utils.checks import check_option
from .protocol import DepthRenderer

__all__ = ["BACKENDS", "make_renderer", "render_depth"]


def _embree(mesh: trimesh.Trimesh, _: torch.device | str) -> DepthRenderer:
    try:
        from .embree import EmbreeRenderer
    except ImportError as error:
        message = f"renderer 'embree' needs the package embreex ({error}): pip install embreex"
        raise MissingDependencyError(message) from error
    return EmbreeRenderer(mesh)


def _pyrender(mesh: trimesh.Trimesh, _: torch.device | str) -> DepthRenderer:
    from .opengl import PyrenderRenderer

    return PyrenderRenderer(mesh)


def _torch(mesh: trimesh.Trimesh, device: torch.device | str) -> DepthRenderer:
    from .zbuffer import TorchRenderer

    return TorchRenderer(mesh, device=device)


BACKENDS: dict[str, Callable[[trimesh.Trimesh, torch.device | str], DepthRenderer]] = {
    "auto": _embree,
    "embree": _embree,
    "pyrender": _pyrender,
    "torch": _torch,
}
"""Renderers by name."""


def make_renderer(
    mesh: trimesh.Trimesh, backend: str | DepthRenderer = "auto", *, device: torch.device | str = "cpu"
) -> DepthRenderer:
    """A renderer of ``mesh``. All backends agree, see ``docs/conventions.md``; all may be shared by threads.

    - ``"embree"``, which "auto" means, casts rays on the CPU and needs only its wheel. Forked processes may share it.
    - ``"pyrender"`` draws through OpenGL and needs a system with EGL. A process that is forked after its first use
      cannot use it: start processes by "spawn".
    - ``"torch"`` runs on any torch device. Forked processes must call ``torch.set_num_threads(1)`` first.

    Args:
        mesh: a clean mesh, from :func:`curvireg_torch.load_mesh`.
        backend: a name, or a renderer, which is returned unchanged.
        device: where "torch" renders.

    Raises:
        RenderingError, MissingDependencyError: the backend does not work here.
    """
    if not isinstance(backend, str):
        return backend
    check_option(backend, list(BACKENDS), "renderer")
    return BACKENDS[backend](mesh, device)


def render_depth(
    mesh: "trimesh.Trimesh | trimesh.Scene | str | PathLike[str]",
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    *,
    renderer: str | DepthRenderer = "auto",
    orthographic: bool = False,
) -> Tensor:
    """Depth images of a mesh.

    Args:
        mesh: a mesh, a scene (all its parts, placed by their transforms) or the path of one.
        T_cam_from_model: (N, 4, 4) or (4, 4), rigid, model to OpenCV camera.
        camera_matrix: (N, 3, 3) or (3, 3) in px, no skew; pixel (0, 0) is the centre of the top-left pixel.
        size: (H, W).
        renderer: a name for :func:`make_renderer`, or a renderer of this mesh, which is then not built in every call.
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
    T = T_cam_from_model[None] if T_cam_from_model.ndim == 2 else T_cam_from_model
    backend = make_renderer(as_mesh(mesh), renderer)
    try:
        return backend.render(T, camera_matrix, size, orthographic=orthographic)
    except (InvalidInputError, RenderingError):
        raise
    except Exception as error:  # drivers raise anything
        reason = f"renderer {backend.name!r} failed: {type(error).__name__}: {error}"
        raise RenderingError(f"{reason}; try another renderer") from error
