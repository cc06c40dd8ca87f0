"""The gradient of photographs, the paper's IG."""

from torch import Tensor, nn

from .derivatives import central_gradient, smooth
from .inputs import on_photograph
from .learnable import as_number, check_width, keep_positive, positive_option

__all__ = ["ImageGradient", "image_gradient"]


def image_gradient(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    """Gradient of the Gaussian-smoothed image, the paper's IG.

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1], or (B, 3, H, W) RGB; NaN pixels are missing (0 in the
            result).
        sigma: smoothing in px before differentiation, >= 0.

    Returns:
        (B, 2, H, W) grey levels per px; channel 0 = x, 1 = y. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or sigma.

    Example:
        >>> import torch
        >>> ramp = torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_gradient(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [1.0, 0.0]
    """
    width = check_width(sigma, "sigma", zero_ok=True)
    return on_photograph(lambda x: central_gradient(smooth(x, width)), image)


class ImageGradient(nn.Module):
    """Gradient of the Gaussian-smoothed image, as a layer; module twin of :func:`image_gradient`.

    Args:
        sigma: smoothing in px before differentiation, >= 0.
        learnable: make its logarithm a parameter, ``log_sigma``; then > 0.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, 2, H, W).

    Example:
        >>> import torch
        >>> ramp = torch.arange(8.0).expand(1, 1, 8, 8)
        >>> ImageGradient(sigma=0.0)(ramp)[0, :, 4, 4].tolist()
        [1.0, 0.0]
    """

    sigma = positive_option("sigma")

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        super().__init__()
        check_width(sigma, "sigma", zero_ok=True)
        keep_positive(self, learnable, sigma=sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}"
