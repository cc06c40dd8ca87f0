"""A start pose and the mesh, as other trackers read them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ..formats.exports.trackers import write_m3t, write_visp
from ..mesh import Mesh
from ..mesh.edges import encloses_volumes, simplified
from ..mesh.mesh import mesh_centre

MAX_CAO_FACES = 2000
"""Triangles to which larger meshes are simplified for ViSP, which follows the edges of each
polygon."""


def write_start(
    tracker: Literal["m3t", "visp"], out: Path, mesh: Mesh, document: Mapping[str, Any]
) -> None:
    """Write the files of M3T or ViSP into the folder ``out``; ``document`` is the content of
    ``result.json``, of a pose of ``mesh``.

    Raises:
        InvalidInputError: the pose has no translation, or is in the world of several cameras.
        OutputError: a file cannot be written.
    """
    if tracker == "m3t":
        closed = encloses_volumes(mesh)
        write_m3t(out, mesh.vertices, mesh.faces, document, is_closed=closed)
    else:
        centre = mesh_centre(mesh).numpy()
        vertices, faces = simplified(mesh, centre, MAX_CAO_FACES)
        write_visp(out, vertices + centre, faces, document)
