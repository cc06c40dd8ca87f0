"""How the answer was found, in tabs; each tab is drawn when it is opened."""

import math
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
from nicegui import ui

from ..errors import MAX_VIEWER_FACES
from ..mesh.mesh import mesh_unit
from ..utils.choices import UNITS
from ..visualization import side_pictures
from ..visualization.encoding import png
from ..visualization.plots import viewpoints
from .pictures import view_pictures
from .widgets import region, text
from .workspace import Workspace

__all__ = ["Panels"]

MAX_VIEWS = 12


class Panels:
    """The tabs of a result."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.session, self.outdated = workspace, workspace.session, set[str]()
        self.shown: tuple[Any, Any] = (None, None)
        self.draw: dict[str, Callable[[], Any]] = {
            "fields": self._draw_fields,
            "views": self._draw_views,
            "view sphere": self._draw_sphere,
            "3D": self._draw_scene,
        }
        with region("section", "panels", aria_label="how the answer was found") as self.section:
            text("h2", "How it was found")
            with ui.tabs(on_change=self._draw_open_tab).props("dense no-caps align=left") as self.tabs:
                for name in self.draw:
                    ui.tab(name).props(f'data-testid="tab-{name}"')
            with ui.tab_panels(self.tabs, value="fields").props("keep-alive"):
                self.rows = {}
                for name in self.draw:
                    with ui.tab_panel(name):
                        self.rows[name] = region("div", "tiles", data_testid=f"panel-{name}")

    async def refresh(self) -> None:
        """Show the displayed pose of the session, and a new result also in the tabs that do not depend on it."""
        result, displayed = self.session.result, self.session.displayed
        self.section.set_visibility(result is not None)
        before, self.shown = self.shown, (result, displayed)
        if result is None:
            return
        if result is not before[0]:
            self.outdated |= set(self.draw)
        if displayed is not before[1]:
            self.outdated |= {"fields", "3D"}
        await self._draw_open_tab()

    async def _draw_open_tab(self) -> None:
        name = self.tabs.value or "fields"
        if name in self.outdated and self.session.displayed is not None:
            self.outdated.discard(name)
            self.rows[name].clear()
            await self.draw[name]()

    def _draw_cards(self, panel: str, cards: Any, kind: str = "") -> None:
        """Pictures with a caption each."""
        for number, (content, caption) in enumerate(cards):
            url = self.workspace.serve(f"{panel.replace(' ', '-')}-{number}.png", content, "image/png")
            with self.rows[panel], region("figure", f"tile {kind}"):
                region("img", src=url, alt=caption.splitlines()[0])
                text("figcaption", caption, "lines")

    async def _draw_fields(self) -> None:
        result, displayed = self.session.require_result()
        pictures = await self.workspace.run(
            "pose", lambda: side_pictures(result.registrar, displayed.pose, result.image, result.box)
        )
        self._draw_cards("fields", [(png(p), name) for name, p in (pictures or {}).items()])

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

        self._draw_cards("views", await self.workspace.run("pose", make) or [], "small")

    async def _draw_sphere(self) -> None:
        result, _ = self.session.require_result()

        def make() -> bytes:
            file = BytesIO()
            viewpoints(result.registrar.bank, result.registration).savefig(file, format="png", dpi=110)
            return file.getvalue()

        content = await self.workspace.run("pose", make)
        if content:
            caption = "The best score of every direction over in-plane rotations. The numbers are the answers."
            self._draw_cards("view sphere", [(content, caption)], "wide")

    async def _draw_scene(self) -> None:
        result, displayed = self.session.require_result()
        mesh = result.registrar.bank.mesh
        if len(mesh.faces) > MAX_VIEWER_FACES:
            with self.rows["3D"]:
                text("p", f"{len(mesh.faces):,} faces are too many to show; download the 3D scene")
            return
        content = await self.workspace.run("pose", self.session.glb)
        if not content:
            return
        url = self.workspace.serve("scene.glb", content, "model/gltf-binary")
        describer = result.registrar.describer
        T, K = displayed.pose.projection
        x, y, z = ((T[:3, :3] @ describer.centre + T[:3, 3]) / describer.radius).tolist()
        fov = 2 * math.degrees(math.atan(result.image.shape[-2] / (1.7 * float(K[1, 1]))))
        camera = ui.scene.perspective_camera(fov=min(fov, 120.0), near=0.05, far=1000.0)
        with self.rows["3D"]:
            scene = ui.scene(width=720, height=460, grid=False, camera=camera, background_color="#222")
        with scene:
            scene.gltf(url).scale(1.0 / (describer.radius * UNITS[mesh_unit(mesh) or "m"]))
        scene.move_camera(0, 0, 0, x, -y, -z, up_x=0, up_y=1, up_z=0, duration=0)
