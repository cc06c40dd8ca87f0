"""What the mouse, fingers and keys make of a box and of a pose. It needs no NiceGUI."""

import math

from torch import Tensor

from .session import Numbers, Result

__all__ = ["dragged_box", "dragged_pose", "scaled_pose"]

Point = tuple[float, float]

MIN_SIDE = 3.0  # px of a new box; a smaller one was a click


def dragged_box(box: Numbers | None, start: Point, end: Point, *, reach: float) -> Numbers | None:
    """The box in px after a drag between two points.

    From within ``reach`` px of an edge or a corner it moves these, from inside the box the whole box, and elsewhere it
    draws a new one.
    """
    (x, y), (u, v) = start, end
    x0, y0, x1, y1 = box or (math.inf, math.inf, -math.inf, -math.inf)
    if x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach:
        left, right = _near_edges(x, x0, x1, reach)
        top, bottom = _near_edges(y, y0, y1, reach)
        if not (left or right or top or bottom):
            x0, y0, x1, y1 = x0 + u - x, y0 + v - y, x1 + u - x, y1 + v - y
        x0, y0 = u if left else x0, v if top else y0
        x1, y1 = u if right else x1, v if bottom else y1
    else:
        x0, y0, x1, y1 = x, y, u, v
    if min(abs(x1 - x0), abs(y1 - y0)) < MIN_SIDE:
        return box
    return round(min(x0, x1), 1), round(min(y0, y1), 1), round(max(x0, x1), 1), round(max(y0, y1), 1)


def _near_edges(at: float, low: float, high: float, reach: float) -> tuple[bool, bool]:
    """Whether the low or the high edge is near; inside, at most a third of the box is near to an edge."""
    inside = min(reach, (high - low) / 3)
    return at <= low + inside, at > low + inside and at >= high - inside


def dragged_pose(result: Result, T: Tensor, K: Tensor, start: Point, end: Point, *, turns: bool) -> Tensor:
    """The (4, 4) pose after a drag: the object's centre follows the mouse or, if it ``turns``, its near side."""
    describer, (dx, dy) = result.registrar.describer, (end[0] - start[0], end[1] - start[1])
    if max(abs(dx), abs(dy)) < 1.0:  # a click
        return T
    depth = float((T[:3, :3] @ describer.centre + T[:3, 3])[2])
    radii = depth / float(K[0, 0]) / describer.radius  # that one pixel is long
    if turns:
        return result.moved(T, rotation=(math.degrees(dy * radii), -math.degrees(dx * radii), 0.0))
    return result.moved(T, translation=(dx * radii, dy * radii, 0.0))


def scaled_pose(result: Result, T: Tensor, factor: float, roll: float = 0.0) -> Tensor:
    """The (4, 4) pose that shows the object larger, at the same place in the photograph, and rolled by degrees."""
    describer = result.registrar.describer
    centre = T[:3, :3] @ describer.centre + T[:3, 3]
    shift = ((1.0 / factor - 1.0) * centre / describer.radius).tolist()
    return result.moved(T, rotation=(0.0, 0.0, roll), translation=shift)
