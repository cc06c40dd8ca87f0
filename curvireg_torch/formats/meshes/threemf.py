"""3MF files: the objects of the build at their places, with the colours and textures of the core
and materials specifications.

trimesh 5.2 reads shapes and places, and no colours, supports or units; it needs lxml. Once it reads
those, and bounds what an archive unpacks to, this reader can go.
"""

import re
import xml.parsers.expat
import zipfile
from array import array
from collections import Counter
from dataclasses import dataclass, field, replace
from io import BytesIO
from xml.etree.ElementTree import Element

import numpy as np

from ...errors import MAX_MESH_BYTES, MAX_MESH_FACES, MAX_MESH_PARTS
from ...utils.arrays import Bytes, Floats
from ..xml_files import check_xml, read_xml
from .colours import SurfaceColours
from .limits import check_corners, check_faces, check_parts
from .source import MeshSource, ReadMesh, fixed_numbers

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

_SUPPORT_TEXT = "supports of the print are left out"
_MODIFIER_TEXT = "parts that change the print, such as modifiers and negative parts, are left out"
_NO_SOLIDS = {"solidsupport": _SUPPORT_TEXT, "support": _SUPPORT_TEXT, "other": _MODIFIER_TEXT}
"""Types of objects that are no material of the printed part, and what is said of them."""

_SETTINGS = ("metadata/model_settings.config", "metadata/slic3r_pe_model.config")
"""Of Bambu Studio and OrcaSlicer, which has parts of objects; of PrusaSlicer, ranges of faces."""

Attributes = dict[str, str]
Item = tuple[str, str, str]
"""Path of a model part, the object in it, and its transform."""

Property = tuple[str, int, int, int]
"""A group of colours or texture coordinates, "" for none, and the entries of three corners."""


@dataclass
class _Object:
    """One object of a model part: a mesh, or copies of other objects.

    Attributes:
        plain: the property of triangles that have none of their own.
        properties: of each triangle.
    """

    plain: Property = ("", 0, 0, 0)
    kind: str = "model"
    vertices: "array[float]" = field(default_factory=lambda: array("d"))
    triangles: "array[int]" = field(default_factory=lambda: array("q"))
    properties: list[Property] = field(default_factory=list)
    components: list[Item] = field(default_factory=list)

    def add_triangle(self, given: Attributes) -> None:
        """Add a triangle with its attributes."""
        self.triangles.extend((int(given["v1"]), int(given["v2"]), int(given["v3"])))
        own = self.plain
        if "p1" in given:
            a, b, c = (int(given.get(name, given["p1"])) for name in ("p1", "p2", "p3"))
            own = given.get("pid", own[0]), a, b, c
        self.properties.append(own)


@dataclass
class _Model:
    """What one model part of the package holds.

    Attributes:
        groups: colours, or texture coordinates, by the id of their group.
        texture_of: ids of the textures of the latter, whose files are the ``paths``.
    """

    unit: str = "millimeter"
    objects: dict[str, _Object] = field(default_factory=dict)
    items: list[Item] = field(default_factory=list)
    groups: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    texture_of: dict[str, str] = field(default_factory=dict)
    paths: dict[str, str] = field(default_factory=dict)
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
    package.leave_out_modifiers(model)
    parts = []
    for path, name, transform in package.items(root):
        parts += package.parts(path, name, _matrix(transform), 0)
    mesh = replace(ReadMesh.joined(parts), up="z")
    if model.unit == _MICRON:
        return replace(mesh, vertices=mesh.vertices * 1e-3, unit="mm")
    return replace(mesh, unit=_UNITS[model.unit])


