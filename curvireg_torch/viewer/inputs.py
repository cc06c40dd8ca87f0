"""The left side of the page: photograph, mesh, options, box, camera and what is known about the pose."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nicegui import ui

from ..limits import MAX_IMAGE_BYTES, MAX_MESH_BYTES
from ..utils.choices import MESHES_AND_BANKS, PRESET_NAMES, UNITS, UP_AXES
from .drawing import BoxDrawing
from .host import Host
from .known import KnownPose

__all__ = ["Inputs"]


class Inputs:
    """Input fields; what is typed, chosen or dropped goes into the session."""

    def __init__(self, host: Host) -> None:
        self.host, self.session, self.drawing = host, host.session, BoxDrawing()
        options = self.session.options
        self._upload("photograph", MAX_IMAGE_BYTES, "image/*", self._photo_uploaded)
        self.photo_facts = self._caption("photo-facts")
        self._upload("mesh", MAX_MESH_BYTES, ",".join(MESHES_AND_BANKS), self._mesh_uploaded)
        self.mesh_facts = self._caption("mesh-facts")
        with ui.row().classes("w-full no-wrap gap-2"):
            self._select("unit", list(UNITS), options.unit)
            self._select("up", {None: "of the format", **{axis: axis for axis in UP_AXES}}, options.up)
        with ui.row().classes("w-full no-wrap gap-2"):
            self._select("pose", {None: "default", "any": "any", "upright": "upright"}, options.pose)
            self._select("preset", {None: "default", **{name: name for name in PRESET_NAMES}}, options.preset)
        self._caption().text = (
            "box, px: draw it on the photograph; drag edges, corners or the box to correct it. Without a box the "
            "object is localized; click a dashed box to choose it"
        )
        self.box = self._numbers("box", ("x0", "y0", "x1", "y1"), self._box_typed)
        self._caption().text = "camera, px: gives the translation"
        self.camera = self._numbers("camera", ("fx", "fy", "cx", "cy"), self._camera_typed)
        self.fov = ui.number("or its horizontal field of view, degrees", on_change=self._fov_typed)
        self.fov.classes("w-full").props("dense data-testid=fov")
        self.camera_facts = self._caption("camera-facts")
        with ui.row().classes("gap-2"):
            ui.button("no box", on_click=lambda: self.set_box(None)).props("flat dense no-caps")
            ui.button("no camera", on_click=lambda: self.set_camera(None)).props("flat dense no-caps")
            self.exif = ui.button("guess from EXIF", on_click=lambda: self.set_camera(self.session.exif_camera()))
            self.exif.props("flat dense no-caps data-testid=exif").set_visibility(False)
        KnownPose(host)

    def _caption(self, test_id: str = "") -> Any:
        return ui.label().classes("text-caption leading-tight").props(f"data-testid={test_id}" if test_id else "")

    def _upload(self, what: str, limit: int, accept: str, on_upload: Callable[..., Any]) -> None:
        field = ui.upload(label=f"{what}: drop it here", auto_upload=True, max_file_size=limit, on_upload=on_upload)
        refused = f"{what}: larger than {limit:,} bytes, or not {accept}"
        field.on_rejected(lambda: self.host.show_message(refused, error=True))
        field.classes("w-full curvireg-drop").props(f'accept="{accept}" flat bordered data-testid=upload-{what}')

    def _select(self, name: str, choices: Any, value: Any) -> None:
        async def changed(event: Any) -> None:
            self.session.options = replace(self.session.options, **{name: event.value})
            if name in ("unit", "up") and self.session.mesh_path is not None:
                await self._open_mesh(self.session.mesh_path, self.session.names[self.session.mesh_path])

        select = ui.select(choices, value=value, label=name, on_change=changed).classes("grow")
        select.props(f"dense options-dense data-testid={name}")

    def _numbers(self, name: str, labels: tuple[str, ...], on_change: Callable[[], None]) -> list[Any]:
        with ui.row().classes("w-full no-wrap gap-1"):
            fields = [ui.number(label, on_change=on_change).classes("w-20").props("dense") for label in labels]
        for label, number in zip(labels, fields, strict=True):
            number.props(f"data-testid={name}-{label}")
        return fields

    async def _photo_uploaded(self, event: Any) -> None:
        path = self.host.upload_path("photo", "")
        await event.file.save(path)
        if await self.host.run(lambda: self.session.open_photo(path, event.file.name)):
            await self.host.show_photograph()

    async def _mesh_uploaded(self, event: Any) -> None:
        suffix = Path(event.file.name).suffix.lower()
        if suffix not in MESHES_AND_BANKS:
            expected = f"expected a mesh file ({', '.join(MESHES_AND_BANKS)}); convert it first"
            self.host.show_message(f"{event.file.name}: {expected}", error=True)
            return
        path = self.host.upload_path("mesh", suffix)
        await event.file.save(path)
        await self._open_mesh(path, event.file.name)

    async def _open_mesh(self, path: Path, name: str) -> None:
        facts = await self.host.run(lambda: self.session.open_mesh(path, name))
        if facts:
            self.mesh_facts.text = f"{name}: {facts}"
        self.host.update_layers()

    def handle_mouse(self, event: Any) -> None:
        """Draw or correct the box with the mouse on the photograph."""
        if self.session.photo is None or self.host.busy:
            return
        scale = self.host.scale
        x, y = event.image_x / scale - 0.5, event.image_y / scale - 0.5
        if event.type == "mousedown":
            self.drawing.press(x, y, reach=10 / scale)
        elif self.drawing.active and event.type == "mousemove" and event.buttons:
            self.drawing.move(x, y)
            self.draw_boxes()
        elif self.drawing.active:  # also if the button was released outside the photograph
            self.drawing.release()
            self.set_box(self.drawing.box or self._proposal_at(x, y))

    def _proposal_at(self, x: float, y: float) -> Any:
        """The first dashed box that contains a point, to 0.1 px, or None."""
        for x0, y0, x1, y1 in self.session.proposals():
            if x0 <= x <= x1 and y0 <= y <= y1:
                return tuple(round(v, 1) for v in (x0, y0, x1, y1))
        return None

    def set_box(self, box: Any) -> None:
        """Set the box; None: the object is localized."""
        self.session.box = self.drawing.box = box
        for number, value in zip(self.box, box or (None,) * 4, strict=True):
            number.value = value
        self.draw_boxes()

    def _box_typed(self) -> None:
        x0, y0, x1, y1 = (number.value for number in self.box)
        if None not in (x0, y0, x1, y1) and not self.drawing.active:
            self.session.box = self.drawing.box = (float(x0), float(y0), float(x1), float(y1))
            self.draw_boxes()

    def draw_boxes(self) -> None:
        """Draw the box, or dashed the proposals of the localization."""
        box = self.drawing.box
        boxes = [(box, "")] if box is not None else [(proposal, "4 6") for proposal in self.session.proposals()]
        self.host.draw("".join(self._outline(box, dashes) for box, dashes in boxes))

    def _outline(self, box: Sequence[float], dashes: str) -> str:
        x0, y0, x1, y1 = ((v + 0.5) * self.host.scale for v in box)
        shape = f"x='{x0}' y='{y0}' width='{x1 - x0}' height='{y1 - y0}' stroke-dasharray='{dashes}'"
        return "".join(
            f"<rect {shape} fill='none' vector-effect='non-scaling-stroke' stroke='{colour}' stroke-width='{width}'/>"
            for colour, width in (("black", 4), ("white", 2))
        )

    def set_camera(self, camera: Any) -> None:
        """Set the camera; None: unknown."""
        self.fov.value = None
        for number, value in zip(self.camera, camera or (None,) * 4, strict=True):
            number.value = value
        self._camera_typed()

    def _camera_typed(self) -> None:
        fx, fy, cx, cy = (number.value for number in self.camera)
        self.session.camera = None if None in (fx, fy, cx, cy) else (float(fx), float(fy), float(cx), float(cy))
        if self.session.camera is not None:
            self.fov.value = None
        self._describe_camera()

    def _fov_typed(self) -> None:
        fov = self.session.fov = None if self.fov.value is None else float(self.fov.value)
        if fov is not None:
            for number in self.camera:
                number.value = None
        self._describe_camera()

    def _describe_camera(self) -> None:
        session = self.session
        self.exif.set_visibility(session.exif_camera() is not None)
        if session.guess == "exif" and session.photo is not None:
            focal = session.photo.focal_35mm
            text = f"guessed from the photograph's EXIF, {focal:g} mm of a 35 mm camera: no covariance"
        elif session.guess is not None:
            text = "guessed from the field of view: no covariance"
        else:
            text = "" if session.camera is not None else "unknown: the result is a rotation without translation"
        self.camera_facts.text = text
