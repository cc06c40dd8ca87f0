"""What was found, in tabs below the photograph; each is drawn when it is looked at."""

import math
from collections.abc import Callable
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from ..geometry import rotation_error
from ..io.meshes.mesh import mesh_unit
from ..limits import MAX_VIEWER_FACES
from ..registration.document import correction
from ..utils.choices import UNITS
from ..visualization import contour_overlay, side_pictures
from ..visualization.plots import view_sphere
from ..visualization.sheet import thumbnail
from .pictures import png, view_pictures

if TYPE_CHECKING:
    from .page import Page

__all__ = ["Panels"]

RANKED = 12
TURNS = {"tilt": (1, 0, 0), "turn": (0, 1, 0), "roll": (0, 0, 1)}
SHIFTS = {"right": (1, 0, 0), "down": (0, 1, 0), "away": (0, 0, 1)}


class Panels:
    """The tabs of a page."""

    def __init__(self, page: "Page") -> None:
        self.page, self.stale = page, set[str]()
        self.draw: dict[str, Callable[[], Any]] = {
            "answer": self._answer, "fields": self._fields, "views": self._views, "view sphere": self._sphere,
            "3D": self._scene,
        }  # fmt: skip
        with ui.row().classes("w-full no-wrap items-start"), ui.column().classes("grow min-w-0 gap-0"):
            self.facts = ui.label().classes("whitespace-pre-line").props("data-testid=facts")
            self._by_hand()
            with ui.tabs(on_change=self._looked_at).props("dense no-caps") as self.tabs:
                for name in self.draw:
                    ui.tab(name).props(f'data-testid="tab-{name}"')
            with ui.tab_panels(self.tabs, value="answer").classes("w-full").props("keep-alive"):
                self.place = {}
                for name in self.draw:
                    with ui.tab_panel(name).classes("p-1"):
                        self.place[name] = ui.row().classes("w-full gap-3").props(f'data-testid="panel-{name}"')

    def _by_hand(self) -> None:
        with ui.row().classes("items-center gap-1") as self.tools:
            ui.label("by hand").classes("text-caption")
            self.step = ui.toggle({1.0: "fine", 4.0: "middle", 15.0: "coarse"}, value=4.0).props("dense no-caps")
            for name, axis in TURNS.items():
                self._pair(name, axis, turning=True)
            for name, axis in SHIFTS.items():
                self._pair(name, axis, turning=False)
            ui.button("let the contours pull it in", on_click=self._pull_in).props("no-caps dense data-testid=pull-in")
            for kind in ("JSON", "PNG", "GLB"):
                ui.button(kind, icon="download", on_click=lambda kind=kind: self._download(kind)).props(
                    f"flat dense data-testid=download-{kind}"
                )
        self.tools.set_visibility(False)

    def _pair(self, name: str, axis: tuple[int, int, int], *, turning: bool) -> None:
        """Buttons to move the pose both ways: by degrees, or by hundredths of the radius."""

        async def move(sign: int) -> None:
            way = [sign * v * float(self.step.value) * (1.0 if turning else 0.01) for v in axis]
            options = {"turn": way} if turning else {"shift": way}
            if await self.page.do(lambda: self.page.session.nudge(**options)):
                await self.page.pose_changed()

        with ui.button_group().props("flat"):
            for sign, mark in ((-1, "-"), (1, "+")):
                ui.button(f"{mark} {name}" if sign < 0 else mark, on_click=lambda sign=sign: move(sign)).props(
                    f'flat dense no-caps data-testid="{mark}{name}"'
                )

    async def _pull_in(self) -> None:
        told = await self.page.do(self.page.session.pull_in)
        if told:
            await self.page.pose_changed()

    async def _download(self, kind: str) -> None:
        session, name = self.page.session, {"JSON": "result.json", "PNG": "overlay.png", "GLB": "pose.glb"}[kind]
        make = {"JSON": session.json, "PNG": self._overlay, "GLB": session.glb}[kind]
        content = await self.page.do(make)
        if content:
            media = {"JSON": "application/json", "PNG": "image/png", "GLB": "model/gltf-binary"}[kind]
            ui.download.from_url(self.page.put(name, content, media), name)

    def _overlay(self) -> bytes:
        answer, shown = self.page.session.seen()
        return png(contour_overlay(answer.registrar, shown.pose, answer.image, answer.box))

    def clear(self) -> None:
        """There is no answer any more."""
        self.tools.set_visibility(False)
        self.facts.text = ""
        for place in self.place.values():
            place.clear()

    async def changed(self, *, answer: bool) -> None:
        """The pose shown, or the whole answer, has changed."""
        self.tools.set_visibility(True)
        self.facts.text = self._told()
        self.stale |= set(self.draw) if answer else {"fields", "3D"}
        await self._looked_at()

    async def _looked_at(self) -> None:
        name = self.tabs.value or "answer"
        if name in self.stale and self.page.session.shown is not None:
            self.stale.discard(name)
            self.place[name].clear()
            await self.draw[name]()

    def _told(self) -> str:
        answer, shown = self.page.session.seen()
        a, e, t = shown.pose.viewpoint
        lines = [f"azimuth {a:.1f}, elevation {e:.1f}, theta {t:.1f} degrees"]
        if shown.pose.translation is not None:
            unit = mesh_unit(answer.registrar.bank.mesh) or "in the mesh's own unit"
            lines[0] += f";  translation {', '.join(f'{v:.4g}' for v in shown.pose.translation.tolist())} {unit}"
        sure = f"confidence {answer.result.confidence:.2f}"
        lines.append(sure if answer.document["reliable"] else f"{sure}: no reliable match; take the pose as a guess")
        if shown.number:
            lines[1] = f"hypothesis {shown.number + 1}, a rival; of the first: {lines[1]}"
        lines += correction(answer.document)
        if shown.by_hand:
            lines.append(f"by hand: {'; '.join(shown.by_hand)}; the command line gives the answer before that")
        return "\n".join(lines)

    async def _pictures(self, panel: str, cards: Any, width: int, kind: str = "png") -> list[Any]:
        """Cards with a picture and words under it."""
        rows = []
        for number, (content, words) in enumerate(cards):
            with self.place[panel], ui.card().tight().style(f"width: {width}px") as card:
                url = self.page.put(f"{panel.replace(' ', '-')}-{number}.{kind}", content, f"image/{kind}")
                ui.element("img").props(f'src="{url}" alt="{words.splitlines()[0]}"').classes("w-full")
                ui.label(words).classes("whitespace-pre-line text-caption p-1")
            rows.append(card)
        return rows

    async def _answer(self) -> None:
        answer, _ = self.page.session.seen()
        registrar, result = answer.registrar, answer.result
        best = result.hypotheses[0]

        def make() -> Any:
            cards = []
            for number, pose in enumerate(result.hypotheses, start=1):
                away = float(rotation_error(pose.rotation, best.rotation))
                told = f"{number}: score {pose.score:.2f}" + (f", {away:.0f} degrees from 1" if number > 1 else "")
                edge_support = "" if pose.edge_support is None else f"support {pose.edge_support:.2f}\n"
                evidence = ", ".join(f"{name} {value:.2f}" for name, value in pose.evidence.items())
                renderer = registrar.describers[pose.model].renderer
                picture = thumbnail(renderer, pose.projection, answer.image, answer.box.tolist())
                cards.append((picture, f"{told}\n{edge_support}{evidence}"))
            return cards

        cards = await self.page.do(make)
        for number, card in enumerate(await self._pictures("answer", cards or [], 240, "jpeg")):
            with card:
                ui.button("show", on_click=lambda number=number: self._choose(number)).props(
                    f"flat dense no-caps data-testid=show-{number + 1}"
                )

    async def _choose(self, number: int) -> None:
        if not self.page.busy:
            self.page.session.choose(number)
            await self.page.pose_changed()

    async def _fields(self) -> None:
        answer, shown = self.page.session.seen()
        made = await self.page.do(lambda: side_pictures(answer.registrar, shown.pose, answer.image, answer.box))
        await self._pictures("fields", [(png(p), name) for name, p in (made or {}).items()], 260)

    async def _views(self) -> None:
        answer, _ = self.page.session.seen()
        registrar, result = answer.registrar, answer.result
        best, views = result.ranking.top(RANKED)[0].cpu(), registrar.bank.views

        def make() -> Any:
            cards = []
            for place, (view, content) in enumerate(zip(best.tolist(), view_pictures(registrar, best), strict=True), 1):
                terms = {n: float(raw[0, view]) for n, raw in result.ranking.terms.items()}
                told = [f"{place}: S {float(result.ranking.scores[0, view]):.3f}"]
                angles = (float(getattr(views, name)[view]) for name in ("azimuth", "elevation", "theta"))
                told.append("a {:.0f}, e {:.0f}, t {:.0f}".format(*angles))
                told += [f"{name} {'-' if np.isnan(v) else f'{v:.3f}'}" for name, v in terms.items()]
                cards.append((content, "\n".join(told)))
            return cards

        await self._pictures("views", await self.page.do(make) or [], 130)

    async def _sphere(self) -> None:
        answer, _ = self.page.session.seen()
        registrar, result = answer.registrar, answer.result

        def make() -> bytes:
            file = BytesIO()
            view_sphere(registrar.bank, result).savefig(file, format="png", dpi=110)
            return file.getvalue()

        content = await self.page.do(make)
        if content:
            told = "The best turn of every direction. Numbers: the hypotheses. One bright place is an answer."
            await self._pictures("view sphere", [(content, told)], 770)

    async def _scene(self) -> None:
        answer, shown = self.page.session.seen()
        registrar = answer.registrar
        mesh = registrar.bank.mesh
        if len(mesh.faces) > MAX_VIEWER_FACES:
            with self.place["3D"]:
                ui.label(f"{len(mesh.faces):,} faces are too many to show; download the GLB")
            return
        content = await self.page.do(self.page.session.glb)
        if not content:
            return
        url = self.page.put("scene.glb", content, "model/gltf-binary")
        describe = registrar.describers[shown.pose.model]
        T = shown.pose.projection[0]
        unit = UNITS[mesh_unit(mesh) or "m"]
        x, y, z = ((T[:3, :3] @ describe.centre + T[:3, 3]) / describe.radius).tolist()
        fov = 2 * math.degrees(math.atan(answer.image.shape[-2] / (1.7 * float(shown.pose.projection[1][1, 1]))))
        camera = ui.scene.perspective_camera(fov=min(fov, 120.0), near=0.05, far=1000.0)
        with self.place["3D"]:
            scene = ui.scene(width=760, height=480, grid=False, camera=camera, background_color="#222")
        with scene:
            scene.gltf(url).scale(1.0 / (describe.radius * unit))
        scene.move_camera(0, 0, 0, x, -y, -z, up_x=0, up_y=1, up_z=0, duration=0)
