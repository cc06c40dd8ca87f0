"""The page: three steps, the photograph, the answer, and how it was found."""

from pathlib import Path
from typing import Any

from nicegui import ui

from .answers import Answers
from .inputs import Inputs
from .panels import Panels
from .stage import Stage
from .steps import Steps
from .widgets import button, region, text
from .workspace import Workspace

__all__ = ["Page", "add_assets"]

_STATIC = Path(__file__).parent / "static"
_TICK_SECONDS = 0.15
_THEMES = {None: "Colours: as the system", False: "Colours: light", True: "Colours: dark"}


def add_assets() -> None:
    """Put styles and script into the page, before it is sent."""
    ui.add_css((_STATIC / "page.css").read_text())
    ui.add_body_html(f"<script>{(_STATIC / 'page.js').read_text()}</script>")


class Page:
    """One browser window. It holds nothing: five times a second it shows what changed in its workspace."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self._busy = workspace, False

    def build(self) -> None:
        """Lay out the page."""
        text("a", "To the photograph", "skip", href="#work")
        self._build_header()
        with region("main"):
            self.steps = Steps(self.workspace)
            with region("div", "work", id="work"):
                self.stage = Stage(self.workspace)
                with region("div", "side"):
                    self.answers = Answers(self.workspace)
                    self.inputs = Inputs(self.workspace)
                self.panels = Panels(self.workspace)
        ui.timer(_TICK_SECONDS, self._refresh)

    def _build_header(self) -> None:
        self.dark = ui.dark_mode(None)
        with region("header", "top"):
            with region("div"):
                text("h1", "curvireg")
                text("p", "Where is this object, and how is it turned? One photograph and its 3D model are enough.")
            with region("div", "row"):
                button("Sample", self.workspace.load_sample, "sample-again", "quiet")
                self.theme = button(_THEMES[None], self._change_theme, "theme", "quiet")

    def _change_theme(self) -> None:
        values: list[bool | None] = list(_THEMES)
        self.dark.value = values[(values.index(self.dark.value) + 1) % len(values)]
        self.theme.set_content(_THEMES[self.dark.value])

    async def _refresh(self, _: Any = None) -> None:
        if self._busy:  # still drawing
            return
        self._busy = True
        try:
            self.steps.refresh()
            self.inputs.refresh()
            await self.stage.refresh()
            await self.answers.refresh()
            await self.panels.refresh()
        finally:
            self._busy = False
