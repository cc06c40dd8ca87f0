"""The column beside the photograph: the answers to choose from, the model, and the inputs besides
files and box."""

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from nicegui import ui

from ..errors import MAX_VIEWER_FACES
from ..geometry import Camera, rotation_error
from ..jobs.store import to_json
from ..registration.confidence import two_decimals
from ..utils.aliases import Document
from ..utils.choices import PRESET_NAMES, UNITS, UP_AXES
from ..visualization.sheet import thumbnail
from ..visualization.words import (
    measured,
    pose_in_words,
    remarks,
    used_camera_in_words,
    view_in_words,
)
from .shot import Answer, Shot, numbers
from .widgets import (
    Panel,
    button,
    copy_button,
    fact_line,
    field,
    file_chooser,
    fold,
    message_line,
    region,
    set_enabled,
    set_pressed,
    set_text,
    show_value,
    text,
)
from .workspace import Workspace

DOWNLOADS = {
    "picture": ("overlay.png", "image/png"),
    "result.json": ("result.json", "application/json"),
    "pose.glb": ("pose.glb", "model/gltf-binary"),
}
VERDICTS = {
    "reliable": "Nine in ten such answers are right. Look whether the contours fit all the same.",
    "reliable axis": "The axis is certain, the turn about it is not. Of such axes, nine in ten "
    "are right.",
    "unsure": "It may be another of the answers below, or none. Choose the one whose contours fit.",
    "no match": "Probably it is not right: check the mesh, its unit and the box, or choose "
    "another answer.",
    "your choice": "You chose another answer than the first, which was {verdict}"
    " ({confidence}). Its contours should fit better than those of the first.",
    "by hand": "You set this pose. How probable it is, nobody has measured.",
}
# Pictures a second of a scene, with and without the pointer on it
FPS_IN_USE = 20
FPS_AT_REST = 2
EXPECTED = {
    4: "four numbers fx fy cx cy in px, such as 1450 1450 960 540",
    1: "the horizontal field of view in degrees, such as 65",
}
CONFIDENCE = "estimated probability that this answer is within 30 degrees of the truth"
CAMERA_HINT = (
    "With it the distance is exact. All photographs have the same: type it and press Enter, or "
    "choose a calibration."
)


def _choices(default: str, names: Iterable[str]) -> dict[str | None, str]:
    """The choices of an option, by their values; None is the default."""
    return {None: default, **{name: name for name in names}}


CHOICES = {
    "unit": ("unit of the mesh", _choices("as the file says, else m", UNITS)),
    "up": ("axis that points up", _choices("as the format says", UP_AXES)),
    "pose": ("how it may stand", _choices("default", ("any", "upright"))),
    "preset": ("method", _choices("default", PRESET_NAMES)),
}
"""Options that are chosen from a list: their labels and choices."""


