"""The photograph with the box and the pose over it, on which both are corrected."""

import asyncio
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from nicegui import ui
from torch import Tensor

from ..errors import InvalidInputError
from ..registration import Hypothesis, Registrar
from ..rendering import shade
from ..visualization.contours import contour_layer
from ..visualization.encoding import jpeg, png, shrink
from ..visualization.overlay import to_uint8
from .gestures import BoxDrawing, PoseDrag
from .widgets import button, file_chooser, region, set_enabled, text
from .workspace import Workspace

__all__ = ["Stage", "contour_paths", "pose_layers"]

PHOTO_SIDE = 2400
"""Longer side in px of the displayed photograph, which can be zoomed."""

LAYER_SIDE = 1400
"""Longer side in px of the layers over it."""

CONTOUR_SIDE = 256
"""Side in px of the crop in which contours are followed while a pose is moved."""

DASH = 0.008
"""Half the length of a contour's dash, as a fraction of that crop."""

COMMIT_SECONDS = 0.5
"""Seconds without wheel or keys after which a moved pose becomes the answer."""

LEGEND = {"outline": "outline of the mesh at this pose", "crease": "its inner edges", "box": "the box"}
HELP = {
    "box": "Photograph. Drag to draw a box; drag its edges, corners or middle to correct it. Arrow keys move it, with "
    "Shift by 10 px, with Alt they resize it. Wheel or pinch zooms, the middle button pans.",
    "pose": "Photograph. Drag the mesh to move it, drag beside it to turn it; the wheel or a pinch changes its "
    "distance, with Shift or a twist it rolls. Arrow keys move, with Shift turn, with Alt roll or change distance.",
}
HINT = {
    "box": "Drag a rectangle around the object; drag its edges to correct it. The wheel zooms.",
    "pose": "Drag the mesh to move it, drag beside it to turn it. Wheel: distance. Shift and wheel: roll.",
}


