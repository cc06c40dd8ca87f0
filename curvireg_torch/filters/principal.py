"""Principal curvature image (PCI) of photographs."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..utils.checks import check_option
from .curvilinear import default_to_x, dominant_eigenvector, scaled_direction
from .modules import FunctionModule
from .operations import Planes, apply_to_photograph, central_derivatives, check_sigmas, smooth


def principal_curvature_image(
    image: Tensor, *, sigmas: Sequence[float] = (1.0, 1.4, 2.0, 2.8, 4.0), eigenvalue: str = "largest"
) -> Tensor:
    r"""Principal curvature image (Deng et al. 2007): lines and the sides of edges, over scales.

    :math:`\max_\sigma \sigma^2 \max(\lambda, 0)` with :math:`\lambda` an eigenvalue of the Hessian of the image
    smoothed by :math:`\sigma`: the largest one (``"largest"``: dark lines and the dark side of edges) or the negated
    smallest one (``"smallest"``: bright lines and the bright side).

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1], or (B, 3, H, W) RGB. Missing (NaN) pixels give 0.
        sigmas: scales in px, > 0.
        eigenvalue: ``"largest"`` or ``"smallest"``.

    Returns:
        (B, 2, H, W): the length is the curvature >= 0 in grey levels, the direction is across the line at the scale of
        the maximum, with arbitrary sign.

    Example:
        >>> line = torch.ones(1, 1, 33, 33)
        >>> line[..., 16] = 0.0                                                     # dark, along y
        >>> field = principal_curvature_image(line)
        >>> int(field[0, 0, 16].abs().argmax())
        16
    """
    check_option(eigenvalue, ("largest", "smallest"), "eigenvalue")
    scales = check_sigmas(sigmas, "sigmas")
    sign = 1.0 if eigenvalue == "largest" else -1.0

    def layer(image: Tensor) -> Planes:
        best = vx = vy = torch.zeros_like(image)
        for sigma in scales:
            xx, yy, xy = (sign * sigma**2 * h for h in central_derivatives(smooth(image, sigma))[2:])
            x, y, half_gap = dominant_eigenvector(xx, xy, xy, yy, sign=1.0)
            curvature = 0.5 * (xx + yy) + half_gap
            better = (curvature > best).to(best.dtype)
            best, vx, vy = torch.maximum(best, curvature), torch.lerp(vx, x, better), torch.lerp(vy, y, better)
        return scaled_direction(best, default_to_x(vx, vy), vy)  # a round blob has no unique direction

    return apply_to_photograph(layer, image)


class PrincipalCurvatureImage(FunctionModule, function=principal_curvature_image):
    """Module twin of :func:`principal_curvature_image`.

    Example:
        >>> PrincipalCurvatureImage(eigenvalue="smallest")(torch.rand(2, 3, 32, 32)).shape
        torch.Size([2, 2, 32, 32])
    """

    def __init__(self, *, sigmas: Sequence[float] = (1.0, 1.4, 2.0, 2.8, 4.0), eigenvalue: str = "largest") -> None: ...
