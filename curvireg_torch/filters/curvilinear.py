"""Curvilinear saliency of depth (the paper's contribution 1); gradient, curvilinear saliency and
PCI of photographs."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import (
    check_image,
    check_option,
    check_positive,
    check_same_device,
    type_and_shape,
)
from . import operations as ops
from .modules import DepthModule, FunctionModule

FORMULAS = ("geometric", "paper", "paper-length")
# of missing pixels behind the nearest visible point, in units of the visible depth range
BACKGROUND_DEPTH = 1.25
# of visible depths, relative to the largest; below it (8 ulp of float32) they are rounding
MIN_RELATIVE_RANGE = 1e-6


def _visible_range(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Depth with missing pixels at the largest number; nearest depth and depth range of each image,
    (B, 1, 1, 1). Missing pixels are 0, negative, inf or NaN. For a range of rounding, which must
    not be stretched, the largest depth is returned instead. The range of an empty image is 1."""
    clean = depth.nan_to_num(0.0, 0.0, 0.0)
    far = clean.amax(dim=(1, 2, 3), keepdim=True)
    visible = far > 0
    surface = F.threshold(clean, 0.0, torch.finfo(depth.dtype).max)
    near = torch.where(visible, surface.amin(dim=(1, 2, 3), keepdim=True), 1.0)
    span = far - near
    return (
        surface,
        near,
        torch.where(span > MIN_RELATIVE_RANGE * far, span, torch.where(visible, far, 1.0)),
    )


def apply_to_depth(
    layer: Callable[..., ops.Planes],
    depth: Tensor,
    mask: Tensor | None,
    sigma: float | Tensor,
    depth_scale: float | None,
    camera_matrix: Tensor | None = None,
) -> Tensor:
    """Apply ``layer`` to smoothed surfaces, enlarged by 1 px, in which missing pixels lie
    ``BACKGROUND_DEPTH`` depth ranges behind the nearest visible point. They are graph surfaces with
    this point at 0; with cameras (B, 3, 3), which the layer then gets too, they keep their distance
    and are in units of the depth range."""
    check_image(depth, "depth")
    scale = None if depth_scale is None else check_positive(depth_scale, "depth_scale")
    checked_sigma = ops.check_scalar(sigma, "sigma", zero_ok=True)
    seen = ops.at_least_float32(depth)
    if mask is not None:
        is_mask = isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.ndim <= 4
        if not is_mask or any(
            m not in (1, n) for m, n in zip(mask.shape[::-1], depth.shape[::-1], strict=False)
        ):
            raise InvalidInputError(
                f"mask: expected bool of shape {tuple(depth.shape)}, got {type_and_shape(mask)}"
            )
        check_same_device(mask, depth, "mask")
        seen = torch.where(mask, seen, 0.0)

    def on_surface(depth: Tensor, *cameras: Tensor) -> ops.Planes:
        surface, near, span = _visible_range(depth)
        if cameras:
            z = torch.minimum(surface, near + BACKGROUND_DEPTH * span) / span
        else:
            z = torch.minimum(surface - near, BACKGROUND_DEPTH * span).mul_(
                1.0 / span if scale is None else scale
            )
        return layer(ops.smooth(z, checked_sigma, linear=True), *cameras)

    cameras = () if camera_matrix is None else (camera_matrix,)
    return ops.apply_in_blocks(on_surface, seen, *cameras).to(depth.dtype)