class Answers(Panel):
    """The chosen answer with its verdict and its downloads, and a card of each answer that can be
    chosen.

    ``commit`` makes a pose that is being moved the answer.
    """

    def __init__(self, workspace: Workspace, commit: Callable[[], None]) -> None:
        self.commit = commit
        super().__init__(workspace)

    def lay_out(self) -> None:
        with region(
            "section", "answers", aria_label="answer", data_testid="answers"
        ) as self.section:
            with region("div", "verdict"):
                self.word = text("h2", "", data_testid="verdict")
                self.certainty = text("p", "", title=CONFIDENCE, data_testid="certainty")
                with region("div", "row"):
                    text("span", "Save:", "facts")
                    for name in DOWNLOADS:
                        button(
                            name,
                            lambda name=name: self._download(name),
                            f"download-{name}",
                            "quiet",
                        )
                    copy_button("copy as Python", "python")
                self.camera = text("p", "", "camera", data_testid="used-camera")
                self.meaning = text("p", "", "facts")
                self.repairs = region("div", "row", data_testid="repairs")
            self.cards = region(
                "div",
                "cards",
                data_testid="panel-answer",
                role="group",
                aria_label="possible answers",
            )
            self.facts = text("p", "", "lines", data_testid="facts")

    async def _download(self, kind: str) -> None:
        self.commit()
        name, media_type = DOWNLOADS[kind]
        shot = self.session.shot.snapshot()  # others may be shown before the job runs
        makers = {
            "picture": shot.overlay,
            "result.json": lambda: to_json(shot.document()).encode(),
            "pose.glb": shot.glb,
        }
        if content := await self.workspace.run("pose", makers[kind]):
            ui.download.from_url(f"./{self.workspace.serve(name, content, media_type)}", name)

    async def refresh(self) -> None:
        """Show the answer of the session, if it changed."""
        shot = self.session.shot
        answer = shot.answer
        self.section.set_visibility(answer is not None)
        new_shot = self.changed("shot", shot)
        if (self.changed("answer", answer) or new_shot) and answer is not None:
            self._describe()
        if (self.changed("result", shot.result) or new_shot) and shot.result is not None:
            await self._draw_cards(shot)
        for repair in self.repairs.default_slot.children:
            set_enabled(repair, not self.workspace.searching)
        for number, card in enumerate(self.cards.default_slot.children):
            set_pressed(card, answer and number == answer.number)

    def _describe(self) -> None:
        document = self.session.document()
        result = self.session.shot.require_result()
        answer = result.answer
        word = "by hand" if answer.edits else document["verdict"]
        word = "your choice" if answer.number and not answer.edits else word
        set_text(self.word, word)
        self.word.classes(replace=f"badge {word.replace(' ', '-')}")
        first = result.document
        of_first = "unknown" if first["confidence"] is None else two_decimals(first["confidence"])
        meaning = VERDICTS[word].format(verdict=first["verdict"], confidence=of_first)
        set_text(self.meaning, meaning)
        set_text(self.camera, used_camera_in_words(document))
        confidence = document["confidence"]
        set_text(
            self.certainty, "" if confidence is None else f"confidence {two_decimals(confidence)}"
        )
        set_text(self.facts, "\n".join(self._lines(document)))
        self.repairs.clear()
        with self.repairs:
            for label, repair in self._repairs(document).items():
                button(label, repair, label.lower().replace(" ", "-"))

    def _lines(self, document: Document) -> list[str]:
        """What is said of the answer's pose."""
        shot = self.session.shot
        result = shot.require_result()
        pose = result.answer.pose
        if shot.view is not None:
            pose = replace(pose, rotation=shot.projection[0][:3, :3])
        mesh = result.registrar.bank.mesh
        front = self.session.options.limits.get("front")
        lines = [pose_in_words(pose.rotation, up=mesh.up, front=front)]
        lines.append(
            "azimuth {:.1f}, elevation {:.1f}, theta {:.1f} degrees".format(*pose.viewpoint)
        )
        if pose.translation is not None:
            unit = mesh.unit or "in the mesh's unit"
            frame = "translation" if shot.view is None else "translation in the world"
            deviation = (document.get("camera") or {}).get("focal_deviation", 0.0)
            numbers = ", ".join(measured(pose.translation.tolist(), deviation))
            lines.append(f"{frame} {numbers} {unit}")
        measures = {"score": document["score"], "edge support": document["edge_support"]}
        lines += [
            f"{name} {value:.2f}"
            for name, value in measures.items()
            if value is not None and value == value
        ]
        if shot.view is not None:
            told = [
                (self.session.name(view["photo"]), view_in_words(view))
                for view in document["photographs"]
            ]
            lines += [f"{name}: {words}" for name, words in told if words]
        return [*lines, *document["warnings"], *remarks(document), *result.answer.edits]

    def _repairs(self, document: Document) -> dict[str, Callable[[], None]]:
        """What one click can do about what the page says of the answer."""
        session = self.session
        box = document["corrected_box"]
        found = dict[str, Callable[[], None]]()
        shot = session.shot
        limits = session.options.limits

        def search_after(change: Callable[[], object]) -> Callable[[], None]:
            def repair() -> None:
                if session.shot is shot and not self.workspace.searching:
                    change()
                    self.workspace.start_search()

            return repair

        if document.get("prior", {}).get("contradiction") is not None:
            if "viewpoint" in limits:
                azimuth, *rest = limits["viewpoint"]
                around = {**limits, "viewpoint": ((azimuth + 180.0) % 360.0, *rest)}
                turned = partial(session.set_limits, **around)
                found["Turn the prior around"] = search_after(turned)
            found["Search without the prior"] = search_after(session.remove_limits)
        if box is not None:
            corrected = numbers([round(v, 1) for v in box])
            found["Search with that box"] = search_after(partial(shot.set_box, corrected))
        return found

    async def _draw_cards(self, shot: Shot) -> None:
        result = shot.require_result()
        box = shot.found_box
        image = shot.image
        around = [0, 0, *image.shape[:0:-1]] if box is None else box.tolist()
        describer = result.registrar.describer
        hypotheses = result.registration.hypotheses
        probabilities = result.registration.probabilities or (None,) * len(hypotheses)

        def make() -> list[bytes]:
            return [
                thumbnail(describer, shot.projection_of(pose), image, around) for pose in hypotheses
            ]

        pictures = await self.workspace.run("page", make) or ()
        self.cards.clear()
        for number, (pose, picture) in enumerate(zip(hypotheses, pictures, strict=False)):
            degrees = float(rotation_error(pose.rotation, hypotheses[0].rotation))
            url = self.workspace.serve(f"answer-{number}.jpeg", picture, "image/jpeg")
            name = f"Answer {number + 1}"
            test_id = f"answer-{number + 1}"
            with (
                self.cards,
                region("button", "card", type="button", data_testid=test_id) as card,
            ):
                region("img", src=url, alt=f"contours of answer {number + 1}")
                text("span", f"{name}, {degrees:.0f}° from 1" if number else name)
                probability = probabilities[number]
                text("span", "" if probability is None else two_decimals(probability), "facts")
            card.on("click", partial(shot.choose, number))


