"""The page: inputs on the left, the photograph in the middle, what was found below it."""

import argparse
import asyncio
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from nicegui import ui

from .._choices import PRESET_NAMES, UNITS, UP_AXES
from ..errors import CurviregError
from ..limits import MAX_IMAGE_BYTES, MAX_MESH_BYTES
from .drawing import BoxDrawing
from .panels import Panels
from .pictures import pose_layers, shown_photograph
from .session import Session

__all__ = ["Page"]

WORKER = ThreadPoolExecutor(1, thread_name_prefix="viewer")
"""All computing of all pages, one job after the other: two at a time would only slow each other down."""

STAGES = {"bank": "rendering views", "ranking": "ranking them", "search": "searching", "contours": "following contours"}
MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".safetensors")
_here = threading.local()


class Page:
    """One browser's page.

    Attributes:
        session: what it knows.
        files: name -> content and media type, served under ``address``.
    """

    def __init__(self, session: Session, folder: Path, address: str) -> None:
        self.session, self.folder, self.address = session, folder, address
        self.files: dict[str, tuple[bytes, str]] = {}
        self.drawing = BoxDrawing()
        self.busy, self.version, self.scale, self.size = False, 0, 1.0, (1, 1)

    @staticmethod
    def started(session: Session, arguments: argparse.Namespace) -> str:
        """Give a session what the command line names; says what the mesh is."""
        if arguments.photo is not None:
            session.take_photo(arguments.photo)
        told = "" if arguments.mesh is None else session.take_mesh(arguments.mesh)
        session.box = arguments.box and tuple(arguments.box)
        session.camera = tuple(arguments.camera) if arguments.camera else session.guessed_camera()
        return told

    @staticmethod
    def show_warning(message: Any, *_: Any, **__: Any) -> None:
        """Warnings of a job belong to its page."""
        getattr(_here, "notes", []).append(str(message))

    def put(self, name: str, content: bytes, kind: str = "image/png") -> str:
        """Serve a file; returns its address, another one each time."""
        self.files[name] = (content, kind)
        self.version += 1
        return f"{self.address}/{name}?v={self.version}"

    async def do(self, job: Callable[[], Any]) -> Any:
        """Run a job in the worker's thread; what is wrong is said on the page, and None is returned.

        One at a time: whatever is asked for meanwhile is not done.
        """
        if self.busy:
            return None
        self.busy = True
        self.message.text = ""
        notes: list[str] = []

        def noted() -> Any:
            _here.notes = notes
            return job()

        try:
            result = await asyncio.get_running_loop().run_in_executor(WORKER, noted)
            self.say("; ".join(notes))
            return True if result is None else result
        except (CurviregError, OSError) as error:
            self.say(self.session.said(str(error)), wrong=True)
        except Exception as error:  # a page never falls over; the terminal has the whole story
            traceback.print_exc()
            self.say(f"{type(error).__name__}: {error}; the terminal says more", wrong=True)
        finally:
            self.busy = False
        return None

    def say(self, text: str, *, wrong: bool = False) -> None:
        """Put a message on the page."""
        self.message.text = self.session.said(text)
        self.message.classes(replace="text-negative" if wrong else "text-warning")

    def build(self, arguments: argparse.Namespace) -> None:
        """Lay out the page, and load what the command line named."""
        ui.query(".nicegui-content").classes("p-2")
        with ui.row().classes("w-full no-wrap items-start gap-4"):
            with ui.column().classes("w-80 shrink-0 gap-2"):
                ui.label("curvireg").classes("text-h5")
                self._inputs()
            with ui.column().classes("grow min-w-0 gap-2"):
                self.message = ui.label().props("data-testid=message")
                self.image = ui.interactive_image(
                    on_mouse=self._mouse, events=["mousedown", "mousemove", "mouseup"], sanitize=False
                ).props("data-testid=photograph")
                with self.image:
                    self.solid, self.lines = (ui.element("img").classes("hidden") for _ in range(2))
                with ui.row().classes("items-center w-full gap-4"):
                    ui.label("mesh")
                    self.opacity = ui.slider(min=0, max=1, step=0.01, value=0.35, on_change=self._layers)
                    self.opacity.classes("w-40").props("data-testid=opacity")
                    ui.label("wipe")
                    self.wipe = ui.slider(min=0, max=1, step=0.01, value=1, on_change=self._layers)
                    self.wipe.classes("w-40").props("data-testid=wipe")
                    self.contours = ui.switch("contours", value=True, on_change=self._layers)
                self.panels = Panels(self)
        ui.timer(0.2, self._tick)
        ui.timer(0, lambda: self._start(arguments), once=True)

    async def _start(self, arguments: argparse.Namespace) -> None:
        told = await self.do(lambda: self.started(self.session, arguments))
        if told and isinstance(told, str):
            self.mesh_facts.text = told
        if self.session.picture is not None:
            await self._show_photograph()

    def _inputs(self) -> None:
        options = self.session.options
        self._upload("photograph", MAX_IMAGE_BYTES, "image/*", self._photo_came)
        self.photo_facts = ui.label().classes("text-caption").props("data-testid=photo-facts")
        self._upload("mesh", MAX_MESH_BYTES, ",".join(MESHES), self._mesh_came)
        self.mesh_facts = ui.label().classes("text-caption").props("data-testid=mesh-facts")
        with ui.row().classes("w-full no-wrap gap-2"):
            self._choice("unit", list(UNITS), options.unit)
            self._choice("up", {None: "as the format says", **{a: a for a in UP_AXES}}, options.up)
        with ui.row().classes("w-full no-wrap gap-2"):
            self._choice("pose", {None: "default", "any": "any", "upright": "upright"}, options.pose)
            self._choice("preset", {None: "default", **{p: p for p in PRESET_NAMES}}, options.preset)
        ui.label("box, px: draw it on the photograph; edges, corners and the box can be dragged").classes(
            "text-caption"
        )
        self.box = self._numbers("box", ("x0", "y0", "x1", "y1"), self._box_typed)
        ui.label("camera, px: gives the translation").classes("text-caption")
        self.camera = self._numbers("camera", ("fx", "fy", "cx", "cy"), self._camera_typed)
        self.camera_facts = ui.label().classes("text-caption").props("data-testid=camera-facts")
        with ui.row().classes("gap-2"):
            ui.button("whole picture", on_click=lambda: self._set_box(None)).props("flat dense no-caps")
            ui.button("no camera", on_click=lambda: self._set_camera(None)).props("flat dense no-caps")
        with ui.row().classes("w-full no-wrap gap-2"):
            self.go = ui.button("register", on_click=self._register).classes("grow").props("data-testid=register")
            ui.button("stop", on_click=self.session.stop).props("outline data-testid=stop")
        self.progress = ui.linear_progress(0, show_value=False).props("data-testid=progress")
        self.stage = ui.label().classes("text-caption").props("data-testid=stage")
        self.command = ui.textarea("the same on the command line").props("readonly autogrow outlined dense")
        self.command.classes("w-full text-caption").props("data-testid=command")
        copy = "() => navigator.clipboard.writeText(document.querySelector('[data-testid=command]').value)"
        ui.button("copy").props("flat dense no-caps").on("click", js_handler=copy)

    def _upload(self, what: str, limit: int, kinds: str, came: Callable[..., Any]) -> None:
        box = ui.upload(label=f"{what}: drop it here", auto_upload=True, max_file_size=limit, on_upload=came)
        box.on_rejected(lambda: self.say(f"{what}: larger than {limit:,} bytes, or not one of {kinds}", wrong=True))
        box.classes("w-full").props(f'accept="{kinds}" flat bordered data-testid=upload-{what}')

    def _choice(self, name: str, choices: Any, value: Any) -> None:
        async def chosen(event: Any) -> None:
            setattr(self.session.options, name, event.value)
            if name in ("unit", "up") and self.session.mesh is not None:
                mesh = self.session.mesh
                self.mesh_facts.text = (
                    await self.do(lambda: self.session.take_mesh(mesh, self.session.names[mesh])) or ""
                )

        ui.select(choices, value=value, label=name, on_change=chosen).classes("grow").props(
            f"dense options-dense data-testid={name}"
        )

    def _numbers(self, name: str, labels: tuple[str, ...], typed: Callable[[], None]) -> list[Any]:
        with ui.row().classes("w-full no-wrap gap-1"):
            fields = [ui.number(label, on_change=typed).classes("w-20").props("dense") for label in labels]
        for label, number in zip(labels, fields, strict=True):
            number.props(f"data-testid={name}-{label}")
        return fields

    async def _photo_came(self, event: Any) -> None:
        path = await self._saved(event.file, "photo", "")
        if await self.do(lambda: self.session.take_photo(path, event.file.name)):
            self.session.camera = self.session.guessed_camera()
            await self._show_photograph()

    async def _mesh_came(self, event: Any) -> None:
        suffix = Path(event.file.name).suffix.lower()
        if suffix not in MESHES:
            self.say(f"{event.file.name}: expected a mesh file ({', '.join(MESHES)}); convert it first", wrong=True)
            return
        path = await self._saved(event.file, "mesh", suffix)
        told = await self.do(lambda: self.session.take_mesh(path, event.file.name))
        if told:
            self.mesh_facts.text = f"{event.file.name}: {told}"
            self._layers()

    async def _saved(self, file: Any, what: str, suffix: str) -> Path:
        self.version += 1
        path = self.folder / f"{what}-{self.version}{suffix}"
        await file.save(path)
        return path

    async def _show_photograph(self) -> None:
        picture = self.session.picture
        assert picture is not None
        found = await self.do(lambda: shown_photograph(picture.image))
        if not found:
            return
        content, self.scale = found
        H, W = (int(n) for n in picture.image.shape[-2:])
        self.size = max(1, round(H * self.scale)), max(1, round(W * self.scale))
        self.image.set_source(self.put("photograph.jpg", content, "image/jpeg"))
        self.image.style(f"width: min(100%, calc(68vh * {W} / {H}))")
        self.photo_facts.text = "; ".join([f"{W} x {H} px", *picture.notes])
        self._set_box(self.session.box)
        self._set_camera(self.session.camera)
        self._layers()

    def _mouse(self, event: Any) -> None:
        if self.session.picture is None or self.busy:
            return
        x, y = event.image_x / self.scale - 0.5, event.image_y / self.scale - 0.5
        if event.type == "mousedown":
            self.drawing.press(x, y, reach=10 / self.scale)
        elif event.type == "mouseup" or not event.buttons:
            if not self.drawing.active:
                return
            self.drawing.release()
        elif self.drawing.active:
            self.drawing.move(x, y)
            self._draw_box()
            return
        if event.type != "mousemove" or not event.buttons:
            self._set_box(self.drawing.box)

    def _set_box(self, box: Any) -> None:
        self.session.box = self.drawing.box = box
        for number, value in zip(self.box, box or (None,) * 4, strict=True):
            number.value = value
        self._draw_box()

    def _box_typed(self) -> None:
        values = [number.value for number in self.box]
        if None not in values and tuple(values) != self.session.box and not self.drawing.active:
            x0, y0, x1, y1 = (float(v) for v in values)
            self.session.box = self.drawing.box = (x0, y0, x1, y1)
            self._draw_box()

    def _draw_box(self) -> None:
        if self.drawing.box is None:
            self.image.content = ""
            return
        x0, y0, x1, y1 = ((v + 0.5) * self.scale for v in self.drawing.box)
        line = "fill='none' vector-effect='non-scaling-stroke'"
        at = f"x='{x0}' y='{y0}' width='{x1 - x0}' height='{y1 - y0}'"
        self.image.content = (
            f"<rect {at} {line} stroke='black' stroke-width='3'/><rect {at} {line} stroke='white' stroke-width='1.5'/>"
        )

    def _set_camera(self, camera: Any) -> None:
        self.session.camera = camera
        for number, value in zip(self.camera, camera or (None,) * 4, strict=True):
            number.value = value
        self._camera_typed()

    def _camera_typed(self) -> None:
        fx, fy, cx, cy = (number.value for number in self.camera)
        self.session.camera = None if None in (fx, fy, cx, cy) else (float(fx), float(fy), float(cx), float(cy))
        guess = self.session.guessed_camera()
        if self.session.camera is None:
            told = "unknown: the answer is a rotation alone" + ("" if guess is None else "; EXIF could guess it")
        else:
            told = "guessed by the EXIF focal length" if self.session.camera == guess else ""
        self.camera_facts.text = told

    async def _register(self) -> None:
        if await self.do(self.session.register):
            await self.pose_changed(answer=True)

    async def pose_changed(self, *, answer: bool = False) -> None:
        """Show the pose of the session; ``answer``: of a new answer."""
        found, shown = self.session.seen()
        layers = await self.do(lambda: pose_layers(found.registrar, shown.pose, self.size, self.scale))
        if layers:
            for element, name, content in zip((self.solid, self.lines), ("solid", "lines"), layers, strict=True):
                element.props(f'src="{self.put(name + ".png", content)}"')
            self._layers()
        await self.panels.changed(answer=answer)

    def _layers(self) -> None:
        place = "position:absolute;inset:0;width:100%;height:100%;pointer-events:none"
        clip = f"clip-path: inset(0 {100 - 100 * self.wipe.value}% 0 0)"
        there = self.session.shown is not None
        for element, opacity in ((self.solid, self.opacity.value), (self.lines, float(self.contours.value))):
            element.classes(remove="hidden") if there else element.classes(add="hidden")
            element.style(replace=f"{place};{clip};opacity:{opacity}")

    def _tick(self) -> None:
        """What changes by itself: the command line, and how far the work is."""
        self.command.value = self.session.command()
        self.go.set_enabled(not self.busy)
        stage, done, of = self.session.progress
        if self.busy and stage:
            share = (list(STAGES).index(stage) + done / of) / len(STAGES)
            self.progress.value = share
            self.stage.text = STAGES[stage] + (f": {done} of {of}" if of > 1 else "")
        elif self.session.answer is not None:
            self.progress.value = 1.0
            changed = self.session.answer.command != self.session.command()
            self.stage.text = "the inputs have changed since this answer" if changed else "done"
