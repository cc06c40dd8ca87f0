"""STEP and IGES files by cascadio, which is OpenCASCADE, and Collada files by pycollada: the extra
``cad``."""

import subprocess
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ET
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from ..errors import (
    MAX_CAD_BYTES,
    MAX_CAD_SECONDS,
    MAX_MESH_BYTES,
    MAX_MESH_PARTS,
)
from ..formats.xml_files import check_xml, local_name
from ..utils.choices import UNITS
from ..utils.extras import check_extras
from ..utils.pictures import picture_format
from .gltf import read_gltf
from .scenes import joined_scene
from .source import MeshSource, ReadMesh, spellings

# Chords of curves may be off by so much of a curve's length, and turn by so many radians: of a
# cylinder 0.1 % of the radius. Tenfold finer ones change no contour of 256 px.
LINEAR_TOLERANCE = 0.002
ANGULAR_TOLERANCE = 0.1
# In a process of its own: OpenCASCADE prints, and damaged files may end or stop it
_CONVERT = f"""
import sys
from pathlib import Path
import cascadio
kind = cascadio.FileType.IGES if sys.argv[3] == "iges" else cascadio.FileType.STEP
options = dict(tol_linear={LINEAR_TOLERANCE}, tol_angular={ANGULAR_TOLERANCE}, tol_relative=True, use_parallel=False)
content = cascadio.to_glb_bytes(Path(sys.argv[1]).read_bytes(), kind, **options)
Path(sys.argv[2]).write_bytes(content)
"""  # noqa: E501
IGES_METRES = 1e-3  # OpenCASCADE leaves the triangles of IGES files in mm
_PREFIXES = {b".MILLI.": "mm", b".CENTI.": "cm", b".DECI.": "dm", b"$": "m"}
_CONVERSIONS = {b"'INCH'": "in", b"'IN'": "in", b"'FOOT'": "ft", b"'FT'": "ft"}
_IGES_FLAGS = {b"1": "in", b"2": "mm", b"4": "ft", b"6": "m", b"10": "cm"}


def bounded(source: MeshSource) -> bytes:
    """The content of a file whose reader takes much more memory than the file."""
    if source.path.stat().st_size > MAX_CAD_BYTES:
        raise ValueError(
            f"larger than {MAX_CAD_BYTES:,} bytes; export parts of it, or another format"
        )
    return source.data()


def read_step(source: MeshSource) -> ReadMesh:
    """Read a STEP or IGES file: in its own unit where that is one of ``UNITS``, else in metres; z
    is up."""
    suffix = source.path.suffix.lower()
    check_extras([source.path])
    data = bounded(source)
    is_iges = suffix in (".igs", ".iges")
    if not is_iges and not data.lstrip().startswith(b"ISO-10303-21"):
        raise ValueError("not a STEP file")
    unit = (iges_unit(data) if is_iges else step_unit(data)) or "m"
    mesh = read_gltf(source, _converted(source.path.resolve(), "iges" if is_iges else "step"))
    metres = IGES_METRES if is_iges else 1.0
    vertices = mesh.vertices * (metres / UNITS[unit])
    return ReadMesh(vertices, mesh.faces, mesh.colours, unit, "z")


