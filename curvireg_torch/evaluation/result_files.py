"""The files of one result: ``result.json``, ``overlay.png`` and ``pose.glb``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..registration import Registrar, Registration
from ..registration.result import SCHEMA
from ..utils.files import write_file
from ..utils.threads import map_on_threads
from ..visualization import pose_glb, registration_sheet
from ..visualization.encoding import png
from .store import to_json

__all__ = ["write_lost", "write_result"]

MAX_GLB_FACES = 300_000  # of the largest mesh that is written: viewers are slow with files above 30 MB


def write_result(
    out: Path, document: dict[str, Any], registrar: Registrar, result: Registration, image: Any, box: Any
) -> None:
    """Write the files of a result into the folder ``out``; ``document`` is the content of ``result.json``.

    The picture and the scene are drawn beside each other, on threads. The other arguments are those of
    :func:`curvireg_torch.visualization.registration_sheet`. :class:`OutputError` if a file cannot be written.
    """
    mesh = registrar.of_model(result.model).bank.mesh
    _remove(out)
    write_file(out / "result.json", to_json(document).encode())  # first: no failure to draw it loses the result

    contents: dict[str, Callable[[], bytes]] = {
        "overlay.png": lambda: png(registration_sheet(registrar, result, image, box)),
        "pose.glb": lambda: pose_glb(mesh, *result.projection, image),
    }
    if len(mesh.faces) > MAX_GLB_FACES:
        del contents["pose.glb"]

    def attempt(name: str) -> Exception | None:
        try:
            write_file(out / name, contents[name]())
        except Exception as error:  # it must not cost the other file
            return error
        return None

    for error in filter(None, map_on_threads(attempt, list(contents))):
        raise error


def write_lost(out: Path, message: str) -> None:
    """Write the ``result.json`` of a refinement that lost the object."""
    _remove(out)
    write_file(out / "result.json", to_json({"schema": SCHEMA, "status": "lost", "message": message}).encode())


def _remove(out: Path) -> None:
    """Remove an older result: none of its files may stay beside those of a new one."""
    for name in ("result.json", "pose.glb", "overlay.png"):
        (out / name).unlink(missing_ok=True)
