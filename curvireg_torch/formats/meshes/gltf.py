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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MAX_MESH_BYTES, MAX_MESH_FACES, MAX_MESH_PARTS, MAX_TABLE_BYTES
from ...utils.srgb import srgb
from .colours import SurfaceColours
from .source import MeshSource, Pixels, ReadMesh, as_plain_numbers

# Beginnings of glTF extensions that a file may require: they leave shape and colours alone, or are
# read here
_READ_EXTENSIONS = (
    "KHR_materials_",
    "KHR_lights_",
    "KHR_animation_",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "EXT_texture_webp",
)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Modes of primitives that have faces
_TRIANGLES = 4
_STRIP = 5
_FAN = 6
SKINNED_AT_ONCE = 100_000  # Vertices, each with a matrix of 128 bytes
_SPECULAR = "KHR_materials_pbrSpecularGlossiness"
_TRANSFORM = "KHR_texture_transform"


def read_gltf(source: MeshSource, data: bytes | None = None) -> ReadMesh:
    """Read a glTF or GLB file, or the ``data`` of one, as one mesh in its scene's frame; skins as
    the joints stand."""
    data = source.data() if data is None else data
    text, binary = _chunks(data)
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
        raise ValueError("the file ends too early")
    version, length, size, kind = struct.unpack_from("<III4s", data, 4)
    if version != 2:
        raise ValueError("only glTF version 2 is read; export version 2")
    if kind != b"JSON" or length > len(data) or 20 + size > len(data):
        raise ValueError("the file ends too early, or is no GLB")
    text = data[20 : 20 + size]
    rest = data[20 + size :]
    if len(rest) < 8:
        return text, None
    size, kind = struct.unpack_from("<I4s", rest)
    if kind != b"BIN\0" or 8 + size > len(rest):
        raise ValueError("the file ends too early, or is no GLB")
    return text, rest[8 : 8 + size]


def _check(tree: Any) -> None:
    """Refuse what is not read, or would take too much memory, before anything is copied."""
    if not str(tree["asset"]["version"]).startswith("2."):
        raise ValueError("only glTF version 2 is read; export version 2")
    names = [str(name) for name in tree.get("extensionsRequired", [])]
    names += [
        name
        for node in tree.get("nodes", [])
        for name in node.get("extensions", {})
        if "instancing" in name
    ]
    for name in names:
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


def _check_sizes(tree: dict[str, Any]) -> None:
    """Bounds on views of buffers, accessors, and every copy of a part."""
    accessors = tree.get("accessors", [])
    copied = sum(_natural(view["byteLength"]) for view in tree.get("bufferViews", []))
    claimed = sum(
        4 * _WIDTHS[accessor["type"]] * _natural(accessor["count"]) for accessor in accessors
    )
    if max(copied, claimed) > 4 * MAX_MESH_BYTES:
        raise ValueError(
            f"its buffer views or accessors claim more than {4 * MAX_MESH_BYTES:,} bytes"
        )

    def count(index: Any) -> int:
        accessor = accessors[_natural(index)]
        if "sparse" not in accessor and "bufferView" not in accessor:
            raise ValueError(
                "an accessor of a part has no data, as in compressed files; export without it"
            )
        return int(accessor["count"])

    def corners(part: dict[str, Any]) -> int:
        """Corners of the faces of a part, or its vertices if these are more."""
        used = [*part["attributes"].values(), *([part["indices"]] if "indices" in part else [])]
        factor = 3 if part.get("mode") in (_STRIP, _FAN) else 1
        return factor * max(map(count, used), default=0)

    meshes = [
        (len(mesh["primitives"]), sum(map(corners, mesh["primitives"])))
        for mesh in tree.get("meshes", [])
    ]
    copies = [meshes[_natural(node["mesh"])] for node in tree.get("nodes", []) if "mesh" in node]
    parts, most = (sum(column) for column in zip((0, 0), *copies, strict=True))
    if parts > MAX_MESH_PARTS:
        raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
    if most > 3 * MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def _check_nodes(tree: dict[str, Any]) -> None:
    """Every node must be the child of one node at most, and a root of none: else the nodes form a
    circle, or more."""
    nodes = tree.get("nodes", [])
    scenes = tree.get("scenes", [])
    if len(nodes) > 10 * MAX_MESH_PARTS:
        raise ValueError(f"more than {10 * MAX_MESH_PARTS:,} nodes; join them")
    joints = sum(len(skin["joints"]) for skin in tree.get("skins", []))
    if joints > 10 * MAX_MESH_PARTS:
        raise ValueError(f"more than {10 * MAX_MESH_PARTS:,} joints; export it without skins")
    named = [child for node in nodes for child in node.get("children", [])]
    named += scenes[_natural(tree.get("scene", 0))].get("nodes", []) if scenes else []
    if len(set(map(_natural, named))) < len(named) or max(named, default=-1) >= len(nodes):
        raise ValueError("a node is missing, or the child of several; or the nodes form a circle")


