"""The files of one result: ``result.json``, ``overlay.png`` and ``pose.glb``."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ..errors import CurviregError
from ..registration import Registrar, Registration
from ..registration.photograph import Photograph
from ..registration.result import PhotographPose
from ..registration.target import Target
from ..utils.aliases import Document, Fields
from ..utils.files import write_file
from ..utils.threads import map_on_threads
from ..visualization.encoding import png
from ..visualization.overlay import views_sheet
from ..visualization.pose_glb import scene_glb
from .documents import SCHEMA
from .store import to_json

# of the largest mesh that is written: viewers are slow with files above 30 MB
MAX_GLB_FACES = 300_000


@dataclass(frozen=True)
class RegisteredViews:
    """One pose in several photographs, to be drawn and saved. In the place of a photograph that
    cannot be used stands its error; ``document`` is the content of ``result.json``."""

    registrar: Registrar
    registration: Registration
    photographs: Sequence[Photograph | CurviregError]
    document: Fields

    @property
    def _target(self) -> Target:
        return self.registrar.of_mesh(self.registration.mesh_index)

    def write(self, out: Path) -> None:
        """:func:`write_files` of the pose."""
        faces = len(self._target.bank.mesh.faces)
        write_files(out, self.document, faces, self.overlay, self.glb)

    def overlay(self) -> bytes:
        """``overlay.png``: the photographs that could be read, with the contours at the pose."""
        shown = []
        for row, item, pose in self._views():
            if isinstance(item, Photograph):
                score = "" if pose.edge_support is None else f"edge support {pose.edge_support:.2f}"
                box = None if pose.box is None else pose.box.tolist()
                projection = pose.T_cam_from_model, item.K
                words = f"{row['name']}: {pose.failure or score}"
                shown.append((projection, item.image, box, words))
        return png(views_sheet(self._target.describer, shown))

    def glb(self) -> bytes:
        """``pose.glb``, with the cameras of the photographs that count."""
        assert self.registration.transform is not None
        cameras = []
        for row, item, pose in self._views():
            if isinstance(item, Photograph) and not pose.failure:
                T = torch.tensor(row["T_cam_from_world"], dtype=torch.float64)
                cameras.append((T, item.K, item.image))
        return scene_glb(self._target.bank.mesh, self.registration.transform, cameras)

    def _views(self) -> Iterator[tuple[Document, Photograph | CurviregError, PhotographPose]]:
        """Of each photograph its row of the document, itself and its pose."""
        rows = self.document["photographs"]
        return zip(rows, self.photographs, self.registration.views, strict=True)


def write_files(
    out: Path,
    document: Document,
    faces: int,
    overlay: Callable[[], bytes],
    glb: Callable[[], bytes],
) -> None:
    """Write ``result.json``, then the picture and the scene, drawn beside each other, into the
    folder ``out``, which :func:`.outputs.output_folder` has emptied of older ones. A scene of many
    ``faces`` is left out.

    :class:`OutputError` if a file cannot be written.
    """
    # first: no failure to draw it loses the result
    write_file(out / "result.json", to_json(document).encode())
    files = [("overlay.png", overlay), *([("pose.glb", glb)] if faces <= MAX_GLB_FACES else [])]

    def attempt(file: tuple[str, Callable[[], bytes]]) -> Exception | None:
        try:
            write_file(out / file[0], file[1]())
        except Exception as error:  # it must not cost the other file
            return error
        return None

    for error in map_on_threads(attempt, files):
        if error is not None:
            raise error


def write_lost(out: Path, message: str) -> None:
    """Write the ``result.json`` of a refinement that lost the object."""
    write_file(
        out / "result.json",
        to_json({"schema": SCHEMA, "verdict": "lost", "message": message}).encode(),
    )
