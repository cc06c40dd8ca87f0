"""Curvilinear saliency of depth images (the paper's contribution 1) and of photographs."""

import torch
from torch import Tensor, nn

from .._checks import check_image, check_mask, check_option, check_positive
from .derivatives import at_least_float32, central_gradient, central_hessian, gaussian_smooth, image_gradient, safe_sqrt

__all__ = [
    "DepthCurvilinearSaliency",
    "ImageCurvilinearSaliency",
    "depth_curvilinear_saliency",
    "image_curvilinear_saliency",
]

BACKGROUND = 1.25
"""Depth given to missing pixels, in units of the visible depth range behind the nearest visible point."""

FORMULAS = ("geometric", "paper")


def fill_depth(depth: Tensor, mask: Tensor | None, depth_scale: float | None) -> Tensor:
    """Depth as a graph surface over the image: nearest visible point at 0, missing pixels at ``BACKGROUND`` ranges.

    Missing is 0 or negative, inf, NaN, or outside ``mask``. With ``depth_scale=None`` the visible range becomes 1;
    a number multiplies the depth instead. An image with no visible pixel becomes a constant.
    """
    visible = torch.isfinite(depth) & (depth > 0)
    if mask is not None:
        visible = visible & mask
    clean = torch.where(visible, depth, torch.zeros_like(depth))
    largest = torch.finfo(depth.dtype).max
    near = torch.where(visible, clean, torch.full_like(depth, largest)).amin(dim=(1, 2, 3), keepdim=True)
    span = clean.amax(dim=(1, 2, 3), keepdim=True) - near
    # A fronto-parallel plane has no range of its own, an empty image not even a depth.
    span = torch.where(span > 0, span, torch.ones_like(span))
    scale = 1.0 / span if depth_scale is None else torch.full_like(span, depth_scale)
    return torch.where(visible, (clean - near) * scale, BACKGROUND * span * scale)


def depth_curvilinear_saliency(
    depth: Tensor,
    mask: Tensor | None = None,
    *,
    sigma: float | Tensor = 1.0,
    formula: str = "geometric",
    depth_scale: float | None = None,
) -> Tensor:
    r"""Curvilinear saliency (CS) of depth images: the difference of the principal curvatures of the graph of Z.

    With :math:`M = \mathrm{adj}(I_P) H_Z` (the paper's ``equ:PG:007``) and :math:`\alpha = 1/\sqrt{1+|\nabla Z|^2}`

    - ``"geometric"``: :math:`\kappa_1-\kappa_2 = \alpha^3 \sqrt{\mathrm{tr}(M)^2 - 4\det M}` (``equ:PG:101``; the paper
      prints :math:`I^{-1}II = M/\alpha`, it is :math:`\alpha^3 M`);
    - ``"paper"``: :math:`|\nabla Z| \sqrt{\mathrm{tr}(M)^2 - 4\det M}` (``lambdasD``).

    The vector's direction is the eigenvector of M whose eigenvalue is largest in absolute value, sign free.

    Args:
        depth: (B, 1, H, W) z-depth in any unit. 0, negative, inf and NaN are background.
        mask: (B, 1, H, W) bool, False = background; optional.
        sigma: smoothing in px before differentiation, >= 0.
        formula: ``"geometric"`` or ``"paper"``.
        depth_scale: None rescales each image's visible depth range to 1, so that the vector points across occluding
            contours; a number multiplies the depth (1 with depth in px gives curvature in 1/px).

    Returns:
        (B, 2, H, W) vector field, finite everywhere; its length is CS >= 0. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype, mask or option.

    Example:
        >>> y, x = torch.meshgrid(torch.arange(65.0) - 32, torch.arange(65.0) - 32, indexing="ij")
        >>> cylinder = (100 - (40.0**2 - x**2).sqrt())[None, None]
        >>> field = depth_curvilinear_saliency(cylinder, sigma=0.0, depth_scale=1.0)
        >>> round(float(field[0, :, 32, 32].norm()) * 40, 2)                          # 1 / radius
        1.0
    """
    check_image(depth, "depth")
    check_option(formula, FORMULAS, "formula")
    if mask is not None:
        check_mask(mask, depth)
    if depth_scale is not None:
        check_positive(depth_scale, "depth_scale")
    z = gaussian_smooth(fill_depth(at_least_float32(depth), mask, depth_scale), sigma)
    zx, zy = central_gradient(z)
    zxx, zyy, zxy = central_hessian(z)
    squared_gradient = zx * zx + zy * zy
    m11 = (zy * zy + 1.0) * zxx - zx * zy * zxy
    m12 = (zy * zy + 1.0) * zxy - zx * zy * zyy
    m21 = (zx * zx + 1.0) * zxy - zx * zy * zxx
    m22 = (zx * zx + 1.0) * zyy - zx * zy * zxy
    # tr^2 - 4 det, in the form that does not cancel.
    root = safe_sqrt((m11 - m22) ** 2 + 4.0 * m12 * m21)
    factor = (1.0 + squared_gradient) ** -1.5 if formula == "geometric" else safe_sqrt(squared_gradient)
    return (factor * root * _dominant_eigenvector(m11, m12, m21, m22, root)).to(depth.dtype)


