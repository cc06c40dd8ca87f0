"""STEP and IGES files by cascadio, which is OpenCASCADE, and Collada files by pycollada: the extra
``cad``."""

import re
import tempfile
import warnings
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from ...errors import (
    MAX_CAD_BYTES,
    MAX_MESH_BYTES,
    MAX_TEXTURE_PIXELS,
)
from ...utils.choices import UNITS
from ...utils.extras import check_extras
from ...utils.programs import run_program
from ..xml_files import local_name, read_xml
from .gltf import read_gltf
from .limits import check_faces, check_parts
from .scenes import joined_scene
from .source import MeshSource, ReadMesh, spellings

# Chords of curves may be off by so much of a curve's length, and turn by so many radians: of a
# cylinder 0.1 % of the radius. Tenfold finer ones change no contour of 256 px.
LINEAR_TOLERANCE = 0.002
ANGULAR_TOLERANCE = 0.1
_PROGRAM = Path(__file__).with_name("step_parts.py")
IGES_METRES = 1e-3  # OpenCASCADE leaves the triangles of IGES files in mm
_PREFIXES = {b".MILLI.": "mm", b".CENTI.": "cm", b".DECI.": "dm", b"$": "m"}
_CONVERSIONS = {b"'INCH'": "in", b"'IN'": "in", b"'FOOT'": "ft", b"'FT'": "ft"}
_IGES_TEXT = re.compile(rb"\s*(\d{1,4})H")  # the length of a text, which may hold separators
_IGES_FLAGS = {b"1": "in", b"2": "mm", b"4": "ft", b"6": "m", b"10": "cm"}
_WORD = re.compile(r"\S+")


def bounded(source: MeshSource) -> bytes:
    """The content of a file whose reader is optional, and takes much more memory than the file."""
    check_extras([source.path])
    if source.path.stat().st_size > MAX_CAD_BYTES:
        raise ValueError(
            f"larger than {MAX_CAD_BYTES:,} bytes; export parts of it, or another format"
        )
    return source.data()


def read_step(source: MeshSource) -> ReadMesh:
    """Read a STEP or IGES file: in its own unit where that is one of ``UNITS``, else in metres; z
    is up."""
    data = bounded(source)
    is_iges = source.path.suffix.lower() in (".igs", ".iges")
    if not is_iges and not data.lstrip().startswith(b"ISO-10303-21"):
        raise ValueError("not a STEP file")
    unit = (iges_unit(data) if is_iges else step_unit(data)) or "m"
    mesh = read_gltf(source, _converted(source.path.resolve(), "iges" if is_iges else "step"))
    metres = IGES_METRES if is_iges else 1.0
    return replace(mesh, vertices=mesh.vertices * (metres / UNITS[unit]), unit=unit, up="z")


