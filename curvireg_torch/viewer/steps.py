"""The three steps of the page, photograph, mesh and box, and the search that follows them."""

from collections.abc import Mapping
from typing import Any

from nicegui import background_tasks

from .widgets import button, file_chooser, region, set_enabled, set_text, text
from .workspace import Workspace

__all__ = ["Steps"]

STAGES: Mapping[str, str] = {
    "bank": "rendering views of the mesh",
    "detection": "looking for the object in the photograph",
    "ranking": "comparing the photograph with the views",
    "search": "searching around the best views",
    "contours": "fitting contours",
}
BOX_HINT = (
    "Drag a rectangle around the object on the photograph. Without one the whole photograph is searched, which is "
    "slower and less certain."
)


class Steps:
    """What is there, what is missing, and the button that finds the pose."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.cards: dict[str, Any] = {}
        self.facts: dict[str, Any] = {}
        self.messages: dict[str, Any] = {}
        with region("ol", "steps"):
            for number, (name, title) in enumerate(
                {"photograph": "Photograph", "mesh": "Mesh", "box": "Box"}.items(), start=1
            ):
                with region("li", "step", data_testid=f"step-{name}") as self.cards[name]:
                    text("h2", title, data_number=str(number))
                    self.facts[name] = text("p", "", "facts", data_testid=f"{name}-facts")
                    if name == "box":
                        self.no_box = button("Remove the box", lambda: workspace.set_box(None), "no-box", "quiet")
                    else:
                        file_chooser("Choose files", f"upload-{name}")
                        self.messages[name] = self._message(name)
        self.messages["file"] = self._message("file")
        with region("div", "go"):
            self.find = button("Find the pose", self._find, "register", "primary")
            self.stop = button("Stop", self._stop, "stop")
            self.bar = region("progress", "", max="1", value="0", aria_label="progress of the search")
            self.stage = text("p", "", "stage", data_testid="stage", role="status")
            self.seconds = text("p", "", "stage", data_testid="seconds")
        self.messages["pose"] = self._message("pose")

    def _message(self, part: str) -> Any:
        return text("p", "", "message", data_testid=f"message-{part}", role="alert")

    def _find(self) -> None:
        background_tasks.create(self.workspace.register(), name="search")  # it outlives the page

    def _stop(self) -> None:
        self.workspace.stop()

    def refresh(self) -> None:
        """Show the state of the workspace."""
        session, workspace = self.session, self.workspace
        for part, element in self.messages.items():
            set_text(element, workspace.messages.get(part, ""))
        done = {"photograph": session.photo, "mesh": session.mesh_path, "box": session.box or session.result}
        for name, card in self.cards.items():
            card.classes(**{"add" if done[name] else "remove": "done"})
        set_text(self.facts["photograph"], self._describe_photo())
        set_text(self.facts["mesh"], self._describe_mesh())
        set_text(self.facts["box"], BOX_HINT if session.box is None else " ".join(f"{v:g}" for v in session.box))
        self.no_box.set_visibility(session.box is not None)
        set_text(self.find, "Find the pose" if session.box or session.photo is None else "Find the object and its pose")
        set_enabled(self.find, bool(done["photograph"] and done["mesh"]) and not workspace.searching)
        self._show_progress()

    def _describe_photo(self) -> str:
        photo, path = self.session.photo, self.session.photo_path
        if photo is None or path is None:
            return "A picture with the whole object in it."
        H, W = photo.image.shape[-2:]
        return "; ".join([f"{self.session.names[path]}: {W} x {H} px", *photo.notes])

    def _describe_mesh(self) -> str:
        path = self.session.mesh_path
        if path is None:
            return "The object's 3D model: .obj, .ply, .stl, .off, .glb, or .gltf with its parts as a .zip."
        return f"{self.session.names[path]}: {self.workspace.mesh_facts}"

    def _show_progress(self) -> None:
        session, workspace = self.session, self.workspace
        stage, done, total = session.progress
        share, words, seconds = 0.0, "", ""
        if workspace.searching:
            seconds = f"{workspace.seconds:.0f} s"
            ahead = workspace.waiting_for
            if ahead:
                words = f"waiting for {ahead} other {'search' if ahead == 1 else 'searches'}"
            elif session.cancelled:
                words = "stopping"
            elif stage:
                share = (list(STAGES).index(stage) + done / total) / len(STAGES)
                words = STAGES[stage] + (f": {done} of {total}" if total > 1 else "")
            else:
                words = "starting"
        elif workspace.receiving:
            words = f"receiving {', '.join(workspace.receiving.values())}"
        elif session.result is not None:
            changed = session.result.command != session.command()
            share, words = 1.0, "the inputs have changed since this answer" if changed else "done"
        self.stop.set_visibility(workspace.searching)
        self.bar.set_visibility(workspace.searching)
        self.bar.props(f"value={share:.3f}")
        set_text(self.stage, words)
        set_text(self.seconds, seconds)