def _converted(path: Path, kind: str) -> bytes:
    """The GLB of a STEP file, in metres, or of an IGES file, in millimetres."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "part.glb")
        command = [sys.executable, "-P", "-c", _CONVERT, str(path), str(out), kind]
        try:
            ended = subprocess.run(
                command, capture_output=True, timeout=MAX_CAD_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            message = (
                f"OpenCASCADE took more than {MAX_CAD_SECONDS} seconds; export it as STL or OBJ"
            )
            raise ValueError(message) from None
        size = out.stat().st_size if out.is_file() else 0
        if size > MAX_MESH_BYTES:
            raise ValueError(
                f"its triangles take more than {MAX_MESH_BYTES:,} bytes; export it as STL or OBJ"
            )
        if ended.returncode != 0 or size == 0:
            raise ValueError(
                "OpenCASCADE finds no shape in it; the file is damaged, or of another kind"
            )
        return out.read_bytes()


def step_unit(data: bytes) -> str | None:
    """The unit of length of a STEP file, None if it is none of ``UNITS``."""
    units: dict[bytes, str | None] = {}
    contexts: list[list[bytes]] = []
    for entity in data.split(b";"):
        name, equals, content = entity.partition(b"=")
        if not equals:
            continue
        if b"LENGTH_UNIT" in content:
            units[name.strip()] = _length_unit(content.replace(b" ", b"").upper())
        _, found, arguments = content.partition(b"GLOBAL_UNIT_ASSIGNED_CONTEXT")
        if found:
            contexts.append(
                arguments.partition(b"))")[0].replace(b"(", b" ").replace(b",", b" ").split()
            )
    used = [units[name] for names in contexts for name in names if name in units]
    return used[0] if used else None


def _length_unit(content: bytes) -> str | None:
    _, found, arguments = content.partition(b"SI_UNIT(")
    if found:
        prefix, _, name = arguments.partition(b")")[0].partition(b",")
        return _PREFIXES.get(prefix) if name == b".METRE." else None
    _, found, arguments = content.partition(b"CONVERSION_BASED_UNIT(")
    return _CONVERSIONS.get(arguments.partition(b",")[0]) if found else None


def iges_unit(data: bytes) -> str | None:
    """The unit of length of an IGES file, its 14th global parameter; None if it is none of
    ``UNITS``."""
    lines = [line for line in data.splitlines() if line[72:73] == b"G"]
    text = b"".join(line[:72].ljust(72) for line in lines[:100])
    separator = b"," if not text.startswith(b"1H") else text[2:3]
    values: list[bytes] = []
    while text and len(values) < 14:
        digits, letter, _ = text.lstrip().partition(b"H")
        if letter and digits.isdigit() and len(digits) < 5:  # a text, preceded by its length
            text = text.lstrip()
            end = len(digits) + 1 + int(digits)
            value = text[len(digits) + 1 : end]
            rest = text[end:]
        else:
            value, _, rest = text.partition(separator)
            rest = separator + rest
        values.append(value.strip())
        text = rest.lstrip()[1:]
    return _IGES_FLAGS.get(values[13]) if len(values) == 14 else None


class _Pictures(trimesh.resolvers.Resolver):  # type: ignore[misc]
    """The pictures that a Collada file names, in the formats of photographs."""

    def __init__(self, source: MeshSource) -> None:
        self._source = source

    def get(self, name: str) -> bytes:
        content = self._source.read_optional("texture", *spellings(name.encode()))
        if content is None:
            raise ValueError("no such picture")
        try:
            picture_format(content)
        except Exception as error:
            self._source.warn("texture", f"the texture {name[:100]} cannot be used ({error})")
            raise
        return content

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: Any) -> None:
        raise ValueError("nothing is written")

    def namespaced(self, namespace: str) -> "_Pictures":
        return self


def read_collada(source: MeshSource) -> ReadMesh:
    """Read a Collada file in its own unit and axes."""
    check_extras([source.path])
    data = bounded(source)
    check_xml(data)
    root = ET.fromstring(data)
    _check_copies(root)
    stated = {local_name(one): one for one in root.iter() if local_name(one) in ("unit", "up_axis")}
    metres = float(stated["unit"].get("meter", "1")) if "unit" in stated else None
    axis = (stated["up_axis"].text or "").strip() if "up_axis" in stated else "Y_UP"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = trimesh.load(
            BytesIO(data), file_type="dae", resolver=_Pictures(source), process=False
        )
        mesh, colours = joined_scene(scene)
    for warning in caught:
        if "texture" in str(warning.message) or "colours" in str(warning.message):
            source.warn("texture", str(warning.message))
    if mesh is None:
        return ReadMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    vertices = np.asarray(mesh.vertices, np.float64)
    unit = None
    if metres is not None:
        unit = next(
            (name for name, length in UNITS.items() if abs(metres / length - 1.0) < 1e-6), None
        )
        if unit is None:
            vertices = vertices * metres
            unit = "m"
    up = {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(axis)
    return ReadMesh(vertices, np.asarray(mesh.faces, np.int64), colours, unit, up)


def _check_copies(root: Any) -> None:
    """Nodes that stand for others, which stand for others: the parts that they unfold to are
    counted first."""
    named = {
        f"#{one.get('id')}": one
        for one in root.iter()
        if local_name(one) == "node" and one.get("id")
    }
    known: dict[Any, int] = {}

    def count(node: Any, depth: int) -> int:
        if node in known:
            return known[node]
        if depth > 200:
            raise ValueError("its nodes form a circle, or are too deep")
        total = 0
        for child in node:
            kind = local_name(child)
            if kind in ("node", "visual_scene", "library_visual_scenes", "library_nodes"):
                total += count(child, depth + 1)
            elif kind == "instance_node" and child.get("url") in named:
                total += count(named[child.get("url")], depth + 1)
            elif kind in ("instance_geometry", "instance_controller"):
                total += 1
        known[node] = total
        if total > MAX_MESH_PARTS:
            raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
        return total

    count(root, 0)
    for node in named.values():
        count(node, 0)
