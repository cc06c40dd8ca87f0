"""The column beside the photograph: the answers to choose from, and all inputs besides the files and a drawn box."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from nicegui import ui

from ..geometry import rotation_error
from ..geometry.pose_prior import SIDES, PosePrior
from ..mesh import mesh_unit, mesh_up
from ..registration.result import pose_in_words, remarks, verdict
from ..utils.choices import PRESET_NAMES, UNITS, UP_AXES
from ..visualization.sheet import thumbnail
from .widgets import button, fold, region, set_text, text
from .workspace import Workspace

__all__ = ["Answers", "Inputs"]

DOWNLOADS = {
    "picture": ("overlay.png", "image/png"),
    "result.json": ("result.json", "application/json"),
    "pose.glb": ("pose.glb", "model/gltf-binary"),
}
VERDICTS = {
    "likely": "Nine in ten such answers are right. Look whether the contours fit all the same.",
    "unsure": "It may be another of the answers below, or none. Choose the one whose contours fit.",
    "no match": "Probably it is not right: check the mesh, its unit and the box, or choose another answer.",
    "by hand": "You set this pose. How probable it is, nobody has measured.",
}
PROBABILITY = "estimated probability that this answer is within 30 degrees of the truth"
RANGES = ("azimuth", "elevation")
AXES: Mapping[str | None, str] = {None: "as the format says", **{axis: axis for axis in UP_AXES}}
FRONTS: Mapping[str | None, str] = {None: "default", **{axis: axis for axis in UP_AXES}}
POSES: Mapping[str | None, str] = {None: "default", "any": "any", "upright": "upright"}
PRESETS: Mapping[str | None, str] = {None: "default", **{name: name for name in PRESET_NAMES}}


class Answers:
    """The chosen answer with its verdict and its downloads, and a card of each answer that can be chosen."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.shown_result: Any = None
        self.shown_answer: Any = None
        with region("section", "answers", aria_label="answer", data_testid="answers") as self.section:
            with region("div", "verdict"):
                self.word = text("h2", "", data_testid="verdict")
                self.certainty = text("p", "", title=PROBABILITY, data_testid="certainty")
                with region("div", "row"):
                    for name in DOWNLOADS:
                        button(name, lambda name=name: self._download(name), f"download-{name}", "quiet")
                    text("button", "copy as Python", "button quiet", type="button", data_copy="python")
                self.meaning = text("p", "", "facts")
            self.cards = region("div", "cards", data_testid="panel-answer", role="group", aria_label="possible answers")
            self.facts = text("p", "", "lines", data_testid="facts")

    async def _download(self, kind: str) -> None:
        name, media_type = DOWNLOADS[kind]
        make = {"picture": self.session.overlay, "result.json": self.session.json, "pose.glb": self.session.glb}[kind]
        if content := await self.workspace.run("pose", make):
            ui.download.from_url(self.workspace.serve(name, content, media_type), name)

    async def refresh(self) -> None:
        """Show the answer of the session, if it changed."""
        result, answer = self.session.result, self.session.answer
        self.section.set_visibility(answer is not None)
        if answer is not self.shown_answer:
            self.shown_answer = answer
            if answer is not None:
                self._describe()
        if result is not self.shown_result:
            self.shown_result = result
            if result is not None:
                await self._draw_cards()
        for number, card in enumerate(self.cards.default_slot.children):
            card.props(f"aria-pressed={'true' if answer and number == answer.number else 'false'}")

    def _describe(self) -> None:
        result, answer = self.session.require_result()
        document, pose = self.session.document(), answer.pose
        word = verdict(document["confidence"], document["none"], document["reliable"])
        word = "by hand" if answer.edits else word
        set_text(self.word, word)
        self.word.classes(replace=f"badge {word.replace(' ', '-')}")
        set_text(self.meaning, VERDICTS[word])
        set_text(self.certainty, "" if document["confidence"] is None else f"probability {document['confidence']:.2f}")
        mesh = result.registrar.bank.mesh
        front = (self.session.options.limits or {}).get("front")
        azimuth, elevation, theta = pose.viewpoint
        lines = [pose_in_words(pose.rotation, up=mesh_up(mesh), front=front)]
        lines.append(f"azimuth {azimuth:.1f}, elevation {elevation:.1f}, theta {theta:.1f} degrees")
        if pose.translation is not None:
            unit = mesh_unit(mesh) or "in the mesh's unit"
            lines.append(f"translation {', '.join(f'{v:.4g}' for v in pose.translation.tolist())} {unit}")
        numbers = {"score": document["score"], "edge support": document["edge_support"]}
        lines += [f"{name} {value:.2f}" for name, value in numbers.items() if value is not None and value == value]
        lines += [*document["warnings"], *remarks(document), *answer.edits]
        set_text(self.facts, "\n".join(lines))

    async def _draw_cards(self) -> None:
        result, _ = self.session.require_result()
        renderer, hypotheses = result.registrar.describer.renderer, result.registration.hypotheses
        probabilities = result.registration.probabilities or (None,) * len(hypotheses)

        def make() -> list[bytes]:
            box = result.box.tolist()
            return [thumbnail(renderer, pose.projection, result.image, box) for pose in hypotheses]

        pictures = await self.workspace.run("pose", make)
        self.cards.clear()
        for number, (pose, picture) in enumerate(zip(hypotheses, pictures or [], strict=True)):
            degrees = float(rotation_error(pose.rotation, hypotheses[0].rotation))
            url = self.workspace.serve(f"answer-{number}.jpeg", picture, "image/jpeg")
            card = region("button", "card", type="button", data_testid=f"answer-{number + 1}")
            card.move(self.cards)
            card.on("click", lambda number=number: self.session.choose(number))
            with card:
                region("img", src=url, alt=f"contours of answer {number + 1}")
                text("span", f"Answer {number + 1}" + (f", {degrees:.0f}° from 1" if number else ""))
                text("span", "" if probabilities[number] is None else f"{probabilities[number]:.2f}", "facts")


