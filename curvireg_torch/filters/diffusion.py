"""Perona-Malik edge-preserving diffusion, the scale space of MCS."""

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_positive, check_tensor
from .blocks import Planes, apply_in_blocks
from .derivatives import replicate_pad
from .inputs import fill_missing
from .learnable import OptionsModule, check_scalar, safe_reciprocal
from .numerics import at_least_float32

CONDUCTANCES = ("rational", "exponential")


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
    :math:`g = 1/(1 + (d/\kappa)^2)` (``"rational"``) or :math:`g = \exp(-(d/\kappa)^2)` (``"exponential"``).

    Args:
        image: (B, C, H, W); channels diffuse independently. NaN pixels are missing and filled.
        iterations: number of steps, >= 0.
        kappa: difference in grey levels above which an edge is preserved, > 0; a scalar tensor is differentiable.
        step: time step in (0, 0.25]; larger steps are unstable.
        conductance: ``"rational"`` or ``"exponential"``.

    Returns:
        (B, C, H, W) with the mean of the input and values within its range.

    Example:
        >>> anisotropic_diffusion(torch.rand(1, 3, 16, 16), iterations=5).shape
        torch.Size([1, 3, 16, 16])
    """
    check_tensor(image, "image", (None, None, None, None))
    kappa, step = check_diffusion(iterations, kappa, step, conductance)

    def layer(x: Tensor) -> Planes:
        return (diffuse(fill_missing(x), iterations, kappa, step, conductance),)

    return apply_in_blocks(layer, at_least_float32(image)).to(image.dtype)


def check_diffusion(
    iterations: int, kappa: float | Tensor, step: float, conductance: str
) -> tuple[float | Tensor, float]:
    """Returns kappa and step."""
    check_option(conductance, CONDUCTANCES, "conductance")
    if iterations < 0:
        raise InvalidInputError(f"iterations: expected >= 0, got {iterations}")
    if not 0 < step <= 0.25:
        raise InvalidInputError(f"step: expected 0 < step <= 0.25 (stability), got {step}")
    return check_scalar(kappa, "kappa"), check_positive(step, "step")


def diffuse(x: Tensor, iterations: int, kappa: float | Tensor, step: float, conductance: str) -> Tensor:
    """:func:`anisotropic_diffusion` of checked arguments."""
    for _ in range(iterations):
        p = replicate_pad(x, 1)  # no difference, hence no flow, across the border
        # The flow between two neighbours is computed once and enters both with opposite signs.
        flow_x = _flow(p[..., 1:-1, 1:] - p[..., 1:-1, :-1], kappa, conductance)
        flow_y = _flow(p[..., 1:, 1:-1] - p[..., :-1, 1:-1], kappa, conductance)
        x = torch.add(x, flow_x[..., 1:], alpha=step).sub_(flow_x[..., :-1], alpha=step)
        x = x.add_(flow_y[..., 1:, :], alpha=step).sub_(flow_y[..., :-1, :], alpha=step)
    return x


def _flow(difference: Tensor, kappa: float | Tensor, conductance: str) -> Tensor:
    scaled = difference * safe_reciprocal(kappa)
    if conductance == "rational":
        return difference / torch.addcmul(scaled.new_ones(()), scaled, scaled)
    return difference * torch.exp(-scaled.square())


class AnisotropicDiffusion(OptionsModule):
    """Module twin of :func:`anisotropic_diffusion`.

    Args:
        iterations, kappa, step, conductance: as in the function.
        learnable: make kappa a positive parameter.

    Shape:
        Input (B, C, H, W); output the same.

    Example:
        >>> noise = torch.rand(1, 3, 32, 32)
        >>> bool(AnisotropicDiffusion(iterations=10, kappa=1.0)(noise).std() < 0.5 * noise.std())
        True
    """

    LEARNABLE = ("kappa",)

    def __init__(
        self,
        *,
        iterations: int,
        kappa: float = 0.03,
        step: float = 0.2,
        conductance: str = "rational",
        learnable: bool = False,
    ) -> None:
        check_diffusion(iterations, kappa, step, conductance)
        super().__init__(learnable, iterations=iterations, kappa=kappa, step=step, conductance=conductance)

    def forward(self, image: Tensor) -> Tensor:
        return anisotropic_diffusion(image, **self.options)
