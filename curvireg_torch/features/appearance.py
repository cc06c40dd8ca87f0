"""Appearance scores: photographs and shaded views compared by local backbone features, cell by cell.

Wrong shapes and dtypes raise :class:`~curvireg_torch.errors.InvalidInputError`.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_tensor
from ..utils.threads import map_on_threads
from .backbone import Backbone

__all__ = ["describe", "similarity"]

CHUNK = 16
"""Views that are compared at a time, and images per network call on a GPU. The latter is 1 on a CPU, where larger
batches are no faster and the rounding of convolutions depends on the batch size."""


@torch.no_grad()
def describe(images: Tensor, backbone: Backbone) -> Tensor:
    """Appearance descriptors of photograph crops and of shaded views; their inner product is the appearance score.

    At both strides of the backbone, each channel loses its mean over the image, which contains light and style, and is
    divided by its standard deviation on ImageNet. Every cell is then scaled to unit length, so that all cells have
    equal weight, and the two strides have equal weight too.

    Args:
        images: (N, 1 or 3, S, S) in [0, 1]; photographs in colour, views from :func:`curvireg_torch.rendering.shade`.
            Missing pixels (NaN or infinite) are filled from their surroundings.
        backbone: the feature network.

    Returns:
        (N, D) float16 of unit length; D = 17 408 at S = 128.

    Example:
        >>> describe(torch.rand(2, 3, 64, 64), Backbone()).shape
        torch.Size([2, 4352])
    """
    chunks = images.split(1 if images.device.type == "cpu" else CHUNK)
    parts = map_on_threads(lambda chunk: _describe_chunk(chunk, backbone), chunks, device=images.device)
    return torch.cat(parts)


def _describe_chunk(images: Tensor, backbone: Backbone) -> Tensor:
    levels = []
    for features, spread in zip(backbone(images), backbone.spreads, strict=True):
        centred = features - features.mean(dim=(2, 3), keepdim=True)
        cells = F.normalize(centred / spread[:, None, None], dim=1)
        levels.append(cells.flatten(1) * (len(backbone.spreads) * cells.shape[2:].numel()) ** -0.5)
    return torch.cat(levels, dim=1).half()


def similarity(photographs: Tensor, views: Tensor) -> Tensor:
    """Mean cosine similarity of the cells, maximum over the crops of each photograph, (B, N) float32 in [-1, 1].

    Args:
        photographs: (B, K, D) descriptors of K crops each, from :func:`describe`.
        views: (N, D).

    Example:
        >>> d = describe(torch.rand(6, 3, 32, 32), Backbone())
        >>> similarity(d.view(2, 3, -1), d[:1]).shape
        torch.Size([2, 1])
    """
    check_tensor(photographs, "photographs", (None, None, None))
    check_tensor(views, "views", (None, photographs.shape[-1]))
    crops = photographs.flatten(0, 1).float()
    # Few views at a time: a float32 copy of all of them takes ten times as long as the product.
    scores = torch.cat([crops @ few.float().T for few in views.split(CHUNK)], dim=1)
    return scores.view(*photographs.shape[:2], len(views)).amax(dim=1)
