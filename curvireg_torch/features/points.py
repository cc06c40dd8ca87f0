"""Feature points of a vector field."""

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..filters.inputs import zero_nonfinite_vectors
from ..filters.numerics import at_least_float32, is_host_readable, safe_sqrt
from ..filters.suppression import is_directional_maximum
from ..utils.checks import check_field, check_fraction


def field_points(field: Tensor, *, fraction: float = 0.04, threshold: float = 0.0, suppress: bool = True) -> Tensor:
    """Feature points: maxima of the length of a vector field across its direction, restricted to the longest vectors.

    Each length is compared with the two neighbours along the direction of the field, rounded to 45 degrees as in Canny.
    Ties at the limit of ``fraction`` are all selected.

    Args:
        field: (B, 2, H, W). Vectors with a NaN or infinite component count as 0.
        fraction: of the pixels of the image, in (0, 1].
        threshold: in the unit of the field, >= 0; vectors of length 0 are never points.
        suppress: False skips the non-maximum suppression.

    Returns:
        (B, 1, H, W) bool.

    Example:
        >>> field = torch.zeros(1, 2, 9, 9)
        >>> field[0, 0, :, 3:6] = torch.tensor([1.0, 2.0, 1.0])          # a ridge along y, pointing along x
        >>> field_points(field, fraction=1.0)[0, 0].sum(dim=0).tolist()
        [0, 0, 0, 0, 9, 0, 0, 0, 0]
    """
    check_field(field)
    if not threshold >= 0:
        raise InvalidInputError(f"threshold: expected >= 0, got {threshold}")
    x, y = zero_nonfinite_vectors(at_least_float32(field)).split(1, dim=1)
    length = safe_sqrt(x * x + y * y)
    candidates = length > threshold
    if suppress:
        candidates = candidates & is_directional_maximum(length, x, y)
    return strongest_points(length, candidates, fraction)


def strongest_points(response: Tensor, candidates: Tensor, fraction: float) -> Tensor:
    """Candidates (B, 1, H, W) with the largest response > 0, up to ``fraction`` of the pixels of each image."""
    check_fraction(fraction, "fraction")
    B, _, H, W = response.shape
    if B == 0:
        return candidates
    candidates, count = candidates & (response > 0), max(1, int(fraction * H * W))
    if is_host_readable(response) and not bool((candidates.sum(dim=(1, 2, 3)) > count).any()):
        return candidates  # most views have fewer, and topk is slow
    limit = torch.where(candidates, response, 0.0).flatten(1).topk(count, dim=1).values[:, -1]
    return candidates & (response >= limit.view(B, 1, 1, 1))
