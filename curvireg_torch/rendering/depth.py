"""Renderers by name, and the depth that they draw."""

import trimesh
from torch import Tensor

from ..errors import InvalidInputError, RenderingError
from ..mesh import Mesh, as_mesh
from ..utils.aliases import Size
from ..utils.checks import check_option
from ..utils.choices import RENDERER_NAMES
from ..utils.likes import MeshLike
from .embree import EmbreeRenderer, RasterRenderer
from .renderer import DepthRenderer


def make_renderer(
    mesh: Mesh | trimesh.Trimesh, backend: str | DepthRenderer = "auto", *, many_views: bool = False
) -> DepthRenderer:
    """A renderer of ``mesh``, or ``backend`` if it is none of these names. All agree, and may be
    shared by threads:

    - ``"auto"`` draws into OpenCV's z-buffer on the CPU, and casts rays where those are faster or
      needed.
    - ``"embree"`` casts rays on the CPU. Forked processes may share it and "auto".
    - ``"pyrender"`` draws through OpenGL, in perspective, and needs a system with EGL. A process
      that is forked after its first use cannot use it: start processes by "spawn".

    For ``many_views``, "auto" leaves out the back faces of closed surfaces, which halves the time.

    Raises :class:`RenderingError` where the backend does not work.

    Example:
        >>> import torch, trimesh
        >>> T = torch.eye(4).double()[None]; T[:, 2, 3] = 5.0
        >>> K = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]]).double()
        >>> depth = make_renderer(trimesh.creation.box()).render(T, K[None], (64, 64))
        >>> round(float(depth[0, 0, 32, 32]), 4)
        4.5
    """
    if not isinstance(backend, str):
        return backend
    check_option(backend, RENDERER_NAMES, "renderer")
    if backend == "pyrender":
        from .opengl import PyrenderRenderer

        return PyrenderRenderer(mesh)
    if backend == "embree":
        return EmbreeRenderer(mesh)
    return RasterRenderer(mesh, many_views=many_views)


def render_depth(
    mesh: MeshLike,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: Size,
    *,
    renderer: str | DepthRenderer = "auto",
    orthographic: bool = False,
) -> Tensor:
    """Depth images of a mesh.

    Args:
        mesh: a mesh, a scene (all its parts, placed by their transforms) or the path of one.
        T_cam_from_model: (N, 4, 4) or (4, 4), rigid, model to OpenCV camera.
        camera_matrix: (N, 3, 3) or (3, 3) in px, no skew; pixel (0, 0) is the centre of the
            top-left pixel.
        size: (H, W).
        renderer: a name for :func:`make_renderer`, or a renderer of this mesh, which is then not
            built in every call.
        orthographic: parallel projection; fx, fy are then px per model unit.

    Returns:
        (N, 1, H, W) float32 z-depth in model units, 0 = background.

    Raises:
        InvalidInputError, MeshError, MissingFileError, RenderingError.

    Example:
        >>> import torch
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
        >>> T = torch.eye(4); T[2, 3] = 4.0
        >>> depth = render_depth(trimesh.creation.box((1.0, 1.0, 1.0)), T, K, (64, 64))
        >>> depth.shape, round(float(depth[0, 0, 32, 32]), 4)
        (torch.Size([1, 1, 64, 64]), 3.5)
    """
    backend = make_renderer(as_mesh(mesh), renderer)
    try:
        return backend.render(T_cam_from_model, camera_matrix, size, orthographic=orthographic)
    except (InvalidInputError, RenderingError):
        raise
    except Exception as error:  # drivers raise anything
        reason = f"renderer {backend.name!r} failed: {type(error).__name__}: {error}"
        raise RenderingError(f"{reason}; try another renderer") from error