def _converted(path: Path, kind: str) -> bytes:
    """The GLB of a STEP file, in metres, or of an IGES file, in millimetres."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "part.glb")
        has_ended_well = run_program(
            _PROGRAM,
            [str(path), str(out), kind, str(LINEAR_TOLERANCE), str(ANGULAR_TOLERANCE)],
            name="OpenCASCADE",
            advice="export it as STL or OBJ",
        )
        size = out.stat().st_size if out.is_file() else 0
        if size > MAX_MESH_BYTES:
            raise ValueError(
                f"its triangles take more than {MAX_MESH_BYTES:,} bytes; export it as STL or OBJ"
            )
        if not has_ended_well or size == 0:
            raise ValueError(
                "OpenCASCADE finds no shape in it; the file is damaged, or of another kind"
            )
        return out.read_bytes()


def step_unit(data: bytes) -> str | None:
    """The unit of length of a STEP file, None if it is none of ``UNITS``."""
    units: dict[bytes, str | None] = {}
    used: list[bytes] = []
    for entity in data.split(b";"):
        name, _, content = entity.partition(b"=")
        if b"LENGTH_UNIT" in content:
            units[name.strip()] = _length_unit(content.replace(b" ", b"").upper())
        _, _, arguments = content.partition(b"GLOBAL_UNIT_ASSIGNED_CONTEXT")
        used += re.findall(rb"#\d+", arguments.partition(b"))")[0])
    return next((units[name] for name in used if name in units), None)


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
    separator = text[2:3] if text.startswith(b"1H") else b","
    value = b""
    for _ in range(14):
        if counted := _IGES_TEXT.match(text):
            value = b""
            text = text[counted.end() + int(counted[1]) :].lstrip()[1:]
        else:
            value, _, text = text.partition(separator)
    return _IGES_FLAGS.get(value.strip())


class _Pictures:
    """The pictures that a Collada file names, each decoded once and reduced as textures are.
    trimesh asks for one again for each material, and keeps each answer as a picture of its own."""

    def __init__(self, source: MeshSource) -> None:
        self._source = source
        self._answers: dict[str, bytes] = {}
        self._pixels_left = MAX_TEXTURE_PIXELS

    def get(self, name: str) -> bytes:
        """The content of a file of the picture; trimesh goes on after any error."""
        pixels = self._source.texture_file(*spellings(name.encode(errors="surrogateescape")))
        if pixels is None:
            raise ValueError("no such picture")
        self._pixels_left -= pixels.shape[0] * pixels.shape[1]
        if self._pixels_left < 0:
            self._source.warn("texture", "too many materials with textures; some are left out")
            raise ValueError("too many pictures")
        if name not in self._answers:
            file = BytesIO()
            Image.fromarray(pixels).save(file, "PNG", compress_level=1)
            self._answers[name] = file.getvalue()
        return self._answers[name]


def read_collada(source: MeshSource) -> ReadMesh:
    """Read a Collada file in its own unit and axes."""
    data = bounded(source)
    root = read_xml(data)
    _check_copies(root)
    _name_unread(source, root)
    stated = {local_name(one): one for one in root.iter() if local_name(one) in ("unit", "up_axis")}
    axis = (stated["up_axis"].text or "").strip() if "up_axis" in stated else "Y_UP"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = trimesh.load(
            BytesIO(data), file_type="dae", resolver=_Pictures(source), process=False
        )
        found = joined_scene(scene)
    if any(map(_has_filled_gaps, scene.geometry.values())):
        text = "it has polygons that are not convex, whose gaps are filled; export triangles"
        source.warn("parts", text)
    for warning in caught:
        if "texture" in str(warning.message) or "colours" in str(warning.message):
            source.warn("texture", str(warning.message))
    if "unit" in stated:
        found = found.in_unit_of(float(stated["unit"].get("meter", "1")))
    return replace(found, up={"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(axis))


def _name_unread(source: MeshSource, root: Any) -> None:
    """Warn of faces with holes and of transforms that pycollada misreads; those of cameras move no
    mesh."""
    for one in root.iter():
        children = {local_name(child) for child in one}
        names = {"ph"} if local_name(one) == "polygons" else {"skew", "lookat"}
        for name in sorted(children & names if "instance_camera" not in children else ()):
            text = f"its elements <{name}> are misread; export triangles, with transforms applied"
            source.warn("parts", text)


def _has_filled_gaps(mesh: Any) -> bool:
    """Whether the fan that pycollada makes of a polygon folds back, as of one that is not convex;
    the two sides of a face have the same corners, and are no fold."""
    corners = np.asarray(mesh.triangles)
    if not len(corners):
        return False
    first = corners[:-1]
    second = corners[1:]
    is_fan = (first[:, [0, 2]] == second[:, [0, 1]]).all(axis=(1, 2))
    is_fan &= (first[:, 1] != second[:, 2]).any(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    # the largest triangle of its fan shows which way each looks: those beside it may have no area
    fan = np.concatenate([[0], np.cumsum(~is_fan)])
    order = np.argsort(sizes)
    largest = np.zeros(fan[-1] + 1, np.int64)
    largest[fan[order]] = order
    other = largest[fan]
    products = (normals * normals[other]).sum(axis=1)
    return bool((products < -0.99 * sizes * sizes[other]).any())


_GROUPS = ("node", "visual_scene", "library_visual_scenes", "library_nodes")
"""Elements of Collada whose children are nodes, or stand for some."""


def _check_copies(root: Any) -> None:
    """Nodes that stand for others, which stand for others: the parts and faces that they unfold to
    are counted first."""
    named = {f"#{one.get('id')}": one for one in root.iter() if one.get("id")}
    known: dict[Any, tuple[int, int]] = {}

    @cache
    def faces(url: str) -> int:
        own = named.get(url, ())
        skins = [str(one.get("source")) for one in own if local_name(one) in ("skin", "morph")]
        return sum(map(_most_faces, [own, *(named.get(skin, ()) for skin in skins)]))

    def count(node: Any, depth: int) -> tuple[int, int]:
        """The parts and faces below a node."""
        if node in known:
            return known[node]
        if depth > 200:
            raise ValueError("its nodes form a circle, or are too deep")
        parts = total = 0
        for child in node:
            kind = local_name(child)
            url = str(child.get("url"))
            more = 0, 0
            if kind == "instance_node" and local_name(named.get(url, child)) == "node":
                more = count(named[url], depth + 1)
            elif kind in _GROUPS:
                more = count(child, depth + 1)
            elif kind in ("instance_geometry", "instance_controller"):
                more = 1, faces(url)
            parts += more[0]
            total += more[1]
        known[node] = parts, total
        check_parts(parts)
        check_faces(total)
        return known[node]

    count(root, 0)


def _most_faces(geometry: Any) -> int:
    """How many triangles the lists of indices of a geometry can hold."""
    total = 0
    for element in (below for child in geometry for below in child.iter()):
        offsets = [
            int(child.get("offset", "0")) for child in element if local_name(child) == "input"
        ]
        lists = [child.text or "" for child in element if local_name(child) == "p"]
        words = sum(1 for text in lists for _ in _WORD.finditer(text))
        corners = words // (max(offsets, default=0) + 1)
        total += corners // 3 if local_name(element) == "triangles" else corners
    return total
