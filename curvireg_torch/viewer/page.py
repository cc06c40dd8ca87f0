"""The page: inputs on the left, the photograph in the middle, panels with the result below it."""

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
from .pictures import photograph_jpeg, pose_layers
from .session import Session

__all__ = ["Page"]

# Runs the jobs of all pages one after the other: two at a time would slow each other down.
WORKER = ThreadPoolExecutor(1, thread_name_prefix="viewer")

STAGES = {
    "bank": "rendering views",
    "localization": "localizing the object",
    "ranking": "ranking views",
    "search": "searching",
    "contours": "fitting contours",
}
STYLE = ".curvireg-drop .q-uploader__list, .curvireg-drop .q-uploader__subtitle { display: none }"
MESSAGE = "sticky top-0 z-10 bg-white"  # visible wherever the page is scrolled to
_thread = threading.local()


class Page:
    """The page of one browser window; it is the :class:`~curvireg_torch.viewer.host.Host` of its parts.

    ``folder`` is for uploaded files; ``files`` are served under ``address``.
    """

    def __init__(self, session: Session, folder: Path, address: str) -> None:
        self.session, self.folder, self.address = session, folder, address
        self.files: dict[str, tuple[bytes, str]] = {}
        self.busy, self.scale, self.size, self._count = False, 1.0, (1, 1), 0

    @staticmethod
    def show_warning(message: Any, *_: Any, **__: Any) -> None:
        """Collect the warnings of a job, for its page; replaces ``warnings.showwarning``."""
        getattr(_thread, "warnings", []).append(message)

    def _next_number(self) -> int:
        self._count += 1
        return self._count

    def upload_path(self, prefix: str, suffix: str) -> Path:
        return self.folder / f"{prefix}-{self._next_number()}{suffix}"

    def serve(self, name: str, content: bytes, media_type: str = "image/png") -> str:
        self.files[name] = (content, media_type)
        return f"{self.address}/{name}?v={self._next_number()}"

    async def run(self, job: Callable[[], Any]) -> Any:
        if self.busy:  # one job at a time; others are dropped
            return None
        self.busy, self.session.progress = True, ("", 0, 1)
        caught: list[Any] = []

        def run_job() -> Any:
            _thread.warnings = caught
            return job()

        try:
            result = await asyncio.get_running_loop().run_in_executor(WORKER, run_job)
            if caught:
                self.show_message("; ".join(map(self.session.describe_warning, caught)))
            return True if result is None else result
        except (CurviregError, OSError) as error:
            self.show_message(str(error), error=True)
        except Exception as error:  # a defect must not end the page; the terminal has the traceback
            traceback.print_exc()
            self.show_message(f"{type(error).__name__}: {error}; see the terminal", error=True)
        finally:
            self.busy = False
        return None

    def show_message(self, text: str, *, error: bool = False) -> None:
        self.message.text = text
        self.message.classes(replace=f"{MESSAGE} text-negative" if error else f"{MESSAGE} text-orange-9")

    def build(self) -> None:
        """Lay out the page, and load the files that the session's options name."""
        ui.add_css(STYLE)
        with ui.row().classes("w-full no-wrap items-start gap-4"):
            with ui.column().classes("w-80 shrink-0 gap-2"):
                ui.label("curvireg").classes("text-h5")
                self.inputs = Inputs(self)
                self._build_actions()
            with ui.column().classes("grow min-w-0 gap-1"):
                self.message = ui.label().props("data-testid=message")
                self.image = ui.interactive_image(
                    on_mouse=self.inputs.handle_mouse, events=["mousedown", "mousemove", "mouseup"], sanitize=False
                ).props("data-testid=photograph")
                with self.image:
                    self.solid, self.lines = (ui.element("img").classes("hidden") for _ in range(2))
                with ui.row().classes("items-center w-full gap-4"):
                    self.opacity = self._slider("mesh", 0.35)
                    self.wipe = self._slider("wipe", 1.0)
                    self.contours = ui.switch("contours", value=True, on_change=self.update_layers)
                self.panels = Panels(self)
        ui.timer(0.2, self._tick)
        ui.timer(0, self._load, once=True)

    def _build_actions(self) -> None:
        with ui.row().classes("w-full no-wrap gap-2"):
            self.register = ui.button("register", on_click=self._register).classes("grow")
            self.register.props("data-testid=register")
            self.find = ui.button("find it", on_click=self._find).props("outline data-testid=find")
            ui.button("stop", on_click=self.session.cancel).props("outline data-testid=stop")
        self.progress = ui.linear_progress(0, show_value=False).props("instant-feedback")
        self.stage = ui.label().classes("text-caption").props("data-testid=stage")
        self.command = ui.textarea("the same on the command line").classes("w-full text-caption")
        self.command.props("readonly autogrow outlined dense data-testid=command")
        copy = "() => navigator.clipboard.writeText(document.querySelector('[data-testid=command]').value)"
        ui.button("copy").props("flat dense no-caps").on("click", js_handler=copy)

    def _slider(self, name: str, value: float) -> Any:
        ui.label(name)
        slider = ui.slider(min=0, max=1, step=0.01, value=value, on_change=self.update_layers)
        return slider.classes("w-40").props(f"data-testid={name}")

    async def _load(self) -> None:
        facts = await self.run(self.session.load)
        self.inputs.mesh_facts.text = facts or ""
        if self.session.photo is not None:
            await self.show_photograph()

    async def show_photograph(self) -> None:
        photo = self.session.photo
        assert photo is not None
        picture = await self.run(lambda: photograph_jpeg(photo.image))
        if not picture:
            return
        content, self.scale = picture
        H, W = (int(n) for n in photo.image.shape[-2:])
        self.size = max(1, round(H * self.scale)), max(1, round(W * self.scale))
        self.image.set_source(self.serve("photograph.jpg", content, "image/jpeg"))
        self.image.style(f"width: min(100%, calc(60vh * {W} / {H}))")
        self.inputs.photo_facts.text = "; ".join([f"{W} x {H} px", *photo.notes])
        self.inputs.set_box(self.session.box)
        fov = self.session.fov
        self.inputs.set_camera(self.session.camera)
        self.inputs.fov.value = None if self.session.camera else fov
        self.update_layers()

    def draw(self, svg: str) -> None:
        self.image.content = svg

    async def _register(self) -> None:
        self.message.text, self.stage.text = "", "starting"
        if await self.run(self.session.register):
            self.inputs.draw_boxes()
            await self.show_pose(new_result=True)

    async def _find(self) -> None:
        if not self.busy:
            self.inputs.set_box(None)
            await self._register()

    async def show_pose(self, *, new_result: bool = False) -> None:
        result, displayed = self.session.require_result()
        layers = await self.run(lambda: pose_layers(result.registrar, displayed.pose, self.size, self.scale))
        if layers:
            for element, name, content in zip((self.solid, self.lines), ("solid", "lines"), layers, strict=True):
                element.props(f'src="{self.serve(name + ".png", content)}"')
            self.update_layers()
        await self.panels.update(new_result=new_result)

    def update_layers(self) -> None:
        position = "position:absolute;inset:0;width:100%;height:100%;pointer-events:none"
        clip = f"clip-path:inset(0 {100 - 100 * self.wipe.value:.1f}% 0 0)"
        visible = self.session.displayed is not None
        for element, opacity in ((self.solid, self.opacity.value), (self.lines, float(self.contours.value))):
            element.classes(remove="hidden") if visible else element.classes(add="hidden")
            element.style(replace=f"{position};{clip};opacity:{opacity}")
        if not visible:
            self.panels.clear()

    def _tick(self) -> None:
        """Update the command line and the progress, five times a second."""
        self.command.value = self.session.command()
        for button in (self.register, self.find):
            button.set_enabled(not self.busy)
        stage, done, total = self.session.progress
        if self.busy:
            if stage:
                self.progress.value = (list(STAGES).index(stage) + done / total) / len(STAGES)
                self.stage.text = STAGES[stage] + (f": {done} of {total}" if total > 1 else "")
        elif self.session.result is not None:
            self.progress.value = 1.0
            changed = self.session.result.command != self.session.command()
            self.stage.text = "the inputs have changed since this result" if changed else "done"
        else:
            self.progress.value, self.stage.text = 0.0, ""
