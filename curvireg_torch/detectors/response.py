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

    Input (B, 1 or 3, H, W), and the levels' sigmas, which kornia passes and no layer here needs; output (B, 1, H, W).

    Example:
        >>> from curvireg_torch.filters import ImageCurvilinearSaliency
        >>> Response(ImageCurvilinearSaliency())(torch.rand(1, 3, 32, 32)).shape
        torch.Size([1, 1, 32, 32])
    """

    def __init__(self, layer: Callable[[Tensor], Tensor | Detection]) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, image: Tensor, sigmas: Tensor | None = None) -> Tensor:
        answer = self.layer(image)
        if isinstance(answer, Detection):
            return answer.response
        if answer.shape[1] == 1:
            return answer
        return safe_sqrt(answer.square().sum(dim=1, keepdim=True))
