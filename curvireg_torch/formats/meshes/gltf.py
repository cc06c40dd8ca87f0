"""glTF and GLB files: triangles, strips and fans at their places, with vertex colours, materials
and textures.

trimesh 5.2 reads scenes of triangles as well; it drops fans, ignores sparse accessors and skins,
and copies a texture for each part. Once it reads fan.gltf, sparse.gltf and skin.gltf of
scripts/upstream, and vertex colours times a material, this reader can go.
"""

import base64
import json
import math
import struct
import urllib.parse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from trimesh.transformations import quaternion_matrix

from ...errors import MAX_MESH_BYTES, MAX_MESH_PARTS, MAX_TABLE_BYTES
from ...utils.aliases import Fields
from ...utils.arrays import Array, Bytes, Floats, Integers
from ...utils.srgb import srgb
from .colours import SurfaceColours, byte_colours
from .limits import check_corners, check_faces, check_parts
from .source import MeshSource, ReadMesh, fixed_numbers

# Beginnings of glTF extensions that a file may require: they leave shape and colours alone, are
# read here, or left out with a warning
_READ_EXTENSIONS = (
    "KHR_materials_",
    "KHR_lights_",
    "KHR_animation_",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "KHR_texture_basisu",
    "KHR_node_visibility",
    "EXT_texture_webp",
)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Modes of primitives that have faces
_TRIANGLES = 4
_STRIP = 5
_FAN = 6
SKINNED_AT_ONCE = 100_000  # Vertices, each with a matrix of 128 bytes
_OTHER_VERSION = "only glTF version 2 is read; export version 2"
_ENDS_EARLY = "the file ends too early, or is no GLB"
_SPECULAR = "KHR_materials_pbrSpecularGlossiness"
_TRANSFORM = "KHR_texture_transform"
_VISIBILITY = "KHR_node_visibility"


def read_gltf(source: MeshSource, data: bytes | None = None) -> ReadMesh:
    """Read a glTF or GLB file, or the ``data`` of one, as one mesh in its scene's frame; skins as
    the joints stand."""
    text, binary = _chunks(source.data() if data is None else data)
    if len(text) > MAX_TABLE_BYTES:
        raise ValueError(f"its JSON is larger than {MAX_TABLE_BYTES:,} bytes")
    try:
        tree = json.loads(text)
    except ValueError as error:
        raise ValueError(f"neither GLB nor glTF, or its JSON is damaged: {error}") from error
    try:
        _check(tree)
        return _File(tree, binary, source).mesh()
    except (TypeError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"not valid glTF ({type(error).__name__}: {error})") from error


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON of a file, and the binary chunk of GLB."""
    if not data.startswith(b"glTF"):
        return data.removeprefix(b"\xef\xbb\xbf"), None
    if len(data) < 20:
        raise ValueError(_ENDS_EARLY)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ValueError(_OTHER_VERSION)
    if length > len(data):
        raise ValueError(_ENDS_EARLY)
    text = _chunk(data, 12, b"JSON")
    start = 20 + len(text)
    return text, _chunk(data, start, b"BIN\0") if start + 8 <= len(data) else None


def _chunk(data: bytes, start: int, expected: bytes) -> bytes:
    size, kind = struct.unpack_from("<I4s", data, start)
    content = data[start + 8 : start + 8 + size]
    if kind != expected or len(content) < size:
        raise ValueError(_ENDS_EARLY)
    return content


def _check(tree: Any) -> None:
    """Refuse what is not read, or would take too much memory, before anything is copied."""
    if not str(tree["asset"]["version"]).startswith("2."):
        raise ValueError(_OTHER_VERSION)
    used = [name for node in tree.get("nodes", []) for name in node.get("extensions", {})]
    names = [*tree.get("extensionsRequired", []), *(name for name in used if "instancing" in name)]
    for name in map(str, names):
        if not name.startswith(_READ_EXTENSIONS):
            raise ValueError(
                f"it requires the glTF extension {name[:60]}, which is not read; export without it"
            )
    _check_sizes(tree)
    _check_nodes(tree)


def _natural(value: Any) -> int:
    """``value`` if it is an integer >= 0, as sizes and indices must be."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise TypeError(f"expected an integer >= 0, got {value!r}")
    return value


