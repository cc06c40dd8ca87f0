"""Saliencies and detectors as kornia's response functions."""

from collections.abc import Callable

from torch import Tensor, nn

from ..filters.numerics import safe_sqrt
from .base import Detection

__all__ = ["Response"]


class Response(nn.Module):
    """How strong a layer or detector finds each pixel: the ``resp_module`` of ``kornia.feature.ScaleSpaceDetector``.

    Args:
        layer: from photographs (B, 1 or 3, H, W) to a vector field (B, 2, H, W), whose length is the response, to a
            :class:`Detection`, whose response it is, or to a map (B, 1, H, W).
        power: p of the factor sigma^p on the response of a level of scale sigma px, without which no level is a maximum
            over scales: the number of derivatives that the response multiplies, 1 for a gradient, 2 for its square or a
            curvature, 4 for the product of two curvatures.

    Shape:
        Input (B, 1 or 3, H, W), and (B,) sigmas of the levels, as kornia passes them; output (B, 1, H, W).

    Example:
        >>> import torch
        >>> from curvireg_torch.filters import ImageCurvilinearSaliency
        >>> Response(ImageCurvilinearSaliency())(torch.rand(1, 3, 32, 32)).shape
        torch.Size([1, 1, 32, 32])
    """

    def __init__(self, layer: Callable[[Tensor], Tensor | Detection], *, power: float = 0.0) -> None:
        super().__init__()
        self.layer, self.power = layer, power

    def forward(self, image: Tensor, sigmas: Tensor | None = None) -> Tensor:
        answer = self.layer(image)
        if isinstance(answer, Detection):
            answer = answer.response
        if answer.shape[1] > 1:
            answer = safe_sqrt(answer.square().sum(dim=1, keepdim=True))
        return answer if sigmas is None else answer * sigmas.to(answer).view(-1, 1, 1, 1) ** self.power
