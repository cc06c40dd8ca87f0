"""What the mouse, fingers and keys change on the photograph: the box, and the pose. It needs no NiceGUI."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from .session import Result

__all__ = ["BoxDrawing", "PoseDrag"]

Box = tuple[float, float, float, float]

MIN_SIDE = 3.0  # px of a new box; a smaller one was a click


@dataclass
class BoxDrawing:
    """A box in px of a picture, as the mouse changes it.

    The mouse drags an edge or a corner that it is near to, inside the box the whole box, and elsewhere a new box.
    """

    box: Box | None = None  # x0, y0, x1, y1
    previous: Box | None = None  # before the last change
    _start: Box | None = None  # before the drag
    _corners: Box | None = None  # while dragged; x0 may exceed x1
    _dragged: tuple[int | None, int | None] = (None, None)  # indices of the x and the y that follow the mouse
    _origin: tuple[float, float] | None = None  # where the drag of the whole box began

    @property
    def active(self) -> bool:
        """Whether something is being dragged."""
        return self._corners is not None

    def press(self, x: float, y: float, *, reach: float) -> None:
        """Begin to drag; edges within ``reach`` px are near."""
        self._start, self._origin = self.box, None
        self._corners, self._dragged = (x, y, x, y), (2, 3)
        if self.box is None:
            return
        x0, y0, x1, y1 = self.box
        if x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach:
            self._corners = self.box
            self._dragged = (_near_edge(x, x0, x1, reach, 0), _near_edge(y, y0, y1, reach, 1))
            if self._dragged == (None, None):
                self._origin = (x, y)

    def move(self, x: float, y: float) -> None:
        """Drag to a point; does nothing before :meth:`press`."""
        if self._corners is None:
            return
        x0, y0, x1, y1 = self._corners
        if self._origin is not None:
            dx, dy = x - self._origin[0], y - self._origin[1]
            self.box = (x0 + dx, y0 + dy, x1 + dx, y1 + dy)
            return
        corners = [x0, y0, x1, y1]
        for i, value in zip(self._dragged, (x, y), strict=True):
            if i is not None:
                corners[i] = value
        x0, y0, x1, y1 = corners
        self.box = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))

    def release(self) -> None:
        """End the drag; a click leaves the box as it was."""
        if self._corners is not None:
            box = self.box
            if box is None or min(box[2] - box[0], box[3] - box[1]) < MIN_SIDE:
                box = self._start
            self.box = self._start
            self.set(None if box is None else (round(box[0], 1), round(box[1], 1), round(box[2], 1), round(box[3], 1)))

    def cancel(self) -> None:
        """End the drag and forget it."""
        if self._corners is not None:
            self.box, self._corners = self._start, None

    def set(self, box: Box | None) -> None:
        """Replace the box."""
        self._corners = None
        if box != self.box:
            self.previous, self.box = self.box, box

    def nudge(self, dx: float, dy: float, *, resize: bool = False) -> None:
        """Move the box by px, or only its right and lower edges."""
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            least = MIN_SIDE if resize else -float("inf")
            x0, y0 = (x0, y0) if resize else (x0 + dx, y0 + dy)
            self.set((x0, y0, max(x1 + dx, x0 + least), max(y1 + dy, y0 + least)))

    def undo(self) -> None:
        """Take back the last change; a second call repeats it."""
        self.set(self.previous)


def _near_edge(at: float, low: float, high: float, reach: float, index: int) -> int | None:
    """Index of the near one of two edges; inside, at most a third of the box is near to an edge."""
    inside = min(reach, (high - low) / 3)
    if at <= low + inside:
        return index
    return index + 2 if at >= high - inside else None


class PoseDrag:
    """A pose as the mouse, fingers and keys change it, from (4, 4) ``T`` before a camera (3, 3) ``K``."""

    def __init__(self, result: Result, T: Tensor, K: Tensor) -> None:
        self.result, self.T, self.focal = result, T, float(K[0, 0])
        self._start: tuple[Tensor, float, float, bool] | None = None  # pose, pixel, whether it turns

    @property
    def active(self) -> bool:
        """Whether it is being dragged."""
        return self._start is not None

    def press(self, x: float, y: float, *, turns: bool) -> None:
        """Begin to move the object with the mouse at a pixel, or to turn it."""
        self._start = self.T, x, y, turns

    def drag(self, x: float, y: float) -> None:
        """Let the object's centre follow the mouse, or its near side, if it is turned."""
        if self._start is None:
            return
        T, x0, y0, turns = self._start
        describer = self.result.registrar.describer
        depth = float((T[:3, :3] @ describer.centre + T[:3, 3])[2])
        radii = depth / self.focal / describer.radius  # that one pixel is long
        dx, dy = (x - x0) * radii, (y - y0) * radii
        if max(abs(x - x0), abs(y - y0)) < 1.0:  # a click
            self.T = T
        elif turns:
            self.T = self.result.moved(T, rotation=(math.degrees(dy), -math.degrees(dx), 0.0))
        else:
            self.T = self.result.moved(T, translation=(dx, dy, 0.0))

    def release(self) -> None:
        """Let go."""
        self._start = None

    def scale(self, factor: float) -> None:
        """Show the object larger, at the same place in the photograph."""
        describer = self.result.registrar.describer
        centre = self.T[:3, :3] @ describer.centre + self.T[:3, 3]
        self.T = self.result.moved(self.T, translation=((1.0 / factor - 1.0) * centre / describer.radius).tolist())

    def move(self, *, rotation: Sequence[float] = (0, 0, 0), translation: Sequence[float] = (0, 0, 0)) -> None:
        """Turn by degrees about the camera's axes, and move by radii of the object along them."""
        self.T = self.result.moved(self.T, rotation, translation)
