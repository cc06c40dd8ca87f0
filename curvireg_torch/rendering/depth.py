"""What a renderer is, renderers by name, and what they draw: depth, and shaded pictures, grey or in colours."""

from os import PathLike
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from ..errors import InvalidInputError, RenderingError
from ..mesh.colours import surface_colours
from ..mesh.mesh import as_mesh
from ..utils.checks import check_camera_matrix, check_image, check_option, check_pose, check_tensor
from ..utils.choices import RENDERER_NAMES

NEAREST = 1e-3  # Near plane, in object radii: surface closer to the camera plane, or behind it, is not rendered


class DepthRenderer(Protocol):
    """Depth images of one mesh. Both sides of every face are visible; textures are ignored."""

    name: str

    def render(
        self, T_cam_from_model: Tensor, camera_matrix: Tensor, size: tuple[int, int], *, orthographic: bool = False
    ) -> Tensor:
        """Render N views, with the arguments of :func:`render_depth`, into (N, 1, H, W) float32 z-depth."""
        ...


def make_renderer(
    mesh: trimesh.Trimesh, backend: str | DepthRenderer = "auto", *, many_views: bool = False
) -> DepthRenderer:
    """A renderer of ``mesh``, or ``backend`` if it is none of these names. All agree, and may be shared by threads:

    - ``"auto"`` draws into OpenCV's z-buffer on the CPU, and casts rays where those are faster or needed.
    - ``"embree"`` casts rays on the CPU. Forked processes may share it and "auto".
    - ``"pyrender"`` draws through OpenGL, in perspective, and needs a system with EGL. A process that is forked after
      its first use cannot use it: start processes by "spawn".

    For ``many_views``, "auto" leaves out the back faces of closed surfaces, which halves the time.

    Raises :class:`RenderingError` where the backend does not work.
    """
    if not isinstance(backend, str):
        return backend
    check_option(backend, RENDERER_NAMES, "renderer")
    if backend == "pyrender":
        from .opengl import PyrenderRenderer

        return PyrenderRenderer(mesh)
    from .embree import EmbreeRenderer, RasterRenderer

    return EmbreeRenderer(mesh) if backend == "embree" else RasterRenderer(mesh, many_views=many_views)


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
    check_tensor(T, "T_cam_from_model", (None, 4, 4))
    if len(size) != 2 or min(size) < 1:
        raise InvalidInputError(f"size: expected (H, W) >= 1, got {size}")
    check_camera_matrix(K)
    if K.ndim == 3 and K.shape[0] not in (1, T.shape[0]):
        raise InvalidInputError(f"camera_matrix: expected one or {T.shape[0]} matrices, got {K.shape[0]}")
    check_pose(T, "T_cam_from_model")
    T = T.detach().to("cpu", torch.float64)
    return T, K.detach().to("cpu", torch.float64).expand(T.shape[0], 3, 3)


AMBIENT, LIT = 0.3, 0.9  # Grey levels of a surface seen edge on and face on; the background is 1
SUPERSAMPLING = 2  # Samples per pixel and axis, because textures are finer than views