class Stage:
    """The photograph, which can be zoomed; ``page.js`` sends what the mouse, the fingers and the keys do on it."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.drawing = BoxDrawing(self.session.box)
        self.shown_photo: Any = None
        self.shown_result: Any = None
        self.shown_answer: Any = None
        self.mode, self.mask = "box", np.zeros((1, 1), bool)
        self.drag: PoseDrag | None = None
        self._last_gesture, self._following = 0.0, False
        with region("section", "stage", aria_label="photograph", data_testid="stage"):
            self._build_empty()
            with region("div", "photo-area") as self.area:
                self._build_toolbar()
                with (
                    region("div", "viewport", tabindex="0", role="application") as self.viewport,
                    region("div", "canvas", data_testid="photograph") as self.canvas,
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
        with region("div", "toolbar", role="toolbar", aria_label="photograph, box and pose"):
            self.modes = {
                "box": button("Box", lambda: self._set_mode("box"), "mode-box", "quiet"),
                "pose": button("Pose", lambda: self._set_mode("pose"), "mode-pose", "quiet"),
            }
            self.undo = button("Undo", self._undo, "undo", "quiet", title="Ctrl+Z; once more repeats it")
            self.fit = button("Fit the contours", self._fit, "fit", "quiet")
            for name, label, symbol in (
                ("out", "zoom out", "−"),
                ("fit", "whole photograph", "⤢"),
                ("in", "zoom in", "+"),
            ):
                text("button", symbol, "button quiet", type="button", data_zoom=name, aria_label=label, title=label)
            self.hint = text("p", "", "facts", data_testid="hint")

    def _build_layers(self) -> None:
        with region("div", "layers") as self.layers:
            self._slider("mesh", "Mesh", 35)
            self._slider("wipe", "Wipe", 100)
            with region("label"):
                self.contours = region("input", type="checkbox", data_testid="contours", checked="checked")
                text("span", "Contours")
            self.contours.on("change", lambda e: self.lines.set_visibility(bool(e.args)), args=["target.checked"])
            with region("ul", "legend"):
                for name, meaning in LEGEND.items():
                    text("li", meaning, name)

    def _slider(self, name: str, label: str, value: int) -> None:
        """A slider that sets the custom property ``--name`` of the photograph, in the browser alone."""
        with region("label"):
            text("span", label)
            values = {"min": "0", "max": "100", "value": str(value), "data_testid": name, "data_property": f"--{name}"}
            region("input", type="range", **values)

    def _set_mode(self, mode: str) -> None:
        self._commit()
        self.mode = mode

    def _undo(self) -> None:
        if self.mode == "pose":
            self._commit()
            self.session.undo()
        else:
            self.drawing.undo()
            self.session.box = self.drawing.box

    async def _fit(self) -> None:
        self._commit()
        await self.workspace.run("pose", self.session.fit)

    async def _handle(self, event: Any) -> None:
        """Correct the box or the pose; coordinates come as fractions of the photograph."""
        photo, what = self.session.photo, event.args
        if photo is None:
            return
        H, W = photo.image.shape[-2:]
        x, y = float(what.get("x", 0.0)) * W - 0.5, float(what.get("y", 0.0)) * H - 0.5
        if what["type"] == "undo":
            self._undo()
        elif self.mode == "box":
            self._change_box(what, x, y, float(what.get("reach", 0.0)) * W)
            self._draw_shapes()
        elif self.session.answer is not None:
            self._change_pose(what, x, y)
            await self._follow()

    def _change_box(self, what: Any, x: float, y: float, reach: float) -> None:
        drawing, kind = self.drawing, what["type"]
        if kind == "press":
            drawing.press(x, y, reach=reach)
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
            step = 10.0 if what["shift"] else 1.0
            drawing.nudge(step * what["dx"], step * what["dy"], resize=what["alt"])
            self.session.box = drawing.box
        elif kind == "remove":
            drawing.set(None)
            self.session.box = None

    def _change_pose(self, what: Any, x: float, y: float) -> None:
        kind, drag = what["type"], self.drag
        if drag is None:
            result, answer = self.session.require_result()
            drag = self.drag = PoseDrag(result, *answer.pose.projection)
        self._last_gesture = time.monotonic()
        try:
            if kind == "press":
                drag.press(x, y, turns=not self._on_mesh(x, y))
            elif kind == "move":
                drag.drag(x, y)
            elif kind == "release":
                drag.release()
                if not self._commit() and (proposal := self._proposal_at(x, y)):  # a click
                    self.mode, self.session.box = "box", proposal
            elif kind == "cancel":
                self.drag = None
            elif kind == "scale":  # wheel and pinch
                drag.scale(float(what["factor"]))
                drag.move(rotation=(0.0, 0.0, float(what["roll"])))
            elif kind == "nudge" and what["shift"]:
                drag.move(rotation=(what["dy"], -what["dx"], 0.0))
            elif kind == "nudge" and what["alt"]:
                drag.move(rotation=(0.0, 0.0, what["dx"]))
                drag.scale(1.01 ** -what["dy"])
            elif kind == "nudge":
                drag.move(translation=(0.01 * what["dx"], 0.01 * what["dy"], 0.0))
        except InvalidInputError:  # the object would touch the camera: it stays
            return

    def _on_mesh(self, x: float, y: float) -> bool:
        """Whether the mesh is drawn at a pixel."""
        photo = self.session.photo
        assert photo is not None
        rows, columns = self.mask.shape
        row, column = int((y + 0.5) / photo.image.shape[-2] * rows), int((x + 0.5) / photo.image.shape[-1] * columns)
        return 0 <= row < rows and 0 <= column < columns and bool(self.mask[row, column])

    async def _follow(self) -> None:
        """Draw the contours of the pose that is being moved; poses that come meanwhile are dropped but for the last."""
        if self._following:
            return
        self._following, drawn = True, None
        try:
            while self.drag is not None and self.drag.T is not drawn:
                drag, drawn = self.drag, self.drag.T
                K = self.session.require_result()[1].pose.projection[1]
                paths = await asyncio.to_thread(contour_paths, drag.result.registrar, drawn, K)
                self._show_layers(shown=False)
                self._draw_shapes(paths)
        finally:
            self._following = False

    def _commit(self) -> bool:
        """Make the pose that was moved the answer; returns whether it was moved."""
        drag, self.drag = self.drag, None
        answer = self.session.answer
        moved = drag is not None and answer is not None and drag.T is not answer.pose.projection[0]
        if drag is not None and moved:
            self.session.place(drag.T)
        return moved

    def _proposal_at(self, x: float, y: float) -> Any:
        """The first dashed box that contains a point, to 0.1 px, or None."""
        for x0, y0, x1, y1 in self.session.proposals():
            if x0 <= x <= x1 and y0 <= y <= y1:
                return tuple(round(v, 1) for v in (x0, y0, x1, y1))
        return None

    async def refresh(self) -> None:
        """Show the photograph, the box and the answer of the workspace."""
        session = self.session
        self.empty.set_visibility(session.photo is None)
        self.area.set_visibility(session.photo is not None)
        if session.photo is None:
            return
        if not self.drawing.active and self.drawing.box != session.box:  # typed, loaded, or drawn in another window
            self.drawing.set(session.box)
        if self.shown_photo != session.photo_path:
            self.shown_photo, self.drawing, self.drag = session.photo_path, BoxDrawing(session.box), None
            await self._show_photo()
        if self.shown_result is not session.result:
            self.shown_result, self.drag = session.result, None
            self.mode = "box" if session.result is None else "pose"
        if self.drag is not None and not self.drag.active and time.monotonic() - self._last_gesture > COMMIT_SECONDS:
            self._commit()
        self._show_mode()
        if self.shown_answer is not session.answer:
            self.drag, self.shown_answer = None, session.answer
            await self._render_answer()
        if self.drag is None:
            self._show_layers(shown=session.answer is not None)
            self._draw_shapes()

    def _show_mode(self) -> None:
        is_pose = self.mode == "pose"
        self.canvas.props(f"data-mode={self.mode}")
        self.viewport.props(f'aria-label="{HELP[self.mode]}"')
        self.hint.set_content(HINT[self.mode])
        for mode, element in self.modes.items():
            element.props(f"aria-pressed={'true' if mode == self.mode else 'false'}")
        set_enabled(self.modes["pose"], self.session.answer is not None)
        self.fit.set_visibility(is_pose)
        can_undo = (
            self.session.can_undo or self.drag is not None if is_pose else self.drawing.previous != self.drawing.box
        )
        set_enabled(self.undo, can_undo)

    async def _show_photo(self) -> None:
        photo = self.session.photo
        assert photo is not None
        content = await self.workspace.run("photograph", lambda: jpeg(shrink(to_uint8(photo.image), PHOTO_SIDE), 92))
        if content:
            H, W = photo.image.shape[-2:]
            self.photo.props(f'src="{self.workspace.serve("photograph.jpg", content, "image/jpeg")}"')
            self.viewport.style(f"--ratio: {W / H:.5f}")

    async def _render_answer(self) -> None:
        if self.shown_answer is None:
            return
        result, answer = self.session.require_result()
        size = (int(result.image.shape[-2]), int(result.image.shape[-1]))
        layers = await self.workspace.run("pose", lambda: pose_layers(result.registrar, answer.pose, size))
        if layers:
            self.mask = layers[2]
            for element, name, content in zip((self.solid, self.lines), ("solid", "lines"), layers, strict=False):
                element.props(f'src="{self.workspace.serve(f"{name}.png", content, "image/png")}"')

    def _show_layers(self, *, shown: bool) -> None:
        for element in (self.solid, self.lines):
            element.classes(**{"remove" if shown else "add": "absent"})
        self.layers.set_visibility(self.session.answer is not None)

    def _draw_shapes(self, contours: str = "") -> None:
        """Draw the box, with handles where it can be changed, or dashed the proposals of the detection."""
        photo, box = self.session.photo, self.drawing.box
        if photo is None:
            return
        H, W = photo.image.shape[-2:]
        boxes = [(box, "")] if box is not None else [(proposal, "4 6") for proposal in self.session.proposals()]
        parts = "".join(_outline(box, dashes) for box, dashes in boxes) + contours
        if box is not None and self.mode == "box":
            parts += _handles(box)
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


def contour_paths(registrar: Registrar, T: Tensor, K: Tensor) -> str:
    """SVG paths of the contours of a mesh at a pose (4, 4), in px of the photograph with the camera matrix (3, 3).

    They are short dashes along the mesh's edges, which needs no rendered view.
    """
    describer = registrar.describer
    centre = T[:3, :3] @ describer.centre + T[:3, 3]
    u, v, _ = (K @ centre / centre[2]).tolist()
    side = 2.4 * describer.radius * float(K[0, 0] / centre[2])  # of a crop around the object
    scale, half = CONTOUR_SIDE / side, (CONTOUR_SIDE - 1) / 2
    crop = torch.tensor([[scale, 0.0, half - scale * u], [0.0, scale, half - scale * v], [0.0, 0.0, 1.0]])
    points = describer.contours.points(T[None], (crop.double() @ K)[None], CONTOUR_SIDE)
    seen = points.valid[0]
    at = (points.model[0][seen] @ T[:3, :3].mT + T[:3, 3]) @ K.mT
    pixel, normal = at[:, :2] / at[:, 2:], points.normals[0][seen]
    dash = DASH * side * torch.stack([-normal[:, 1], normal[:, 0]], dim=1)
    ends = torch.cat([pixel - dash, pixel + dash], dim=1)
    parts = []
    for lines, name in ((ends[~points.outline[0][seen]], "crease"), (ends[points.outline[0][seen]], "outline")):
        path = "".join("M{:.1f} {:.1f}L{:.1f} {:.1f}".format(*line) for line in lines.tolist())
        parts.append(f"<path d='{path}' class='rim'/><path d='{path}' class='{name}'/>")
    return "".join(parts)


def pose_layers(registrar: Registrar, pose: Hypothesis, size: tuple[int, int]) -> tuple[bytes, bytes, np.ndarray]:
    """Two transparent PNGs over a photograph of ``size`` (H, W), the shaded mesh and its contours, and where it is."""
    T, K = pose.projection
    scale = min(1.0, LAYER_SIDE / max(size))
    small = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    sy, sx = small[0] / size[0], small[1] / size[1]
    to_layer = torch.tensor([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    K = to_layer.double() @ K
    depth = registrar.describer.renderer.render(T[None], K, small)[0, 0].cpu().float()
    mask: np.ndarray = (depth > 0).numpy()
    grey = shade(depth[None, None], K[None])[0, 0].numpy()
    solid = np.zeros((*small, 4), np.uint8)
    solid[mask, :3] = (grey[mask, None] * np.array([255, 235, 190])).round().astype(np.uint8)
    solid[mask, 3] = 255
    return png(solid), png(contour_layer(depth, K)), mask
