"""Agreement of two sets of feature points given as boolean masks."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_mask, check_positive, type_and_shape

Mask = NDArray[np.bool_]


def intersection_percentage(photo: Tensor, view: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """IP of the paper: fraction of the photograph's points within ``eps_px`` of a point of the view.

    Args:
        photo, view: (..., H, W) bool, one mask of feature points per image.
        eps_px: Euclidean radius >= 0 in px, inclusive.

    Returns:
        (...) in [0, 1]; NaN where the photograph has no points, 0 where only the view has none.

    Example:
        >>> photo, view = torch.tensor([[[True, False, False, True]], [[False, True, False, False]]])
        >>> float(intersection_percentage(photo, view, eps_px=1.0))
        0.5
    """
    return _per_image(_fraction_within(eps_px), photo, view, ("photo", "view"))


def view_repeatability(view: Tensor, photo: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """Repeatability of a detector: fraction of the view's points within ``eps_px`` of a point of the photograph.

    This is :func:`intersection_percentage` with the roles exchanged. The paper's Rep, which ranks views
    (:func:`curvireg_torch.terms.repeatability.repeatability`), has the other direction.

    Example:
        >>> photo, view = torch.tensor([[[True, False, False, True]], [[False, True, False, False]]])
        >>> float(view_repeatability(view, photo, eps_px=1.0))
        1.0
    """
    return _per_image(_fraction_within(eps_px), view, photo, ("view", "photo"))


def hausdorff_distance(a: Tensor, b: Tensor, *, percentile: float = 100.0, directed: bool = False) -> Tensor:
    """Hausdorff distance of two point sets in pixels, or a percentile of it.

    ``h(A, B)`` is the percentile over a in A of the distance from a to the nearest point of B; the result is
    ``max(h(A, B), h(B, A))``. The classical distance (percentile 100) depends on a single point; 95 is robust.

    Args:
        a, b: (..., H, W) bool.
        percentile: in (0, 100], linear between order statistics.
        directed: only ``h(A, B)``.

    Returns:
        (...) px >= 0; ``inf`` where one mask is empty, NaN where both are.

    Example:
        >>> a, b = torch.tensor([[[True, False, False, False]], [[True, False, False, True]]])
        >>> float(hausdorff_distance(a, b)), float(hausdorff_distance(a, b, directed=True))
        (3.0, 0.0)
    """
    if not 0.0 < percentile <= 100.0:
        raise InvalidInputError(f"percentile: expected a number in (0, 100], got {percentile}")

    def of_pair(x: Mask, y: Mask) -> float:
        if not (x.any() and y.any()):
            return np.inf if x.any() or y.any() else np.nan
        forward = float(np.percentile(_distances(x, y), percentile))
        return forward if directed else max(forward, float(np.percentile(_distances(y, x), percentile)))

    return _per_image(of_pair, a, b, ("a", "b"))


def _fraction_within(eps_px: float) -> Callable[[Mask, Mask], float]:
    check_positive(eps_px, "eps_px", zero_ok=True)
    return lambda a, b: float((_distances(a, b) <= eps_px).mean()) if a.any() else np.nan


def _distances(a: Mask, b: Mask) -> NDArray[np.float64]:
    """Distance from each point of ``a`` to the nearest point of ``b``; ``inf`` if ``b`` is empty."""
    if not b.any():
        return np.full(int(a.sum()), np.inf)
    to_b: NDArray[np.float64] = distance_transform_edt(~b)
    return to_b[a]


def _per_image(score: Callable[[Mask, Mask], float], a: Tensor, b: Tensor, names: tuple[str, str]) -> Tensor:
    """``score`` of each pair of (..., H, W) masks, as a (...) tensor of the default dtype on their device."""
    for name, mask in zip(names, (a, b), strict=True):
        if not isinstance(mask, Tensor) or mask.ndim < 2 or mask.dtype != torch.bool:
            raise InvalidInputError(f"{name}: expected bool (..., H, W), got {type_and_shape(mask)}")
    check_mask(b, a, names[1])
    shape = (a.shape[:-2].numel(), *a.shape[-2:])
    scores = [score(x, y) for x, y in zip(*(m.reshape(shape).cpu().numpy() for m in (a, b)), strict=True)]
    return torch.tensor(scores, dtype=torch.get_default_dtype(), device=a.device).reshape(a.shape[:-2])
