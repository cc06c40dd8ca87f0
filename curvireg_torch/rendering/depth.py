"""What a renderer is, renderers by name, and :func:`render_depth`."""

from os import PathLike
from typing import Protocol

import torch
import trimesh
from torch import Tensor

from ..errors import InvalidInputError, MissingDependencyError, RenderingError
from ..mesh.mesh import as_mesh
from ..utils.checks import check_camera_matrix, check_option, check_pose
from ..utils.choices import RENDERER_NAMES

NEAREST = 1e-3  # Near plane, in object radii: surface closer to the camera plane, or behind it, is not rendered


class DepthRenderer(Protocol):
    """Depth images of one mesh. Both sides of every face are visible; textures are ignored."""

    name: str

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        """Render N views, with the arguments of :func:`render_depth`, into (N, 1, H, W) float32 z-depth. The depth is
        on the renderer's device, which is the CPU except for "torch"."""
        ...


def make_renderer(
    mesh: trimesh.Trimesh, backend: str | DepthRenderer = "auto", *, device: torch.device | str = "cpu"
) -> DepthRenderer:
    """A renderer of ``mesh``. All backends agree, see ``docs/conventions.md``; all may be shared by threads.

    - ``"auto"`` draws into OpenCV's z-buffer on the CPU, and casts rays where those are faster or needed.
    - ``"embree"`` casts rays on the CPU. Forked processes may share it and "auto".
    - ``"pyrender"`` draws through OpenGL, in perspective, and needs a system with EGL. A process that is forked after
      its first use cannot use it: start processes by "spawn".
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
    check_option(backend, RENDERER_NAMES, "renderer")
    if backend == "pyrender":
        from .opengl import PyrenderRenderer

        return PyrenderRenderer(mesh)
    if backend == "torch":
        from .zbuffer import TorchRenderer

        return TorchRenderer(mesh, device=device)
    try:
        from .embree import EmbreeRenderer, RasterRenderer
    except ImportError as error:
        message = f"renderer {backend!r} needs the package embreex ({error}): pip install embreex"
        raise MissingDependencyError(message) from error
    return EmbreeRenderer(mesh) if backend == "embree" else RasterRenderer(mesh)


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


def check_render_arguments(T: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Rigid poses (N, 4, 4) and cameras (N, 3, 3), checked, as float64 on the CPU."""
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
