"""The photograph with the box and the pose over it, on which both are corrected."""

import asyncio
import time
from functools import partial
from typing import Any

import cv2
import numpy as np
from nicegui import ui
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import Camera
from ..registration import Registrar
from ..rendering import shade
from ..visualization.contours import contour_layer
from ..visualization.encoding import jpeg, png, shrink, to_uint8
from ..visualization.overlay import LEGEND
from .shot import Answer, Numbers, Point, Shot, dragged_box
from .widgets import (
    Panel,
    button,
    fact_line,
    file_chooser,
    mark,
    region,
    set_enabled,
    set_pressed,
    text,
)

PHOTO_SIDE = 2400  # px of the longer side of the displayed photograph, which can be zoomed
THUMBNAIL_SIDE = 96  # px of the longer side of the small photographs
# px of the longer side of the layers over it, and while a pose is moved
LAYER_SIDE = 1400
MOVING_SIDE = 480
COMMIT_SECONDS = 0.5  # without wheel or keys, after which a moved pose becomes the answer
ZOOMS = {
    "out": ("−", "zoom out"),
    "fit": ("⤢", "whole photograph or object"),
    "in": ("+", "zoom in"),
}
HELP = {
    "box": "Drag to draw a box; drag its edges, corners or middle to correct it. Arrow keys move "
    "it. The wheel zooms; Z shows the whole photograph or the object.",
    "pose": "Drag the mesh to move it, drag beside it to turn it: the pointer shows which. Wheel: "
    "distance; with Shift: roll. Arrow keys move, with Shift turn. Z shows the whole photograph or "
    "the object.",
}
TOUCH_HELP = {
    "box": "Draw with one finger; pinch to zoom.",
    "pose": "One finger moves the mesh, or turns it beside it; pinch for distance and roll.",
}


