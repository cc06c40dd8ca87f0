"""3MF files: the objects of the build at their places, with the colours and textures of the core
and materials specifications.

trimesh 5.2 reads shapes and places, and no colours, supports or units; it needs lxml. Once it reads
those, and bounds what an archive unpacks to, this reader can go.
"""

import xml.parsers.expat
import zipfile
from array import array
from collections import Counter
from dataclasses import dataclass, field
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

from ...errors import MAX_MESH_BYTES, MAX_MESH_FACES, MAX_MESH_PARTS
from ..xml_files import check_xml
from .colours import SurfaceColours
from .source import MeshSource, Pixels, ReadMesh

_UNITS = {"millimeter": "mm", "centimeter": "cm", "inch": "in", "foot": "ft", "meter": "m"}
_MICRON = "micron"
_MODEL = "3dmodel"
_UNREAD = ("beamlattice", "booleanshape", "displacementmesh", "levelset", "slicestack")
"""Shapes of the extensions of 3MF."""

_MOST = {
    "vertex": 3 * MAX_MESH_FACES,
    "triangle": MAX_MESH_FACES,
    "tex2coord": 3 * MAX_MESH_FACES,
    "color": MAX_MESH_FACES,
    "base": MAX_MESH_FACES,
}
"""Entries of one model part of the package; of objects, items and groups so many as parts."""

_SUPPORTS = ("solidsupport", "support")  # Types of objects

Attributes = dict[str, str]
Item = tuple[str, str, str]
"""Path of a model part, the object in it, and its transform."""


@dataclass
class _Object:
    """One object of a model part: a mesh, or copies of other objects."""

    group: str = ""
    index: int = 0
    kind: str = "model"
    vertices: "array[float]" = field(default_factory=lambda: array("d"))
    triangles: "array[int]" = field(default_factory=lambda: array("q"))
    properties: list[tuple[str, int, int, int] | None] = field(default_factory=list)
    components: list[tuple[str, str, str]] = field(default_factory=list)


@dataclass
class _Model:
    """What one model part of the package holds."""

    unit: str = "millimeter"
    objects: dict[str, _Object] = field(default_factory=dict)
    items: list[Item] = field(default_factory=list)
    colours: dict[str, list[tuple[int, int, int]]] = field(default_factory=dict)
    coordinates: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    texture_of: dict[str, str] = field(default_factory=dict)
    paths: dict[str, str] = field(default_factory=dict)
    lost: set[str] = field(default_factory=set)
    unread: set[str] = field(default_factory=set)


def read_threemf(source: MeshSource) -> ReadMesh:
    """Read a 3MF file in its own unit (microns as millimetres); z is up."""
    try:
        package = _Package(source)
    except zipfile.BadZipFile as error:
        raise ValueError(
            "no zip archive, as a 3MF file is; it ends too early, or is of another kind"
        ) from error
    root = package.root()
    model = package.model(root)
    parts = []
    for path, name, transform in package.items(root):
        parts += package.parts(path, name, _matrix(transform), 0)
    mesh = ReadMesh.joined(parts)
    if model.unit == _MICRON:
        return ReadMesh(mesh.vertices * 1e-3, mesh.faces, mesh.colours, "mm", "z")
    return ReadMesh(mesh.vertices, mesh.faces, mesh.colours, _UNITS[model.unit], "z")


