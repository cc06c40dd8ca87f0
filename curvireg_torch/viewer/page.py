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

from ..errors import CurviregError
from .inputs import Inputs
from .panels import Panels
from .pictures import pose_layers, shown_photograph
from .session import Session

__all__ = ["Page"]

WORKER = ThreadPoolExecutor(1, thread_name_prefix="viewer")
"""All computing of all pages, one job after the other: two at a time would only slow each other down."""

STAGES = {
    "bank": "rendering views",
    "looking": "looking for the object",
    "ranking": "ranking views",
    "search": "searching",
    "contours": "following contours",
}
STYLE = ".curvireg-drop .q-uploader__list, .curvireg-drop .q-uploader__subtitle { display: none }"
SEEN = "sticky top-0 z-10 bg-white"  # wherever the page is scrolled to
_here = threading.local()


class Page:
    """One browser's page.

    Attributes:
        session: what it knows.
        folder: for its uploads.
        files: name -> content and media type, served under ``address``.
        scale, size: of the photograph as shown, to the photograph; (H, W) px.
    """

    def __init__(self, session: Session, folder: Path, address: str) -> None:
        self.session, self.folder, self.address = session, folder, address
        self.files: dict[str, tuple[bytes, str]] = {}
        self.busy, self.scale, self.size, self._count = False, 1.0, (1, 1), 0

    @staticmethod
    def load(session: Session, arguments: argparse.Namespace) -> str:
        """Give a session what the command line names; says what the mesh is."""
        if arguments.photo is not None:
            session.take_photo(arguments.photo)
        told = "" if arguments.mesh is None else session.take_mesh(arguments.mesh)
        session.box = arguments.box and tuple(arguments.box)
        session.camera = arguments.camera and tuple(arguments.camera)
        session.fov = arguments.fov
        return told

    @staticmethod
    def show_warning(message: Any, *_: Any, **__: Any) -> None:
        """Warnings of a job belong to its page."""
        getattr(_here, "notes", []).append(str(message))

    def counted(self) -> int:
        """Another number each time."""
        self._count += 1
        return self._count

    def put(self, name: str, content: bytes, kind: str = "image/png") -> str:
        """Serve a file; returns its address, another one each time."""
        self.files[name] = (content, kind)
        return f"{self.address}/{name}?v={self.counted()}"

    async def do(self, job: Callable[[], Any]) -> Any:
        """Run a job in the worker's thread; what is wrong is said on the page, and None is returned.

        One at a time: what is asked for meanwhile is not done.
        """
        if self.busy:
            return None
        self.busy, self.session.progress = True, ("", 0, 1)
        notes: list[str] = []

        def noted() -> Any:
            _here.notes = notes
            return job()

        try:
            result = await asyncio.get_running_loop().run_in_executor(WORKER, noted)
            if notes:
                self.say("; ".join(notes))
            return True if result is None else result
        except (CurviregError, OSError) as error:
            self.say(str(error), wrong=True)
        except Exception as error:  # a page never falls over; the terminal has the whole story
            traceback.print_exc()
            self.say(f"{type(error).__name__}: {error}; the terminal says more", wrong=True)
        finally:
            self.busy = False
        return None

    def say(self, text: str, *, wrong: bool = False) -> None:
        """Put a message on the page."""
        self.message.text = self.session.said(text)
        self.message.classes(replace=f"{SEEN} text-negative" if wrong else f"{SEEN} text-orange-9")

    def build(self, arguments: argparse.Namespace) -> None:
        """Lay out the page, and load what the command line named."""
        ui.add_css(STYLE)
        with ui.row().classes("w-full no-wrap items-start gap-4"):
            with ui.column().classes("w-80 shrink-0 gap-2"):
                ui.label("curvireg").classes("text-h5")
                self.inputs = Inputs(self)
                self._actions()
            with ui.column().classes("grow min-w-0 gap-1"):
                self.message = ui.label().props("data-testid=message")
                self.image = ui.interactive_image(
                    on_mouse=self.inputs.mouse, events=["mousedown", "mousemove", "mouseup"], sanitize=False
                ).props("data-testid=photograph")
                with self.image:
                    self.solid, self.lines = (ui.element("img").classes("hidden") for _ in range(2))
                with ui.row().classes("items-center w-full gap-4"):
                    self.opacity = self._slider("mesh", 0.35)
                    self.wipe = self._slider("wipe", 1.0)
                    self.contours = ui.switch("contours", value=True, on_change=self.arrange_layers)
                self.panels = Panels(self)
        ui.timer(0.2, self._tick)
        ui.timer(0, lambda: self._start(arguments), once=True)

    def _actions(self) -> None:
        with ui.row().classes("w-full no-wrap gap-2"):
            self.go = ui.button("register", on_click=self._register).classes("grow").props("data-testid=register")
            self.find = ui.button("find it", on_click=self._find).props("outline data-testid=find")
            ui.button("stop", on_click=self.session.stop).props("outline data-testid=stop")
        self.progress = ui.linear_progress(0, show_value=False).props("instant-feedback")
        self.stage = ui.label().classes("text-caption").props("data-testid=stage")
        self.command = ui.textarea("the same on the command line").classes("w-full text-caption")
        self.command.props("readonly autogrow outlined dense data-testid=command")
        copy = "() => navigator.clipboard.writeText(document.querySelector('[data-testid=command]').value)"
        ui.button("copy").props("flat dense no-caps").on("click", js_handler=copy)

    def _slider(self, name: str, value: float) -> Any:
        ui.label(name)
        slider = ui.slider(min=0, max=1, step=0.01, value=value, on_change=self.arrange_layers)
        return slider.classes("w-40").props(f"data-testid={name}")

    async def _start(self, arguments: argparse.Namespace) -> None:
        told = await self.do(lambda: self.load(self.session, arguments))
        self.inputs.mesh_facts.text = told if isinstance(told, str) else ""
        if self.session.picture is not None:
            await self.show_photograph()

    async def show_photograph(self) -> None:
        """Show the session's photograph, its box and its camera."""
        picture = self.session.picture
        assert picture is not None
        found = await self.do(lambda: shown_photograph(picture.image))
        if not found:
            return
        content, self.scale = found
        H, W = (int(n) for n in picture.image.shape[-2:])
        self.size = max(1, round(H * self.scale)), max(1, round(W * self.scale))
        self.image.set_source(self.put("photograph.jpg", content, "image/jpeg"))
        self.image.style(f"width: min(100%, calc(60vh * {W} / {H}))")
        self.inputs.photo_facts.text = "; ".join([f"{W} x {H} px", *picture.notes])
        self.inputs.set_box(self.session.box)
        fov = self.session.fov
        self.inputs.set_camera(self.session.camera)
        self.inputs.fov.value = None if self.session.camera else fov
        self.arrange_layers()

    async def _register(self) -> None:
        self.message.text, self.stage.text = "", "starting"
        if await self.do(self.session.register):
            self.inputs.proposals_changed()
            await self.pose_changed(answer=True)

    async def _find(self) -> None:
        if not self.busy:
            self.inputs.set_box(None)
            await self._register()

    async def pose_changed(self, *, answer: bool = False) -> None:
        """Show the pose of the session; ``answer``: of a new answer."""
        found, shown = self.session.seen()
        layers = await self.do(lambda: pose_layers(found.registrar, shown.pose, self.size, self.scale))
        if layers:
            for element, name, content in zip((self.solid, self.lines), ("solid", "lines"), layers, strict=True):
                element.props(f'src="{self.put(name + ".png", content)}"')
            self.arrange_layers()
        await self.panels.changed(answer=answer)

    def arrange_layers(self) -> None:
        """Show as much of the pose as the sliders say, and nothing of it where there is no answer."""
        place = "position:absolute;inset:0;width:100%;height:100%;pointer-events:none"
        clip = f"clip-path:inset(0 {100 - 100 * self.wipe.value:.1f}% 0 0)"
        there = self.session.shown is not None
        for element, opacity in ((self.solid, self.opacity.value), (self.lines, float(self.contours.value))):
            element.classes(remove="hidden") if there else element.classes(add="hidden")
            element.style(replace=f"{place};{clip};opacity:{opacity}")
        if not there:
            self.panels.clear()

    def _tick(self) -> None:
        """What changes by itself: the command line, and how far the work is."""
        self.command.value = self.session.command()
        for button in (self.go, self.find):
            button.set_enabled(not self.busy)
        stage, done, of = self.session.progress
        if self.busy:
            if stage:
                self.progress.value = (list(STAGES).index(stage) + done / of) / len(STAGES)
                self.stage.text = STAGES[stage] + (f": {done} of {of}" if of > 1 else "")
        elif self.session.answer is not None:
            self.progress.value = 1.0
            changed = self.session.answer.command != self.session.command()
            self.stage.text = "the inputs have changed since this answer" if changed else "done"
        else:
            self.progress.value, self.stage.text = 0.0, ""
