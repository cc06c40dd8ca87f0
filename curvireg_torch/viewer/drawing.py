"""A box drawn and corrected with the mouse."""

from dataclasses import dataclass, field

__all__ = ["BoxDrawing"]

Box = tuple[float, float, float, float]

MAX_UNDO = 100  # changes that are kept
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
    _undone: list[Box | None] = field(default_factory=list)
    _done: list[Box | None] = field(default_factory=list)  # earlier boxes

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
        self._remember(self._before)

    def cancel(self) -> None:
        """End the drag and forget it."""
        if self._corners is not None:
            self.box, self._corners = self._before, None

    def set(self, box: Box | None) -> None:
        """Replace the box."""
        before, self.box, self._corners = self.box, box, None
        self._remember(before)

    def nudge(self, dx: float, dy: float, *, resize: bool = False) -> None:
        """Move the box by px, or only its right and lower edges."""
        if self.box is None:
            return
        x0, y0, x1, y1 = self.box
        if resize:
            self.set((x0, y0, max(x1 + dx, x0 + MIN_SIDE), max(y1 + dy, y0 + MIN_SIDE)))
        else:
            self.set((x0 + dx, y0 + dy, x1 + dx, y1 + dy))

    @property
    def can_undo(self) -> bool:
        """Whether :meth:`undo` changes the box."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether :meth:`redo` changes the box."""
        return bool(self._undone)

    def undo(self) -> None:
        """Bring back the box before the last change."""
        if self._done:
            self._undone.append(self.box)
            self.box = self._done.pop()

    def redo(self) -> None:
        """Repeat the change that :meth:`undo` took back."""
        if self._undone:
            self._done.append(self.box)
            self.box = self._undone.pop()

    def _remember(self, before: Box | None) -> None:
        if self.box != before:
            self._done = [*self._done[1 - MAX_UNDO :], before]
            self._undone = []


def _near_edge(at: float, low: float, high: float, reach: float, index: int) -> int | None:
    """Index of the near one of two edges; inside, at most a third of the box is near to an edge."""
    inside = min(reach, (high - low) / 3)
    if at <= low + inside:
        return index
    return index + 2 if at >= high - inside else None