class Inputs:
    """Input fields; what is typed or chosen goes into the session, and what changes there is shown."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.shown: tuple[Any, ...] = ()
        self._showing = False  # while fields are filled one after the other
        self.selects: dict[str, Any] = {}
        with fold("Mesh and method", "options", is_open=True):
            self._select("unit", "unit of the mesh", {unit: unit for unit in UNITS})
            self._select("up", "axis that points up", AXES)
            self._select("pose", "how it may stand", POSES)
            self._select("preset", "method", PRESETS)
        with fold("Camera", "camera"):
            text("p", "With it the position is found, not only the rotation.", "facts")
            self.camera = self._numbers("camera-", ("fx", "fy", "cx", "cy"), self._camera_typed)
            self.fov = self._number("fov", "or the horizontal field of view, degrees", self._fov_typed)
            self.camera_facts = text("p", "", "facts", data_testid="camera-facts")
            with region("div", "row"):
                button("No camera", lambda: self._set_camera(None), "no-camera", "quiet")
                self.exif = button(
                    "Guess from EXIF", lambda: self._set_camera(self.session.exif_camera()), "exif", "quiet"
                )
        with fold("What is known about the pose", "known"):
            self._build_known()
        with fold("The same on the command line, and in Python", "command-line"):
            self.command = self._copied("command")
            self.python = self._copied("python")

    def _copied(self, name: str) -> Any:
        element = text("pre", "", data_testid=name)
        text("button", "Copy", "button quiet", type="button", data_copy=name)
        return element

    def _build_known(self) -> None:
        text("p", "Seen from its", "facts")
        with region("div", "row"):
            for name in SIDES:
                limits = {"azimuth": PosePrior.side(name).azimuth}
                button(name, lambda limits=limits: self.session.set_limits(**limits), f"known-{name}", "quiet")
            nothing = dict.fromkeys(RANGES)
            button("anything", lambda: self.session.set_limits(**nothing), "known-anything", "quiet")
        text("p", "or within these degrees", "facts")
        names = [f"{name}-{end}" for name in RANGES for end in ("low", "high")]
        self.known = self._numbers("", names, self._known_typed)
        self.front = ui.select(dict(FRONTS), label="front of the mesh")
        self.front.on_value_change(
            lambda event: self._unless_showing(lambda: self.session.set_limits(front=event.value))
        )
        self.front.props("dense options-dense data-testid=front")

    def _select(self, name: str, label: str, choices: Mapping[Any, str]) -> None:
        async def changed(event: Any) -> None:
            if self._showing:
                return
            self.session.options = replace(self.session.options, **{name: event.value})
            path = self.session.mesh_path
            if name in ("unit", "up") and path is not None:
                await self.workspace.open_mesh(path, self.session.names[path])

        value = getattr(self.session.options, name)
        select = ui.select(dict(choices), value=value, label=label, on_change=changed)
        self.selects[name] = select.props(f"dense options-dense data-testid={name}")

    def _number(self, test_id: str, label: str, on_change: Callable[[], None]) -> Any:
        field = ui.number(label, on_change=lambda: self._unless_showing(on_change))
        return field.props(f"dense data-testid={test_id}")

    def _numbers(self, prefix: str, names: Sequence[str], on_change: Callable[[], None]) -> list[Any]:
        with region("div", "numbers"):
            return [self._number(prefix + name, name.replace("-", " "), on_change) for name in names]

    def _unless_showing(self, change: Callable[[], None]) -> None:
        if not self._showing:
            change()

    def _camera_typed(self) -> None:
        fx, fy, cx, cy = (number.value for number in self.camera)
        if None not in (fx, fy, cx, cy):
            self._set_camera((float(fx), float(fy), float(cx), float(cy)))

    def _fov_typed(self) -> None:
        if self.fov.value is not None:
            self.session.camera, self.session.fov = None, float(self.fov.value)
        elif self.session.camera is None:
            self.session.fov = None

    def _known_typed(self) -> None:
        for k, name in enumerate(RANGES):
            low, high = (number.value for number in self.known[2 * k : 2 * k + 2])
            self.session.set_limits(**{name: None if None in (low, high) else (float(low), float(high))})

    def _set_camera(self, camera: Any) -> None:
        self.session.camera, self.session.fov = camera, None

    def refresh(self) -> None:
        """Show what changed in the session since the last time, here or in another window."""
        session = self.session
        set_text(self.command, session.command())
        set_text(self.python, "" if session.answer is None else session.python())
        now = (session.camera, session.fov, session.photo_path, session.options)
        if now == self.shown:
            return
        self.shown, self._showing = now, True
        limits = session.options.limits or {}
        ranges = [value for name in RANGES for value in limits.get(name) or (None, None)]
        for fields, values in ((self.camera, session.camera), (self.known, ranges)):
            for number, value in zip(fields, values or (None,) * 4, strict=True):
                number.value = value
        self.fov.value, self.front.value = session.fov, limits.get("front")
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
