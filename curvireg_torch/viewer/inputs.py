"""The left side of the page: photograph, mesh, what is known of them, box and camera."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import ui

from ..limits import MAX_IMAGE_BYTES, MAX_MESH_BYTES
from ..utils.choices import MESHES_AND_BANKS, PRESET_NAMES, UNITS, UP_AXES
from .drawing import BoxDrawing

if TYPE_CHECKING:
    from .page import Page

__all__ = ["Inputs"]


class Inputs:
    """Fields of a page; what is typed, chosen or dropped goes into its session.

    Attributes:
        drawing: the box, as the mouse draws it.
    """

    def __init__(self, page: "Page") -> None:
        self.page, self.session, self.drawing = page, page.session, BoxDrawing()
        options = self.session.options
        self._upload("photograph", MAX_IMAGE_BYTES, "image/*", self._photo_came)
        self.photo_facts = self._told("photo-facts")
        self._upload("mesh", MAX_MESH_BYTES, ",".join(MESHES_AND_BANKS), self._mesh_came)
        self.mesh_facts = self._told("mesh-facts")
        with ui.row().classes("w-full no-wrap gap-2"):
            self._choice("unit", list(UNITS), options.unit)
            self._choice("up", {None: "as the format says", **{a: a for a in UP_AXES}}, options.up)
        with ui.row().classes("w-full no-wrap gap-2"):
            self._choice("pose", {None: "default", "any": "any", "upright": "upright"}, options.pose)
            self._choice("preset", {None: "default", **{p: p for p in PRESET_NAMES}}, options.preset)
        self._told().text = (
            "box, px: draw it on the photograph; drag edges, corners or the box to correct it; none: it is looked for, "
            "and a click on a dashed box takes that"
        )
        self.box = self._numbers("box", ("x0", "y0", "x1", "y1"), self._box_typed)
        self._told().text = "camera, px: gives the translation"
        self.camera = self._numbers("camera", ("fx", "fy", "cx", "cy"), self._camera_typed)
        self.fov = ui.number("or its field of view, degrees across", on_change=self._fov_typed)
        self.fov.classes("w-full").props("dense data-testid=fov")
        self.camera_facts = self._told("camera-facts")
        with ui.row().classes("gap-2"):
            ui.button("no box", on_click=lambda: self.set_box(None)).props("flat dense no-caps")
            ui.button("no camera", on_click=lambda: self.set_camera(None)).props("flat dense no-caps")
            self.exif = ui.button("guess by EXIF", on_click=lambda: self.set_camera(self.session.guessed_camera()))
            self.exif.props("flat dense no-caps data-testid=exif").set_visibility(False)

    def _told(self, test: str = "") -> Any:
        return ui.label().classes("text-caption leading-tight").props(f"data-testid={test}" if test else "")

    def _upload(self, what: str, limit: int, kinds: str, came: Callable[..., Any]) -> None:
        box = ui.upload(label=f"{what}: drop it here", auto_upload=True, max_file_size=limit, on_upload=came)
        box.on_rejected(lambda: self.page.say(f"{what}: larger than {limit:,} bytes, or not {kinds}", wrong=True))
        box.classes("w-full curvireg-drop").props(f'accept="{kinds}" flat bordered data-testid=upload-{what}')

    def _choice(self, name: str, choices: Any, value: Any) -> None:
        async def chosen(event: Any) -> None:
            setattr(self.session.options, name, event.value)
            if name in ("unit", "up") and self.session.mesh is not None:
                await self._take_mesh(self.session.mesh, self.session.names[self.session.mesh])

        select = ui.select(choices, value=value, label=name, on_change=chosen).classes("grow")
        select.props(f"dense options-dense data-testid={name}")

    def _numbers(self, name: str, labels: tuple[str, ...], typed: Callable[[], None]) -> list[Any]:
        with ui.row().classes("w-full no-wrap gap-1"):
            fields = [ui.number(label, on_change=typed).classes("w-20").props("dense") for label in labels]
        for label, number in zip(labels, fields, strict=True):
            number.props(f"data-testid={name}-{label}")
        return fields

    async def _photo_came(self, event: Any) -> None:
        path = await self._saved(event.file, "photo", "")
        if await self.page.do(lambda: self.session.take_photo(path, event.file.name)):
            await self.page.show_photograph()

    async def _mesh_came(self, event: Any) -> None:
        suffix = Path(event.file.name).suffix.lower()
        if suffix not in MESHES_AND_BANKS:
            self.page.say(
                f"{event.file.name}: expected a mesh file ({', '.join(MESHES_AND_BANKS)}); convert it first", wrong=True
            )
            return
        await self._take_mesh(await self._saved(event.file, "mesh", suffix), event.file.name)

    async def _take_mesh(self, path: Path, name: str) -> None:
        told = await self.page.do(lambda: self.session.take_mesh(path, name))
        if told:
            self.mesh_facts.text = f"{name}: {told}"
        self.page.arrange_layers()

    async def _saved(self, file: Any, what: str, suffix: str) -> Path:
        path = self.page.folder / f"{what}-{self.page.counted()}{suffix}"
        await file.save(path)
        return path

    def mouse(self, event: Any) -> None:
        """The mouse on the photograph."""
        if self.session.picture is None or self.page.busy:
            return
        scale = self.page.scale
        x, y = event.image_x / scale - 0.5, event.image_y / scale - 0.5
        if event.type == "mousedown":
            self.drawing.press(x, y, reach=10 / scale)
        elif self.drawing.active and event.type == "mousemove" and event.buttons:
            self.drawing.move(x, y)
            self._draw()
        elif self.drawing.active:  # also where the button came up beside the photograph
            self.drawing.release()
            self.set_box(self.drawing.box or self._proposed(x, y))

    def _proposed(self, x: float, y: float) -> Any:
        """The first of the dashed boxes in which a click lies, to 0.1 px; None where there is none."""
        for x0, y0, x1, y1 in self.session.proposals():
            if x0 <= x <= x1 and y0 <= y <= y1:
                return tuple(round(v, 1) for v in (x0, y0, x1, y1))
        return None

    def set_box(self, box: Any) -> None:
        """Take a box, or None: the object is looked for."""
        self.session.box = self.drawing.box = box
        for number, value in zip(self.box, box or (None,) * 4, strict=True):
            number.value = value
        self._draw()

    def _box_typed(self) -> None:
        x0, y0, x1, y1 = (number.value for number in self.box)
        if None not in (x0, y0, x1, y1) and not self.drawing.active:
            self.session.box = self.drawing.box = (float(x0), float(y0), float(x1), float(y1))
            self._draw()

    def _draw(self) -> None:
        given = self.drawing.box
        boxes = [(given, "")] if given is not None else [(b, "4 6") for b in self.session.proposals()]
        self.page.image.content = "".join(self._outline(box, dashes) for box, dashes in boxes)

    def _outline(self, box: Sequence[float], dashes: str) -> str:
        x0, y0, x1, y1 = ((v + 0.5) * self.page.scale for v in box)
        place = f"x='{x0}' y='{y0}' width='{x1 - x0}' height='{y1 - y0}' stroke-dasharray='{dashes}'"
        return "".join(
            f"<rect {place} fill='none' vector-effect='non-scaling-stroke' stroke='{colour}' stroke-width='{width}'/>"
            for colour, width in (("black", 4), ("white", 2))
        )

    def proposals_changed(self) -> None:
        """Draw where the object was looked for."""
        self._draw()

    def set_camera(self, camera: Any) -> None:
        """Take a camera, or None for an unknown one."""
        self.fov.value = None
        for number, value in zip(self.camera, camera or (None,) * 4, strict=True):
            number.value = value
        self._camera_typed()

    def _camera_typed(self) -> None:
        fx, fy, cx, cy = (number.value for number in self.camera)
        self.session.camera = None if None in (fx, fy, cx, cy) else (float(fx), float(fy), float(cx), float(cy))
        if self.session.camera is not None:
            self.fov.value = None
        self._tell_camera()

    def _fov_typed(self) -> None:
        fov = self.session.fov = None if self.fov.value is None else float(self.fov.value)
        if fov is not None:
            for number in self.camera:
                number.value = None
        self._tell_camera()

    def _tell_camera(self) -> None:
        """Say where the camera is from."""
        session = self.session
        self.exif.set_visibility(session.guessed_camera() is not None)
        if session.guessed and session.picture is not None:
            focal = session.picture.focal_35mm
            self.camera_facts.text = f"a guess by the photograph's EXIF, {focal:g} mm of a 35 mm camera: no covariance"
        elif session.guess is not None:
            self.camera_facts.text = "a guess by the field of view: no covariance"
        else:
            unknown = "unknown: the answer is a rotation without translation"
            self.camera_facts.text = "" if session.camera is not None else unknown