class Inputs(Panel):
    """Input fields; what is typed or chosen goes into the session, and what changes there is
    shown."""

    def lay_out(self) -> None:
        self.selects: dict[str, Any] = {}
        with fold("Mesh and method", "options", is_open=True):
            for name, (label, choices) in CHOICES.items():
                self._select(name, label, choices)
        with fold("The same on the command line, and in Python", "command-line"):
            self.command = self._copied("command")
            self.python = self._copied("python")

    def _copied(self, name: str) -> Any:
        element = text("pre", "", data_testid=name)
        copy_button("Copy", name)
        return element

    def _select(self, name: str, label: str, choices: dict[str | None, str]) -> None:
        async def changed(event: Any) -> None:
            if event.value != getattr(self.session.options, name):  # not by another window
                await self.workspace.set_option(name, event.value)

        value = getattr(self.session.options, name)
        select = ui.select(choices, value=value, label=label, on_change=changed)
        self.selects[name] = select.props(f"dense options-dense data-testid={name}")

    async def refresh(self) -> None:
        """Show what changed in the session since the last time, here or in another window."""
        session = self.session
        set_text(self.command, session.command() or session.lacks_command())
        set_text(self.python, "" if session.shot.answer is None else session.python())
        for name, select in self.selects.items():
            if select.value != getattr(session.options, name):
                select.value = getattr(session.options, name)


class CameraPanel(Panel):
    """The camera of all photographs without a rig: two fields, each sent by Enter or on leaving it,
    and where it is from."""

    def lay_out(self) -> None:
        with region("div", "fold"):  # a card, which names the camera when its fields are folded
            with fold("Camera", "camera"):
                text("p", CAMERA_HINT, "facts")
                self.matrix = field("fx fy cx cy in px", "camera", partial(self._set, 4))
                self.view = field(
                    "or the horizontal field of view in degrees", "fov", partial(self._set, 1)
                )
                file_chooser("From a file", "upload-camera")
            self.facts = fact_line("camera-facts")
            self.message = message_line("camera")

    async def _set(self, count: int, typed: str) -> None:
        found = _typed_numbers(typed, count)
        if found is None:
            self.workspace.errors["camera"] = (
                f"camera: expected {EXPECTED[count]}, got {typed!r:.80}"
            )
            return
        camera = numbers(found) if len(found) == 4 else next(iter(found), None)
        await self.workspace.run("camera", partial(self.session.set_camera, camera), stop=True)

    async def refresh(self) -> None:
        """Show the camera of the session, wherever it was changed."""
        camera = self.session.request().camera
        is_alone = self.session.shot.view is None
        show_value(self.matrix, camera if isinstance(camera, tuple) else ())
        show_value(self.view, (camera,) if isinstance(camera, float) else ())
        for element in (self.matrix, self.view):
            set_enabled(element, is_alone)
        set_text(self.facts, self._describe_camera())
        set_text(self.message, self.workspace.messages.get("camera", ""))

    def _describe_camera(self) -> str:
        camera = self.session.options.camera
        shot = self.session.shot
        if shot.view is not None:
            words = "of each photograph, from the rig"
            return f"{words}, without its distortion" if shot.is_undistorted else words
        exif = None if shot.photo is None else shot.photo.camera()
        if camera == "exif" or (camera is None and exif is not None):
            words = "from the photograph's EXIF"
            if shot.photo is None:
                return words
            focal = shot.photo.focal_35mm
            length = f"{focal:g} mm of a 35 mm camera" if focal else "has no focal length"
            return f"{words}, {length}"
        if isinstance(camera, float):
            return "from the field of view, to about 10 %"
        if isinstance(camera, Camera):
            words = "from a calibration file"
            return f"{words}, without its distortion" if camera.distorts else words
        if camera:
            return ""
        return "unknown: the focal length is estimated, and the distance with it"


