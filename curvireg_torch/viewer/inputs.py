"""What can be given besides the photograph, the mesh and a drawn box: numbers, options, the camera."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from nicegui import ui

from ..utils.choices import PRESET_NAMES, UNITS, UP_AXES
from .known import KnownPose
from .widgets import button, region, set_text, text
from .workspace import Workspace

__all__ = ["Inputs"]

AXES: Mapping[str | None, str] = {None: "as the format says", **{axis: axis for axis in UP_AXES}}
POSES: Mapping[str | None, str] = {None: "default", "any": "any", "upright": "upright"}
PRESETS: Mapping[str | None, str] = {None: "default", **{name: name for name in PRESET_NAMES}}


class Inputs:
    """Input fields; what is typed or chosen goes into the session, and what changes there is shown."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.shown: tuple[Any, ...] = ()
        self._showing = False  # while fields are filled one after the other
        self.selects: dict[str, Any] = {}
        options = self.session.options
        with self._fold("Mesh and method", "options", is_open=True):
            self._select("unit", "unit of the mesh", {unit: unit for unit in UNITS}, options.unit)
            self._select("up", "axis that points up", AXES, options.up)
            self._select("pose", "how it may stand", POSES, options.pose)
            self._select("preset", "method", PRESETS, options.preset)
        with self._fold("Camera", "camera"):
            text("p", "With it the position is found, not only the rotation.", "facts")
            self.camera = self._numbers("camera", ("fx", "fy", "cx", "cy"), self._camera_typed)
            self.fov = ui.number("or the horizontal field of view, degrees", on_change=self._fov_typed)
            self.fov.props("dense data-testid=fov")
            self.camera_facts = text("p", "", "facts", data_testid="camera-facts")
            with region("div", "row"):
                button("No camera", lambda: self._set_camera(None), "no-camera", "quiet")
                self.exif = button("Guess from EXIF", self._guess_camera, "exif", "quiet")
        with self._fold("Box in pixels", "box-numbers"):
            self.box = self._numbers("box", ("x0", "y0", "x1", "y1"), self._box_typed)
        with self._fold("What is known about the pose", "known"):
            self.known = KnownPose(self.session)
        with self._fold("The same on the command line", "command-line"):
            self.command = ui.textarea("command").props("readonly autogrow dense data-testid=command")
            copy = "() => navigator.clipboard.writeText(document.querySelector('[data-testid=command]').value)"
            text("button", "Copy", "button quiet", type="button").on("click", js_handler=copy)

    def _fold(self, title: str, test_id: str, *, is_open: bool = False) -> Any:
        fold = region("details", "fold", data_testid=f"fold-{test_id}").props("open" if is_open else "")
        with fold:
            text("summary", title)
        return fold

    def _select(self, name: str, label: str, choices: Mapping[Any, str], value: Any) -> None:
        async def changed(event: Any) -> None:
            if getattr(self.session.options, name) == event.value:
                return
            self.session.options = replace(self.session.options, **{name: event.value})
            path = self.session.mesh_path
            if name in ("unit", "up") and path is not None:
                await self.workspace.open_mesh(path, self.session.names[path])

        select = ui.select(dict(choices), value=value, label=label, on_change=changed)
        select.props(f"dense options-dense data-testid={name}")
        self.selects[name] = select

    def _numbers(self, name: str, labels: tuple[str, ...], on_change: Callable[[], None]) -> list[Any]:
        with region("div", "numbers"):
            fields = [ui.number(label, on_change=on_change).props("dense") for label in labels]
        for label, number in zip(labels, fields, strict=True):
            number.props(f"data-testid={name}-{label}")
        return fields

    def _box_typed(self) -> None:
        values = [number.value for number in self.box]
        if None not in values and not self._showing:
            self.workspace.set_box(tuple(map(float, values)))

    def _camera_typed(self) -> None:
        fx, fy, cx, cy = (number.value for number in self.camera)
        if None not in (fx, fy, cx, cy) and not self._showing:
            self.session.camera, self.session.fov = (float(fx), float(fy), float(cx), float(cy)), None

    def _fov_typed(self) -> None:
        if self._showing:
            return
        if self.fov.value is not None:
            self.session.camera, self.session.fov = None, float(self.fov.value)
        elif self.session.camera is None:
            self.session.fov = None

    def _set_camera(self, camera: Any) -> None:
        self.session.camera, self.session.fov = camera, None

    def _guess_camera(self) -> None:
        self._set_camera(self.session.exif_camera())

    def refresh(self) -> None:
        """Show what changed in the session since the last time."""
        session = self.session
        self.command.value = session.command()
        now = (session.box, session.camera, session.fov, session.photo_path, session.options)
        if now == self.shown:
            return
        self.shown, self._showing = now, True
        for fields, values in ((self.box, session.box), (self.camera, session.camera)):
            for number, value in zip(fields, values or (None,) * 4, strict=True):
                number.value = value
        self.fov.value = session.fov
        for name, select in self.selects.items():
            select.value = getattr(session.options, name)
        self._showing = False
        self.exif.set_visibility(session.exif_camera() is not None)
        set_text(self.camera_facts, self._describe_camera())

    def _describe_camera(self) -> str:
        session = self.session
        if session.guess == "exif" and session.photo is not None:
            return (
                f"guessed from the photograph's EXIF, {session.photo.focal_35mm:g} mm of a 35 mm camera: no covariance"
            )
        if session.guess is not None:
            return "guessed from the field of view: no covariance"
        return "" if session.camera is not None else "unknown: the result is a rotation without translation"
