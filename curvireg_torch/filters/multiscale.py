"""Perona-Malik diffusion, and multi-scale curvilinear saliency (MCS) of photographs over its scale
space."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import (
    check_image,
    check_integer,
    check_option,
    check_positive,
    check_tensor,
)
from . import operations as ops
from .curvilinear import scaled_direction
from .modules import FunctionModule

DIFFUSION_STEP = 0.2  # of the diffusion under MCS


def anisotropic_diffusion(
    image: Tensor,
    *,
    iterations: int,
    kappa: float | Tensor = 0.03,
    step: float = 0.2,
    conductance: str = "rational",
) -> Tensor:
    r"""Perona-Malik diffusion: explicit steps, four neighbours, no flow through the border.

    :math:`I \leftarrow I + \mathrm{step} \sum_{n \in N_4} g(\nabla_n I)\,\nabla_n I` with
    :math:`g = 1/(1 + (d/\kappa)^2)` (``"rational"``) or :math:`g = \exp(-(d/\kappa)^2)`
    (``"exponential"``).

    Args:
        image: (B, C, H, W); channels diffuse independently. NaN pixels are missing and filled.
        iterations: number of steps, >= 0.
        kappa: difference in grey levels above which an edge is preserved, > 0; a scalar tensor is
            differentiable. It has the unit of the image: 0.03 is for [0, 1], about 8 for [0, 255].
            Values below 1e-6 count as 1e-6.
        step: time step in (0, 0.25]; larger steps are unstable.
        conductance: ``"rational"`` or ``"exponential"``.

    Returns:
        (B, C, H, W) with the mean of the input and values within its range.

    Warns:
        CurviregWarning: of an image beyond [-0.01, 1.01], as of 0 to 255 or normalised ones, with a
            kappa below 0.2, by which hardly anything is smoothed.

    Example:
        >>> anisotropic_diffusion(torch.rand(1, 3, 16, 16), iterations=5).shape
        torch.Size([1, 3, 16, 16])
    """
    check_tensor(image, "image", (None, None, None, None))
    check_image(image[:, :1])
    check_option(conductance, ("rational", "exponential"), "conductance")
    check_integer(iterations, "iterations", least=0)
    kappa = ops.check_scalar(kappa, "kappa")
    step = check_positive(step, "step")
    if step > 0.25:
        raise InvalidInputError(f"step: expected 0 < step <= 0.25 (stability), got {step}")

    def layer(x: Tensor) -> ops.Planes:
        missing = ops.missing_mask(x) if ops.may_have_missing(x) else None
        filled = x if missing is None else ops.fill_missing(x, missing)
        _warn_of_unit(filled, kappa)
        return (diffuse(filled, iterations, kappa, step, conductance, missing),)

    return ops.apply_in_blocks(layer, ops.at_least_float32(image)).to(image.dtype)


LARGEST_KAPPA = 0.2  # that is meant for images in [0, 1]


def _warn_of_unit(image: Tensor, kappa: float | Tensor) -> None:
    """Warn of grey levels in another unit than kappa's, where it can be read."""
    if isinstance(kappa, Tensor) and not ops.is_host_readable(kappa):
        return
    number = float(kappa.detach()) if isinstance(kappa, Tensor) else kappa
    if number < LARGEST_KAPPA:
        ops.warn_of_range(image, f"kappa = {number:.3g}, a difference of grey levels, is for these")


def diffuse(
    x: Tensor,
    iterations: int,
    kappa: float | Tensor,
    step: float,
    conductance: str,
    missing: Tensor | None,
) -> Tensor:
    """:func:`anisotropic_diffusion` of checked arguments, in which missing pixels are filled."""
    inside_x = inside_y = None
    if missing is not None:  # no flow across the border of what is valid, either
        inside_x = F.pad(ops.nearest_in_box(missing, -1).diff(dim=-1).to(x.dtype), (1, 1))
        inside_y = F.pad(ops.nearest_in_box(missing, -2).diff(dim=-2).to(x.dtype), (0, 0, 1, 1))
    for _ in range(iterations):
        p = ops.replicate_pad(x, 1)  # no difference, hence no flow, across the border
        # The flow between two neighbours is computed once and enters both with opposite signs.
        flow_x = _flow(p[..., 1:-1, 1:] - p[..., 1:-1, :-1], kappa, conductance, inside_x)
        flow_y = _flow(p[..., 1:, 1:-1] - p[..., :-1, 1:-1], kappa, conductance, inside_y)
        x = torch.add(x, flow_x[..., 1:], alpha=step).sub_(flow_x[..., :-1], alpha=step)
        x = x.add_(flow_y[..., 1:, :], alpha=step).sub_(flow_y[..., :-1, :], alpha=step)
    return ops.replicate_box(x, missing)


