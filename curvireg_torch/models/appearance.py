"""How much a photograph looks like a shaded view: local features compared cell by cell."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_tensor
from .backbone import Backbone

__all__ = ["describe", "similarity"]

CHUNK = 16
"""Images in the network at a time on a GPU. On a CPU it is one: more are no faster there, and convolutions of a batch
round each image in a way that depends on how many there are."""


@torch.no_grad()
def describe(images: Tensor, backbone: Backbone) -> Tensor:
    """Descriptors of photographs' crops and of shaded views, whose inner product is the appearance score.

    Of the backbone's features at both strides, each channel loses its mean over the image (what the whole image has in
    common: light, style, "this is a rendering") and is divided by its spread on ImageNet; every cell is then scaled to
    unit length, so that each counts the same. Both strides together weigh one.

    Args:
        images: (N, 1 or 3, S, S) in [0, 1]; photographs in colour, views from :func:`curvireg_torch.rendering.shade`.
            Missing pixels (NaN or infinite) are filled from around them.
        backbone: where they are described.

    Returns:
        (N, D) float16 of length 1; D = 17 408 at S = 128.

    Raises:
        InvalidInputError: wrong shape or dtype.

    Example:
        >>> describe(torch.rand(2, 3, 64, 64), Backbone()).shape
        torch.Size([2, 4352])
    """
    chunks = images.split(1 if images.device.type == "cpu" else CHUNK)
    parts = [_described(chunk, backbone) for chunk in chunks] or [_described(images, backbone)]
    return torch.cat(parts)


def _described(images: Tensor, backbone: Backbone) -> Tensor:
    levels = []
    for features, spread in zip(backbone(images), backbone.spreads, strict=True):
        centred = features - features.mean(dim=(2, 3), keepdim=True)
        cells = F.normalize(centred / spread[:, None, None], dim=1)
        levels.append(cells.flatten(1) * (len(backbone.spreads) * cells.shape[2:].numel()) ** -0.5)
    return torch.cat(levels, dim=1).half()


def similarity(photographs: Tensor, views: Tensor) -> Tensor:
    """Mean cosine of the cells, the best over the crops of each photograph.

    Args:
        photographs: (B, K, D) descriptors of K crops each, from :func:`describe`.
        views: (N, D).

    Returns:
        (B, N) float32 in [-1, 1].

    Raises:
        InvalidInputError: wrong shapes.

    Example:
        >>> net = Backbone()
        >>> d = describe(torch.rand(6, 3, 32, 32), net)
        >>> similarity(d.view(2, 3, -1), d[:1]).shape
        torch.Size([2, 1])
    """
    check_tensor(photographs, "photographs", (None, None, None))
    check_tensor(views, "views", (None, photographs.shape[-1]))
    found = photographs.flatten(0, 1).float() @ views.float().T
    return found.view(*photographs.shape[:2], len(views)).amax(dim=1)
