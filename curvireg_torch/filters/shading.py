"""Average shading gradient (ASG) and Hessian Frobenius norm (HFN) of depth images, which the paper compares with CS."""

import math
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_camera_matrix, check_same_device, check_tensor
from .blocks import Planes, apply_in_blocks
from .curvilinear import (
    BACKGROUND,
    check_depth,
    check_depth_scale,
    default_to_x,
    dominant_eigenvector,
    fill_depth,
    scaled_direction,
    visible_range,
)
from .derivatives import central_derivatives, smooth
from .learnable import OptionsModule, check_scalar
from .numerics import at_least_float32, is_host_readable, safe_sqrt


def average_shading_gradient(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    camera_matrix: Tensor | None = None,
    sigma: float | Tensor = 1.0,
    depth_scale: float | None = None,
) -> Tensor:
    r"""Average shading gradient (Plötz and Roth 2017; the paper's ``equ:PG:103``).

    :math:`\gamma\sqrt{|N_x|^2 + |N_y|^2}`, :math:`\gamma = \sqrt{\pi/3}`, where N is the unit normal of the observed
    surface: a bound on the gradient of a Lambertian image averaged over all light directions.

    Args:
        depth, mask, sigma: as in :func:`depth_curvilinear_saliency`.
        camera_matrix: (3, 3), (1, 3, 3) or (B, 3, 3) in px without skew: N is the normal of the surface seen by this
            perspective camera (``equ:PG:300``), for any unit of depth. None (orthographic): N is the normal of the
            graph of Z.
        depth_scale: of :func:`depth_curvilinear_saliency`; refused together with ``camera_matrix``.

    Returns:
        (B, 2, H, W): length ASG in 1/px, direction in which the normal changes fastest, with arbitrary sign.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(65.0) - 32, torch.arange(65.0) - 32, indexing="ij")
        >>> sphere = (100 - (60.0**2 - x**2 - y**2).sqrt())[None, None]
        >>> field = average_shading_gradient(sphere, sigma=0.0, depth_scale=1.0)
        >>> round(float(field[0, :, 32, 32].norm()) * 60 / (2 * torch.pi / 3) ** 0.5, 2)     # gamma sqrt(2) / radius
        1.0
    """
    sigma, scale = check_shading(sigma, depth_scale, camera_matrix)
    mask, camera = check_depth(depth, mask), batched_camera(camera_matrix, depth)

    def layer(depth: Tensor, mask: Tensor | None, camera: Tensor | None) -> Planes:
        a, b, c = normal_structure_tensor(depth, mask, camera, sigma, scale)
        vx, vy, _ = dominant_eigenvector(a, b, b, c)
        return scaled_direction(math.sqrt(math.pi / 3.0) * safe_sqrt(a + c), default_to_x(vx, vy), vy)

    return apply_in_blocks(layer, at_least_float32(depth), mask, camera).to(depth.dtype)


def check_shading(
    sigma: float | Tensor, depth_scale: float | None, camera_matrix: Tensor | None
) -> tuple[float | Tensor, float | None]:
    """Returns sigma and depth_scale."""
    if camera_matrix is not None:
        check_tensor(camera_matrix, "camera_matrix", (None,) * (camera_matrix.ndim == 3) + (3, 3))
        if is_host_readable(camera_matrix):
            check_camera_matrix(camera_matrix)
        if depth_scale is not None:
            raise InvalidInputError("depth_scale: has no meaning with a camera_matrix; leave one of them out")
    return check_scalar(sigma, "sigma", zero_ok=True), check_depth_scale(depth_scale)


def batched_camera(camera_matrix: Tensor | None, depth: Tensor) -> Tensor | None:
    """(B, 3, 3) in the dtype that ``depth`` is computed in; None stays None."""
    if camera_matrix is None:
        return None
    if camera_matrix.ndim == 2 or len(camera_matrix) == 1:
        camera_matrix = camera_matrix.expand(depth.shape[0], -1, -1)
    check_tensor(camera_matrix, "camera_matrix", (depth.shape[0], 3, 3))
    check_same_device(camera_matrix, depth, "camera_matrix")
    return camera_matrix.to(at_least_float32(depth).dtype)


