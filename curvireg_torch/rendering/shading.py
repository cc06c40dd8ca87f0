"""Shaded pictures of meshes, grey or in their colours."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..mesh.colours import colours_at
from ..mesh.mesh import as_mesh
from ..utils.aliases import Size
from ..utils.checks import check_camera_matrix, check_image, check_integer, check_tensor
from ..utils.likes import MeshLike
from .depth import make_renderer
from .renderer import DepthRenderer, check_render_arguments

AMBIENT = 0.3  # Grey level of a surface seen edge on; the background is 1
LIT = 0.9  # Grey level of a surface seen face on


@torch.no_grad()
def render_colour(
    mesh: MeshLike,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: Size,
    *,
    renderer: str | DepthRenderer = "auto",
    orthographic: bool = False,
    supersampling: int = 2,
) -> Tensor:
    """Pictures of a mesh in its colours before white: the colour times :func:`shade`, with
    ``supersampling`` samples per pixel and axis, because textures are finer than views. A mesh
    without colours is white, and so is every mesh with a renderer that does not report which face a
    pixel shows; "auto" and "embree" do. The other arguments and errors are those of
    :func:`render_depth`.

    Returns:
        (N, 3, H, W) float32 RGB in [0, 1] on the CPU.

    Example:
        >>> import trimesh
        >>> box = trimesh.creation.box()
        >>> box.visual.face_colors = [200, 20, 20, 255]
        >>> K = torch.tensor([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]])
        >>> T = torch.eye(4); T[2, 3] = 4.0
        >>> red, green, blue = render_colour(box, T, K, (64, 64))[0, :, 32, 32].tolist()
        >>> red > 0.6 and green < 0.1 and blue < 0.1
        True
    """
    mesh = as_mesh(mesh)
    T, K = check_render_arguments(T_cam_from_model, camera_matrix, size)
    check_integer(supersampling, "supersampling")
    shift = 0.5 - 0.5 / supersampling
    zoom = torch.tensor([[1.0, 0, shift], [0, 1, shift], [0, 0, 1 / supersampling]])
    K = supersampling * zoom.double() @ K
    fine = supersampling * size[0], supersampling * size[1]
    backend = make_renderer(mesh, renderer)
    colours = mesh.colours
    faces_at = getattr(backend, "faces_at", None)
    albedo = np.ones((len(T), *fine, 3), np.float32)
    if colours is None or faces_at is None:
        depth = backend.render(T, K, fine, orthographic=orthographic).cpu()
    else:
        face, u, v, depth = faces_at(T, K, fine, orthographic=orthographic)
        visible = face >= 0
        albedo[visible] = colours_at(colours, face[visible], u[visible], v[visible])
    grey = shade(depth, K, orthographic=orthographic)
    picture = grey * torch.from_numpy(albedo).movedim(3, 1)
    return F.avg_pool2d(picture.contiguous(), supersampling)


def shade(depth: Tensor, camera_matrix: Tensor, *, orthographic: bool = False) -> Tensor:
    """Lambertian shading with a light at the camera: grey 0.3 edge on to 0.9 face on, background 1.
    Normals come from neighbouring pixels, of two along an axis the one nearer in depth, and are
    exact for planes.

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
    K = camera_matrix.to(z)[..., None, None]
    fx = K[:, 0, 0, None]
    fy = K[:, 1, 1, None]
    # Across a plane, inverse depth is linear in pixel coordinates; under parallel projection, depth
    # is.
    height = torch.where(visible, z if orthographic else 1.0 / z, torch.inf)
    slope_u = _slope(height, -1)
    slope_v = _slope(height, -2)
    normal_x = fx * slope_u
    normal_y = fy * slope_v
    if orthographic:
        cosine = 1.0 / (normal_x * normal_x + normal_y * normal_y + 1.0).sqrt()
    else:
        u = torch.arange(z.shape[-1], device=z.device, dtype=z.dtype) - K[:, 0, 2, None]
        v = torch.arange(z.shape[-2], device=z.device, dtype=z.dtype)[:, None] - K[:, 1, 2, None]
        normal_z = height - u * slope_u - v * slope_v
        length = (normal_x * normal_x + normal_y * normal_y + normal_z * normal_z).sqrt()
        # The product of the normal with the pixel's ray (u / fx, v / fy, 1) is the height.
        ray = ((u / fx).square() + (v / fy).square() + 1.0).sqrt()
        cosine = height / (ray * length)
    return torch.where(visible, AMBIENT + (LIT - AMBIENT) * cosine, 1.0).to(depth.dtype)


def _slope(s: Tensor, dim: int) -> Tensor:
    """Difference per px along ``dim`` to the neighbour nearer in depth; 0 if neither neighbour is
    on the surface."""
    step = s.diff(dim=dim).nan_to_num(torch.inf, torch.inf, torch.inf)  # inf beside the background
    edge = torch.full_like(s.narrow(dim, 0, 1), torch.inf)
    before = torch.cat([edge, step], dim)
    after = torch.cat([step, edge], dim)
    slope = torch.where(before.abs() < after.abs(), before, after)
    return torch.where(slope.isinf(), 0.0, slope)
