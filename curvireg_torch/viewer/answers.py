"""The answer: the pose in words, the rivals to choose from, corrections by hand, and downloads."""

from typing import Any

from nicegui import ui

from ..geometry import rotation_error
from ..mesh import mesh_unit, mesh_up
from ..registration.confidence import RELIABLE
from ..registration.result import RIVAL_FRACTION, pose_in_words, remarks, verdict
from ..visualization import contour_overlay
from ..visualization.encoding import png
from ..visualization.sheet import thumbnail
from .widgets import button, region, set_text, term, text
from .workspace import Workspace

__all__ = ["Answers"]

STEPS = {"fine": 1.0, "middle": 4.0, "coarse": 15.0}  # degrees, and hundredths of the radius
ROTATIONS = {"tilt": (1, 0, 0), "turn": (0, 1, 0), "roll": (0, 0, 1)}
TRANSLATIONS = {"right": (1, 0, 0), "down": (0, 1, 0), "away": (0, 0, 1)}
VERDICTS = {
    "likely": "Nine in ten such answers are right. Look whether the contours fit all the same.",
    "unsure": "It may be another of the answers below, or none. Choose the one whose contours fit.",
    "no match": "Probably none of the answers is right: check the mesh, its unit and the box.",
}
TERMS = {
    "confidence": "estimated probability that the rotation is within 30 degrees of the truth",
    "probability": "estimated probability that this answer is within 30 degrees of the truth",
    "score": "how well the view at this pose correlates with the photograph, with all other evidence",
    "edge support": "how strongly the photograph's edges lie under the contours, 0 to 1",
    "rank": "how well the view that the search started from compares with the best one; 0 is the best",
    "similarity": "correlation of the curves in the photograph and in the view at this pose, 0 to 1",
    "appearance": "how well shading and surface of the view compare with the photograph, by a network; 0 is the best",
}


