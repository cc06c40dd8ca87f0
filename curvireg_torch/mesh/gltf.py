"""Checks of glTF files before trimesh reads them: their claims, the files they name, and the tree of their nodes."""

import json
import struct
from collections.abc import Callable
from typing import Any

from ..errors import MAX_MESH_BYTES, MAX_MESH_DEPTH, MAX_MESH_FACES, MAX_MESH_PARTS, MAX_TABLE_BYTES

_OPTIONAL_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "KHR_animation_")
_COMPONENTS = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_PER_TRIANGLE = {4: 3, 5: 1, 6: 1}  # indices for each triangle of a list, strip or fan


def check_gltf(data: bytes, suffix: str, size_of: Callable[[str], int]) -> None:
    """Refuse files that name others outside their folder, take too much memory, or need unknown extensions.

    ``size_of`` gives the bytes of a file beside the mesh, or raises ValueError. So does this function, for the user.
    """
    data, chunk = _chunks(data) if suffix == ".glb" else (data, None)
    if len(data) > MAX_TABLE_BYTES:
        raise ValueError(f"its JSON is larger than {MAX_TABLE_BYTES:,} bytes")
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"its JSON is damaged ({error})") from None
    if not isinstance(tree, dict):
        raise ValueError("its JSON is no object")
    try:
        _check_extensions(tree)
        views = _check_buffers(tree, chunk, size_of)
        counts = _check_accessors(tree, views)
        _check_nodes(tree, [_triangles(mesh, counts) for mesh in tree.get("meshes", [])])
    except (TypeError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"not valid glTF ({type(error).__name__}: {error})") from error


def _chunks(data: bytes) -> tuple[bytes, int | None]:
    """The JSON, and the length of the binary chunk."""
    if len(data) < 20:
        raise ValueError("the file ends too early")
    magic, version, _, length, kind = struct.unpack_from("<4sIII4s", data)
    if magic != b"glTF" or kind != b"JSON":
        raise ValueError("not a GLB file")
    if version != 2:
        raise ValueError(f"glTF version {version} is not read; export version 2")
    end = 20 + length
    if end > len(data):
        raise ValueError("the file ends too early")
    binary = struct.unpack_from("<I", data, end)[0] if len(data) >= end + 8 else None
    if binary is not None and end + 8 + binary > len(data):
        raise ValueError("the file ends too early")
    return data[20:end], binary


def _index(value: Any, default: int | None = None) -> int:
    """``value`` if it is an integer >= 0, as sizes and indices must be."""
    value = default if value is None else value
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise TypeError(f"expected an integer >= 0, got {value!r}")
    return value


def _check_extensions(tree: dict[str, Any]) -> None:
    if str(tree.get("asset", {}).get("version", "2.0")).split(".")[0] != "2":
        raise ValueError("only glTF version 2 is read; export version 2")
    for name in tree.get("extensionsRequired", []):
        if not str(name).startswith(_OPTIONAL_EXTENSIONS):
            raise ValueError(f"it requires the glTF extension {str(name)[:60]}, which is not read; export without it")


def _check_buffers(tree: dict[str, Any], chunk: int | None, size_of: Callable[[str], int]) -> list[int]:
    """The length of every buffer view."""
    buffers, total = [], 0
    for buffer in tree.get("buffers", []):
        uri = buffer.get("uri")
        if uri is None:
            if chunk is None:
                raise ValueError("a buffer without content")
            length = chunk
        elif str(uri).startswith("data:"):
            if ";base64," not in uri[:200]:
                raise ValueError("a data URI that is not base64")
            length = (len(uri) - uri.index(",")) * 3 // 4
        else:
            length = size_of(str(uri))
        if _index(buffer["byteLength"]) > length:
            raise ValueError(f"a buffer claims {buffer['byteLength']} bytes, {length} are there")
        buffers.append(_index(buffer["byteLength"]))
        total += length
    if total > MAX_MESH_BYTES:
        raise ValueError(f"its buffers hold more than {MAX_MESH_BYTES:,} bytes")
    views = []
    for view in tree.get("bufferViews", []):
        length, start = _index(view["byteLength"]), _index(view.get("byteOffset"), 0)
        if start + length > buffers[_index(view["buffer"])]:
            raise ValueError("a buffer view reaches beyond its buffer")
        views.append(length)
    return views


def _check_accessors(tree: dict[str, Any], views: list[int]) -> list[int]:
    """The length of every accessor."""
    counts = []
    for accessor in tree.get("accessors", []):
        count = _index(accessor["count"])
        size = _COMPONENTS[accessor["componentType"]] * _WIDTHS[accessor["type"]]
        if count > 3 * MAX_MESH_FACES:
            raise ValueError(f"an accessor claims {count} values, more than {3 * MAX_MESH_FACES:,}")
        if "bufferView" in accessor:
            view = _index(accessor["bufferView"])
            stride = max(size, _index(tree["bufferViews"][view].get("byteStride"), 0))
            needed = _index(accessor.get("byteOffset"), 0) + stride * max(count - 1, 0) + size * min(count, 1)
            if needed > views[view]:
                raise ValueError(f"an accessor claims {count} values, more than its buffer view holds")
        counts.append(count)
    return counts


def _triangles(mesh: dict[str, Any], counts: list[int]) -> int:
    total = 0
    for part in mesh["primitives"]:
        mode = _index(part.get("mode"), 4)
        values = part["indices"] if "indices" in part else part.get("attributes", {}).get("POSITION")
        if mode in _PER_TRIANGLE and values is not None:
            total += counts[_index(values)] // _PER_TRIANGLE[mode] + 1
    return total


def _check_nodes(tree: dict[str, Any], triangles: list[int]) -> None:
    nodes = tree.get("nodes", [])
    parts = [0 if "mesh" not in node else triangles[_index(node["mesh"])] for node in nodes]
    if sum(map(bool, parts)) > MAX_MESH_PARTS:
        raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
    if sum(parts) > MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if _index(child) >= len(nodes) or child in parents:
                raise ValueError(f"node {child} is missing, or the child of several")
            parents[child] = index
    depth = {index: 0 for index in range(len(nodes)) if index not in parents}
    ahead = list(depth)
    while ahead:
        index = ahead.pop()
        for child in nodes[index].get("children", []):
            depth[child] = depth[index] + 1
            ahead.append(child)
        if depth[index] > MAX_MESH_DEPTH:
            raise ValueError(f"nodes more than {MAX_MESH_DEPTH} deep")
    if len(depth) < len(nodes):
        raise ValueError("its nodes form a circle")
    for scene in tree.get("scenes", []):
        if any(_index(root) >= len(nodes) for root in scene.get("nodes", [])):
            raise ValueError("a scene names nodes that do not exist")
