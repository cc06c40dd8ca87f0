"""Edges by fuzzy logic."""

import torch
from torch import Tensor

from ..filters import image_gradient
from ..filters.numerics import image_maximum
from ..utils.checks import check_positive
from .base import Detection, detector, from_field


@detector
def fuzzy_edges(image: Tensor, *, width: float = 0.1, share: float = 0.04) -> Detection:
    r"""Edges by a rule base on the two derivatives of the image, each divided by the image's largest derivative.

    Membership of "zero": :math:`\mu(g) = \exp(-g^2 / (2\,\mathrm{width}^2))`. AND is min, OR is max, NOT is 1 - mu.

    1. If I_x is zero and I_y is zero, the pixel is uniform (0).
    2. If I_x is not zero or I_y is not zero, the pixel is an edge (1).

    The answer is the mean of 0 and 1 weighted by how far each rule holds (Sugeno). Since rule 2 negates rule 1, the
    weights add up to 1 and the answer is :math:`1 - \min(\mu(I_x), \mu(I_y))`, in [0, 1]. Points are its maxima along
    the gradient.
    """
    check_positive(width, "width")
    gradient = image_gradient(image, sigma=1.0)
    peak = image_maximum(gradient.abs())
    relative = gradient / torch.where(peak > 0, peak, 1.0)
    zero = torch.exp(-0.5 * (relative / width).square()).amin(dim=1, keepdim=True)
    length = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    return from_field((1.0 - zero) * gradient / torch.where(length > 0, length, 1.0), share)
