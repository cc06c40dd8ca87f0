"""What the user knows about the pose: sides, ranges, and a map of directions on which the allowed part is drawn."""

from typing import Any

from nicegui import ui

from ..geometry.pose_prior import SIDES, PosePrior
from ..utils.choices import UP_AXES
from .directions import HEIGHT, WIDTH, limits_of_box, map_svg
from .drawing import BoxDrawing
from .session import Session
from .widgets import button, region, text

__all__ = ["KnownPose"]

RANGES = ("azimuth", "elevation")


class KnownPose:
    """Input fields; what is chosen, typed or drawn becomes limits of the session."""

    def __init__(self, session: Session) -> None:
        self.session, self.drawing = session, BoxDrawing()
        text("p", "Seen from its", "facts")
        with region("div", "row"):
            for name in SIDES:
                self._button(name, azimuth=PosePrior.side(name).azimuth)
            self._button("anything", azimuth=None, elevation=None)
        text("p", "or from the part of this map that you mark with the mouse", "facts")
        self.map = ui.interactive_image(
            size=(WIDTH, HEIGHT),
            on_mouse=self._handle_mouse,
            events=["mousedown", "mousemove", "mouseup"],
            sanitize=False,
        ).props("data-testid=directions")
        with region("div", "numbers"):
            self.numbers = {name: [self._number(f"{name} {end}") for end in ("low", "high")] for name in RANGES}
        axes: dict[str | None, str] = {None: "default", **{axis: axis for axis in UP_AXES}}
        front = ui.select(axes, label="front of the mesh")
        front.value = (self.session.options.limits or {}).get("front")
        front.on_value_change(lambda event: self.session.set_limits(front=event.value))
        front.props("dense options-dense data-testid=front")
        self._show()

    def _button(self, name: str, **limits: Any) -> None:
        button(name, lambda: self._set(**limits), f"known-{name}", "quiet")

    def _number(self, name: str) -> Any:
        return ui.number(name, on_change=self._typed).props(f"dense data-testid={name.replace(' ', '-')}")

    def _set(self, **limits: Any) -> None:
        self.session.set_limits(**limits)
        self._show()

    def _show(self) -> None:
        limits = self.session.options.limits or {}
        self.map.content = map_svg(limits)
        for name, fields in self.numbers.items():
            for number, value in zip(fields, limits.get(name) or (None, None), strict=True):
                number.set_value(value)

    def _typed(self) -> None:
        for name, fields in self.numbers.items():
            values = [number.value for number in fields]
            self.session.set_limits(**{name: None if None in values else tuple(map(float, values))})
        self.map.content = map_svg(self.session.options.limits or {})

    def _handle_mouse(self, event: Any) -> None:
        """Draw the allowed part of the map."""
        if event.type == "mousedown":
            self.drawing.box = None
            self.drawing.press(event.image_x, event.image_y, reach=0.0)
        elif self.drawing.active and event.type == "mousemove" and event.buttons:
            self.drawing.move(event.image_x, event.image_y)
            if self.drawing.box is not None:
                self.map.content = map_svg(limits_of_box(self.drawing.box))
        elif self.drawing.active:
            self.drawing.release()
            if self.drawing.box is not None:
                self._set(**limits_of_box(self.drawing.box))