def depth_curvilinear_saliency(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    sigma: float | Tensor = 1.0,
    formula: str = "geometric",
    depth_scale: float | None = None,
) -> Tensor:
    r"""Curvilinear saliency (CS) of depth images: the difference of the principal curvatures of the
    graph of Z.

    With :math:`M = \mathrm{adj}(I_P) H_Z` (the paper's ``equ:PG:007``) and
    :math:`\alpha = 1/\sqrt{1+|\nabla Z|^2}`

    - ``"geometric"``: :math:`\kappa_1-\kappa_2 = \alpha^3 \sqrt{\mathrm{tr}(M)^2 - 4\det M}`
      (``equ:PG:101``; the paper prints :math:`I^{-1}II = M/\alpha`, it is :math:`\alpha^3 M`);
    - ``"paper"``: :math:`|\nabla Z| \sqrt{\mathrm{tr}(M)^2 - 4\det M}` (``lambdasD``).

    The vector is parallel to the eigenvector of M whose eigenvalue is largest in absolute value;
    its sign is arbitrary. That of ``"paper"`` belongs to the largest eigenvalue, as printed there,
    which ranks views worse (``docs/paper.md``); ``"paper-length"`` has the paper's length in the
    direction of ``"geometric"``.

    Args:
        depth: (B, 1, H, W) z-depth in any unit. 0, negative, inf and NaN are background.
        mask: bool, False = background; (B, 1, H, W) or broadcastable to it.
        sigma: smoothing in px before differentiation, >= 0.
        formula: ``"geometric"``, ``"paper"`` or ``"paper-length"``.
        depth_scale: None rescales each image's visible depth range to 1, so that vectors point
            across occluding contours (a range of at most 1e-6 of the largest depth counts as
            rounding); a number multiplies the depth (1 with depth in px gives curvature in 1/px).

    Returns:
        (B, 2, H, W) vector field, finite at missing pixels too; its length is CS >= 0.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(65.0) - 32, torch.arange(65.0) - 32, indexing="ij")
        >>> cylinder = (100 - (40.0**2 - x**2).sqrt())[None, None]
        >>> field = depth_curvilinear_saliency(cylinder, sigma=0.0, depth_scale=1.0)
        >>> round(float(field[0, :, 32, 32].norm()) * 40, 2)                          # 1 / radius
        1.0
    """
    check_option(formula, FORMULAS, "formula")

    def layer(z: Tensor) -> ops.Planes:
        factor, m11, m12, m21, m22 = _shape_operator(z, formula)
        sign = 1.0 if formula == "paper" else None
        vx, vy, half_gap = dominant_eigenvector(m11, m12, m21, m22, sign)
        return scaled_direction(factor.mul_(half_gap), vx, vy)

    return apply_to_depth(layer, depth, mask, sigma, depth_scale)


def _shape_operator(z: Tensor, formula: str) -> ops.Planes:
    """Ratio of CS to half the eigenvalue difference of M, and M row by row; z has a margin of 1
    px."""
    zx, zy, zxx, zyy, zxy = ops.central_derivatives(z)
    # M = adj(I_P) H_Z = H_Z + (z_y, -z_x)^T (u, -v).
    u = (zy * zxx).addcmul_(zx, zxy, value=-1)
    v = (zx * zyy).addcmul_(zy, zxy, value=-1)
    m11 = torch.addcmul(zxx, zy, u)
    m12 = torch.addcmul(zxy, zy, v, value=-1)
    m21 = torch.addcmul(zxy, zx, u, value=-1)
    m22 = torch.addcmul(zyy, zx, v)
    if formula != "geometric":
        return ops.safe_sqrt(ops.squared_length(zx, zy)).mul_(2.0), m11, m12, m21, m22
    # 2 alpha^3 = (c + c |grad Z|^2)^(-3/2)
    c = 2.0 ** (-2.0 / 3.0)
    metric = torch.addcmul(z.new_full((), c), zx, zx, value=c).addcmul_(zy, zy, value=c)
    return metric.rsqrt_().pow(3), m11, m12, m21, m22