class Stage(Panel):
    """The photographs, one of which is large and can be zoomed; ``page.js`` sends what mouse,
    fingers and keys do."""

    def lay_out(self) -> None:
        self.mode = "box"
        self.mask = np.zeros((1, 1), bool)
        # What a drag began with: the box or the pose, where, and whether it turns.
        self.pressed: tuple[Any, Point, bool] | None = None
        self.drawn: Numbers | None = None  # the box, as it is dragged
        self.moved: Tensor | None = None  # the pose that is being moved by hand
        self.held: Answer | None = None  # the answer from which it is moved
        self._last_gesture = 0.0
        self._following = False
        with region("section", "stage", aria_label="photograph", data_testid="stage"):
            with region("div", "empty") as self.empty:
                text("p", "Drop a photograph and a mesh anywhere on this page", "large")
                text(
                    "p",
                    "The two may come together and in any order. Nothing is sent to the internet.",
                )
                with region("div", "row"):
                    file_chooser("Choose files", "upload-any")
                    button("Try the sample", self.workspace.load_sample, "sample", "primary")
            with region("div", "photo-area") as self.area:
                self.strip = region(
                    "div", "strip", role="group", aria_label="photographs", data_testid="strip"
                )
                self._lay_out_toolbar()
                with (
                    region("div", "viewport", tabindex="0", role="application") as self.viewport,
                    region("div", "canvas", data_testid="photograph") as self.canvas,
                ):
                    self.photo = region("img", alt="the photograph", draggable="false")
                    self.solid = region("img", alt="", draggable="false")
                    self.lines = region("img", alt="", draggable="false")
                    self.shapes = ui.html("", sanitize=False).classes("shapes")
                self._lay_out_layers()
        ui.on("stage", self._handle)

    def _lay_out_toolbar(self) -> None:
        with region("div", "toolbar", role="toolbar", aria_label="photograph, box and pose"):
            self.modes = {
                mode: button(
                    mode.capitalize(),
                    lambda mode=mode: self._set_mode(mode),
                    f"mode-{mode}",
                    "quiet",
                )
                for mode in HELP
            }
            self.undo = button(
                "Undo", self._undo, "undo", "quiet", title="Ctrl+Z; once more repeats it"
            )
            self.fit = button("Fit the contours", self._fit, "fit", "quiet")
            for name, (symbol, label) in ZOOMS.items():
                zoom = {"type": "button", "data_zoom": name, "aria_label": label}
                text("button", symbol, "button quiet", title=label, **zoom)
            self.hint = fact_line("hint")
            self.touch_hint = text("p", "", "touch", data_testid="touch-hint")

    def _lay_out_layers(self) -> None:
        with region("div", "layers") as self.layers:
            with region("label"):
                text("span", "Mesh")
                slider = {"type": "range", "min": "0", "max": "100", "value": "35"}
                region("input", data_testid="mesh", data_property="--mesh", **slider)
            with region("label"):
                contours = region(
                    "input", type="checkbox", data_testid="contours", checked="checked"
                )
                text("span", "Contours")
            contours.on(
                "change",
                lambda e: self.lines.set_visibility(bool(e.args)),
                js_handler="(event) => emit(event.target.checked)",
            )
            text("p", LEGEND, "facts")

    def _set_mode(self, mode: str) -> None:
        self.commit()
        self.mode = mode

    def _undo(self) -> None:
        shot = self.session.shot
        if self.mode == "pose":
            self.commit()
            shot.undo()
        else:
            shot.set_box(shot.box_before)

    async def _fit(self) -> None:
        self.commit()
        await self.workspace.run("pose", self.session.shot.fit)

    async def _handle(self, event: Any) -> None:
        """Correct the box or the pose; coordinates come as fractions of the photograph."""
        shot = self.session.shot
        what = event.args
        # another window has just changed it
        if shot.photo is None or shot.photo is not self.shown.get("photo"):
            return
        H, W = shot.size
        point = float(what.get("x", 0.0)) * W - 0.5, float(what.get("y", 0.0)) * H - 0.5
        if what["type"] == "undo":
            self._undo()
        elif self.mode == "box":
            self._change_box(what, point, float(what.get("reach", 0.0)) * W)
            self._draw_shapes()
        elif shot.answer is not None:
            self._change_pose(what, point, float(what.get("reach", 0.0)))
            await self._follow()

    def _change_box(self, what: Any, point: Point, reach: float) -> None:
        shot = self.session.shot
        kind = what["type"]
        if kind == "press":
            self.pressed = (shot.box, point, False)
            self.drawn = shot.box
        elif kind == "move" and self.pressed is not None:
            self.drawn = dragged_box(shot.box, self.pressed[1], point, reach=reach)
        elif kind in ("release", "cancel") and self.pressed is not None:
            self.pressed = None
            if kind == "release":
                shot.set_box(self.drawn)
        elif kind == "nudge" and shot.box is not None:
            dx, dy = (what[name] * (10.0 if what["shift"] else 1.0) for name in ("dx", "dy"))
            x0, y0, x1, y1 = shot.box
            shot.set_box((x0 + dx, y0 + dy, x1 + dx, y1 + dy))
        elif kind == "remove":
            shot.set_box(None)

    def _change_pose(self, what: Any, point: Point, reach: float) -> None:
        result = self.session.shot.require_result()
        T, K = self.session.shot.projection
        kind = what["type"]
        if self.pressed is None and self.moved is None:
            self.held = self.session.shot.answer
        T = T if self.moved is None else self.moved
        self._last_gesture = time.monotonic()
        try:
            if kind == "press":
                self.pressed = T, point, not self._on_mesh(*point, reach)
            elif kind == "move" and self.pressed is not None:
                T, start, turns = self.pressed
                self.moved = result.dragged(T, K, start, point, turns=turns)
            elif kind == "release":
                self.commit()
            elif kind == "cancel":
                self._end_gesture()
            elif kind == "scale":  # wheel and pinch
                self.moved = result.scaled(T, float(what["factor"]), float(what["roll"]))
            elif kind == "nudge" and what["shift"]:
                self.moved = result.moved(T, rotation=(what["dy"], -what["dx"], 0.0))
            elif kind == "nudge":
                self.moved = result.moved(
                    T, translation=(0.01 * what["dx"], 0.01 * what["dy"], 0.0)
                )
        except InvalidInputError:  # the object would touch the camera: it stays
            return

    def _on_mesh(self, x: float, y: float, reach: float) -> bool:
        """Whether the mesh is drawn at a pixel, or within ``reach`` of it, in widths of the
        photograph."""
        rows, columns = self.mask.shape
        H, W = self.session.shot.size
        row = int((y + 0.5) / H * rows)
        column = int((x + 0.5) / W * columns)
        around = round(reach * columns)
        near = self.mask[
            max(row - around, 0) : row + around + 1, max(column - around, 0) : column + around + 1
        ]
        return bool(near.any())

    async def _follow(self) -> None:
        """Draw the pose that is being moved; poses that come meanwhile are dropped but for the
        last."""
        if self._following:
            return
        self._following = True
        drawn = None
        shot = self.session.shot
        registrar = shot.require_result().registrar
        K = shot.projection[1]
        try:
            while self.moved is not None and self.moved is not drawn:
                drawn = self.moved
                layers = await asyncio.to_thread(
                    _pose_layers, registrar, (drawn, K), shot.size, MOVING_SIDE
                )
                if self.moved is not None:
                    self._show_layers(layers)
        finally:
            self._following = False

    def commit(self) -> None:
        """Make the pose that was moved the answer, unless that is another one by now."""
        shot = self.session.shot
        moved = self.moved
        self._end_gesture()
        is_shown = shot.photo is self.shown.get("photo") and shot.answer is self.held
        if moved is None or not is_shown:
            return
        if not moved.equal(shot.projection[0]):
            shot.place(moved)

    def _end_gesture(self) -> None:
        """Forget the pose that was moved; the answer is drawn again."""
        if self.moved is not None:
            self.shown["answer"] = "moved"
        self.pressed = self.moved = None

    async def refresh(self) -> None:
        """Show the photographs, the box and the answer of the workspace."""
        shot = self.session.shot
        self.empty.set_visibility(shot.photo is None)
        self.area.set_visibility(shot.photo is not None)
        if shot.photo is None:
            return
        new_photo = self.changed("photo", shot.photo)
        new_box = self.changed("box", shot.box)
        if self.changed("result", shot.result) or new_photo:
            self._end_gesture()
            self.mode = "box" if shot.result is None else "pose"
        # changed elsewhere on the page
        elif new_box and self.pressed is None and self.moved is None:
            self.mode = "box"
        if new_photo:
            self.shown["answer"] = "of another photograph"  # those of a rig share theirs
            await self._show_photo()
        if (
            self.pressed is None
            and self.moved is not None
            and time.monotonic() - self._last_gesture > COMMIT_SECONDS
        ):
            self.commit()
        self._show_mode()
        if self.changed("answer", shot.answer):
            self.pressed = self.moved = None
            await self._render_answer()
        for element in (self.solid, self.lines):
            mark(element, "absent", shot.answer is None)
        self.layers.set_visibility(shot.answer is not None)
        self._draw_shapes()
        await self._show_strip()

    async def _show_strip(self) -> None:
        """Show small pictures of the photographs, if there are several, and mark the one that is
        shown."""
        shots = tuple(self.session.shots)  # others may be opened meanwhile
        images = [shot.photo.image for shot in shots if shot.photo is not None]
        if list(map(id, images)) != list(map(id, self.shown.get("strip", []))):
            self.shown["strip"] = images

            def make() -> list[bytes]:
                shown = images if len(images) > 1 else []
                return [jpeg(shrink(to_uint8(image), THUMBNAIL_SIDE), 80) for image in shown]

            pictures = await self.workspace.run("page", make) or ()
            self.strip.clear()
            for number, picture in enumerate(pictures):
                url = self.workspace.serve(f"photograph-{number}.jpg", picture, "image/jpeg")
                name = self.session.name(shots[number].path)
                test_id = f"photograph-{number + 1}"
                with (
                    self.strip,
                    region(
                        "button", "thumbnail", type="button", title=name, data_testid=test_id
                    ) as small,
                ):
                    region("img", src=url, alt=name)
                small.on("click", partial(self._select, shots[number]))
        for shot, thumbnail in zip(shots, self.strip.default_slot.children, strict=False):
            set_pressed(thumbnail, shot is self.session.shot)
            mark(thumbnail, "done", shot.answer)

    def _select(self, shot: Shot) -> None:
        self.commit()
        if shot in self.session.shots:  # not closed in another window
            self.session.shot = shot

    def _show_mode(self) -> None:
        is_pose = self.mode == "pose"
        shot = self.session.shot
        self.canvas.props(f"data-mode={self.mode}")
        self.viewport.props(f'aria-label="Photograph. {HELP[self.mode]}"')
        self.hint.set_content(HELP[self.mode])
        self.touch_hint.set_content(TOUCH_HELP[self.mode])
        for mode, element in self.modes.items():
            set_pressed(element, mode == self.mode)
        set_enabled(self.modes["pose"], shot.answer is not None)
        self.fit.set_visibility(is_pose and shot.view is None)
        before = None if shot.result is None else shot.result.answer_before
        moved = before is not None or self.moved is not None
        set_enabled(self.undo, moved if is_pose else shot.box_before != shot.box)

    async def _show_photo(self) -> None:
        photo = self.session.shot.photo
        assert photo is not None
        content = await self.workspace.run(
            "page", lambda: jpeg(shrink(to_uint8(photo.image), PHOTO_SIDE), 92)
        )
        if content:
            H, W = photo.image.shape[-2:]
            self.photo.props(
                f'src="{self.workspace.serve("photograph.jpg", content, "image/jpeg")}"'
            )
            self.viewport.style(f"--ratio: {W / H:.5f}")
            self.canvas.props(f'data-photo="{time.monotonic()}"')  # page.js then shows it whole

    async def _render_answer(self) -> None:
        shot = self.session.shot
        if shot.answer is None:
            return
        registrar = shot.require_result().registrar
        projection = shot.projection
        draw = partial(_pose_layers, registrar, projection, shot.size, LAYER_SIDE)
        if layers := await self.workspace.run("page", draw):
            self._show_layers(layers)
            self.canvas.props(f'data-object="{_extent(self.mask)}"')
            if self.changed("zoomed", shot.result):  # page.js then shows the object
                self.canvas.props(f'data-answer="{time.monotonic()}"')

    def _show_layers(self, layers: tuple[bytes, bytes, np.ndarray]) -> None:
        solid, lines, self.mask = layers
        for element, name, content in (
            (self.solid, "solid.png", solid),
            (self.lines, "lines.png", lines),
        ):
            element.props(f'src="{self.workspace.serve(name, content, "image/png")}"')

    def _draw_shapes(self) -> None:
        """Draw the box, with handles where it can be changed."""
        shot = self.session.shot
        is_box = self.mode == "box"
        parts = ""
        box = self.drawn if is_box and self.pressed is not None else shot.box
        if shot.photo is None:
            return
        H, W = shot.size
        if box is not None:
            x0, y0, x1, y1 = box
            shape = f"x='{x0:g}' y='{y0:g}' width='{x1 - x0:g}' height='{y1 - y0:g}'"
            parts += f"<rect {shape} class='rim'/><rect {shape} class='line'/>"
        if box is not None and is_box:  # squares of the same size at every zoom
            points = [(x, y) for x in (x0, (x0 + x1) / 2, x1) for y in (y0, (y0 + y1) / 2, y1)]
            del points[4]  # the middle
            path = " ".join(f"M{x:g} {y:g}h0" for x, y in points)
            parts += f"<path d='{path}' class='handle rim'/><path d='{path}' class='handle line'/>"
        self.shapes.set_content(
            f"<svg viewBox='-0.5 -0.5 {W} {H}' preserveAspectRatio='none'>{parts}</svg>"
        )


def _extent(mask: np.ndarray) -> str:
    """x0 y0 x1 y1 of what is true in a mask, in its widths and heights; "" of an empty one."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    H, W = mask.shape
    box = x / W, y / H, (x + width) / W, (y + height) / H
    return " ".join(f"{v:.4f}" for v in box) if width else ""


def _pose_layers(
    registrar: Registrar, projection: tuple[Tensor, Tensor], size: tuple[int, int], side: int
) -> tuple[bytes, bytes, np.ndarray]:
    """Two transparent PNGs over a photograph of ``size`` (H, W), at most ``side`` px long: the
    shaded mesh and its contours; and a mask of the mesh."""
    T, K = projection
    scale = min(1.0, side / max(size))
    small = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    K = Camera(K, size=size).at(small).matrix
    depth = registrar.describer.renderer.render(T[None], K, small)[0, 0].cpu().float()
    mask: np.ndarray = (depth > 0).numpy()
    grey = shade(depth[None, None], K[None])[0, 0].numpy()
    colour = (grey[..., None] * np.array([255, 235, 190])).round()
    solid = np.dstack([colour, np.full(small, 255)]).astype(np.uint8) * mask[..., None]
    return png(solid), png(contour_layer(registrar.describer, T, K, small)), mask
