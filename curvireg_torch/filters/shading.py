"""Fields of depth images that the paper compares with CS: average shading gradient (ASG), Hessian
Frobenius norm (HFN), and apparent ridges (AR)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import (
    check_camera_matrix,
    check_image,
    check_last_axes,
    check_same_device,
    check_tensor,
)
from . import operations as ops
from .curvilinear import apply_to_depth, default_to_x, dominant_eigenvector, scaled_direction
from .modules import DepthModule


def average_shading_gradient(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    camera_matrix: Tensor | None = None,
    sigma: float | Tensor = 1.0,
    depth_scale: float | None = None,
) -> Tensor:
    r"""Average shading gradient (Plötz and Roth 2017; the paper's ``equ:PG:103``).

    :math:`\gamma\sqrt{|N_x|^2 + |N_y|^2}`, :math:`\gamma = \sqrt{\pi/3}`, where N is the unit
    normal of the observed surface: a bound on the gradient of a Lambertian image averaged over all
    light directions.

    Args:
        depth, mask, sigma: as in :func:`depth_curvilinear_saliency`.
        camera_matrix: (3, 3), (1, 3, 3) or (B, 3, 3) in px without skew: N is the normal of the
            surface seen by this perspective camera (``equ:PG:300``), for any unit of depth. None
            (orthographic): N is the normal of the graph of Z.
        depth_scale: of :func:`depth_curvilinear_saliency`; refused together with ``camera_matrix``.

    Returns:
        (B, 2, H, W): length ASG in 1/px, direction in which the normal changes fastest, with
        arbitrary sign.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(65.0) - 32, torch.arange(65.0) - 32, indexing="ij")
        >>> sphere = (100 - (60.0**2 - x**2 - y**2).sqrt())[None, None]
        >>> field = average_shading_gradient(sphere, sigma=0.0, depth_scale=1.0)
        >>> # gamma sqrt(2) / radius
        >>> round(float(field[0, :, 32, 32].norm()) * 60 / (2 * torch.pi / 3) ** 0.5, 2)
        1.0
    """

    def length(trace: Tensor, *_: Tensor) -> Tensor:
        return math.sqrt(math.pi / 3.0) * ops.safe_sqrt(trace)

    return _field_of_normals(depth, mask, camera_matrix, sigma, depth_scale, length)


def _field_of_normals(
    depth: Tensor,
    mask: Tensor | None,
    camera_matrix: Tensor | None,
    sigma: float | Tensor,
    depth_scale: float | None,
    length: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
) -> Tensor:
    """Vectors along which the normal changes fastest, of a length that follows from the trace and
    half the eigenvalue difference of its structure tensor, and from the direction (vx, vy)."""
    if camera_matrix is not None:
        check_image(depth, "depth")
        check_last_axes(camera_matrix, "camera_matrix", (3, 3))
        if camera_matrix.shape[:-2] in ((), (1,)):
            camera_matrix = camera_matrix.expand(depth.shape[0], -1, -1)
        check_tensor(camera_matrix, "camera_matrix", (depth.shape[0], 3, 3))
        check_same_device(camera_matrix, depth, "camera_matrix")
        if ops.is_host_readable(camera_matrix):
            check_camera_matrix(camera_matrix)
        if depth_scale is not None:
            raise InvalidInputError(
                "depth_scale: has no meaning with a camera_matrix; leave one of them out"
            )
        camera_matrix = camera_matrix.to(ops.at_least_float32(depth).dtype)

    def layer(z: Tensor, camera: Tensor | None = None) -> ops.Planes:
        a, b, c = _normal_structure_tensor(z, camera)
        vx, vy, half_gap = dominant_eigenvector(a, b, b, c)
        vx = default_to_x(vx, vy)
        return scaled_direction(length(a + c, half_gap, vx, vy), vx, vy)

    return apply_to_depth(layer, depth, mask, sigma, depth_scale, camera_matrix)


def _normal_structure_tensor(z: Tensor, camera: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """N_x . N_x, N_x . N_y, N_y . N_y per px^2, each (B, 1, H, W), from the Hessian in closed form;
    ``z`` has a margin of 1 px."""
    zx, zy, zxx, zyy, zxy = ops.central_derivatives(z)
    if camera is None:
        one = torch.ones_like(zx)
        zero = torch.zeros_like(zx)
        return _unit_vector_products((-zx, -zy, one), (-zxx, -zxy, zero), (-zxy, -zyy, zero))
    z = z[..., 1:-1, 1:-1]
    H, W = z.shape[-2:]
    fx, fy, cx, cy = (
        camera[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))
    )
    x = torch.arange(W, device=z.device, dtype=z.dtype).view(1, 1, 1, W) - cx
    y = torch.arange(H, device=z.device, dtype=z.dtype).view(1, 1, H, 1) - cy
    # equ:PG:300 without its factor Z, per px. With (x, y) in px from the principal point, x Z_x has
    # no focal length.
    normal = (-fx * zx, -fy * zy, x * zx + y * zy + z)
    normal_x = (-fx * zxx, -fy * zxy, x * zxx + y * zxy + 2.0 * zx)
    normal_y = (-fx * zxy, -fy * zyy, x * zxy + y * zyy + 2.0 * zy)
    return _unit_vector_products(normal, normal_x, normal_y)


Vector = tuple[Tensor, Tensor, Tensor]


def _unit_vector_products(normal: Vector, normal_x: Vector, normal_y: Vector) -> Vector:
    """Inner products of the derivatives of normal / |normal|, given the derivatives of
    ``normal``."""

    def dot(a: Vector, b: Vector) -> Tensor:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def cross(a: Vector, b: Vector) -> Vector:
        return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]

    # The component of a derivative orthogonal to N has the length |N x derivative| / |N|; cross
    # products cancel less than projections.
    inverse = 1.0 / dot(normal, normal)
    tx = cross(normal, normal_x)
    ty = cross(normal, normal_y)
    factor = inverse * inverse
    return dot(tx, tx) * factor, dot(tx, ty) * factor, dot(ty, ty) * factor


def hessian_frobenius_norm(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    sigma: float | Tensor = 1.0,
    depth_scale: float | None = None,
) -> Tensor:
    r"""Hessian Frobenius norm (HFN): :math:`\sqrt{Z_{xx}^2 + 2 Z_{xy}^2 + Z_{yy}^2}` of depth
    images.

    Args:
        depth, mask, sigma, depth_scale: as in :func:`depth_curvilinear_saliency`.

    Returns:
        (B, 2, H, W): length HFN, direction of the largest second derivative, with arbitrary sign.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(33.0) - 16, torch.arange(33.0) - 16, indexing="ij")
        >>> bowl = (1 + 0.5 * x**2)[None, None]
        >>> hessian_frobenius_norm(bowl, sigma=0.0, depth_scale=1.0)[0, :, 16, 16].tolist()
        [1.0, 0.0]
    """

    def layer(z: Tensor) -> ops.Planes:
        _, _, zxx, zyy, zxy = ops.central_derivatives(z)
        vx, vy, _ = dominant_eigenvector(zxx, zxy, zxy, zyy)
        return scaled_direction(
            ops.safe_sqrt(zxx * zxx + 2.0 * zxy * zxy + zyy * zyy), default_to_x(vx, vy), vy
        )

    return apply_to_depth(layer, depth, mask, sigma, depth_scale)


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

    View-dependent curvature :math:`q_1` is the largest rate of change of the surface normal per
    step *on the screen*, the largest singular value of :math:`[N_x\ N_y]`; :math:`t_1` is the
    screen direction of that step. Apparent ridges are the maxima of :math:`q_1` along :math:`t_1`:
    here pixels, with :math:`t_1` rounded to 45 degrees and N from the smoothed depth, in place of
    zero crossings over the mesh's faces.

    Args:
        depth, mask, camera_matrix, sigma, depth_scale: as in :func:`average_shading_gradient`.
        maxima: False returns :math:`q_1` at all pixels.

    Returns:
        (B, 2, H, W): length :math:`q_1` in 1/px (0 off the ridges), direction :math:`t_1` with
        arbitrary sign.

    Example:
        >>> roof = 10 + (torch.arange(33.0) - 16).abs().expand(1, 1, 33, 33)
        >>> int(apparent_ridges(roof, depth_scale=1.0)[0, :, 16].norm(dim=0).argmax())  # its edge
        16
    """

    def length(trace: Tensor, half_gap: Tensor, vx: Tensor, vy: Tensor) -> Tensor:
        curvature = ops.safe_sqrt(0.5 * trace + half_gap)
        return (
            torch.where(ops.is_directional_maximum(curvature, vx, vy), curvature, 0.0)
            if maxima
            else curvature
        )

    return _field_of_normals(depth, mask, camera_matrix, sigma, depth_scale, length)


class AverageShadingGradient(DepthModule, function=average_shading_gradient):
    """Module twin of :func:`average_shading_gradient`."""

    def __init__(
        self,
        *,
        camera_matrix: Tensor | None = None,
        sigma: float = 1.0,
        depth_scale: float | None = None,
    ) -> None: ...


class HessianFrobeniusNorm(DepthModule, function=hessian_frobenius_norm):
    """Module twin of :func:`hessian_frobenius_norm`."""

    def __init__(self, *, sigma: float = 1.0, depth_scale: float | None = None) -> None: ...


class ApparentRidges(DepthModule, function=apparent_ridges):
    """Module twin of :func:`apparent_ridges`."""

    def __init__(
        self,
        *,
        camera_matrix: Tensor | None = None,
        sigma: float = 1.0,
        depth_scale: float | None = None,
        maxima: bool = True,
    ) -> None: ...