def _dominant_eigenvector(m11: Tensor, m12: Tensor, m21: Tensor, m22: Tensor, root: Tensor) -> Tensor:
    """Unit eigenvector of [[m11, m12], [m21, m22]] to the eigenvalue largest in absolute value; 0 where there is none."""
    trace = m11 + m22
    # (lambda - m22, m21) and (m12, lambda - m11) are both eigenvectors: take the one that does not cancel.
    half_gap = 0.5 * (m11 - m22)
    signed = torch.where(trace >= 0, 0.5 * root, -0.5 * root)
    first = (half_gap * signed) >= 0
    vx = torch.where(first, half_gap + signed, m12)
    vy = torch.where(first, m21, signed - half_gap)
    return unit_vector(vx, vy)


def unit_vector(vx: Tensor, vy: Tensor) -> Tensor:
    """(B, 2, H, W) unit vectors along (vx, vy), each (B, 1, H, W); the zero vector stays zero, with zero gradient."""
    # Scaling by the larger component first keeps squares of tiny vectors from underflowing.
    largest = torch.maximum(vx.abs(), vy.abs())
    nonzero = largest > 0
    safe = torch.where(nonzero, largest, torch.ones_like(largest)).detach()
    ux, uy = vx / safe, vy / safe
    squared = torch.where(nonzero, ux * ux + uy * uy, torch.ones_like(ux))
    return torch.cat([ux, uy], dim=1) * squared.rsqrt()


def image_curvilinear_saliency(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    r"""Curvilinear saliency of a photograph, :math:`\mu_1-\mu_2 = |\nabla I|^2` (the paper's ``equ:PG:004``).

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1].
        sigma: smoothing in px before differentiation, >= 0.

    Returns:
        (B, 2, H, W): length :math:`|\nabla I|^2`, direction of the gradient. dtype kept.

    Raises:
        InvalidInputError: wrong shape, dtype or sigma.

    Example:
        >>> ramp = 3 * torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_curvilinear_saliency(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [9.0, 0.0]
    """
    gradient = image_gradient(at_least_float32(image), sigma=sigma)
    length = safe_sqrt(gradient.square().sum(dim=1, keepdim=True))
    return (length * gradient).to(image.dtype)


class DepthCurvilinearSaliency(nn.Module):
    """Module twin of :func:`depth_curvilinear_saliency`."""

    def __init__(self, *, sigma: float = 1.0, formula: str = "geometric", depth_scale: float | None = None) -> None:
        super().__init__()
        check_option(formula, FORMULAS, "formula")
        self.sigma, self.formula, self.depth_scale = sigma, formula, depth_scale

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return depth_curvilinear_saliency(
            depth, mask, sigma=self.sigma, formula=self.formula, depth_scale=self.depth_scale
        )

    def extra_repr(self) -> str:
        return f"sigma={self.sigma}, formula={self.formula!r}, depth_scale={self.depth_scale}"


class ImageCurvilinearSaliency(nn.Module):
    """Module twin of :func:`image_curvilinear_saliency`."""

    def __init__(self, *, sigma: float = 1.0) -> None:
        super().__init__()
        self.sigma = sigma

    def forward(self, image: Tensor) -> Tensor:
        return image_curvilinear_saliency(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={self.sigma}"