def normal_structure_tensor(
    depth: Tensor, mask: Tensor | None, camera: Tensor | None, sigma: float | Tensor, depth_scale: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """N_x . N_x, N_x . N_y, N_y . N_y per px^2, each (B, 1, H, W), from the Hessian in closed form."""
    if camera is None:
        z = smooth(fill_depth(depth, mask, depth_scale), sigma, linear=True)
        zx, zy, zxx, zyy, zxy = central_derivatives(z)
        one, zero = torch.ones_like(zx), torch.zeros_like(zx)
        return _unit_vector_products((-zx, -zy, one), (-zxx, -zxy, zero), (-zxy, -zyy, zero))
    surface, near, span = visible_range(depth, mask)
    z = smooth(torch.minimum(surface, near + BACKGROUND * span) / span, sigma, linear=True)
    zx, zy, zxx, zyy, zxy = central_derivatives(z)
    z = z[..., 1:-1, 1:-1]
    H, W = z.shape[-2:]
    fx, fy, cx, cy = (camera[:, i, j].view(-1, 1, 1, 1) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x = torch.arange(W, device=z.device, dtype=z.dtype).view(1, 1, 1, W) - cx
    y = torch.arange(H, device=z.device, dtype=z.dtype).view(1, 1, H, 1) - cy
    # equ:PG:300 without its factor Z, per px. With (x, y) in px from the principal point, x Z_x has no focal length.
    normal = (-fx * zx, -fy * zy, x * zx + y * zy + z)
    normal_x = (-fx * zxx, -fy * zxy, x * zxx + y * zxy + 2.0 * zx)
    normal_y = (-fx * zxy, -fy * zyy, x * zxy + y * zyy + 2.0 * zy)
    return _unit_vector_products(normal, normal_x, normal_y)


Vector = tuple[Tensor, Tensor, Tensor]


def _unit_vector_products(normal: Vector, normal_x: Vector, normal_y: Vector) -> Vector:
    """Inner products of the derivatives of normal / |normal|, given the derivatives of ``normal``."""

    def dot(a: Vector, b: Vector) -> Tensor:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    def cross(a: Vector, b: Vector) -> Vector:
        return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]

    # The component of a derivative orthogonal to N has the length |N x derivative| / |N|; cross products cancel less
    # than projections.
    inverse = 1.0 / dot(normal, normal)
    tx, ty = cross(normal, normal_x), cross(normal, normal_y)
    factor = inverse * inverse
    return dot(tx, tx) * factor, dot(tx, ty) * factor, dot(ty, ty) * factor


def hessian_frobenius_norm(
    depth: Tensor, mask: Tensor | None = None, *, sigma: float | Tensor = 1.0, depth_scale: float | None = None
) -> Tensor:
    r"""Hessian Frobenius norm (HFN): :math:`\sqrt{Z_{xx}^2 + 2 Z_{xy}^2 + Z_{yy}^2}` of depth images.

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
    mask = check_depth(depth, mask)
    sigma, scale = check_shading(sigma, depth_scale, None)

    def layer(depth: Tensor, mask: Tensor | None) -> Planes:
        _, _, zxx, zyy, zxy = central_derivatives(smooth(fill_depth(depth, mask, scale), sigma, linear=True))
        vx, vy, _ = dominant_eigenvector(zxx, zxy, zxy, zyy)
        return scaled_direction(safe_sqrt(zxx * zxx + 2.0 * zxy * zxy + zyy * zyy), default_to_x(vx, vy), vy)

    return apply_in_blocks(layer, at_least_float32(depth), mask).to(depth.dtype)


class CameraModule(OptionsModule):
    """A module whose camera matrix moves between devices and keeps its dtype: ``.half()`` would round it."""

    camera_matrix: Tensor | None

    def __init__(self, camera_matrix: Tensor | None, **options: Any) -> None:
        super().__init__(**options)
        self.register_buffer("camera_matrix", camera_matrix, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        camera = self.camera_matrix
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if camera is not None and self.camera_matrix is not None:
            self.camera_matrix = camera.to(self.camera_matrix.device)
        return self

    def extra_repr(self) -> str:
        return f"{'orthographic' if self.camera_matrix is None else 'perspective'}, {super().extra_repr()}"


class AverageShadingGradient(CameraModule):
    """Module twin of :func:`average_shading_gradient`.

    Args:
        camera_matrix, sigma, depth_scale: as in the function; the camera keeps its dtype.

    Shape:
        Input (B, 1, H, W) depth and optionally a mask that broadcasts to it; output (B, 2, H, W).

    Example:
        >>> camera = torch.tensor([[50.0, 0.0, 15.5], [0.0, 50.0, 15.5], [0.0, 0.0, 1.0]])
        >>> wall = torch.full((1, 1, 32, 32), 3.0)
        >>> round(float(AverageShadingGradient(camera_matrix=camera)(wall).norm()), 3)
        0.0
    """

    def __init__(
        self, *, camera_matrix: Tensor | None = None, sigma: float = 1.0, depth_scale: float | None = None
    ) -> None:
        check_shading(sigma, depth_scale, camera_matrix)
        super().__init__(camera_matrix, sigma=sigma, depth_scale=depth_scale)

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return average_shading_gradient(depth, mask, camera_matrix=self.camera_matrix, **self.options)


class HessianFrobeniusNorm(OptionsModule):
    """Module twin of :func:`hessian_frobenius_norm`.

    Args:
        sigma, depth_scale: as in the function.

    Shape:
        Input (B, 1, H, W) depth and optionally a mask that broadcasts to it; output (B, 2, H, W).

    Example:
        >>> HessianFrobeniusNorm()(torch.ones(1, 1, 32, 32)).shape
        torch.Size([1, 2, 32, 32])
    """

    def __init__(self, *, sigma: float = 1.0, depth_scale: float | None = None) -> None:
        check_shading(sigma, depth_scale, None)
        super().__init__(sigma=sigma, depth_scale=depth_scale)

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return hessian_frobenius_norm(depth, mask, **self.options)