class _Package:
    """The zip archive: its files, of which a few bytes may not unpack to more than a mesh file may
    hold."""

    def __init__(self, source: MeshSource) -> None:
        self._source = source
        self._archive = zipfile.ZipFile(BytesIO(source.data()))
        self._names = {name.lower(): name for name in self._archive.namelist()}
        self._bytes_left = MAX_MESH_BYTES
        self._faces_left = MAX_MESH_FACES
        self._parts_left = MAX_MESH_PARTS
        self._models: dict[str, _Model] = {}
        self._meshes: dict[tuple[str, str], ReadMesh] = {}

    def root(self) -> str:
        """The path of the model that the package starts with."""
        models = [name for name in self._names if name.endswith(".model")]
        first = [name for name in models if _MODEL in name]
        if not models:
            raise ValueError("no model in it")
        return "/" + min(first or models, key=lambda name: (name.count("/"), len(name), name))

    def model(self, path: str) -> _Model:
        """One model part of the package."""
        if path not in self._models:
            model = _parsed(self._content(path))
            for kind in sorted(model.unread):
                self._source.warn("parts", f"it has parts that are not read ({kind}): left out")
            self._models[path] = model
        return self._models[path]

    def items(self, root: str) -> list[Item]:
        """What of the build is the object itself: no supports, nothing that is not printed, and of
        copies on the plate the first."""
        items: dict[tuple[str, str], Item] = {}
        copies = 0
        for path, name, transform in self.model(root).items:
            known = self.model(path or root).objects.get(name)
            if known is not None and known.kind in _SUPPORTS:
                self._source.warn("parts", "supports of the print are left out")
            elif (path or root, name) in items:
                copies += 1
            else:
                items[path or root, name] = (path or root, name, transform)
        if copies:
            self._source.warn(
                "parts", f"further copies of its objects on the build plate are left out ({copies})"
            )
        if len(items) > 1:
            text = f"{len(items)} objects on its build plate are read as one rigid body, as they"
            self._source.warn("parts", f"{text} lie: if they are loose, export one of them")
        return list(items.values())

    def parts(self, path: str, name: str, place: NDArray[np.float64], depth: int) -> list[ReadMesh]:
        """The meshes of an object and of its components, at their places."""
        model = self.model(path)
        if name not in model.objects:
            raise ValueError(f"it names object {name[:50]}, which it lacks")
        if depth > 50:
            raise ValueError("its components form a circle")
        self._parts_left -= 1
        if self._parts_left < 0:
            raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
        found = []
        one = model.objects[name]
        if one.triangles:
            mesh = self._mesh(path, name)
            self._faces_left -= len(mesh.faces)
            if self._faces_left < 0:
                raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")
            found.append(mesh.transformed(place))
        for other, child, transform in one.components:
            found += self.parts(other or path, child, place @ _matrix(transform), depth + 1)
        return found

    def _mesh(self, path: str, name: str) -> ReadMesh:
        key = (path, name)
        if key not in self._meshes:
            model = self.model(path)
            one = model.objects[name]
            vertices = np.array(one.vertices, np.float64).reshape(-1, 3)
            faces = np.array(one.triangles, np.int64).reshape(-1, 3)
            if faces.min(initial=0) < 0 or faces.max(initial=0) >= len(vertices):
                raise IndexError
            mesh = ReadMesh(vertices, faces, self._colours(model, one))
            self._meshes[key] = mesh.without_unused_vertices()
        return self._meshes[key]

    def _colours(self, model: _Model, one: _Object) -> SurfaceColours | None:
        default = (one.group, one.index, one.index, one.index) if one.group else None
        rows = [found or default for found in one.properties]
        if not any(rows):
            return None
        plain = SurfaceColours.plain(len(rows))
        corners = plain.corners.copy()
        uv = plain.uv.copy()
        texture = plain.texture.copy()
        pixels: list[Pixels] = []
        number: dict[str, int] = {}
        for row, found in enumerate(rows):
            if found is None:
                continue
            group, *indices = found
            if group in model.colours:
                corners[row] = [model.colours[group][index] for index in indices]
            elif group in model.coordinates:
                if group not in number:
                    picture = self._texture(model, group)
                    number[group] = -1 if picture is None else len(pixels)
                    pixels += [] if picture is None else [picture]
                uv[row] = [model.coordinates[group][index] for index in indices]
                texture[row] = number[group]
            elif group not in model.lost:
                model.lost.add(group)
                self._source.warn(
                    "material",
                    "it has materials of a kind that is not read; they are shown in white",
                )
        return SurfaceColours(corners, np.nan_to_num(uv), texture, tuple(pixels))

    def _texture(self, model: _Model, group: str) -> Pixels | None:
        path = model.paths.get(model.texture_of.get(group, ""), "")

        def read_content() -> bytes | None:
            try:
                return self._content(path)
            except KeyError:
                text = f"the texture {path[:100]} is missing in it; its faces are shown in white"
                self._source.warn("texture", text)
                return None

        return self._source.texture(path.lower(), read_content, path)

    def _content(self, path: str) -> bytes:
        name = self._names[path.lstrip("/").lower()]
        with self._archive.open(name) as file:
            content = file.read(self._bytes_left + 1)
        self._bytes_left -= len(content)
        if self._bytes_left < 0:
            raise ValueError(f"it unpacks to more than {MAX_MESH_BYTES:,} bytes")
        return content