def _check_sizes(tree: Fields) -> None:
    """Bounds on views of buffers, accessors, and every copy of a part."""
    accessors = tree.get("accessors", [])
    copied = sum(_natural(view["byteLength"]) for view in tree.get("bufferViews", []))
    claimed = sum(4 * _WIDTHS[one["type"]] * _natural(one["count"]) for one in accessors)
    if max(copied, claimed) > 4 * MAX_MESH_BYTES:
        raise ValueError(
            f"its buffer views or accessors claim more than {4 * MAX_MESH_BYTES:,} bytes"
        )

    def corners(part: Fields) -> int:
        """Corners of the faces of a part, or its vertices if these are more."""
        used = [*part["attributes"].values(), *([part["indices"]] if "indices" in part else [])]
        factor = 3 if part.get("mode") in (_STRIP, _FAN) else 1
        return factor * max((accessors[_natural(index)]["count"] for index in used), default=0)

    parts_of = [mesh["primitives"] for mesh in tree.get("meshes", [])]
    corners_of = [sum(map(corners, parts)) for parts in parts_of]
    copies = [_natural(node["mesh"]) for node in tree.get("nodes", []) if "mesh" in node]
    check_parts(sum(len(parts_of[mesh]) for mesh in copies))
    check_faces(sum(corners_of[mesh] for mesh in copies) / 3)


def _check_nodes(tree: Fields) -> None:
    """Every node must be the child of one node at most, and a root of none: else the nodes form a
    circle, or more."""
    nodes = tree.get("nodes", [])
    most = 10 * MAX_MESH_PARTS
    if len(nodes) > most:
        raise ValueError(f"more than {most:,} nodes; join them")
    if sum(len(skin["joints"]) for skin in tree.get("skins", [])) > most:
        raise ValueError(f"more than {most:,} joints; export it without skins")
    named = [*_roots(tree), *_children(nodes)]
    if len(set(map(_natural, named))) < len(named) or max(named, default=-1) >= len(nodes):
        raise ValueError("a node is missing, or the child of several; or the nodes form a circle")


def _children(nodes: list[Fields]) -> list[int]:
    return [child for node in nodes for child in node.get("children", [])]


def _roots(tree: Fields) -> list[int]:
    """The nodes that stand in the scene itself; without a scene, those that are no children."""
    if scenes := tree.get("scenes", []):
        return list(scenes[_natural(tree.get("scene", 0))].get("nodes", []))
    nodes = tree.get("nodes", [])
    children = set(_children(nodes))
    return [index for index in range(len(nodes)) if index not in children]


