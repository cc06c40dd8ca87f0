"""A box drawn and corrected with the mouse."""

from dataclasses import dataclass

__all__ = ["BoxDrawing"]

Box = tuple[float, float, float, float]

MIN_SIDE = 3.0  # px of a new box; a smaller one was a click


@dataclass
class BoxDrawing:
    """A box in px of a picture, as the mouse changes it.

    The mouse drags an edge or a corner that it is near to, inside the box the whole box, and elsewhere a new box.

    Example:
        >>> drawing = BoxDrawing()
        >>> drawing.press(10.0, 20.0, reach=5.0); drawing.move(60.0, 50.0); drawing.release()
        >>> drawing.press(61.0, 35.0, reach=5.0); drawing.move(80.0, 90.0); drawing.release()     # the right edge
        >>> drawing.box
        (10.0, 20.0, 80.0, 50.0)
    """

    box: Box | None = None  # x0, y0, x1, y1
    _before: Box | None = None
    _corners: Box | None = None  # while dragged; x0 may exceed x1
    _dragged: tuple[int | None, int | None] = (None, None)  # indices of the x and the y that follow the mouse
    _origin: tuple[float, float] | None = None  # where the drag of the whole box began

    @property
    def active(self) -> bool:
        """Whether something is being dragged."""
        return self._corners is not None

    def press(self, x: float, y: float, *, reach: float) -> None:
        """Begin to drag; edges within ``reach`` px are near."""
        self._before, self._origin = self.box, None
        self._corners, self._dragged = (x, y, x, y), (2, 3)
        if self.box is None:
            return
        x0, y0, x1, y1 = self.box
        if not (x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach):
            return
        self._corners = self.box
        self._dragged = (_near_edge(x, x0, x1, reach, 0), _near_edge(y, y0, y1, reach, 1))
        if self._dragged == (None, None):
            self._origin = (x, y)

    def move(self, x: float, y: float) -> None:
        """Drag to a point; does nothing before :meth:`press`."""
        if self._corners is None:
            return
        if self._origin is not None:
            assert self._before is not None
            dx, dy = x - self._origin[0], y - self._origin[1]
            x0, y0, x1, y1 = self._before
            self.box = (x0 + dx, y0 + dy, x1 + dx, y1 + dy)
            return
        corners = list(self._corners)
        for i, value in zip(self._dragged, (x, y), strict=True):
            if i is not None:
                corners[i] = value
        x0, y0, x1, y1 = corners
        self._corners = (x0, y0, x1, y1)
        self.box = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))

    def release(self) -> None:
        """End the drag; a click leaves the box as it was."""
        if self._corners is None:
            return
        if self.box is None or min(self.box[2] - self.box[0], self.box[3] - self.box[1]) < MIN_SIDE:
            self.box = self._before
        if self.box is not None:
            x0, y0, x1, y1 = (round(v, 1) for v in self.box)
            self.box = (x0, y0, x1, y1)
        self._corners = None


def _near_edge(at: float, low: float, high: float, reach: float, index: int) -> int | None:
    """Index of the near one of two edges; inside, at most a third of the box is near to an edge."""
    inside = min(reach, (high - low) / 3)
    if at <= low + inside:
        return index
    return index + 2 if at >= high - inside else None