class Answers:
    """Cards of the possible poses, and tools for the displayed one."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session = workspace, workspace.session
        self.shown_result: Any = None
        self.shown_pose: Any = None
        self.step = STEPS["middle"]
        with region("section", "answers", aria_label="answer", data_testid="answers") as self.section:
            with region("div", "verdict"):
                self.word = text("h2", "", data_testid="verdict")
                self.certainty = ui.html("", tag="p", sanitize=False)
                self.facts = text("p", "", "lines", data_testid="facts")
                self.meaning = text("p", "", "facts")
            self.cards = region("div", "cards", data_testid="panel-answer")
            with region("details", "fold", data_testid="fold-by-hand"):
                text("summary", "Correct the pose by hand")
                self._build_tools()
            with region("div", "row"):
                for kind, label in (("JSON", "Numbers (.json)"), ("PNG", "Picture (.png)"), ("GLB", "3D scene (.glb)")):
                    button(label, lambda kind=kind: self._download(kind), f"download-{kind}", "quiet")

    def _build_tools(self) -> None:
        with region("label", "row"):
            text("span", "Size of a step")
            with region("select", "button", data_testid="step").on("change", self._set_step, args=["target.value"]):
                for name in STEPS:
                    text("option", name, value=name).props("selected" if STEPS[name] == self.step else "")
        with region("div", "pairs"):
            for name, axis in ROTATIONS.items():
                self._build_pair(name, "rotation", axis, 1.0)
            for name, axis in TRANSLATIONS.items():
                self._build_pair(name, "translation", axis, 0.01)
        button("Fit the contours", self._fit, "fit")

    def _build_pair(self, name: str, kind: str, axis: tuple[int, int, int], unit: float) -> None:
        """Two buttons that rotate about an axis or move along it, in steps of ``unit`` degrees or radii."""

        async def move(sign: int) -> None:
            step = {kind: [sign * v * self.step * unit for v in axis]}
            await self.workspace.run("pose", lambda: self.session.move(**step))

        with region("div", "pair", role="group", aria_label=name):
            button("−", lambda: move(-1), f"-{name}", "quiet", aria_label=f"{name} back")
            text("span", name)
            button("+", lambda: move(1), f"+{name}", "quiet", aria_label=f"{name} on")

    def _set_step(self, event: Any) -> None:
        self.step = STEPS[event.args]

    async def _fit(self) -> None:
        await self.workspace.run("pose", self.session.fit)

    async def _download(self, kind: str) -> None:
        name, media_type, make = {
            "JSON": ("result.json", "application/json", self.session.json),
            "PNG": ("overlay.png", "image/png", self._overlay),
            "GLB": ("pose.glb", "model/gltf-binary", self.session.glb),
        }[kind]
        content = await self.workspace.run("pose", make)
        if content:
            ui.download.from_url(self.workspace.serve(name, content, media_type), name)

    def _overlay(self) -> bytes:
        result, displayed = self.session.require_result()
        return png(contour_overlay(result.registrar, displayed.pose, result.image, result.box))

    async def refresh(self) -> None:
        """Show the answer of the session, if it changed."""
        result, displayed = self.session.result, self.session.displayed
        self.section.set_visibility(result is not None)
        if result is None or displayed is None:
            self.shown_result = self.shown_pose = None
            return
        if displayed is not self.shown_pose:
            self.shown_pose = displayed
            self._describe_pose()
        if result is not self.shown_result:
            self.shown_result = result
            await self._draw_cards()
        for number, card in enumerate(self.cards.default_slot.children):
            card.classes(**{"add" if number == displayed.number else "remove": "current"})

    def _describe_pose(self) -> None:
        result, displayed = self.session.require_result()
        word = verdict(result.registration.confidence, result.registration.none, result.document["reliable"])
        set_text(self.word, word)
        self.word.classes(replace=f"badge {word.replace(' ', '-')}")
        set_text(self.meaning, VERDICTS[word])
        pose, mesh = displayed.pose, result.registrar.bank.mesh
        front = (self.session.options.limits or {}).get("front")
        azimuth, elevation, theta = pose.viewpoint
        lines = [pose_in_words(pose.rotation, up=mesh_up(mesh), front=front)]
        lines.append(f"azimuth {azimuth:.1f}, elevation {elevation:.1f}, theta {theta:.1f} degrees")
        if pose.translation is not None:
            unit = mesh_unit(mesh) or "in the mesh's unit"
            lines.append(f"translation {', '.join(f'{v:.4g}' for v in pose.translation.tolist())} {unit}")
        if displayed.number:
            lines[0] = f"answer {displayed.number + 1}{', picked by you' if displayed.chosen else ''}: {lines[0]}"
        certainty = f"{term('confidence', TERMS['confidence'])} {result.registration.confidence or 0.0:.2f}"
        self.certainty.set_content(certainty + (" of the first answer" if displayed.number else ""))
        lines += [*result.document["warnings"], *remarks(result.document)]
        if displayed.edits:
            lines.append(f"by hand: {'; '.join(displayed.edits)}; the command line gives the result before that")
        set_text(self.facts, "\n".join(lines))

    async def _draw_cards(self) -> None:
        result, _ = self.session.require_result()
        registrar, hypotheses = result.registrar, result.registration.hypotheses
        probabilities = result.registration.probabilities or (0.0,) * len(hypotheses)

        def make() -> list[bytes]:
            return [
                thumbnail(registrar.describer.renderer, p.projection, result.image, result.box.tolist())
                for p in hypotheses
            ]

        pictures = await self.workspace.run("pose", make)
        self.cards.clear()
        for number, (pose, picture) in enumerate(zip(hypotheses, pictures or [], strict=True)):
            degrees = float(rotation_error(pose.rotation, hypotheses[0].rotation))
            probability = probabilities[number]
            fraction = RIVAL_FRACTION * probabilities[0]
            word = "likely" if probability >= RELIABLE else "possible" if probability >= fraction else "unlikely"
            values = {"probability": probability, "score": pose.score}
            if pose.edge_support is not None:
                values["edge support"] = pose.edge_support
            values |= {name: value for name, value in pose.evidence.items() if name in TERMS}
            rows = "".join(f"<li>{term(name, TERMS[name])} {value:.2f}</li>" for name, value in values.items())
            with self.cards, region("article", "card"):
                url = self.workspace.serve(f"answer-{number}.jpeg", picture, "image/jpeg")
                region("img", src=url, alt=f"contours of answer {number + 1}")
                text("h3", f"Answer {number + 1}" + (f", {degrees:.0f}° from 1" if number else ""))
                with region("details"):
                    text("summary", f"{word}: {probability:.2f}")
                    ui.html(rows, tag="ul", sanitize=False)
                self._build_choice("Show", number, chosen=False)
                if len(hypotheses) > 1:
                    self._build_choice("This is it", number, chosen=True)

    def _build_choice(self, label: str, number: int, *, chosen: bool) -> None:
        name = f"{'pick' if chosen else 'show'}-{number + 1}"
        button(label, lambda: self.session.display(number, chosen=chosen), name, "quiet" if chosen else "")