class _File:
    """A checked glTF tree and what it names."""

    def __init__(self, tree: dict[str, Any], binary: bytes | None, source: MeshSource) -> None:
        self._tree = tree
        self._binary = binary
        self._source = source
        self._buffers: dict[int, bytes] = {}
        self._parts: dict[int, list[tuple[dict[str, Any], ReadMesh]]] = {}
        self._skins: dict[int, NDArray[np.float64]] = {}
        self._places = dict(self._nodes())

    def mesh(self) -> ReadMesh:
        """All parts of the scene at their places."""
        found = []
        for index, place in self._places.items():
            node = self._tree["nodes"][index]
            if "mesh" in node:
                found += [self._placed(node, place, *part) for part in self._mesh(node["mesh"])]
        return ReadMesh.joined(found)

    def _placed(
        self, node: dict[str, Any], place: NDArray[np.float64], part: dict[str, Any], mesh: ReadMesh
    ) -> ReadMesh:
        attributes = part["attributes"]
        if "skin" not in node or "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
            return mesh.transformed(place)
        vertices = self._skinned(node["skin"], attributes, mesh.vertices)
        return ReadMesh(vertices, mesh.faces, mesh.colours)

    def _skinned(
        self, index: int, attributes: dict[str, int], vertices: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Vertices moved by the joints of a skin; its node's own place does not count."""
        T = self._joints(_natural(index))
        joints = self._accessor(attributes["JOINTS_0"]).astype(np.int64)
        weights = self._accessor(attributes["WEIGHTS_0"])
        if (
            len(joints) != len(vertices)
            or len(weights) != len(vertices)
            or joints.max(initial=0) >= len(T)
        ):
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

    def _joints(self, index: int) -> NDArray[np.float64]:
        """(J, 4, 4) what the joints of a skin do to a vertex that they alone move."""
        if index not in self._skins:
            skin = self._tree["skins"][index]
            T = np.stack([self._places.get(joint, np.eye(4)) for joint in skin["joints"]])
            if "inverseBindMatrices" in skin:
                inverse = self._accessor(skin["inverseBindMatrices"])
                T = T @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)[: len(T)]
            self._skins[index] = T
        return self._skins[index]

    def _nodes(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """The nodes of the scene and their places in it."""
        nodes = self._tree.get("nodes", [])
        scenes = self._tree.get("scenes", [])
        if scenes:
            roots = scenes[self._tree.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        waiting = [(root, np.eye(4)) for root in reversed(roots)]
        while waiting:
            index, above = waiting.pop()
            place = above @ _local(nodes[index])
            yield index, place
            waiting += [(child, place) for child in reversed(nodes[index].get("children", []))]

    def _mesh(self, index: int) -> list[tuple[dict[str, Any], ReadMesh]]:
        if index not in self._parts:
            mesh = self._tree["meshes"][index]
            if any(mesh.get("weights", [])):
                self._source.warn(
                    "skin", "its morph targets are left out: the shape is that without them"
                )
            parts = [
                part
                for part in mesh["primitives"]
                if part.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN)
            ]
            self._parts[index] = [
                (part, self._part(part)) for part in parts if "POSITION" in part["attributes"]
            ]
        return self._parts[index]

    def _part(self, part: dict[str, Any]) -> ReadMesh:
        vertices = self._accessor(part["attributes"]["POSITION"])
        if "indices" in part:
            indices = self._accessor(part["indices"], as_stored=True)[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(vertices))
        if vertices.shape[1:] != (3,) or indices.max(initial=0) >= max(len(vertices), 1):
            raise ValueError("a face names a vertex that does not exist")
        faces = _faces(indices, part.get("mode", _TRIANGLES))
        return ReadMesh(vertices, faces, self._colours(part, faces, len(vertices)))

    def _colours(
        self, part: dict[str, Any], faces: NDArray[np.int64], count: int
    ) -> SurfaceColours | None:
        """Vertex colours times the colour of the material times its texture."""
        attributes = part["attributes"]
        if "material" not in part and "COLOR_0" not in attributes:
            return None
        plain = SurfaceColours.plain(len(faces))
        material = self._tree["materials"][_natural(part["material"])] if "material" in part else {}
        factor, info = _base_colour(material)
        tint = np.broadcast_to(srgb(factor), (len(faces), 3, 3))
        if "COLOR_0" in attributes:
            colours = self._accessor(attributes["COLOR_0"], normalized=True)[:, :3]
            if colours.shape != (count, 3):
                raise ValueError("vertex colours that do not fit the vertices")
            tint = tint * np.clip(np.nan_to_num(colours), 0.0, 1.0)[faces]
        corners = np.round(255.0 * tint).astype(np.uint8)
        pixels = None if info is None else self._texture(info)
        if pixels is None or info is None:
            return SurfaceColours(corners, plain.uv, plain.texture)
        uv = self._coordinates(info, attributes, count)
        if uv is None:
            return SurfaceColours(corners, plain.uv, plain.texture)
        return SurfaceColours(corners, uv[faces], np.zeros(len(faces), np.int32), (pixels,))

    def _coordinates(
        self, info: dict[str, Any], attributes: dict[str, int], count: int
    ) -> NDArray[np.float32] | None:
        """(V, 2) texture coordinates from the bottom left, in the set and by the transform that the
        texture names."""
        transform = info.get("extensions", {}).get(_TRANSFORM, {})
        number = _natural(transform.get("texCoord", info.get("texCoord", 0)))
        name = f"TEXCOORD_{number}"
        if name not in attributes:
            self._source.warn(
                "texture", f"a textured part lacks {name}; it is shown in its plain colour"
            )
            return None
        uv = self._accessor(attributes[name], normalized=True)
        if uv.shape != (count, 2):
            raise ValueError("texture coordinates that do not fit the vertices")
        u, v = np.nan_to_num(uv, posinf=0.0, neginf=0.0).T
        scale = as_plain_numbers(transform.get("scale"), 2, (1.0, 1.0))
        offset = as_plain_numbers(transform.get("offset"), 2, (0.0, 0.0))
        angle = float(transform.get("rotation", 0.0))
        u = scale[0] * u
        v = scale[1] * v
        cos = math.cos(angle)
        sin = math.sin(angle)
        turned_u = cos * u + sin * v + offset[0]
        turned_v = cos * v - sin * u + offset[1]
        return np.column_stack([turned_u, 1.0 - turned_v]).astype(np.float32)

    def _texture(self, info: dict[str, Any]) -> Pixels | None:
        texture = self._tree["textures"][_natural(info["index"])]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        index = webp.get("source", texture.get("source"))
        if index is None:
            self._source.warn(
                "texture",
                "a texture is in a format that is not read; its faces are in plain colour",
            )
            return None
        image = self._tree["images"][_natural(index)]
        name = str(image.get("name", f"number {index}"))
        if "bufferView" in image:
            view = _natural(image["bufferView"])
            return self._source.texture(("view", view), lambda: bytes(self._view(view)), name)
        uri = str(image["uri"])
        if uri.startswith("data:"):
            return self._source.texture(("image", index), lambda: _data_of(uri), name)
        return self._source.texture_file(urllib.parse.unquote(uri))

    def _accessor(
        self, index: Any, *, normalized: bool = False, as_stored: bool = False
    ) -> NDArray[Any]:
        """(count, width) values of an accessor as float64; integers that stand for fractions are
        divided."""
        accessor = self._tree["accessors"][_natural(index)]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        width = _WIDTHS[accessor["type"]]
        stored = self._stored(accessor, kind, width, accessor["count"])
        if "sparse" in accessor:
            stored = self._with_exceptions(stored, accessor["sparse"])
        if as_stored or kind.kind == "f":
            return stored if as_stored else stored.astype(np.float64)
        values = stored.astype(np.float64)
        if normalized or accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(kind).max, -1.0)
        return values

    def _stored(
        self, place: dict[str, Any], kind: np.dtype[Any], width: int, count: int
    ) -> NDArray[Any]:
        """(count, width) values at the ``place`` in a view that an accessor, or a part of one,
        names; zeros where it names none."""
        if "bufferView" not in place:
            return np.zeros((count, width), kind)
        view = self._tree["bufferViews"][_natural(place["bufferView"])]
        data = self._view(place["bufferView"])
        start = _natural(place.get("byteOffset", 0))
        size = width * kind.itemsize
        stride = _natural(view.get("byteStride", 0)) or size
        if count and start + stride * (count - 1) + size > len(data):
            raise ValueError("an accessor is longer than its data; the file ends too early")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def _with_exceptions(self, stored: NDArray[Any], sparse: dict[str, Any]) -> NDArray[Any]:
        """Values of a sparse accessor: those stored, but for some, which are named one by one."""
        count = _natural(sparse["count"])
        if count > len(stored):
            raise ValueError("a sparse accessor names more values than it has")
        places = sparse["indices"]
        if "bufferView" not in places or "bufferView" not in sparse["values"]:
            raise ValueError("a sparse accessor has no data")
        kind = np.dtype(_TYPES[places["componentType"]])
        index = self._stored(places, kind, 1, count)[:, 0].astype(np.int64)
        if count and not 0 <= index.min() <= index.max() < len(stored):
            raise ValueError("a sparse accessor names a value that it does not have")
        values = stored.copy()
        values[index] = self._stored(sparse["values"], stored.dtype, stored.shape[1], count)
        return values

    def _view(self, index: Any) -> memoryview:
        view = self._tree["bufferViews"][_natural(index)]
        buffer = self._buffer(_natural(view["buffer"]))
        start = _natural(view.get("byteOffset", 0))
        end = start + view["byteLength"]
        if end > len(buffer):
            raise ValueError("a buffer is shorter than its views; the file ends too early")
        return memoryview(buffer)[start:end]  # no copy: many accessors may share a view

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = self._tree["buffers"][index]
            uri = buffer.get("uri")
            if uri is None:
                content = self._binary if index == 0 else None
                if content is None:
                    raise ValueError("a buffer without content")
            elif str(uri).startswith("data:"):
                content = _data_of(str(uri))
            else:
                content = self._source.read(urllib.parse.unquote(str(uri)))
            self._buffers[index] = content
        return self._buffers[index]


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4) place of a node below its parent."""
    if "matrix" in node:
        return as_plain_numbers(node["matrix"], 16, ()).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = as_plain_numbers(node.get("rotation"), 4, (0.0, 0.0, 0.0, 1.0))
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if norm > 0.0:
        x = x / norm
        y = y / norm
        z = z / norm
        w = w / norm
        T[0, :3] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        T[1, :3] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        T[2, :3] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    T[:3, :3] *= as_plain_numbers(node.get("scale"), 3, (1.0, 1.0, 1.0))
    T[:3, 3] = as_plain_numbers(node.get("translation"), 3, (0.0, 0.0, 0.0))
    return T


def _faces(indices: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """(F, 3) faces of triangles, of a strip, whose every second one is turned over, or of a fan."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    second = indices[1:-1]
    third = indices[2:]
    if mode == _FAN:
        return np.column_stack([np.full(len(second), indices[0]), second, third])
    faces = np.column_stack([indices[:-2], second, third])
    faces[1::2] = faces[1::2, ::-1]
    return faces


def _base_colour(material: dict[str, Any]) -> tuple[NDArray[np.float64], dict[str, Any] | None]:
    """(3,) linear colour of a material, and its texture, if any."""
    specular = material.get("extensions", {}).get(_SPECULAR)
    metallic = material.get("pbrMetallicRoughness", {})
    factor = metallic.get("baseColorFactor") if specular is None else specular.get("diffuseFactor")
    info = metallic.get("baseColorTexture") if specular is None else specular.get("diffuseTexture")
    return as_plain_numbers(factor, 4, (1.0,) * 4)[:3], info


def _data_of(uri: str) -> bytes:
    head, _, content = uri.partition(",")
    return (
        base64.b64decode(content)
        if head.endswith(";base64")
        else urllib.parse.unquote_to_bytes(content)
    )
