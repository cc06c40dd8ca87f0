"""Views in the mesh's colours, shaded like grey views."""

from os import PathLike

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from ..mesh.colours import surface_colours
from ..mesh.mesh import as_mesh
from .factory import make_renderer
from .protocol import DepthRenderer, check_render_arguments
from .shading import shade

__all__ = ["render_colour"]

SUPERSAMPLING = 2
"""Samples per pixel and axis, because textures are finer than views."""


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
    """Pictures of a mesh in its colours before white: the colour times :func:`shade`, four samples per pixel.

    A mesh without colours (:func:`has_colours`) is white. So is every mesh with a renderer that does not report which
    face a pixel shows; only "embree" does. Arguments and errors are those of :func:`render_depth`.

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
