"""Feature points of a vector field."""

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..filters.inputs import finite_vectors
from ..filters.numerics import at_least_float32, safe_sqrt
from ..filters.suppression import is_ridge
from ..utils.checks import check_field, check_share

__all__ = ["field_points"]


def field_points(field: Tensor, *, share: float = 0.04, threshold: float = 0.0, suppress: bool = True) -> Tensor:
    """Pixels that are maxima of the field's length across the field's direction, the longest ones first.

    The length is compared with both neighbours along the direction, rounded to 45 degrees (as Canny does). Of the
    maxima longer than ``threshold`` the longest are kept, up to ``share`` of all pixels; equal lengths at the limit are
    all kept.

    Args:
        field: (B, 2, H, W). Vectors with a NaN or infinite component count as 0.
        share: of the image's pixels, in (0, 1].
        threshold: in the field's unit, >= 0; vectors of length 0 are never points.
        suppress: False skips the non-maximum suppression.

    Returns:
        (B, 1, H, W) bool.

    Raises:
        InvalidInputError: wrong shape, dtype, share or threshold.

    Example:
        >>> field = torch.zeros(1, 2, 9, 9)
        >>> field[0, 0, :, 3:6] = torch.tensor([1.0, 2.0, 1.0])          # a ridge along y, pointing along x
        >>> field_points(field, share=1.0)[0, 0].sum(dim=0).tolist()
        [0, 0, 0, 0, 9, 0, 0, 0, 0]
    """
    check_field(field)
    if not threshold >= 0:
        raise InvalidInputError(f"threshold: expected >= 0, got {threshold}")
    x, y = finite_vectors(at_least_float32(field)).split(1, dim=1)
    length = safe_sqrt(x * x + y * y)
    candidates = length > threshold
    if suppress:
        candidates = candidates & is_ridge(length, x, y)
    return strongest_points(length, candidates, share)


def strongest_points(response: Tensor, candidates: Tensor, share: float) -> Tensor:
    """Of the candidates (B, 1, H, W) those of largest response > 0, up to ``share`` of each image's pixels."""
    check_share(share, "share")
    B, _, H, W = response.shape
    if B == 0:
        return candidates
    kept = torch.where(candidates, response, 0.0).flatten(1)
    limit = kept.topk(max(1, int(share * H * W)), dim=1).values[:, -1]
    return candidates & (response > 0) & (response >= limit.view(B, 1, 1, 1))
