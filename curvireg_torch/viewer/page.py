"""The page: the photograph, and beside it three steps, the answers and the inputs."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from nicegui import ui

from ..errors import CurviregError
from .session import STATIC
from .side import Answers, CameraPanel, Inputs, Preview, Space
from .stage import Stage
from .widgets import (
    Panel,
    button,
    fact_line,
    file_chooser,
    mark,
    message_line,
    region,
    set_enabled,
    set_text,
    text,
)
from .workspace import Workspace

TICK_SECONDS = 0.15  # between two looks at what changed
STAGES: Mapping[str, str] = {
    "bank": "rendering views of the mesh",
    "detection": "looking for the object in the photograph",
    "ranking": "comparing the photograph with the views",
    "search": "searching around the best views",
    "contours": "fitting contours",
}
EXAMINING = "Looking for sides that look alike."
BOX_HINT = (
    "Drag a rectangle around the object. Without one the whole photograph is searched: slower, "
    "less certain."
)
BOX_HINT_IN_RIG = (
    "Drag a rectangle around the object. Where there is none, the other photographs say where to "
    "look."
)


def build_page(workspace: Workspace) -> None:
    """Lay out one browser window. It holds nothing: several times a second it shows what changed in
    the workspace."""
    ui.add_css((STATIC / "page.css").read_text())
    ui.add_body_html(f"<script>{(STATIC / 'page.js').read_text()}</script>")
    text("a", "To the photograph", "skip", href="#work")
    ui.dark_mode(None)
    with region("header", "top"):
        text("h1", "curvireg")
        text(
            "p",
            "Where is this object, and how is it turned? One photograph and its 3D model are "
            "enough.",
        )
    with region("div", "work", id="work"):
        stage = Stage(workspace)
        with region("div", "side"):
            steps = Steps(workspace)
            answers = Answers(workspace, stage.commit)
            space = Space(workspace)
            camera = CameraPanel(workspace)
            preview = Preview(workspace)
            inputs = Inputs(workspace)

    async def refresh() -> None:
        try:
            workspace.examination.start_if_due(searching=workspace.searching)
            steps.refresh()
            for part in (camera, inputs, stage, answers, space, preview):
                await part.refresh()
        except CurviregError as error:  # else all that comes after it would stand still
            workspace.errors["page"] = workspace.session.without_folders(str(error))
            steps.show_messages()

    ui.timer(TICK_SECONDS, refresh)


class Steps(Panel):
    """What is there, what is missing, and the button that finds the pose."""

    def lay_out(self) -> None:
        self.cards = dict[str, Any]()
        self.facts = dict[str, Any]()
        self.messages = dict[str, Any]()
        with region("ol", "steps"):
            with self._step(1, "photograph"):
                self._ask_for("photograph")
                self.facts["rig"] = fact_line("rig-facts")
                self.messages["rig"] = message_line("rig")
                with region("div", "row below"):
                    self.no_photo = button(
                        "Remove it", self.workspace.remove_photo, "no-photo", "quiet"
                    )
                    self.restore = button(
                        "Bring it back", self.workspace.restore_photo, "restore-photo", "quiet"
                    )
                    self.no_rig = button(
                        "Without the rig", lambda: self.workspace.open_rig(None), "no-rig", "quiet"
                    )
            with self._step(2, "mesh"):
                self._ask_for("mesh")
                self.use_mm = button(
                    "Use mm",
                    lambda: self.workspace.set_option("unit", "mm"),
                    "use-mm",
                    "quiet below",
                )
                self.facts["advice"] = fact_line("mesh-advice")
            with self._step(3, "box"):
                self.no_box = button(
                    "Remove the box", lambda: self.session.shot.set_box(None), "no-box", "quiet"
                )
        self.messages["file"] = message_line("file")
        with region("div", "go"):
            self.find = button("Find the pose", self._find, "register", "primary")
            self.stop = button("Stop", self.workspace.stop, "stop")
            self.bar = region(
                "progress", "", max="1", value="0", aria_label="progress of the search"
            )
            self.stage = text("p", "", "stage", data_testid="progress", role="status")
            self.seconds = text("p", "", "stage", data_testid="seconds")
        self.messages |= {part: message_line(part) for part in ("pose", "page")}

    @contextmanager
    def _step(self, number: int, name: str) -> Iterator[None]:
        """The card of a step, with what is known about it."""
        with region("li", "step", data_testid=f"step-{name}") as self.cards[name]:
            text("h2", name.capitalize(), data_number=str(number))
            self.facts[name] = fact_line(f"{name}-facts")
            yield

    def _ask_for(self, name: str) -> None:
        file_chooser("Choose files", f"upload-{name}")
        self.messages[name] = message_line(name)

    def _find(self) -> None:
        self.workspace.start_search()  # the task outlives the page

    def show_messages(self) -> None:
        """Show what the workspace has to say about each part."""
        messages = {"rig": self.session.rig_gaps(), **self.workspace.messages}
        messages["pose"] = self.workspace.pose_message()
        for part, element in self.messages.items():
            set_text(element, messages.get(part, ""))

    def refresh(self) -> None:
        """Show the state of the workspace."""
        session = self.session
        workspace = self.workspace
        shot = self.session.shot
        self.show_messages()
        done = {"photograph": shot.photo, "mesh": session.mesh_path, "box": shot.box or shot.result}
        for name, card in self.cards.items():
            doubtful = bool(done[name] and workspace.messages.get(name))
            mark(card, "done", done[name] and not doubtful)
            mark(card, "doubt", doubtful)
        set_text(self.facts["photograph"], self._describe_photo())
        set_text(self.facts["mesh"], self._describe_mesh())
        examination = workspace.examination
        set_text(self.facts["advice"], EXAMINING if examination.running else examination.advice)
        box = " ".join(f"{v:g}" for v in shot.box or ())
        set_text(self.facts["box"], box or (BOX_HINT_IN_RIG if shot.view else BOX_HINT))
        together = len(session.together())
        counted = f"{together} photograph{'s' * (together > 1)}"
        set_text(
            self.facts["rig"], f"{session.rig_name}: one pose in {counted}" if shot.view else ""
        )
        self.no_rig.set_visibility(session.rig_path is not None)
        self.no_box.set_visibility(shot.box is not None)
        self.no_photo.set_visibility(shot.photo is not None)
        self.restore.set_visibility(session.removed is not None)
        self.use_mm.set_visibility(workspace.asks_for_unit and session.options.unit != "mm")
        words = (
            "Find the pose" if shot.box or shot.photo is None else "Find the object and its pose"
        )
        set_text(self.find, words if shot.view is None else f"Find the pose in {counted}")
        set_enabled(
            self.find, bool(done["photograph"] and done["mesh"]) and not workspace.searching
        )
        self._show_progress()

    def _describe_photo(self) -> str:
        shot = self.session.shot
        if shot.photo is None:
            return (
                "A picture that shows the whole object, or several. With a file of the cameras' "
                "poses (CSV, COLMAP, BOP), several give one pose together."
            )
        H, W = shot.size
        return "; ".join([f"{self.session.name(shot.path)}: {W} x {H} px", *shot.photo.notes])

    def _describe_mesh(self) -> str:
        path = self.session.mesh_path
        if path is None:
            return (
                "The object's 3D model: .obj, .stl, .glb, .step, .usdz, or .gltf with its parts as "
                "a .zip."
            )
        return f"{self.session.name(path)}: {self.session.mesh_facts}"

    def _show_progress(self) -> None:
        session = self.session
        workspace = self.workspace
        stage, done, total = session.progress
        share = 0.0
        words = ""
        if workspace.searching and session.cancelled:
            words = "stopping"
        elif workspace.searching and stage:
            share = (list(STAGES).index(stage) + done / total) / len(STAGES)
            words = STAGES[stage] + (f": {done} of {total}" if total > 1 else "")
        elif workspace.searching:
            words = "starting"
        elif workspace.receiving:
            words = f"receiving {', '.join(name for name, _ in workspace.receiving.values())}"
        elif session.shot.result is not None:
            changed = session.shot.result.inputs != session.inputs()
            share = 1.0
            words = "the inputs have changed since this answer" if changed else "done"
        self.stop.set_visibility(workspace.searching)
        self.bar.set_visibility(workspace.searching)
        self.bar.props(f"value={share:.3f}")
        set_text(self.stage, words)
        set_text(
            self.seconds,
            f"{time.monotonic() - workspace.started:.0f} s" if workspace.searching else "",
        )
