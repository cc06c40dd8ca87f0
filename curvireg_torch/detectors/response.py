"""Filters and detectors as response functions of kornia."""

from collections.abc import Callable

from torch import Tensor, nn

from ..filters.numerics import safe_sqrt
from .base import Detection


class Response(nn.Module):
    """Response map of a filter or detector, as ``resp_module`` of ``kornia.feature.ScaleSpaceDetector``.

    Args:
        layer: maps photographs (B, 1 or 3, H, W) to a vector field (B, 2, H, W), whose length is the response, to a
            :class:`Detection`, whose response is used, or to a response map (B, 1, H, W).
        power: p of the scale normalisation sigma^p, without which no level is a maximum over scales. Use the number of
            derivatives in the response: 1 for a gradient, 2 for its square or a curvature, 4 for a product of two
            curvatures.

    Shape:
        Input (B, 1 or 3, H, W), and (B,) the sigma of each level, as kornia passes it; output (B, 1, H, W).

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
        output = self.layer(image)
        response = output.response if isinstance(output, Detection) else output
        if response.shape[1] > 1:
            response = safe_sqrt(response.square().sum(dim=1, keepdim=True))
        return response if sigmas is None else response * sigmas.to(response).view(-1, 1, 1, 1) ** self.power
