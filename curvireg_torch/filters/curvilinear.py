"""Curvilinear saliency of depth images (the paper's contribution 1) and of photographs."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .._checks import check_image, check_mask, check_option, check_positive
from .derivatives import at_least_float32, gaussian_smooth, image_gradient, in_blocks, replicate_pad, safe_sqrt
from .learnable import as_number, parameter_if

__all__ = [
    "DepthCurvilinearSaliency",
    "ImageCurvilinearSaliency",
    "depth_curvilinear_saliency",
    "image_curvilinear_saliency",
]

BACKGROUND = 1.25
"""Depth given to missing pixels, in units of the visible depth range behind the nearest visible point."""

FORMULAS = ("geometric", "paper")


def visible_range(depth: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Visible pixels (bool), depth with 0 elsewhere, and each image's nearest depth and range, (B, 1, 1, 1).

    Missing is 0 or negative, inf, NaN, or outside ``mask``. A range of zero counts as 1.
    """
    visible = (depth > 0) & (depth < math.inf)  # false for NaN
    if mask is not None:
        visible = visible & mask
    clean = torch.where(visible, depth, 0.0)
    near = torch.where(visible, depth, torch.finfo(depth.dtype).max).amin(dim=(1, 2, 3), keepdim=True)
    far = clean.amax(dim=(1, 2, 3), keepdim=True)
    # An empty image has no depth at all, a fronto-parallel plane no range.
    near = torch.where(far > 0, near, 1.0)
    span = far - near
    return visible, clean, near, torch.where(span > 0, span, 1.0)


def fill_depth(depth: Tensor, mask: Tensor | None, depth_scale: float | None) -> Tensor:
    """Depth as a graph surface over the image: nearest visible point at 0, missing pixels at ``BACKGROUND`` ranges.

    With ``depth_scale=None`` the visible range becomes 1; a number multiplies the depth instead. An image with no
    visible
    pixel becomes a constant.
    """
    visible, clean, near, span = visible_range(depth, mask)
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
    check_depth(depth, mask, depth_scale)
    check_option(formula, FORMULAS, "formula")

    def layer(depth: Tensor, mask: Tensor | None) -> Tensor:
        return _graph_saliency(gaussian_smooth(fill_depth(depth, mask, depth_scale), sigma), formula)

    return in_blocks(layer, at_least_float32(depth), mask).to(depth.dtype)


def check_depth(depth: Tensor, mask: Tensor | None, depth_scale: float | None = None) -> None:
    check_image(depth, "depth")
    if mask is not None:
        check_mask(mask, depth)
    if depth_scale is not None:
        check_positive(depth_scale, "depth_scale")


def _graph_saliency(z: Tensor, formula: str) -> Tensor:
    """CS of the graph surface z.

    Computed on the padded images laid end to end, where a neighbour is a shift: every intermediate is then one
        contiguous
    run, and the compiler makes one loop of all of them. What the shifts mix across borders lies in the padding and is
    cut.
    """
    B, _, H, W = z.shape
    if B == 0:
        return z.expand(0, 2, H, W)
    padded = replicate_pad(z, 1).reshape(-1)
    width = W + 2
    inner = padded.numel() - 2 * (width + 1)

    def at(dy: int, dx: int) -> Tensor:
        return padded.narrow(0, width + 1 + dy * width + dx, inner)

    def cut(flat: Tensor) -> Tensor:
        return F.pad(flat, (0, 2 * (width + 1))).view(B, 1, H + 2, width)[..., :H, :W]

    left, right, up, down = at(0, -1), at(0, 1), at(-1, 0), at(1, 0)
    zx, zy = 0.5 * (right - left), 0.5 * (down - up)
    zxx, zyy = torch.sub(right + left, at(0, 0), alpha=2), torch.sub(down + up, at(0, 0), alpha=2)
    zxy = 0.25 * ((at(1, 1) - at(1, -1)) - (at(-1, 1) - at(-1, -1)))
    # I_P = [[E, F], [F, G]] and M = adj(I_P) H_Z.
    metric_e, metric_f, metric_g = zx * zx + 1.0, zx * zy, zy * zy + 1.0
    m11 = torch.addcmul(metric_g * zxx, metric_f, zxy, value=-1)
    m12 = torch.addcmul(metric_g * zxy, metric_f, zyy, value=-1)
    m21 = torch.addcmul(metric_e * zxy, metric_f, zxx, value=-1)
    m22 = torch.addcmul(metric_e * zyy, metric_f, zxy, value=-1)
    vx, vy, root = dominant_eigenvector(m11, m12, m21, m22)
    if formula == "geometric":
        alpha = torch.addcmul(metric_e, zy, zy).rsqrt()
        length = alpha * alpha * alpha * root
    else:
        length = safe_sqrt(zx * zx + zy * zy) * root
    return torch.cat([cut(vx * length), cut(vy * length)], dim=1)


def dominant_eigenvector(m11: Tensor, m12: Tensor, m21: Tensor, m22: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of [[m11, m12], [m21, m22]] with real eigenvalues: (vx, vy, difference of the eigenvalues >= 0).

    (vx, vy) is the unit eigenvector to the eigenvalue largest in absolute value, and 0 where both are equal.
    """
    gap, trace = m11 - m22, m11 + m22
    # tr^2 - 4 det, in the form that does not cancel.
    root = safe_sqrt(torch.addcmul(gap * gap, m12, m21, value=4.0))
    # (lambda - m22, m21) and (m12, lambda - m11) are both eigenvectors: take the one that does not cancel.
    first = (gap >= 0) == (trace >= 0)
    main = torch.where(trace >= 0, gap.abs() + root, -(gap.abs() + root))
    side = 2.0 * torch.where(first, m21, m12)
    squared = torch.addcmul(main * main, side, side)
    # The floor keeps the cube in rsqrt's derivative finite.
    scale = squared.clamp(min=torch.finfo(squared.dtype).tiny ** 0.6).rsqrt()
    main, side = main * scale, side * scale
    return torch.where(first, main, side), torch.where(first, side, main), root


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
    """Module twin of :func:`depth_curvilinear_saliency`; ``learnable=True`` makes sigma a parameter."""

    def __init__(
        self,
        *,
        sigma: float = 1.0,
        formula: str = "geometric",
        depth_scale: float | None = None,
        learnable: bool = False,
    ) -> None:
        super().__init__()
        check_option(formula, FORMULAS, "formula")
        self.sigma, self.formula, self.depth_scale = parameter_if(learnable, sigma), formula, depth_scale

    def forward(self, depth: Tensor, mask: Tensor | None = None) -> Tensor:
        return depth_curvilinear_saliency(
            depth, mask, sigma=self.sigma, formula=self.formula, depth_scale=self.depth_scale
        )

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}, formula={self.formula!r}, depth_scale={self.depth_scale}"


class ImageCurvilinearSaliency(nn.Module):
    """Module twin of :func:`image_curvilinear_saliency`; ``learnable=True`` makes sigma a parameter."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        super().__init__()
        self.sigma = parameter_if(learnable, sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_curvilinear_saliency(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}"
