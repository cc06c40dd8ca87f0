"""The result, in tabs below the photograph; each tab is drawn when it is opened."""

import math
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
from nicegui import ui

from ..geometry import rotation_error
from ..io.meshes.mesh import mesh_unit
from ..limits import MAX_VIEWER_FACES
from ..registration.document import remarks
from ..utils.choices import UNITS
from ..visualization import contour_overlay, side_pictures
from ..visualization.encoding import png
from ..visualization.plots import view_sphere
from ..visualization.sheet import thumbnail
from .host import Host
from .pictures import view_pictures

__all__ = ["Panels"]

MAX_VIEWS = 12
ROTATIONS = {"tilt": (1, 0, 0), "turn": (0, 1, 0), "roll": (0, 0, 1)}
TRANSLATIONS = {"right": (1, 0, 0), "down": (0, 1, 0), "away": (0, 0, 1)}


class Panels:
    """The tabs, and above them the pose in words and the buttons that change it."""

    def __init__(self, host: Host) -> None:
        self.host, self.session, self.outdated = host, host.session, set[str]()
        self.draw: dict[str, Callable[[], Any]] = {
            "answer": self._draw_hypotheses,
            "fields": self._draw_fields,
            "views": self._draw_views,
            "view sphere": self._draw_sphere,
            "3D": self._draw_scene,
        }
        with ui.row().classes("w-full no-wrap items-start"), ui.column().classes("grow min-w-0 gap-0"):
            self.facts = ui.label().classes("whitespace-pre-line").props("data-testid=facts")
            self._build_tools()
            with ui.tabs(on_change=self._draw_open_tab).props("dense no-caps") as self.tabs:
                for name in self.draw:
                    ui.tab(name).props(f'data-testid="tab-{name}"')
            with ui.tab_panels(self.tabs, value="answer").classes("w-full").props("keep-alive"):
                self.rows = {}
                for name in self.draw:
                    with ui.tab_panel(name).classes("p-1"):
                        self.rows[name] = ui.row().classes("w-full gap-3").props(f'data-testid="panel-{name}"')

    def _build_tools(self) -> None:
        with ui.row().classes("items-center gap-1") as self.tools:
            ui.label("by hand").classes("text-caption")
            self.step = ui.toggle({1.0: "fine", 4.0: "middle", 15.0: "coarse"}, value=4.0).props("dense no-caps")
            for name, axis in ROTATIONS.items():
                self._build_pair(name, "rotation", axis, 1.0)
            for name, axis in TRANSLATIONS.items():
                self._build_pair(name, "translation", axis, 0.01)
            ui.button("fit contours", on_click=self._fit).props("no-caps dense data-testid=fit")
            for kind in ("JSON", "PNG", "GLB"):
                ui.button(kind, icon="download", on_click=lambda kind=kind: self._download(kind)).props(
                    f"flat dense data-testid=download-{kind}"
                )
        self.tools.set_visibility(False)

    def _build_pair(self, name: str, kind: str, axis: tuple[int, int, int], unit: float) -> None:
        """Two buttons that rotate about an axis or move along it, in steps of ``unit`` degrees or radii."""

        async def move(sign: int) -> None:
            step = {kind: [sign * v * float(self.step.value) * unit for v in axis]}
            if await self.host.run(lambda: self.session.move(**step)):
                await self.host.show_pose()

        with ui.button_group().props("flat"):
            for sign, mark in ((-1, "-"), (1, "+")):
                ui.button(f"{mark} {name}" if sign < 0 else mark, on_click=lambda sign=sign: move(sign)).props(
                    f'flat dense no-caps data-testid="{mark}{name}"'
                )

    async def _fit(self) -> None:
        if await self.host.run(self.session.fit):
            await self.host.show_pose()

    async def _download(self, kind: str) -> None:
        name, media_type, make = {
            "JSON": ("result.json", "application/json", self.session.json),
            "PNG": ("overlay.png", "image/png", self._overlay),
            "GLB": ("pose.glb", "model/gltf-binary", self.session.glb),
        }[kind]
        content = await self.host.run(make)
        if content:
            ui.download.from_url(self.host.serve(name, content, media_type), name)

    def _overlay(self) -> bytes:
        result, displayed = self.session.require_result()
        return png(contour_overlay(result.registrar, displayed.pose, result.image, result.box))

    def clear(self) -> None:
        """Remove the result."""
        self.tools.set_visibility(False)
        self.facts.text = ""
        for row in self.rows.values():
            row.clear()

    async def update(self, *, new_result: bool) -> None:
        """Show the displayed pose of the session, and a new result also in the tabs that do not depend on it."""
        self.tools.set_visibility(True)
        self.facts.text = self._describe_pose()
        self.outdated |= set(self.draw) if new_result else {"fields", "3D"}
        await self._draw_open_tab()

    async def _draw_open_tab(self) -> None:
        name = self.tabs.value or "answer"
        if name in self.outdated and self.session.displayed is not None:
            self.outdated.discard(name)
            self.rows[name].clear()
            await self.draw[name]()

    def _describe_pose(self) -> str:
        result, displayed = self.session.require_result()
        azimuth, elevation, theta = displayed.pose.viewpoint
        lines = [f"azimuth {azimuth:.1f}, elevation {elevation:.1f}, theta {theta:.1f} degrees"]
        if displayed.pose.translation is not None:
            unit = mesh_unit(result.registrar.bank.mesh) or "in the mesh's unit"
            lines[0] += f";  translation {', '.join(f'{v:.4g}' for v in displayed.pose.translation.tolist())} {unit}"
        confidence = f"confidence {result.registration.confidence:.2f}"
        if not result.document["reliable"]:
            confidence += ": no reliable match; take the pose as a guess"
        rival = f"hypothesis {displayed.number + 1}, a rival; of the first: " if displayed.number else ""
        if displayed.chosen:
            rival = f"hypothesis {displayed.number + 1}, picked by you; of the first: "
        lines += [rival + confidence, *remarks(result.document)]
        if displayed.edits:
            lines.append(f"by hand: {'; '.join(displayed.edits)}; the command line gives the result before that")
        return "\n".join(lines)

    async def _draw_cards(self, panel: str, cards: Any, width: int, kind: str = "png") -> list[Any]:
        """Cards with a picture and a caption each."""
        drawn = []
        for number, (content, caption) in enumerate(cards):
            with self.rows[panel], ui.card().tight().style(f"width: {width}px") as card:
                url = self.host.serve(f"{panel.replace(' ', '-')}-{number}.{kind}", content, f"image/{kind}")
                ui.element("img").props(f'src="{url}" alt="{caption.splitlines()[0]}"').classes("w-full")
                ui.label(caption).classes("whitespace-pre-line text-caption p-1")
            drawn.append(card)
        return drawn

    async def _draw_hypotheses(self) -> None:
        result, _ = self.session.require_result()
        registrar, hypotheses = result.registrar, result.registration.hypotheses
        answers = result.registration.answer_set

        def make() -> Any:
            cards = []
            for number, pose in enumerate(hypotheses, start=1):
                degrees = float(rotation_error(pose.rotation, hypotheses[0].rotation))
                away = f", {degrees:.0f} degrees from 1" if number > 1 else ""
                support = "" if pose.edge_support is None else f"edge support {pose.edge_support:.2f}\n"
                evidence = ", ".join(f"{name} {value:.2f}" for name, value in pose.evidence.items())
                renderer = registrar.describers[pose.model].renderer
                picture = thumbnail(renderer, pose.projection, result.image, result.box.tolist())
                probability = f"{number}: probability {answers.probabilities[number - 1]:.2f}{away}"
                cards.append((picture, f"{probability}\nscore {pose.score:.2f}, {support}{evidence}"))
            return cards

        cards = await self.host.run(make)
        for number, card in enumerate(await self._draw_cards("answer", cards or [], 240, "jpeg")):
            with card:
                self._build_display_button("show", number, chosen=False)
                if len(answers.members) > 1 and number in answers.members:
                    self._build_display_button("could be this: pick it", number, chosen=True)

    def _build_display_button(self, text: str, number: int, *, chosen: bool) -> None:
        async def display() -> None:
            if not self.host.busy:
                self.session.display(number, chosen=chosen)
                await self.host.show_pose()

        name = f"{'pick' if chosen else 'show'}-{number + 1}"
        ui.button(text, on_click=display).props(f"flat dense no-caps data-testid={name}")

    async def _draw_fields(self) -> None:
        result, displayed = self.session.require_result()
        pictures = await self.host.run(
            lambda: side_pictures(result.registrar, displayed.pose, result.image, result.box)
        )
        await self._draw_cards("fields", [(png(p), name) for name, p in (pictures or {}).items()], 260)

    async def _draw_views(self) -> None:
        result, _ = self.session.require_result()
        registrar, ranking = result.registrar, result.registration.ranking
        best, views = ranking.top(MAX_VIEWS)[0].cpu(), registrar.bank.views

        def make() -> Any:
            cards = []
            for rank, (view, content) in enumerate(zip(best.tolist(), view_pictures(registrar, best), strict=True), 1):
                angles = (float(getattr(views, name)[view]) for name in ("azimuth", "elevation", "theta"))
                lines = [
                    f"{rank}: S {float(ranking.scores[0, view]):.3f}",
                    "a {:.0f}, e {:.0f}, t {:.0f}".format(*angles),
                ]
                terms = {name: float(raw[0, view]) for name, raw in ranking.terms.items()}
                lines += [f"{name} {'-' if np.isnan(v) else f'{v:.3f}'}" for name, v in terms.items()]
                cards.append((content, "\n".join(lines)))
            return cards

        await self._draw_cards("views", await self.host.run(make) or [], 130)

    async def _draw_sphere(self) -> None:
        result, _ = self.session.require_result()

        def make() -> bytes:
            file = BytesIO()
            view_sphere(result.registrar.bank, result.registration).savefig(file, format="png", dpi=110)
            return file.getvalue()

        content = await self.host.run(make)
        if content:
            caption = "The best score of every direction over in-plane rotations. The numbers are the hypotheses."
            await self._draw_cards("view sphere", [(content, caption)], 770)

    async def _draw_scene(self) -> None:
        result, displayed = self.session.require_result()
        mesh = result.registrar.bank.mesh
        if len(mesh.faces) > MAX_VIEWER_FACES:
            with self.rows["3D"]:
                ui.label(f"{len(mesh.faces):,} faces are too many to show; download the GLB")
            return
        content = await self.host.run(self.session.glb)
        if not content:
            return
        url = self.host.serve("scene.glb", content, "model/gltf-binary")
        describer = result.registrar.describers[displayed.pose.model]
        T, K = displayed.pose.projection
        x, y, z = ((T[:3, :3] @ describer.centre + T[:3, 3]) / describer.radius).tolist()
        fov = 2 * math.degrees(math.atan(result.image.shape[-2] / (1.7 * float(K[1, 1]))))
        camera = ui.scene.perspective_camera(fov=min(fov, 120.0), near=0.05, far=1000.0)
        with self.rows["3D"]:
            scene = ui.scene(width=760, height=480, grid=False, camera=camera, background_color="#222")
        with scene:
            scene.gltf(url).scale(1.0 / (describer.radius * UNITS[mesh_unit(mesh) or "m"]))
        scene.move_camera(0, 0, 0, x, -y, -z, up_x=0, up_y=1, up_z=0, duration=0)