class _Package:
    """The zip archive: its files, of which a few bytes may not unpack to more than a mesh file may
    hold."""

    def __init__(self, source: MeshSource) -> None:
        self._source = source
        self._archive = zipfile.ZipFile(BytesIO(source.data()))
        self._names = {name.lower(): name for name in self._archive.namelist()}
        self._bytes_left = MAX_MESH_BYTES
        self._faces = 0
        self._parts = 0
        self._models: dict[str, _Model] = {}
        self._meshes: dict[tuple[str, str], ReadMesh] = {}

    def root(self) -> str:
        """The path of the model that the package starts with: the one that it names, else by its
        name."""
        relations = "_rels/.rels"
        if relations in self._names:
            for one in read_xml(self._content(relations)):
                target = one.get("Target", "").lstrip("/").lower()
                if one.get("Type", "").endswith(f"/{_MODEL}") and target in self._names:
                    return f"/{target}"
        models = [name for name in self._names if name.endswith(".model")]
        if not models:
            raise ValueError("no model in it")
        order = [(_MODEL not in name, name.count("/"), len(name), name) for name in models]
        return f"/{min(order)[-1]}"

    def model(self, path: str) -> _Model:
        """One model part of the package."""
        if path not in self._models:
            model = _parsed(self._content(path))
            for kind in sorted(model.unread):
                self._source.warn("parts", f"it has parts that are not read ({kind}): left out")
            self._models[path] = model
        return self._models[path]

    def leave_out_modifiers(self, model: _Model) -> None:
        """Take out of the first model what the settings of slicers say is no material."""
        for name in filter(self._names.__contains__, _SETTINGS):
            try:
                settings = read_xml(self._content(name))
            except ValueError:
                self._source.warn("parts", f"{name} cannot be read: modifiers in it count as parts")
                continue
            for given in settings.iter("object"):
                one = model.objects.get(given.get("id", ""))
                if one is not None and _leave_out(one, given):
                    self._source.warn("parts", _MODIFIER_TEXT)

    def _is_no_solid(self, path: str, name: str) -> bool:
        known = self.model(path).objects.get(name)
        text = _NO_SOLIDS.get(known.kind) if known else None
        if text is not None:
            self._source.warn("parts", text)
        return text is not None

    def items(self, root: str) -> list[Item]:
        """What of the build is the object itself: no supports, nothing that is not printed, and of
        copies on the plate the first."""
        items: dict[tuple[str, str], Item] = {}
        copies = 0
        for given, name, transform in self.model(root).items:
            path = given or root
            if self._is_no_solid(path, name):
                continue
            if (path, name) in items:
                copies += 1
            else:
                items[path, name] = path, name, transform
        if copies:
            self._source.warn(
                "parts", f"further copies of its objects on the build plate are left out ({copies})"
            )
        if len(items) > 1:
            text = f"{len(items)} objects on its build plate are read as one rigid body, as they"
            self._source.warn("parts", f"{text} lie: if they are loose, export one of them")
        return list(items.values())

    def parts(self, path: str, name: str, place: Floats, depth: int) -> list[ReadMesh]:
        """The meshes of an object and of its components, at their places."""
        one = self.model(path).objects.get(name)
        if one is None:
            raise ValueError(f"it names object {name[:50]}, which it lacks")
        if depth > 50:
            raise ValueError("its components form a circle")
        self._parts += 1
        check_parts(self._parts)
        found = []
        if one.triangles:
            mesh = self._mesh(path, name, one)
            self._faces += len(mesh.faces)
            check_faces(self._faces)
            found.append(mesh.transformed(place))
        for other, child, transform in one.components:
            if not self._is_no_solid(other or path, child):
                found += self.parts(other or path, child, place @ _matrix(transform), depth + 1)
        return found

    def _mesh(self, path: str, name: str, one: _Object) -> ReadMesh:
        if (path, name) not in self._meshes:
            vertices = np.array(one.vertices, np.float64).reshape(-1, 3)
            faces = np.array(one.triangles, np.int64).reshape(-1, 3)
            mesh = ReadMesh(vertices, faces, self._colours(self.model(path), one))
            self._meshes[path, name] = mesh.without_unused_vertices()
        return self._meshes[path, name]

    def _colours(self, model: _Model, one: _Object) -> SurfaceColours | None:
        rows_of: dict[str, list[tuple[int, ...]]] = {}
        for row, (group, *entries) in enumerate(one.properties):
            if group:
                rows_of.setdefault(group, []).append((row, *entries))
        if not rows_of:
            return None
        painted = SurfaceColours.plain(len(one.properties))
        for group, table in rows_of.items():
            if group not in model.groups:
                self._source.warn(
                    "material",
                    "it has materials of a kind that is not read; they are shown in white",
                )
                continue
            indices = np.array(table)
            rows = indices[:, 0]
            known = np.array(model.groups[group])
            check_corners(indices[:, 1:], len(known), "a colour")
            values = known[indices[:, 1:]]
            if group not in model.texture_of:
                painted.corners[rows] = values
            elif (texture := self._texture(model, group)) is not None:
                painted = painted.with_texture(rows, texture, values)
        return painted

    def _texture(self, model: _Model, group: str) -> Bytes | None:
        path = model.paths.get(model.texture_of[group], "")

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


