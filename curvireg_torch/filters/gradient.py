"""The gradient of photographs, the paper's IG."""

from torch import Tensor

from .derivatives import central_gradient, smooth
from .inputs import apply_to_photograph
from .learnable import OptionsModule, check_scalar


def image_gradient(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    """Gradient of the Gaussian-smoothed image, the paper's IG.

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1], or (B, 3, H, W) RGB. Missing (NaN) pixels give 0.
        sigma: smoothing in px before differentiation, >= 0.

    Returns:
        (B, 2, H, W) grey levels per px; channel 0 = x, 1 = y.

    Example:
        >>> import torch
        >>> ramp = torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_gradient(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [1.0, 0.0]
    """
    checked_sigma = check_scalar(sigma, "sigma", zero_ok=True)
    return apply_to_photograph(lambda x: central_gradient(smooth(x, checked_sigma)), image)


class ImageGradient(OptionsModule):
    """Module twin of :func:`image_gradient`.

    Args:
        sigma: as in the function.
        learnable: make sigma a positive parameter.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, 2, H, W).

    Example:
        >>> len(list(ImageGradient(learnable=True).parameters()))
        1
    """

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        check_scalar(sigma, "sigma", zero_ok=True)
        super().__init__(learnable, sigma=sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, **self.options)