def _flow(
    difference: Tensor, kappa: float | Tensor, conductance: str, inside: Tensor | None
) -> Tensor:
    difference = difference if inside is None else difference * inside
    # The range of a tensor cannot be checked while tracing, and its square must not overflow.
    scaled = difference * (
        1.0 / (kappa.clamp(1e-6, 1e6) if isinstance(kappa, Tensor) else max(kappa, 1e-6))
    )
    if conductance == "rational":
        return difference / torch.addcmul(scaled.new_ones(()), scaled, scaled)
    return difference * torch.exp(-scaled.square())


def multiscale_curvilinear_saliency(
    image: Tensor,
    *,
    scales: int = 5,
    sigma: float | Tensor = 1.0,
    kappa: float | Tensor = 0.03,
) -> Tensor:
    r"""MCS (the paper's section "Multi-Curvilinear Saliency"): edges that survive edge-preserving
    smoothing.

    The image curvilinear saliency :math:`|\nabla I|^2` of every level is divided by its maximum
    over the image. The result is the largest of these where *every* level exceeds :math:`e^{-n}`,
    and 0 elsewhere.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB. Missing (NaN) pixels give 0.
        scales: number n of levels, after 0, 5, 10, 20, ... steps of 0.2 of diffusion.
        sigma: smoothing in px before differentiation, >= 0.
        kappa: of :func:`anisotropic_diffusion`, which smooths the levels and warns alike.

    Returns:
        (B, 2, H, W): length in [0, 1], direction of the gradient at the level with the largest
        value.

    Example:
        >>> step = (torch.arange(32) >= 16).float().expand(1, 1, 32, 32)
        >>> field = multiscale_curvilinear_saliency(step)
        >>> round(float(field[0, :, 16, 16].norm()), 3)
        1.0
    """
    check_integer(scales, "scales")
    checked_sigma = ops.check_scalar(sigma, "sigma", zero_ok=True)
    contrast = ops.check_scalar(kappa, "kappa")

    def layer(image: Tensor, missing: Tensor | None) -> ops.Planes:
        _warn_of_unit(image, contrast)
        level = image
        field, saliency = _normalised_saliency(level, checked_sigma, missing)
        lowest = saliency
        for k in range(scales - 1):
            steps = 5 * 2 ** max(k - 1, 0)
            level = diffuse(level, steps, contrast, DIFFUSION_STEP, "rational", missing)
            level_field, level_saliency = _normalised_saliency(level, checked_sigma, missing)
            # On a CPU, selection by arithmetic is much faster than argmax and gather.
            field = torch.lerp(field, level_field, (level_saliency > saliency).to(field.dtype))
            saliency = torch.maximum(saliency, level_saliency)
            lowest = torch.minimum(lowest, level_saliency)
        return (field * (lowest > math.exp(-scales)),)

    return ops.apply_to_photograph(layer, image)


def _normalised_saliency(
    level: Tensor, sigma: float | Tensor, missing: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Vectors of the image CS of one level, and their lengths, with maximum 1 over the image."""
    gx, gy = ops.central_gradient(ops.smooth(level, sigma))
    saliency = ops.squared_length(gx, gy)
    peak = ops.image_maximum(saliency, missing)
    saliency = saliency / torch.where(peak > 0, peak, 1.0)
    return ops.stack_channels(*scaled_direction(saliency, gx, gy)), saliency


class AnisotropicDiffusion(FunctionModule, function=anisotropic_diffusion, learnable=("kappa",)):
    """Module twin of :func:`anisotropic_diffusion`."""

    def __init__(
        self,
        *,
        iterations: int,
        kappa: float = 0.03,
        step: float = 0.2,
        conductance: str = "rational",
        learnable: bool = False,
    ) -> None: ...


class MultiScaleCurvilinearSaliency(
    FunctionModule, function=multiscale_curvilinear_saliency, learnable=("sigma", "kappa")
):
    """Module twin of :func:`multiscale_curvilinear_saliency`."""

    def __init__(
        self,
        *,
        scales: int = 5,
        sigma: float = 1.0,
        kappa: float = 0.03,
        learnable: bool = False,
    ) -> None: ...