def _matrix(text: str) -> NDArray[np.float64]:
    """(4, 4) of the 12 numbers of a transform, which 3MF writes for row vectors."""
    if not text:
        return np.eye(4)
    values = np.array([float(word) for word in text.split()])
    if values.shape != (12,) or not np.isfinite(values).all():
        raise ValueError("a transform does not have 12 numbers")
    T = np.eye(4)
    T[:3] = values.reshape(4, 3).T
    return T


def _parsed(data: bytes) -> _Model:
    """The model of an XML file, read in one pass."""
    check_xml(data)
    model = _Model()
    current = _Object()
    group = ""
    counts: Counter[str] = Counter()

    def start(tag: str, attributes: Attributes) -> None:
        nonlocal current, group
        kind = tag.rpartition(":")[2]
        counts[kind] += 1
        if counts[kind] > _MOST.get(kind, MAX_MESH_PARTS):
            raise ValueError(f"more than {_MOST.get(kind, MAX_MESH_PARTS):,} of {kind[:50]!r}")
        plain = {name.rpartition(":")[2]: value for name, value in attributes.items()}
        if kind == "vertex":
            current.vertices.extend((float(plain["x"]), float(plain["y"]), float(plain["z"])))
        elif kind == "triangle":
            current.triangles.extend((int(plain["v1"]), int(plain["v2"]), int(plain["v3"])))
            current.properties.append(_property(plain, current))
        elif kind == "object":
            current = model.objects[plain["id"]] = _Object(
                plain.get("pid", ""), int(plain.get("pindex", 0)), plain.get("type", "model")
            )
        elif kind == "component":
            current.components.append(
                (plain.get("path", ""), plain["objectid"], plain.get("transform", ""))
            )
        elif kind == "item":
            item = plain.get("path", ""), plain["objectid"], plain.get("transform", "")
            if plain.get("printable", "1") in ("0", "false"):
                model.unread.add("items that are not printed")
            else:
                model.items.append(item)
        elif kind == "model":
            model.unit = plain.get("unit", "millimeter")
            if model.unit not in (*_UNITS, _MICRON):
                raise ValueError(f"its unit {model.unit[:50]!r} is unknown")
        elif kind in ("basematerials", "colorgroup"):
            group = plain["id"]
            model.colours[group] = []
        elif kind in ("base", "color"):
            model.colours[group].append(_colour(plain.get("displaycolor", plain.get("color", ""))))
        elif kind == "texture2dgroup":
            group = plain["id"]
            model.coordinates[group] = []
            model.texture_of[group] = plain["texid"]
        elif kind == "tex2coord":
            model.coordinates[group].append((float(plain["u"]), float(plain["v"])))
        elif kind in _UNREAD:
            model.unread.add(kind)
        elif kind == "texture2d":
            model.paths[plain["id"]] = plain["path"]

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        parser.Parse(data, True)
    except xml.parsers.expat.ExpatError as error:
        raise ValueError(f"damaged XML ({error})") from error
    return model


def _property(attributes: Attributes, current: _Object) -> tuple[str, int, int, int] | None:
    """The group of properties of a triangle, and the entries of its corners."""
    if "p1" not in attributes:
        return None
    first = int(attributes["p1"])
    second = int(attributes.get("p2", first))
    third = int(attributes.get("p3", first))
    if min(first, second, third) < 0:
        raise IndexError
    return attributes.get("pid", current.group), first, second, third


def _colour(text: str) -> tuple[int, int, int]:
    """#RRGGBB or #RRGGBBAA; white for anything else."""
    try:
        value = bytes.fromhex(text.removeprefix("#")[:6])
    except ValueError:
        value = b""
    return (value[0], value[1], value[2]) if len(value) == 3 else (255, 255, 255)
