"""A box drawn and corrected with the mouse."""

from dataclasses import dataclass

__all__ = ["BoxDrawing"]

Box = tuple[float, float, float, float]

SMALLEST = 3.0
"""Sides in px below which what was drawn is a click, not a box."""


@dataclass
class BoxDrawing:
    """A box in px of a picture, and what the mouse does to it.

    Pressed near an edge or a corner it drags that; inside the box, the box; elsewhere it begins a new one.

    Attributes:
        box: x0, y0, x1, y1, or None.

    Example:
        >>> drawing = BoxDrawing()
        >>> drawing.press(10.0, 20.0, reach=5.0); drawing.move(60.0, 50.0); drawing.release()
        >>> drawing.press(61.0, 35.0, reach=5.0); drawing.move(80.0, 90.0); drawing.release()     # the right edge
        >>> drawing.box
        (10.0, 20.0, 80.0, 50.0)
    """

    box: Box | None = None
    _before: Box | None = None
    _corners: Box | None = None  # as they are dragged, perhaps crossed
    _held: tuple[int | None, int | None] | None = None  # which of x0, x1 and of y0, y1 follow the mouse
    _from: tuple[float, float] | None = None  # where the whole box was seized

    @property
    def active(self) -> bool:
        """Whether the mouse holds something."""
        return self._corners is not None

    def press(self, x: float, y: float, *, reach: float) -> None:
        """The button goes down; edges within ``reach`` px are seized."""
        self._before, self._from = self.box, None
        self._corners, self._held = (x, y, x, y), (2, 3)
        if self.box is None:
            return
        x0, y0, x1, y1 = self.box
        if not (x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach):
            return
        self._corners = self.box
        self._held = (_seized(x, x0, x1, reach, 0), _seized(y, y0, y1, reach, 1))
        if self._held == (None, None):
            self._from = (x, y)

    def move(self, x: float, y: float) -> None:
        """The mouse moves; without the button nothing happens."""
        if self._corners is None or self._held is None:
            return
        if self._from is not None:
            assert self._before is not None
            dx, dy = x - self._from[0], y - self._from[1]
            x0, y0, x1, y1 = self._before
            self.box = (x0 + dx, y0 + dy, x1 + dx, y1 + dy)
            return
        corners = list(self._corners)
        for i, value in zip(self._held, (x, y), strict=True):
            if i is not None:
                corners[i] = value
        x0, y0, x1, y1 = corners
        self._corners = (x0, y0, x1, y1)
        self.box = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))

    def release(self) -> None:
        """The button comes up; a click leaves the box as it was."""
        if self._corners is None:
            return
        if self.box is None or min(self.box[2] - self.box[0], self.box[3] - self.box[1]) < SMALLEST:
            self.box = self._before
        if self.box is not None:
            x0, y0, x1, y1 = (round(v, 1) for v in self.box)
            self.box = (x0, y0, x1, y1)
        self._corners = None


def _seized(at: float, low: float, high: float, reach: float, index: int) -> int | None:
    """Which of two edges the mouse seizes; from within a small box it reaches no farther than a third of it."""
    inside = min(reach, (high - low) / 3)
    if at <= low + inside:
        return index
    return index + 2 if at >= high - inside else None