def _leave_out(one: _Object, settings: Element) -> bool:
    """Remove the parts of an object that are no material, by the settings of its slicer; whether
    there are any."""
    count = len(one.components) + len(one.properties)
    kinds = {part.get("id"): part.get("subtype", "normal_part") for part in settings.iter("part")}
    one.components = [
        item for item in one.components if kinds.get(item[1], "normal_part") == "normal_part"
    ]
    volumes = [
        (int(volume.get("firstid", "0")), int(volume.get("lastid", "-1")))
        for volume in settings.iter("volume")
        if not _is_solid(volume)
    ]
    for first, last in sorted(volumes, reverse=True):
        del one.triangles[3 * first : 3 * (last + 1)]
        del one.properties[first : last + 1]
    return len(one.components) + len(one.properties) < count


def _is_solid(volume: Element) -> bool:
    """Whether a range of faces of PrusaSlicer is material; earlier versions say ``modifier``."""
    values = {entry.get("key"): entry.get("value") for entry in volume.iter("metadata")}
    return values.get("volume_type", "ModelPart") == "ModelPart" and values.get("modifier") != "1"


def _matrix(text: str) -> Floats:
    """(4, 4) of the 12 numbers of a transform, which 3MF writes for row vectors."""
    T = np.eye(4)
    if text:
        T[:3] = fixed_numbers(text, 12).reshape(4, 3).T
    return T


def _parsed(data: bytes) -> _Model:
    """The model of an XML file, read in one pass."""
    check_xml(data)
    model = _Model()
    current = _Object()
    group: list[tuple[float, ...]] = []
    counts: Counter[str] = Counter()

    def start(tag: str, attributes: Attributes) -> None:
        nonlocal current, group
        kind = tag.rpartition(":")[2]
        most = _MOST.get(kind, MAX_MESH_PARTS)
        counts[kind] += 1
        if counts[kind] > most:
            raise ValueError(f"more than {most:,} of {kind[:50]!r}")
        given = {name.rpartition(":")[2]: value for name, value in attributes.items()}
        if kind == "vertex":
            current.vertices.extend((float(given["x"]), float(given["y"]), float(given["z"])))
        elif kind == "triangle":
            current.add_triangle(given)
        elif kind == "object":
            index = int(given.get("pindex", 0))
            plain = given.get("pid", ""), index, index, index
            current = model.objects[given["id"]] = _Object(plain, given.get("type", "model"))
        elif kind == "item" and given.get("printable", "1") in ("0", "false"):
            model.unread.add("items that are not printed")
        elif kind in ("component", "item"):
            copies = model.items if kind == "item" else current.components
            copies.append((given.get("path", ""), given["objectid"], given.get("transform", "")))
        elif kind == "model":
            model.unit = given.get("unit", "millimeter")
            if model.unit not in (*_UNITS, _MICRON):
                raise ValueError(f"its unit {model.unit[:50]!r} is unknown")
        elif kind in ("basematerials", "colorgroup", "texture2dgroup"):
            group = model.groups[given["id"]] = []
            if "texid" in given:
                model.texture_of[given["id"]] = given["texid"]
        elif kind in ("base", "color"):
            group.append(_colour(given.get("displaycolor", given.get("color", ""))))
        elif kind == "tex2coord":
            group.append((float(given["u"]), float(given["v"])))
        elif kind in _UNREAD:
            model.unread.add(kind)
        elif kind == "texture2d":
            model.paths[given["id"]] = given["path"]

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler = start
    try:
        parser.Parse(data, True)
    except xml.parsers.expat.ExpatError as error:
        raise ValueError(f"damaged XML ({error})") from error
    return model


def _colour(text: str) -> tuple[int, ...]:
    """#RRGGBB or #RRGGBBAA; white for anything else."""
    found = re.match(r"#?([0-9a-fA-F]{6})", text)
    return (255, 255, 255) if found is None else tuple(bytes.fromhex(found[1]))
