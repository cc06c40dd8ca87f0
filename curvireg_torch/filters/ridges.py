"""Apparent ridges (AR) of depth images."""

import torch
from torch import Tensor

from .blocks import Planes, apply_in_blocks
from .curvilinear import check_depth, default_to_x, dominant_eigenvector, scaled_direction
from .numerics import at_least_float32, safe_sqrt
from .shading import CameraModule, batched_camera, check_shading, normal_structure_tensor
from .suppression import is_directional_maximum


def apparent_ridges(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    camera_matrix: Tensor | None = None,
    sigma: float | Tensor = 1.0,
    depth_scale: float | None = None,
    maxima: bool = True,
) -> Tensor:
    r"""Apparent ridges (Judd, Durand and Adelson 2007): maxima of view-dependent curvature.

    View-dependent curvature :math:`q_1` is the largest rate of change of the surface normal per step *on the screen*,
    the largest singular value of :math:`[N_x\ N_y]`; :math:`t_1` is the screen direction of that step. Apparent ridges
    are the maxima of :math:`q_1` along :math:`t_1`.

    This is an approximation: Judd et al. follow the zero crossings of :math:`D_{t_1} q_1` over the faces of the mesh.
    Here N comes from finite differences of the smoothed depth, so :math:`q_1` is finite at an occluding contour; maxima
    are pixels, along :math:`t_1` rounded to 45 degrees.

    Args:
        depth, mask, camera_matrix, sigma, depth_scale: as in :func:`average_shading_gradient`.
        maxima: False returns :math:`q_1` at all pixels.

    Returns:
        (B, 2, H, W): length :math:`q_1` in 1/px (0 off the ridges), direction :math:`t_1` with arbitrary sign.

    Example:
        >>> x = (torch.arange(33.0) - 16).expand(1, 1, 33, 33)
        >>> roof = 10 + x.abs()
        >>> field = apparent_ridges(roof, sigma=1.0, depth_scale=1.0)
        >>> int(field[0, :, 16].norm(dim=0).argmax())                              # its edge
        16
    """
    sigma, scale = check_shading(sigma, depth_scale, camera_matrix)
    mask, camera = check_depth(depth, mask), batched_camera(camera_matrix, depth)

    def layer(depth: Tensor, mask: Tensor | None, camera: Tensor | None) -> Planes:
        a, b, c = normal_structure_tensor(depth, mask, camera, sigma, scale)
        vx, vy, half_gap = dominant_eigenvector(a, b, b, c)
        vx = default_to_x(vx, vy)
        curvature = safe_sqrt(0.5 * (a + c) + half_gap)
        if maxima:
            curvature = torch.where(is_directional_maximum(curvature, vx, vy), curvature, 0.0)
        return scaled_direction(curvature, vx, vy)

    return apply_in_blocks(layer, at_least_float32(depth), mask, camera).to(depth.dtype)


class ApparentRidges(CameraModule):
    """Module twin of :func:`apparent_ridges`.

    Args:
        camera_matrix, sigma, depth_scale, maxima: as in the function; the camera keeps its dtype.

    Shape:
        Input (B, 1, H, W) depth and optionally a mask that broadcasts to it; output (B, 2, H, W).

    Example:
        >>> ApparentRidges(depth_scale=1.0)(torch.rand(1, 1, 32, 32)).shape
        torch.Size([1, 2, 32, 32])
    """

    def __init__(
        self,
        *,
        camera_matrix: Tensor | None = None,
        sigma: float = 1.0,
        depth_scale: float | None = None,
        maxima: bool = True,
    ) -> None:
        check_shading(sigma, depth_scale, camera_matrix)
        super().__init__(camera_matrix, sigma=sigma, depth_scale=depth_scale, maxima=maxima)

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return apparent_ridges(depth, mask, camera_matrix=self.camera_matrix, **self.options)