class _File:
    """A checked glTF tree and what it names."""

    def __init__(self, tree: Fields, binary: bytes | None, source: MeshSource) -> None:
        self._tree = tree
        self._binary = binary
        self._source = source
        self._buffers: dict[int, bytes] = {}
        self._parts: dict[int, list[tuple[Fields, ReadMesh]]] = {}
        self._skins: dict[int, Floats] = {}
        self._hidden: set[int] = set()
        self._places = dict(self._nodes())

    def _item(self, kind: str, index: Any) -> Any:
        """One of the tree's lists of buffers, materials, and so on, by its number."""
        return self._tree[kind][_natural(index)]

    def mesh(self) -> ReadMesh:
        """All parts of the scene at their places."""
        found = []
        for index, place in self._places.items():
            node = self._tree["nodes"][index]
            if "mesh" in node and index in self._hidden:
                self._source.warn("parts", "its invisible parts are left out")
            elif "mesh" in node:
                self._name_targets(node)
                found += [self._placed(node, place, *part) for part in self._mesh(node["mesh"])]
        return ReadMesh.joined(found)

    def _placed(self, node: Fields, place: Floats, part: Fields, mesh: ReadMesh) -> ReadMesh:
        attributes = part["attributes"]
        if "skin" not in node or not {"JOINTS_0", "WEIGHTS_0"} <= attributes.keys():
            return mesh.transformed(place)
        return replace(mesh, vertices=self._skinned(node["skin"], attributes, mesh.vertices))

    def _skinned(self, index: int, attributes: dict[str, int], vertices: Floats) -> Floats:
        """Vertices moved by the joints of a skin; its node's own place does not count."""
        T = self._joints(_natural(index))
        joints = self._accessor(attributes["JOINTS_0"]).astype(np.int64)
        weights = self._accessor(attributes["WEIGHTS_0"])
        fits = len(joints) == len(weights) == len(vertices)
        if not fits or joints.max(initial=0) >= len(T):
            raise ValueError("a skin does not fit its mesh")
        weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
        moved = np.zeros_like(vertices)
        for start in range(0, len(vertices), SKINNED_AT_ONCE):
            block = slice(start, start + SKINNED_AT_ONCE)
            for k in range(joints.shape[1]):
                at = T[joints[block, k]]
                turned = np.einsum("nij,nj->ni", at[:, :3, :3], vertices[block])
                moved[block] += weights[block, k, None] * (turned + at[:, :3, 3])
        return moved

    def _joints(self, index: int) -> Floats:
        """(J, 4, 4) what the joints of a skin do to a vertex that they alone move."""
        if index not in self._skins:
            skin = self._tree["skins"][index]
            T = np.stack([self._places.get(joint, np.eye(4)) for joint in skin["joints"]])
            if "inverseBindMatrices" in skin:
                inverse = self._accessor(skin["inverseBindMatrices"])
                T = T @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)[: len(T)]
            self._skins[index] = T
        return self._skins[index]

    def _nodes(self) -> Iterator[tuple[int, Floats]]:
        """The nodes of the scene and their places in it."""
        waiting = [(root, np.eye(4)) for root in reversed(_roots(self._tree))]
        while waiting:
            index, above = waiting.pop()
            node = self._tree["nodes"][index]
            place = above @ _local(node)
            yield index, place
            visibility = node.get("extensions", {}).get(_VISIBILITY, {})
            if index in self._hidden or not visibility.get("visible", True):
                self._hidden.update((index, *node.get("children", [])))
            waiting += [(child, place) for child in reversed(node.get("children", []))]

    def _name_targets(self, node: Fields) -> None:
        """Warn of a node's morph targets, whose weights come before those of its mesh."""
        mesh = self._item("meshes", node["mesh"])
        if any(node.get("weights", mesh.get("weights", []))):
            self._source.warn(
                "skin", "its morph targets are left out: the shape is that without them"
            )

    def _mesh(self, index: int) -> list[tuple[Fields, ReadMesh]]:
        if index not in self._parts:
            mesh = self._tree["meshes"][index]
            self._parts[index] = [
                (part, self._part(part))
                for part in mesh["primitives"]
                if part.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN)
                and "POSITION" in part["attributes"]
            ]
        return self._parts[index]

    def _part(self, part: Fields) -> ReadMesh:
        vertices = self._accessor(part["attributes"]["POSITION"])
        if vertices.shape[1:] != (3,):
            raise ValueError("positions that are not of three numbers")
        indices = np.arange(len(vertices))
        if "indices" in part:
            indices = self._stored(part["indices"])[:, 0].astype(np.int64)
        check_corners(indices, len(vertices))
        faces = _faces(indices, part.get("mode", _TRIANGLES))
        return ReadMesh(vertices, faces, self._colours(part, faces, len(vertices)))

    def _colours(self, part: Fields, faces: Integers, count: int) -> SurfaceColours | None:
        """Vertex colours times the colour of the material times its texture."""
        attributes = part["attributes"]
        if "material" not in part and "COLOR_0" not in attributes:
            return None
        material = self._item("materials", part["material"]) if "material" in part else {}
        factor, info = _base_colour(material)
        tint = srgb(factor)
        if "COLOR_0" in attributes:
            colours = self._accessor(attributes["COLOR_0"], normalized=True)[:, :3]
            if colours.shape != (count, 3):
                raise ValueError("vertex colours that do not fit the vertices")
            tint = tint * np.clip(np.nan_to_num(colours), 0.0, 1.0)[faces]
        painted = SurfaceColours.plain(len(faces))
        painted.corners[:] = byte_colours(tint)
        texture = None if info is None else self._texture(info)
        if info is not None and texture is not None:
            uv = self._coordinates(info, attributes, count)
            if uv is not None:
                return painted.with_texture(slice(None), texture, uv[faces])
        return painted

    def _coordinates(self, info: Fields, attributes: dict[str, int], count: int) -> Floats | None:
        """(V, 2) texture coordinates from the bottom left, in the set and by the transform that the
        texture names."""
        transform = info.get("extensions", {}).get(_TRANSFORM, {})
        name = f"TEXCOORD_{_natural(transform.get('texCoord', info.get('texCoord', 0)))}"
        if name not in attributes:
            self._source.warn(
                "texture", f"a textured part lacks {name}; it is shown in its plain colour"
            )
            return None
        uv = self._accessor(attributes[name], normalized=True)
        if uv.shape != (count, 2):
            raise ValueError("texture coordinates that do not fit the vertices")
        angle = float(transform.get("rotation", 0.0))
        cos = math.cos(angle)
        sin = math.sin(angle)
        scale = fixed_numbers(transform.get("scale"), 2, (1.0, 1.0))
        scaled = scale * np.nan_to_num(uv, posinf=0.0, neginf=0.0)
        offset = fixed_numbers(transform.get("offset"), 2, (0.0, 0.0))
        turned = scaled @ np.array([[cos, -sin], [sin, cos]]) + offset
        return np.asarray(np.array([0.0, 1.0]) + turned * np.array([1.0, -1.0]))

    def _texture(self, info: Fields) -> Bytes | None:
        texture = self._item("textures", info["index"])
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        index = webp.get("source", texture.get("source"))
        if index is None:
            self._source.warn(
                "texture",
                "a texture is in a format that is not read; its faces are in plain colour",
            )
            return None
        image = self._item("images", index)
        name = str(image.get("name", f"number {index}"))
        if "bufferView" in image:
            view = _natural(image["bufferView"])
            return self._source.texture(("view", view), lambda: bytes(self._view(view)), name)
        uri = str(image["uri"])
        if uri.startswith("data:"):
            return self._source.texture(("image", index), lambda: _data_of(uri), name)
        return self._source.texture_file(urllib.parse.unquote(uri))

    def _accessor(self, index: Any, *, normalized: bool = False) -> Floats:
        """(count, width) values of an accessor; integers that stand for fractions are divided."""
        stored = self._stored(index)
        values = stored.astype(np.float64)
        is_fraction = normalized or self._item("accessors", index).get("normalized")
        if is_fraction and stored.dtype.kind != "f":
            values = np.maximum(values / np.iinfo(stored.dtype).max, -1.0)
        return values

    def _stored(self, index: Any) -> Array:
        """(count, width) values of an accessor as they are stored: those of its view, or zeros, but
        for some that it names one by one."""
        accessor = self._item("accessors", index)
        if accessor.keys().isdisjoint(("sparse", "bufferView")):
            raise ValueError(
                "an accessor of a part has no data, as in compressed files; export without it"
            )
        kind = np.dtype(_TYPES[accessor["componentType"]])
        shape = (accessor["count"], _WIDTHS[accessor["type"]])
        if "sparse" not in accessor:
            return self._viewed(accessor, kind, shape)
        sparse = accessor["sparse"]
        count = _natural(sparse["count"])
        if count > shape[0]:
            raise ValueError("a sparse accessor names more values than it has")
        index_kind = np.dtype(_TYPES[sparse["indices"]["componentType"]])
        places = self._viewed(sparse["indices"], index_kind, (count, 1))[:, 0].astype(np.int64)
        values = self._viewed(sparse["values"], kind, (count, shape[1]))
        if count and not 0 <= places.min() <= places.max() < shape[0]:
            raise ValueError("a sparse accessor names a value that it does not have")
        if "bufferView" in accessor:
            stored = self._viewed(accessor, kind, shape).copy()
        else:
            # Zeros are not in the file; what else it says of each value takes a byte or more
            if shape[0] > sum(map(len, self._buffers.values())):
                raise ValueError("a sparse accessor has more values than its buffers have bytes")
            stored = np.zeros(shape, kind)
        stored[places] = values
        return stored

    def _viewed(self, place: Fields, kind: np.dtype[Any], shape: tuple[int, int]) -> Array:
        """(count, width) values at the ``place`` in a view that an accessor, or a part of one,
        names."""
        if "bufferView" not in place:
            raise ValueError("a sparse accessor has no data")
        data = self._view(place["bufferView"])
        start = _natural(place.get("byteOffset", 0))
        size = shape[1] * kind.itemsize
        stride = (
            _natural(self._item("bufferViews", place["bufferView"]).get("byteStride", 0)) or size
        )
        if shape[0] and start + stride * (shape[0] - 1) + size > len(data):
            raise ValueError("an accessor is longer than its data; the file ends too early")
        return np.ndarray(shape, kind, data, start, (stride, kind.itemsize))

    def _view(self, index: Any) -> memoryview:
        view = self._item("bufferViews", index)
        buffer = self._buffer(_natural(view["buffer"]))
        start = _natural(view.get("byteOffset", 0))
        end = start + view["byteLength"]
        if end > len(buffer):
            raise ValueError("a buffer is shorter than its views; the file ends too early")
        return memoryview(buffer)[start:end]  # no copy: many accessors may share a view

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = str(self._tree["buffers"][index].get("uri") or "")
            if uri.startswith("data:"):
                self._buffers[index] = _data_of(uri)
            elif uri:
                self._buffers[index] = self._source.read(urllib.parse.unquote(uri))
            elif index == 0 and self._binary is not None:
                self._buffers[index] = self._binary
            else:
                raise ValueError("a buffer without content")
        return self._buffers[index]