def _typed_numbers(text: str, count: int) -> tuple[float, ...] | None:
    """The ``count`` numbers of a text, none of an empty one, or None of any other. They are
    separated by blanks, semicolons or commas; where these are not needed for that, commas are
    decimal ones.

    Example:
        >>> _typed_numbers("536,8 538,2 310,4 241", 4), _typed_numbers("300, 300, 160, 120", 4)
        ((536.8, 538.2, 310.4, 241.0), (300.0, 300.0, 160.0, 120.0))
        >>> _typed_numbers("65,5°", 1), _typed_numbers("", 1), _typed_numbers("300 300", 4)
        ((65.5,), (), None)
    """
    words = [word for word in re.split(r"[\s;]+|,\s+", text.strip().rstrip("°")) if word]
    if len(words) == 1 and count > 1:
        words = words[0].split(",")
    try:
        found = tuple(float(word.replace(",", ".")) for word in words)
    except ValueError:
        return None
    return found if len(found) in (0, count) and all(map(math.isfinite, found)) else None


class Preview(Panel):
    """The mesh in 3D. Turned with the mouse until it looks as in the photograph, it is a pose
    prior."""

    def lay_out(self) -> None:
        self.scene: Any = None
        self.mark = ""
        with fold("The model", "model", is_open=True) as self.section:
            self.place = region("div", "preview", data_testid="preview")
            with region("div", "row"):
                self.of_scene = [
                    self.place,
                    button("It looks like this", self._hint, "looks-like-this"),
                ]
                self.no_prior = button("No prior", self.session.remove_limits, "no-prior", "quiet")
                for name, label in (("up", "Mark what is up"), ("front", "Mark the front")):
                    marking = partial(setattr, self, "mark", name)
                    self.of_scene.append(button(label, marking, f"mark-{name}", "quiet"))
            self.facts = fact_line("prior-facts")

    async def _hint(self) -> None:
        if self.scene is not None:
            at = (await self.scene.get_camera())["position"]
            self.session.hint_direction((at["x"], at["y"], at["z"]))

    async def _clicked(self, event: Any) -> None:
        mesh = self.session.mesh
        if mesh is None or not self.mark or not event.hits:
            return
        name = self.mark
        self.mark = ""
        hit = event.hits[0]
        axis = self.session.mesh_axis((hit.x, hit.y, hit.z))
        if name == "up":
            self.session.set_limits(front=None)
            await self.workspace.set_option("up", axis)
        elif axis[-1] != mesh.up[-1]:
            self.session.set_limits(front=axis)

    async def refresh(self) -> None:
        """Show the mesh of the session, if it or its frame changed, and the pose prior."""
        mesh = self.session.mesh
        limits = self.session.options.limits
        self.section.set_visibility(mesh is not None)
        limiting = limits.keys() - {"front"}
        self.no_prior.set_visibility(bool(limiting))
        is_drawn = mesh is not None and len(mesh.faces) <= MAX_VIEWER_FACES
        for element in self.of_scene:
            element.set_visibility(is_drawn)
        words = "Turn it with the mouse until it looks as in the photograph: that helps the search."
        if not is_drawn:
            self.mark = ""
            words = f"Meshes of more than {MAX_VIEWER_FACES:,} faces are not drawn."
        if "viewpoint" in limits:
            at = "azimuth {:g}, elevation {:g}".format(*limits["viewpoint"])
            words = f"Pose prior: seen from {at}, within {limits['within']:g} degrees."
        elif limiting:
            words = "There is a pose prior; the command line below has it."
        set_text(self.facts, f"Click on the side that is {self.mark}." if self.mark else words)
        new_mesh = self.changed("mesh", mesh)
        if not (self.changed("front", limits.get("front")) or new_mesh):
            return
        self.scene = None
        self.place.clear()
        if not is_drawn:
            return
        if content := await self.workspace.run("page", self.session.preview):
            self._draw(self.workspace.serve("model.glb", content, "model/gltf-binary"))

    def _draw(self, url: str) -> None:
        with self.place, _scene(40, on_click=self._clicked) as scene:
            scene.gltf(url)
            for name, end in (("up", [0, 0, 1.0]), ("front", [0, -1.2, 0])):
                scene.line([0, 0, 0], end).material("#0a6b35" if name == "up" else "#a8201a")
                scene.text(name, "font-weight: bold; color: #1b1f23").move(*end)
        scene.move_camera(1.6, -2.6, 1.3, 0, 0, 0, duration=0)
        self.scene = scene


