"""Apparent ridges (AR) of depth images."""

import torch
from torch import Tensor

from .blocks import Planes, in_blocks
from .curvilinear import along, check_depth, dominant_eigenvector, x_if_none
from .numerics import at_least_float32, safe_sqrt
from .shading import WithCamera, batched_camera, check_shading, normal_variation
from .suppression import is_ridge

__all__ = ["ApparentRidges", "apparent_ridges"]


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

    View-dependent curvature :math:`q_1` is the largest rate at which the surface's normal turns per step *on the
    screen*, the largest singular value of :math:`[N_x\ N_y]`; :math:`t_1` is the screen direction of that step.
    Apparent ridges are the maxima of :math:`q_1` along :math:`t_1`.

    What a depth image approximates: Judd et al. take curvature from the mesh and follow the zero crossings of
    :math:`D_{t_1} q_1` over its faces. Here N comes from finite differences of the smoothed depth; the drop to the
    background at an occluding contour, where the true :math:`q_1` is infinite, is a steep slope with a finite one;
    maxima are pixels, along :math:`t_1` rounded to 45 degrees; and the surface behind a contour is not seen.

    Args:
        depth, mask, camera_matrix, sigma, depth_scale: as in :func:`average_shading_gradient`.
        maxima: False keeps :math:`q_1` everywhere.

    Returns:
        (B, 2, H, W): length :math:`q_1` in 1/px (0 off the ridges), direction :math:`t_1`, sign free. dtype kept (half
        types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype, mask or option.

    Example:
        >>> x = (torch.arange(33.0) - 16).expand(1, 1, 33, 33)
        >>> roof = 10 + x.abs()
        >>> field = apparent_ridges(roof, sigma=1.0, depth_scale=1.0)
        >>> int(field[0, :, 16].norm(dim=0).argmax())                              # its edge
        16
    """
    width, scale = check_shading(sigma, depth_scale, camera_matrix)
    mask, camera = check_depth(depth, mask), batched_camera(camera_matrix, depth)

    def layer(depth: Tensor, mask: Tensor | None, camera: Tensor | None) -> Planes:
        a, b, c = normal_variation(depth, mask, camera, width, scale)
        vx, vy, half_gap = dominant_eigenvector(a, b, b, c)
        vx = x_if_none(vx, vy)
        curvature = safe_sqrt(0.5 * (a + c) + half_gap)
        if maxima:
            curvature = torch.where(is_ridge(curvature, vx, vy), curvature, 0.0)
        return along(curvature, vx, vy)

    return in_blocks(layer, at_least_float32(depth), mask, camera).to(depth.dtype)


class ApparentRidges(WithCamera):
    """Apparent ridges, as a layer; module twin of :func:`apparent_ridges`.

    Args:
        camera_matrix: (3, 3), (1, 3, 3) or (B, 3, 3), px; it moves with the module and keeps its dtype. None:
            orthographic.
        sigma: smoothing in px before differentiation, >= 0.
        depth_scale: of :func:`depth_curvilinear_saliency`; orthographic only.
        maxima: False keeps the view-dependent curvature everywhere.

    Shape:
        Input (B, 1, H, W) depth and, optionally, a mask that broadcasts to it; output (B, 2, H, W).

    Example:
        >>> import torch
        >>> roof = 10 + (torch.arange(33.0) - 16).abs().expand(1, 1, 33, 33)
        >>> int(ApparentRidges(depth_scale=1.0)(roof)[0, :, 16].norm(dim=0).argmax())
        16
    """

    def __init__(
        self,
        *,
        camera_matrix: Tensor | None = None,
        sigma: float = 1.0,
        depth_scale: float | None = None,
        maxima: bool = True,
    ) -> None:
        super().__init__(camera_matrix)
        check_shading(sigma, depth_scale, camera_matrix)
        self.sigma, self.depth_scale, self.maxima = sigma, depth_scale, maxima

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return apparent_ridges(
            depth,
            mask,
            camera_matrix=self.camera_matrix,
            sigma=self.sigma,
            depth_scale=self.depth_scale,
            maxima=self.maxima,
        )

    def extra_repr(self) -> str:
        camera = "orthographic" if self.camera_matrix is None else "perspective"
        return f"{camera}, sigma={self.sigma}, depth_scale={self.depth_scale}, maxima={self.maxima}"