def dominant_eigenvector(
    m11: Tensor, m12: Tensor, m21: Tensor, m22: Tensor, sign: float | Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvector (vx, vy), of any length, of [[m11, m12], [m21, m22]], and half the difference of
    its eigenvalues. Its eigenvalue is the largest in absolute value, or with ``sign=1`` the
    largest; it is 0 for a multiple of I."""
    gap = m11 - m22
    # tr^2 / 4 - det in a form without cancellation.
    half_gap = ops.safe_sqrt((m12 * m21).addcmul_(gap, gap, value=0.25))
    # (s half_gap + gap / 2, m21) and (m12, s half_gap - gap / 2), where s is the sign, are both
    # eigenvectors. Take the one without cancellation, by arithmetic, since torch.where with an
    # unpredictable mask is slow.
    sign = (m11 + m22).ge_(0.0).mul_(2.0).sub_(1.0) if sign is None else sign
    diagonal = gap.abs().mul_(0.5).add_(half_gap).mul_(sign)
    first = (gap * sign).ge_(0.0)
    return torch.lerp(m12, diagonal, first), torch.lerp(diagonal, m21, first), half_gap


def scaled_direction(length: Tensor, vx: Tensor, vy: Tensor) -> ops.Planes:
    """Vectors parallel to (vx, vy) with the given length, as planes; 0 where (vx, vy) is 0."""
    squared = ops.squared_length(vx, vy)
    scale = squared.clamp_(min=ops.safe_eps(squared)).rsqrt_() * length
    return vx * scale, vy * scale


def default_to_x(vx: Tensor, vy: Tensor) -> Tensor:
    """vx, replaced by 1 where (vx, vy) is numerically 0 and the direction is arbitrary."""
    squared = ops.squared_length(vx, vy)
    return torch.where(squared <= ops.safe_eps(squared), 1.0, vx)


def image_gradient(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    r"""Gradient of the Gaussian-smoothed image by central differences, the paper's IG.

    A step edge of contrast A and blur s across the unit vector n has
    :math:`A/\sqrt{2\pi(s^2 + \sigma^2 + v)}` on its line, where :math:`v = \frac13(n_x^4 + n_y^4)`
    is the variance of the differences: 1/3 along an axis, 1/6 at 45 degrees.

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1], or (B, 3, H, W) RGB. Missing (NaN)
            pixels give 0.
        sigma: smoothing in px before differentiation, >= 0.

    Returns:
        (B, 2, H, W) grey levels per px; channel 0 = x, 1 = y.

    Example:
        >>> ramp = torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_gradient(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [1.0, 0.0]
    """
    checked_sigma = ops.check_scalar(sigma, "sigma", zero_ok=True)
    return ops.apply_to_photograph(
        lambda x, _: ops.central_gradient(ops.smooth(x, checked_sigma)), image
    )


def image_curvilinear_saliency(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    r"""Curvilinear saliency of a photograph, :math:`\mu_1-\mu_2 = |\nabla I|^2` (the paper's
    ``equ:PG:004``).

    Args:
        image, sigma: as in :func:`image_gradient`.

    Returns:
        (B, 2, H, W): length :math:`|\nabla I|^2`, direction of the gradient.

    Example:
        >>> ramp = 3 * torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_curvilinear_saliency(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [9.0, 0.0]
    """
    checked_sigma = ops.check_scalar(sigma, "sigma", zero_ok=True)

    def layer(x: Tensor, _: Tensor | None) -> ops.Planes:
        gx, gy = ops.central_gradient(ops.smooth(x, checked_sigma))
        length = ops.safe_sqrt(ops.squared_length(gx, gy))
        return gx * length, gy * length

    return ops.apply_to_photograph(layer, image)


def principal_curvature_image(
    image: Tensor, *, sigmas: Sequence[float] = (1.0, 1.4, 2.0, 2.8, 4.0)
) -> Tensor:
    r"""Principal curvature image (Deng et al. 2007): lines and the sides of edges, over scales.

    :math:`\max_\sigma \sigma^2 \max(\lambda, 0)` with :math:`\lambda` the largest eigenvalue of the
    Hessian of the image smoothed by :math:`\sigma`: dark lines and the dark side of edges. Bright
    ones are those of the negated image.

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1], or (B, 3, H, W) RGB. Missing (NaN)
            pixels give 0.
        sigmas: scales in px, > 0.

    Returns:
        (B, 2, H, W): the length is the curvature >= 0 in grey levels, the direction is across the
        line at the scale of the maximum, with arbitrary sign.

    Example:
        >>> # dark, along y
        >>> line = (torch.arange(33.0) - 16).abs().clamp(max=1).expand(1, 1, 33, 33)
        >>> int(principal_curvature_image(line)[0, 0, 16].abs().argmax())
        16
    """
    scales = ops.check_sigmas(sigmas, "sigmas")

    def layer(image: Tensor, _: Tensor | None) -> ops.Planes:
        best = vx = vy = torch.zeros_like(image)
        for sigma in scales:
            xx, yy, xy = (
                sigma**2 * h for h in ops.central_derivatives(ops.smooth(image, sigma))[2:]
            )
            x, y, half_gap = dominant_eigenvector(xx, xy, xy, yy, sign=1.0)
            curvature = 0.5 * (xx + yy) + half_gap
            better = (curvature > best).to(best.dtype)
            best = torch.maximum(best, curvature)
            vx = torch.lerp(vx, x, better)
            vy = torch.lerp(vy, y, better)
        # a round blob has no unique direction
        return scaled_direction(best, default_to_x(vx, vy), vy)

    return ops.apply_to_photograph(layer, image)


class ImageGradient(FunctionModule, function=image_gradient, learnable=("sigma",)):
    """Module twin of :func:`image_gradient`."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None: ...


class ImageCurvilinearSaliency(
    FunctionModule, function=image_curvilinear_saliency, learnable=("sigma",)
):
    """Module twin of :func:`image_curvilinear_saliency`."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None: ...


class DepthCurvilinearSaliency(
    DepthModule, function=depth_curvilinear_saliency, learnable=("sigma",)
):
    """Module twin of :func:`depth_curvilinear_saliency`."""

    def __init__(
        self,
        *,
        sigma: float = 1.0,
        formula: str = "geometric",
        depth_scale: float | None = None,
        learnable: bool = False,
    ) -> None: ...


class PrincipalCurvatureImage(FunctionModule, function=principal_curvature_image):
    """Module twin of :func:`principal_curvature_image`."""

    def __init__(self, *, sigmas: Sequence[float] = (1.0, 1.4, 2.0, 2.8, 4.0)) -> None: ...