def _scene(fov: float, on_click: Callable[..., Any] | None = None) -> ui.scene:
    """A scene that is drawn often only while the pointer is on it: without a GPU, pictures cost the
    processor that a search needs."""
    scene = ui.scene(
        340,
        240,
        grid=False,
        camera=ui.scene.perspective_camera(fov=fov),
        background_color="#c8ced3",
        on_click=on_click,
        fps=FPS_AT_REST,
    )
    scene.on("pointerenter", lambda: scene.props(f"fps={FPS_IN_USE}"))
    scene.on("pointerleave", lambda: scene.props(f"fps={FPS_AT_REST}"))
    return scene


class Space(Panel):
    """Camera, photograph and mesh in 3D, to be turned with the mouse; drawn when asked for."""

    def lay_out(self) -> None:
        self.drawn: Answer | None = None
        with fold("The answer in 3D", "space", is_open=True) as self.section:
            self.place = region("div", "preview", data_testid="space")
            self.show = button(
                "Show camera, photograph and mesh", self._draw, "show-space", "quiet"
            )

    async def refresh(self) -> None:
        """Forget what was drawn of another answer."""
        shot = self.session.shot
        self.section.set_visibility(shot.answer is not None and shot.view is None)
        if self.drawn is not None and self.drawn is not shot.answer:
            self.drawn = None
            self.place.clear()
        self.show.set_visibility(self.drawn is None)

    async def _draw(self) -> None:
        shot = self.session.shot.snapshot()
        content = await self.workspace.run("pose", shot.glb)
        if not content:
            return
        self.drawn = shot.answer
        url = self.workspace.serve("space.glb", content, "model/gltf-binary")
        T, K = shot.projection
        depth = float(shot.require_result().centre(T)[2])
        metres = UNITS[shot.require_result().registrar.bank.mesh.unit or "m"]
        H, W = shot.size
        corners = [[-0.5, -0.5, 1], [W - 0.5, -0.5, 1], [W - 0.5, H - 0.5, 1], [-0.5, H - 0.5, 1]]
        rays = torch.tensor(corners).double() @ torch.linalg.inv(K.double()).mT
        self.place.clear()
        with self.place, _scene(50) as scene:
            # from glTF's axes, y up, to those of the scene, z up; the object is at distance 1
            scene.gltf(url).rotate(math.pi / 2, 0, 0).scale(1.0 / (depth * metres))
            for x, y, _ in rays.tolist():
                scene.line([0, 0, 0], [x, 1.0, -y]).material("#0a6b35")
            scene.text("camera", "font-weight: bold; color: #1b1f23").move(0, 0, -0.12)
        scene.move_camera(-0.9, -0.5, 0.6, 0, 0.6, 0, duration=0)
