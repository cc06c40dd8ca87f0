"""The files of one result: ``result.json``, ``overlay.png`` and ``pose.glb``."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from ..errors import CurviregError
from ..registration import Registrar, Registration
from ..registration.photograph import Photograph
from ..utils.aliases import Document, Fields
from ..utils.files import write_file
from ..utils.threads import map_on_threads
from ..visualization import pose_glb, registration_sheet
from ..visualization.encoding import png
from ..visualization.overlay import views_sheet
from ..visualization.pose_glb import scene_glb
from .documents import SCHEMA
from .store import to_json

# of the largest mesh that is written: viewers are slow with files above 30 MB
MAX_GLB_FACES = 300_000


def write_result(
    out: Path,
    document: Fields,
    registrar: Registrar,
    result: Registration,
    photograph: Photograph,
    *,
    copies: Sequence[Registration] = (),
) -> None:
    """Write the files of a result into the folder ``out``, which :func:`.outputs.output_folder` has
    emptied of older ones; ``document`` is the content of ``result.json``.

    The other arguments are those of :func:`curvireg_torch.visualization.registration_sheet`.
    :class:`OutputError` if a file cannot be written.
    """
    mesh = registrar.of_mesh(result.mesh_index).bank.mesh
    camera = document["camera"]
    distorts = camera is not None and (camera["model"] == "fisheye" or any(camera["distortion"]))
    note = "Distortion of the lens removed." if distorts else ""
    _write(
        out,
        document,
        len(mesh.faces),
        lambda: png(registration_sheet(registrar, result, photograph, note=note, copies=copies)),
        lambda: pose_glb(mesh, *result.projection, photograph.image),
    )


def write_views(
    out: Path,
    document: Fields,
    registrar: Registrar,
    result: Registration,
    photographs: Sequence[Photograph | CurviregError],
) -> None:
    """Write the files of one pose in several photographs."""
    faces = len(registrar.of_mesh(result.mesh_index).bank.mesh.faces)
    arguments = (registrar, result, photographs, document)
    _write(out, document, faces, lambda: views_picture(*arguments), lambda: views_glb(*arguments))


def views_picture(
    registrar: Registrar,
    result: Registration,
    photographs: Sequence[Photograph | CurviregError],
    document: Document,
) -> bytes:
    """``overlay.png`` of several photographs: those that could be read, with the contours at the
    pose."""
    shown = []
    for row, item, pose in zip(document["photographs"], photographs, result.views, strict=True):
        if isinstance(item, Photograph):
            score = "" if pose.edge_support is None else f"edge support {pose.edge_support:.2f}"
            box = None if pose.box is None else pose.box.tolist()
            projection = pose.T_cam_from_model, item.K
            shown.append((projection, item.image, box, f"{row['name']}: {pose.failure or score}"))
    return png(views_sheet(registrar.of_mesh(result.mesh_index).describer, shown))


def views_glb(
    registrar: Registrar,
    result: Registration,
    photographs: Sequence[Photograph | CurviregError],
    document: Document,
) -> bytes:
    """``pose.glb`` of several photographs, with the cameras of those that count."""
    assert result.transform is not None
    cameras = []
    for row, item, pose in zip(document["photographs"], photographs, result.views, strict=True):
        if isinstance(item, Photograph) and not pose.failure:
            T = torch.tensor(row["T_cam_from_world"], dtype=torch.float64)
            cameras.append((T, item.K, item.image))
    return scene_glb(registrar.of_mesh(result.mesh_index).bank.mesh, result.transform, cameras)


def _write(
    out: Path,
    document: Fields,
    faces: int,
    overlay: Callable[[], bytes],
    scene: Callable[[], bytes],
) -> None:
    """Write ``result.json``, then the picture and the scene, drawn beside each other."""
    # first: no failure to draw it loses the result
    write_file(out / "result.json", to_json(document).encode())
    files = [("overlay.png", overlay), *([("pose.glb", scene)] if faces <= MAX_GLB_FACES else [])]

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
