"""Boxes and cameras that are possible, but probably a mistake. A result from them is never reliable."""

import math

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import are_nearly_equal

__all__ = ["camera_warnings", "check_box_side", "input_warnings"]

MIN_BOX_SIDE = 12
"""Pixels; a smaller box is refused. With one of 1 px, the preset "fast" reached a confidence of 0.98."""

SMALL_BOX_SIDE = 24
"""Pixels; of a smaller box a result carries a warning."""

FOCAL_RANGE = (1 / 3, 20.0)
"""Focal lengths of usual cameras, as multiples of the photograph's longer side: fields of view of 113 to 3 degrees."""


def input_warnings(box: Tensor, camera_matrix: Tensor | None, size: tuple[int, int]) -> tuple[str, ...]:
    """What is questionable about the (4,) box and the (3, 3) camera of an (H, W) photograph; each names the mistake."""
    warnings = [] if camera_matrix is None else camera_warnings(camera_matrix, size)
    if (side := _visible_side(box, size)) < SMALL_BOX_SIDE:
        warnings.append(
            f"the box shows {side:.0f} px on its shorter side; use a picture with at least {SMALL_BOX_SIDE}"
        )
    return tuple(warnings)


def check_box_side(box: Tensor, size: tuple[int, int]) -> None:
    """Refuse a box of which less than ``MIN_BOX_SIDE`` px lie inside the (H, W) photograph in a direction."""
    side = _visible_side(box, size)
    if side < MIN_BOX_SIDE:
        where = "the photograph has" if min(size) < MIN_BOX_SIDE else "the part of the photograph in the box has"
        raise InvalidInputError(
            f"{where} {side:.1f} px on its shorter side, at least {MIN_BOX_SIDE} are needed; use a larger picture"
        )


def camera_warnings(K: Tensor, size: tuple[int, int]) -> list[str]:
    """What is questionable about a valid (3, 3) camera matrix of an (H, W) photograph.

    Example:
        >>> swapped = torch.tensor([[325.0, 0, 572], [0, 325, 573], [0, 0, 1]])
        >>> camera_warnings(swapped, (480, 640))[0].rpartition("; ")[-1]
        'FX FY and CX CY seem to be swapped'
        >>> camera_warnings(torch.tensor([[572.0, 0, 325], [0, 573, 242], [0, 0, 1]]), (480, 640))
        []
    """
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    H, W = size
    found = []
    if not _is_inside(cx, cy, size):
        found.append(
            f"the principal point ({cx:g}, {cy:g}) lies outside the photograph of {W} x {H} px; "
            f"{_likely_mistake(fx, fy, cx, cy, size)}"
        )
    low, high = FOCAL_RANGE
    focal, side = min(fx, fy), max(W, H)
    if not low * side <= focal <= high * side:
        degrees = 2 * math.degrees(math.atan(W / 2 / fx))
        advice = "it is in px of this photograph, not in mm" if focal < side else "scale it with the photograph"
        found.append(
            f"the focal length of {focal:g} px gives the photograph of {W} x {H} px a field of view of {degrees:.2g} "
            f"degrees; {advice}"
        )
    return found


def _likely_mistake(fx: float, fy: float, cx: float, cy: float, size: tuple[int, int]) -> str:
    """Of a camera whose principal point lies outside the (H, W) photograph."""
    H, W = size
    if _is_inside(fx, fy, size) and are_nearly_equal(cx, cy):
        return "FX FY and CX CY seem to be swapped"
    if cx >= W - 1 and cy >= H - 1:
        return f"this camera seems to belong to a picture of about {2 * cx + 1:.0f} x {2 * cy + 1:.0f} px; scale it"
    return "it is near the centre, unless the picture was cropped"


def _is_inside(x: float, y: float, size: tuple[int, int]) -> bool:
    """Whether a point lies in an (H, W) picture and not in its corner (0, 0), which stands for unknown values."""
    H, W = size
    return -0.5 < x < W - 0.5 and -0.5 < y < H - 0.5 and (x, y) != (0.0, 0.0)


def _visible_side(box: Tensor, size: tuple[int, int]) -> float:
    """Pixels of the shorter side of the part of a (4,) box that lies inside an (H, W) picture."""
    H, W = size
    limits = torch.tensor([W, H], dtype=torch.float64) - 0.5
    inside = torch.minimum(box[2:].double().cpu(), limits) - box[:2].double().cpu().clamp(min=-0.5)
    return float(inside.min())
