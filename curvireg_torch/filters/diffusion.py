"""Perona-Malik edge-preserving diffusion, the scale space of MCS."""

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_positive, check_tensor
from .blocks import Planes, in_blocks
from .derivatives import replicate_pad
from .inputs import filled
from .learnable import as_number, check_width, inverse, keep_positive, positive_option
from .numerics import at_least_float32

__all__ = ["AnisotropicDiffusion", "anisotropic_diffusion"]

CONDUCTANCES = ("rational", "exponential")


def anisotropic_diffusion(
    image: Tensor,
    *,
    iterations: int,
    kappa: float | Tensor = 0.03,
    step: float = 0.2,
    conductance: str = "rational",
) -> Tensor:
    r"""Perona-Malik diffusion, explicit, four neighbours, no flow through the border.

    :math:`I \leftarrow I + \mathrm{step} \sum_{n \in N_4} g(\nabla_n I)\,\nabla_n I` with
    :math:`g = 1/(1 + (d/\kappa)^2)` (``"rational"``) or :math:`g = \exp(-(d/\kappa)^2)` (``"exponential"``).

    Args:
        image: (B, C, H, W); channels diffuse independently. NaN pixels are missing and come out filled.
        iterations: number of steps, >= 0.
        kappa: difference in grey levels above which an edge is kept, > 0; a scalar tensor is differentiated through.
        step: time step in (0, 0.25]; larger ones are unstable.
        conductance: ``"rational"`` or ``"exponential"``.

    Returns:
        (B, C, H, W), mean kept, within the range of the input. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> anisotropic_diffusion(torch.rand(1, 3, 16, 16), iterations=5).shape
        torch.Size([1, 3, 16, 16])
    """
    check_tensor(image, "image", (None, None, None, None))
    edge, dt = check_diffusion(iterations, kappa, step, conductance)

    def layer(x: Tensor) -> Planes:
        return (diffuse(filled(x), iterations, edge, dt, conductance),)

    return in_blocks(layer, at_least_float32(image)).to(image.dtype)


def check_diffusion(
    iterations: int, kappa: float | Tensor, step: float, conductance: str
) -> tuple[float | Tensor, float]:
    """kappa and step, once they and the other options are right."""
    check_option(conductance, CONDUCTANCES, "conductance")
    if iterations < 0:
        raise InvalidInputError(f"iterations: expected >= 0, got {iterations}")
    if not 0 < step <= 0.25:
        raise InvalidInputError(f"step: expected 0 < step <= 0.25 (stability), got {step}")
    return check_width(kappa, "kappa"), check_positive(step, "step")


def diffuse(x: Tensor, iterations: int, kappa: float | Tensor, step: float, conductance: str) -> Tensor:
    """:func:`anisotropic_diffusion` of what was checked."""
    for _ in range(iterations):
        p = replicate_pad(x, 1)  # no difference, hence no flow, across the border
        # The flow between two neighbours is computed once and enters both with opposite signs.
        flow_x = _flow(p[..., 1:-1, 1:] - p[..., 1:-1, :-1], kappa, conductance)
        flow_y = _flow(p[..., 1:, 1:-1] - p[..., :-1, 1:-1], kappa, conductance)
        x = torch.add(x, flow_x[..., 1:], alpha=step).sub_(flow_x[..., :-1], alpha=step)
        x = x.add_(flow_y[..., 1:, :], alpha=step).sub_(flow_y[..., :-1, :], alpha=step)
    return x


def _flow(difference: Tensor, kappa: float | Tensor, conductance: str) -> Tensor:
    scaled = difference * inverse(kappa)
    if conductance == "rational":
        return difference / torch.addcmul(scaled.new_ones(()), scaled, scaled)
    return difference * torch.exp(-scaled.square())


class AnisotropicDiffusion(nn.Module):
    """Perona-Malik diffusion, as a layer; module twin of :func:`anisotropic_diffusion`.

    Args:
        iterations: number of steps, >= 0.
        kappa: difference in grey levels above which an edge is kept, > 0.
        step: time step in (0, 0.25].
        conductance: ``"rational"`` or ``"exponential"``.
        learnable: make the logarithm of kappa a parameter, ``log_kappa``.

    Shape:
        Input (B, C, H, W); output the same.

    Example:
        >>> import torch
        >>> noise = torch.rand(1, 3, 32, 32)
        >>> bool(AnisotropicDiffusion(iterations=10, kappa=1.0)(noise).std() < 0.5 * noise.std())
        True
    """

    kappa = positive_option("kappa")

    def __init__(
        self,
        *,
        iterations: int,
        kappa: float = 0.03,
        step: float = 0.2,
        conductance: str = "rational",
        learnable: bool = False,
    ) -> None:
        super().__init__()
        check_diffusion(iterations, kappa, step, conductance)
        keep_positive(self, learnable, kappa=kappa)
        self.iterations, self.step, self.conductance = iterations, step, conductance

    def forward(self, image: Tensor) -> Tensor:
        return anisotropic_diffusion(
            image, iterations=self.iterations, kappa=self.kappa, step=self.step, conductance=self.conductance
        )

    def extra_repr(self) -> str:
        return (
            f"iterations={self.iterations}, kappa={as_number(self.kappa)}, step={self.step}, "
            f"conductance={self.conductance!r}"
        )
