"""The photograph with the box and the pose over it."""

from collections.abc import Sequence
from typing import Any

from nicegui import ui

from .pictures import photograph_jpeg, pose_layers
from .widgets import button, file_chooser, region, set_enabled, text
from .workspace import Workspace

__all__ = ["Stage"]

LEGEND = {"outline": "outline of the mesh at this pose", "crease": "its inner edges", "box": "the box"}
HELP = (
    "Photograph. Drag to draw a box; drag its edges, corners or middle to correct it. Arrow keys move it, with Shift "
    "by 10 px, with Alt they resize it. Wheel or pinch zooms, the middle button pans."
)


class Stage:
    """The photograph, which can be zoomed; ``page.js`` sends what the mouse, the fingers and the keys do on it."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.shown_photo: Any = None
        self.shown_pose: Any = None
        with region("section", "stage", aria_label="photograph"):
            self._build_empty()
            with region("div", "photo-area") as self.area:
                self._build_toolbar()
                with (
                    region("div", "viewport", tabindex="0", role="application", aria_label=HELP) as self.viewport,
                    region("div", "canvas", data_testid="photograph"),
                ):
                    self.photo = region("img", alt="the photograph", draggable="false")
                    self.solid = region("img", alt="", draggable="false")
                    self.lines = region("img", alt="", draggable="false")
                    self.shapes = ui.html("", sanitize=False).classes("shapes")
                self._build_layers()
        ui.on("stage", self._handle)

    def _build_empty(self) -> None:
        with region("div", "empty") as self.empty:
            text("p", "Drop a photograph and a mesh anywhere on this page", "large")
            text("p", "The two may come together and in any order. Nothing is sent to the internet.")
            with region("div", "row"):
                file_chooser("Choose files", "upload-any")
                button("Try the sample", self.workspace.load_sample, "sample", "primary")

    def _build_toolbar(self) -> None:
        with region("div", "toolbar", role="toolbar", aria_label="photograph and box"):
            for name, label, symbol in (("out", "zoom out", "−"), ("fit", "fit", "Fit"), ("in", "zoom in", "+")):
                text("button", symbol, "button quiet", type="button", data_zoom=name, aria_label=label, title=label)
            self.undo = button("Undo", lambda: self._change("undo"), "undo", "quiet", title="Ctrl+Z")
            self.redo = button("Redo", lambda: self._change("redo"), "redo", "quiet", title="Ctrl+Y")

    def _build_layers(self) -> None:
        with region("div", "layers") as self.layers:
            self.opacity = self._slider("mesh", "Mesh", 35)
            self.wipe = self._slider("wipe", "Wipe", 100)
            with region("label"):
                self.contours = region("input", type="checkbox", data_testid="contours", checked="checked")
                text("span", "Contours")
            self.contours.on("change", self._show_contours, args=["target.checked"])
            with region("ul", "legend"):
                for name, meaning in LEGEND.items():
                    text("li", meaning, name)

    def _slider(self, name: str, label: str, value: int) -> Any:
        """A slider that sets the custom property ``--name`` of the photograph, in the browser alone."""
        with region("label"):
            text("span", label)
            return region(
                "input", type="range", min="0", max="100", value=str(value), data_testid=name, data_property=f"--{name}"
            )

    def _show_contours(self, event: Any) -> None:
        self.lines.set_visibility(bool(event.args))

    def _change(self, name: str, *values: float, **options: bool) -> None:
        """Undo, redo or nudge."""
        getattr(self.workspace.drawing, name)(*values, **options)
        self.session.box = self.workspace.drawing.box

    def _handle(self, event: Any) -> None:
        """Draw or correct the box; coordinates come as fractions of the photograph."""
        drawing, photo, what = self.workspace.drawing, self.session.photo, event.args
        if photo is None:
            return
        H, W = photo.image.shape[-2:]
        x, y = float(what.get("x", 0.0)) * W - 0.5, float(what.get("y", 0.0)) * H - 0.5
        kind = what.get("type")
        if kind == "press":
            drawing.press(x, y, reach=float(what.get("reach", 0.0)) * W)
        elif kind == "move":
            drawing.move(x, y)
        elif kind == "cancel":
            drawing.cancel()
        elif kind == "release" and drawing.active:
            drawing.release()
            if drawing.box is None and (proposal := self._proposal_at(x, y)):
                drawing.set(proposal)
            self.session.box = drawing.box
        elif kind == "nudge":
            self._change("nudge", float(what["dx"]), float(what["dy"]), resize=bool(what["resize"]))
        elif kind in ("undo", "redo"):
            self._change(kind)
        elif kind == "remove":
            self.workspace.set_box(None)
        self._draw_boxes()

    def _proposal_at(self, x: float, y: float) -> Any:
        """The first dashed box that contains a point, to 0.1 px, or None."""
        for x0, y0, x1, y1 in self.session.proposals():
            if x0 <= x <= x1 and y0 <= y <= y1:
                return tuple(round(v, 1) for v in (x0, y0, x1, y1))
        return None

    async def refresh(self) -> None:
        """Show the photograph, the box and the displayed pose of the workspace."""
        session, drawing = self.session, self.workspace.drawing
        self.empty.set_visibility(session.photo is None)
        self.area.set_visibility(session.photo is not None)
        if session.photo is None:
            return
        if not drawing.active and drawing.box != session.box:  # typed, or loaded
            drawing.set(session.box)
        set_enabled(self.undo, drawing.can_undo)
        set_enabled(self.redo, drawing.can_redo)
        self._draw_boxes()
        if self.shown_photo != session.photo_path:
            self.shown_photo = session.photo_path
            await self._show_photo()
        if self.shown_pose is not session.displayed:
            self.shown_pose = session.displayed
            await self._show_pose()

    async def _show_photo(self) -> None:
        photo = self.session.photo
        assert photo is not None
        content = await self.workspace.run("photograph", lambda: photograph_jpeg(photo.image))
        if content:
            H, W = photo.image.shape[-2:]
            self.photo.props(f'src="{self.workspace.serve("photograph.jpg", content, "image/jpeg")}"')
            self.viewport.style(f"--ratio: {W / H:.5f}")

    async def _show_pose(self) -> None:
        shown = self.shown_pose is not None
        if shown:
            result, displayed = self.session.require_result()
            size = (int(result.image.shape[-2]), int(result.image.shape[-1]))
            layers = await self.workspace.run("pose", lambda: pose_layers(result.registrar, displayed.pose, size))
            if not layers:
                return
            for element, name, content in zip((self.solid, self.lines), ("solid", "lines"), layers, strict=True):
                element.props(f'src="{self.workspace.serve(f"{name}.png", content, "image/png")}"')
        for element in (self.solid, self.lines):
            element.classes(**{"remove" if shown else "add": "absent"})
        self.layers.set_visibility(shown)

    def _draw_boxes(self) -> None:
        """Draw the box with its handles, or dashed the proposals of the detection."""
        photo, box = self.session.photo, self.workspace.drawing.box
        if photo is None:
            return
        H, W = photo.image.shape[-2:]
        boxes = [(box, "")] if box is not None else [(proposal, "4 6") for proposal in self.session.proposals()]
        parts = "".join(_outline(box, dashes) for box, dashes in boxes) + ("" if box is None else _handles(box))
        self.shapes.set_content(f"<svg viewBox='-0.5 -0.5 {W} {H}' preserveAspectRatio='none'>{parts}</svg>")


def _outline(box: Sequence[float], dashes: str) -> str:
    x0, y0, x1, y1 = box
    shape = f"x='{x0:g}' y='{y0:g}' width='{x1 - x0:g}' height='{y1 - y0:g}' stroke-dasharray='{dashes}'"
    return f"<rect {shape} class='rim'/><rect {shape} class='line'/>"


def _handles(box: Sequence[float]) -> str:
    """Squares at the corners and in the middle of the edges, of the same size at every zoom."""
    x0, y0, x1, y1 = box
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    points = [(x, y) for x in (x0, middle[0], x1) for y in (y0, middle[1], y1) if (x, y) != middle]
    path = " ".join(f"M{x:g} {y:g}h0" for x, y in points)
    return f"<path d='{path}' class='handle rim'/><path d='{path}' class='handle line'/>"
