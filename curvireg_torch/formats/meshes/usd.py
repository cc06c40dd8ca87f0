"""USD and USDZ files by OpenUSD: the extra ``usd``."""

import json
import os
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import (
    MAX_IMAGE_BYTES,
    MAX_MESH_BYTES,
    MAX_MESH_FACES,
    MAX_MESH_PARTS,
)
from ...utils.aliases import Fields
from ...utils.arrays import Array, Bytes, Integers
from ...utils.programs import run_program
from ...utils.srgb import srgb
from .cad import bounded
from .colours import SurfaceColours, byte_colours
from .polygons import triangulated
from .source import MeshSource, ReadMesh

_PROGRAM = Path(__file__).with_name("usd_parts.py")
FALLBACK_UNIT = "cm"  # OpenUSD's, of a stage that states no metersPerUnit
Arrays = Mapping[str, Array]


def read_usd(source: MeshSource) -> ReadMesh:
    """Read a USD or USDZ file at its first frame, in its own unit and axes; surfaces that are
    subdivided are taken as they are stored."""
    bounded(source)
    about, arrays = _parts_of(source.path.resolve())
    for name in about["layers"]:
        source.find(name)
    if about["left_out"]:
        kinds = ", ".join(about["left_out"])
        source.warn("parts", f"parts that are no meshes are left out ({kinds}); export meshes")
    parts = [_part(source, f"{k}.", part, arrays) for k, part in enumerate(about["parts"])]
    mesh = replace(ReadMesh.joined(parts), up=about["up"], usual_unit=FALLBACK_UNIT)
    return mesh if about["metres"] is None else mesh.in_unit_of(about["metres"])


def _parts_of(path: Path) -> tuple[Fields, Arrays]:
    """What OpenUSD finds in a file, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "parts.npz")
        bounds = [str(MAX_MESH_PARTS), str(MAX_MESH_FACES)]
        run_program(
            _PROGRAM,
            [str(path), str(out), *bounds],
            name="OpenUSD",
            advice="export it as OBJ or GLB",
        )
        if not out.is_file():
            raise ValueError("OpenUSD cannot read it; it is damaged, or too large")
        if out.stat().st_size > 4 * MAX_MESH_BYTES:
            raise ValueError(f"its parts take more than {4 * MAX_MESH_BYTES:,} bytes")
        with np.load(out, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    about = json.loads(str(arrays["about"]))
    if "error" in about:
        raise ValueError(about["error"])
    return about, arrays


def _part(source: MeshSource, key: str, part: Fields, arrays: Arrays) -> ReadMesh:
    """One mesh at its place, with its colours."""
    indices = arrays[key + "indices"]
    corner, owner = triangulated(arrays[key + "points"], indices, arrays[key + "counts"])
    material = arrays[key + "material"][owner]
    kept = material >= 0  # the others are holes
    corner = corner[kept]
    colours = _colours(source, key, part, arrays, corner, material[kept])
    mesh = ReadMesh(arrays[key + "points"], indices[corner], colours)
    mesh = mesh.turned_over() if part["left_handed"] else mesh
    return mesh.transformed(np.array(part["place"]))


def _colours(
    source: MeshSource,
    key: str,
    part: Fields,
    arrays: Arrays,
    corner: Integers,
    material: Integers,
) -> SurfaceColours | None:
    """Colours of faces by their material, where they have one, else those of the mesh."""
    own = arrays.get(key + "colour")
    if own is None and not part["materials"]:
        return None
    painted = SurfaceColours.plain(len(corner))
    if own is not None:
        painted.corners[:] = byte_colours(srgb(own[corner]))
    for number, surface in enumerate(part["materials"]):
        faces = material == number + 1
        if "colour" in surface:
            painted.corners[faces] = byte_colours(srgb(np.array(surface["colour"])))
        if surface.get("unread"):
            source.warn("texture", "a texture is made in a way that is not read; it is left out")
        texture = _texture(source, surface) if "texture" in surface else None
        if texture is not None:
            painted.corners[faces] = _tint(source, surface)
            uv = arrays[f"{key}uv{number}"][corner[faces]]
            painted = painted.with_texture(faces, texture, uv)
    return painted


def _tint(source: MeshSource, surface: Fields) -> Bytes:
    """(3,) what the colours of a texture are multiplied by."""
    scale = np.array(surface.get("scale", (1.0, 1.0, 1.0)))
    if scale.max() > 1.0 or any(surface.get("bias", ())):
        source.warn("texture", "a texture is made brighter by scale or bias: read without")
    return byte_colours(srgb(scale))


def _texture(source: MeshSource, surface: Fields) -> Bytes | None:
    """The pixels of a texture: a file beside the mesh, or in a package."""
    name = str(surface["texture"])
    inner = str(surface["inner"])
    beside = os.path.relpath(Path(surface["file"]).resolve(), source.folder)
    if not inner:
        names = [beside, name] if os.path.isabs(name) else [beside]
        return source.texture_file(*names)
    package = source.find(beside)

    def read_content() -> bytes | None:
        if package is not None and package.is_file():
            with zipfile.ZipFile(package) as archive:
                sizes = {one.filename: one.file_size for one in archive.infolist()}
                if sizes.get(inner, MAX_IMAGE_BYTES + 1) <= MAX_IMAGE_BYTES:
                    return archive.read(inner)
        source.warn("texture", f"{name[:100]} is missing in it; its faces have no colours")
        return None

    return source.texture((package, inner), read_content, name)