def _local(node: Fields) -> Floats:
    """(4, 4) place of a node below its parent."""
    if "matrix" in node:
        return fixed_numbers(node["matrix"], 16).reshape(4, 4).T
    x, y, z, w = fixed_numbers(node.get("rotation"), 4, (0.0, 0.0, 0.0, 1.0))
    T = np.asarray(quaternion_matrix((w, x, y, z)))
    T[:3, :3] *= fixed_numbers(node.get("scale"), 3, (1.0, 1.0, 1.0))
    T[:3, 3] = fixed_numbers(node.get("translation"), 3, (0.0, 0.0, 0.0))
    return T


def _faces(indices: Integers, mode: int) -> Integers:
    """(F, 3) faces of triangles, of a strip, whose every second one is turned over, or of a fan."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    faces = np.column_stack([indices[:-2], indices[1:-1], indices[2:]])
    if mode == _FAN:
        faces[:, 0] = indices[:1]
    else:
        faces[1::2] = faces[1::2, ::-1]
    return faces


def _base_colour(material: Fields) -> tuple[Floats, Fields | None]:
    """(3,) linear colour of a material, and its texture, if any."""
    specular = material.get("extensions", {}).get(_SPECULAR)
    metallic = material.get("pbrMetallicRoughness", {})
    kind, values = ("baseColor", metallic) if specular is None else ("diffuse", specular)
    factor = fixed_numbers(values.get(f"{kind}Factor"), 4, (1.0,) * 4)
    return factor[:3], values.get(f"{kind}Texture")


def _data_of(uri: str) -> bytes:
    head, _, content = uri.partition(",")
    if head.endswith(";base64"):
        return base64.b64decode(content)
    return urllib.parse.unquote_to_bytes(content)