@torch.no_grad()
def render_colour(
    mesh: "trimesh.Trimesh | trimesh.Scene | str | PathLike[str]",
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    *,
    renderer: str | DepthRenderer = "auto",
    orthographic: bool = False,
) -> Tensor:
    """Pictures of a mesh in its colours before white: the colour times :func:`shade`, four samples per pixel. A mesh
    without colours is white, and so is every mesh with a renderer that does not report which face a pixel shows; "auto"
    and "embree" do. Arguments and errors are those of :func:`render_depth`.

    Returns:
        (N, 3, H, W) float32 RGB in [0, 1] on the CPU.

    Example:
        >>> box = trimesh.creation.box()
        >>> box.visual.face_colors = [200, 20, 20, 255]
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
        >>> T = torch.eye(4); T[2, 3] = 4.0
        >>> red, green, blue = render_colour(box, T, K, (64, 64))[0, :, 32, 32].tolist()
        >>> red > 0.6 and green < 0.1 and blue < 0.1
        True
    """
    mesh = as_mesh(mesh)
    T, K = check_render_arguments(T_cam_from_model.view(-1, 4, 4), camera_matrix, size)
    shift = 0.5 - 0.5 / SUPERSAMPLING
    zoom = torch.tensor([[1.0, 0, shift], [0, 1, shift], [0, 0, 1 / SUPERSAMPLING]])
    K = SUPERSAMPLING * zoom.double() @ K
    fine = SUPERSAMPLING * size[0], SUPERSAMPLING * size[1]
    backend = make_renderer(mesh, renderer)
    colours, faces_at = surface_colours(mesh), getattr(backend, "faces_at", None)
    albedo = np.ones((len(T), *fine, 3), np.float32)
    if colours is None or faces_at is None:
        depth = backend.render(T, K, fine, orthographic=orthographic).cpu()
    else:
        face, u, v, depth = faces_at(T, K, fine, orthographic=orthographic)
        visible = face >= 0
        albedo[visible] = colours.at(face[visible], u[visible], v[visible])
    picture = shade(depth, K, orthographic=orthographic) * torch.from_numpy(albedo).permute(0, 3, 1, 2)
    return F.avg_pool2d(picture.contiguous(), SUPERSAMPLING)


def shade(depth: Tensor, camera_matrix: Tensor, *, orthographic: bool = False) -> Tensor:
    """Lambertian shading with a light at the camera: grey 0.3 edge on to 0.9 face on, background 1. Normals come from
    neighbouring pixels, of two along an axis the one nearer in depth, and are exact for planes.

    Args:
        depth: (N, 1, H, W) z-depth, 0 = background; the result has its shape and dtype.
        camera_matrix: (N, 3, 3) or (3, 3) in px, without skew.
        orthographic: parallel projection; fx, fy are then px per unit of depth.

    Example:
        >>> K = torch.tensor([[100.0, 0, 15.5], [0, 100.0, 15.5], [0, 0, 1]])
        >>> round(float(shade(torch.full((1, 1, 32, 32), 5.0), K)[0, 0, 16, 16]), 2)
        0.9
    """
    check_image(depth, "depth")
    if camera_matrix.ndim == 2:
        camera_matrix = camera_matrix.expand(depth.shape[0], -1, -1)
    check_tensor(camera_matrix, "camera_matrix", (depth.shape[0], 3, 3))
    check_camera_matrix(camera_matrix)
    z = depth.float()
    visible = z > 0
    fx, fy, cx, cy = (camera_matrix.to(z)[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    # Across a plane, inverse depth is linear in pixel coordinates; under parallel projection, depth is.
    s = torch.where(visible, z if orthographic else 1.0 / z, torch.inf)
    su, sv = _slope(s, -1), _slope(s, -2)
    if orthographic:
        x, y, n = fx * su, fy * sv, torch.ones_like(s)
        cosine = n / (x * x + y * y + n).sqrt()
    else:
        u = torch.arange(z.shape[-1], device=z.device, dtype=z.dtype) - cx
        v = torch.arange(z.shape[-2], device=z.device, dtype=z.dtype)[:, None] - cy
        x, y, n = fx * su, fy * sv, s - u * su - v * sv
        # The product of the normal (x, y, n) with the pixel's ray (u / fx, v / fy, 1) is s.
        ray = ((u / fx).square() + (v / fy).square() + 1.0).sqrt()
        cosine = s / (ray * (x * x + y * y + n * n).sqrt())
    return torch.where(visible, AMBIENT + (LIT - AMBIENT) * cosine, 1.0).to(depth.dtype)


def _slope(s: Tensor, dim: int) -> Tensor:
    """Difference per px along ``dim`` to the neighbour nearer in depth; 0 if neither neighbour is on the surface."""
    step = s.diff(dim=dim).nan_to_num(torch.inf, torch.inf, torch.inf)  # inf beside the background
    edge = torch.full_like(s.narrow(dim, 0, 1), torch.inf)
    before, after = torch.cat([edge, step], dim), torch.cat([step, edge], dim)
    slope = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(slope.isinf(), 0.0, slope)
