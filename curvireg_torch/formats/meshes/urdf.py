"""URDF: the visible meshes of a robot's links, all joints at zero, as one rigid mesh; or those of
one link.

yourdfpy reads the same tree of joints. It would replace some 60 lines here, not the search for
meshes, their bounds and colours, and would bring lxml as another dependency.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...errors import MAX_MESH_FACES, MAX_MESH_PARTS, MAX_TABLE_BYTES, MeshError
from ...utils.choices import UNITS
from ..xml_files import check_elements, check_xml
from .colours import SurfaceColours
from .source import MeshSource, ReadMesh, is_file_name

_URDF_FOLDERS = ("robots", "urdf")  # of ROS packages, beside their meshes
ReadPart = Callable[[MeshSource], ReadMesh]


def read_urdf(source: MeshSource, read_part: ReadPart, link: str | None = None) -> ReadMesh:
    """Read the meshes that a URDF names, in metres, in the frame of its root link or of ``link``; z
    is up."""
    if source.path.stat().st_size > MAX_TABLE_BYTES:
        raise ValueError(f"larger than {MAX_TABLE_BYTES:,} bytes")
    data = source.data()
    check_xml(data)
    check_elements(data)
    robot = ET.fromstring(data)
    if robot.tag != "robot":
        raise ValueError(
            "no robot in it; of a xacro file, write the URDF first (xacro FILE > robot.urdf)"
        )
    links = {str(one.get("name")): one for one in robot.findall("link")}
    if link is not None and link not in links:
        raise ValueError(f"it has no link {link!r}; it has {', '.join(list(links)[:20])}"[:250])
    places = {link: np.eye(4)} if link is not None else _places(robot, links)
    colours = {str(one.get("name")): _colour(one) for one in robot.findall("material")}
    reader = _Parts(source, read_part, colours)
    parts = [part for name, place in places.items() for part in reader.of_link(links[name], place)]
    if reader.missing and not parts:
        raise MeshError(
            f"the meshes that it names are missing in its folder ({reader.missing[0][:100]}); name "
            f"their folder (textures)"
        )
    return ReadMesh.joined(parts, "m", "z")


def _places(robot: Any, links: dict[str, Any]) -> dict[str, NDArray[np.float64]]:
    """The place of each link in the root's frame, all joints at zero."""
    above: dict[str, tuple[str, NDArray[np.float64]]] = {}
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        child = joint.find("child")
        if parent is None or child is None:
            raise ValueError("a joint without parent or child")
        above[str(child.get("link"))] = (str(parent.get("link")), _origin(joint))
    places: dict[str, NDArray[np.float64]] = {}
    for name in links:
        chain = [name]
        while chain[-1] not in places and chain[-1] in above:
            if len(chain) > len(above):
                raise ValueError("its joints form a circle")
            chain.append(above[chain[-1]][0])
        places.setdefault(chain[-1], np.eye(4))
        for child in reversed(chain[:-1]):
            parent_name, place = above[child]
            places[child] = places[parent_name] @ place
    return {name: places[name] for name in links}


def _origin(element: Any) -> NDArray[np.float64]:
    """(4, 4) of an ``origin``: roll, pitch and yaw about fixed axes, and a translation."""
    origin = element.find("origin")
    T = np.eye(4)
    if origin is None:
        return T
    roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"), 3)
    T[:3, :3] = _turn(yaw, 2) @ _turn(pitch, 1) @ _turn(roll, 0)
    T[:3, 3] = _numbers(origin.get("xyz", "0 0 0"), 3)
    return T


def _turn(angle: float, axis: int) -> NDArray[np.float64]:
    first = (axis + 1) % 3
    second = (axis + 2) % 3
    R = np.eye(3)
    R[first, first] = R[second, second] = math.cos(angle)
    R[first, second] = -math.sin(angle)
    R[second, first] = math.sin(angle)
    return R


def _numbers(text: str, count: int) -> NDArray[np.float64]:
    values = np.array([float(word) for word in text.split()])
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"expected {count} numbers, got {text[:50]!r}")
    return values


def _colour(material: Any) -> NDArray[np.uint8] | None:
    """(3,) of a material's ``color``, None without one."""
    colour = material.find("color")
    if colour is None:
        return None
    rgba = _numbers(colour.get("rgba", "1 1 1 1"), 4)
    return np.asarray(np.round(255.0 * np.clip(rgba[:3], 0.0, 1.0)), np.uint8)


class _Parts:
    """The visible parts of links; each mesh file is read once."""

    def __init__(
        self, source: MeshSource, read_part: ReadPart, colours: dict[str, NDArray[np.uint8] | None]
    ) -> None:
        self._source = source
        self._read_part = read_part
        self._colours = colours
        self._meshes: dict[Path, ReadMesh] = {}
        self._paths: dict[str, Path | None] = {}
        self.missing: list[str] = []
        self._faces_left = MAX_MESH_FACES
        self._parts_left = MAX_MESH_PARTS

    def of_link(self, link: Any, place: NDArray[np.float64]) -> list[ReadMesh]:
        """The visible parts of a link that lies at ``place``."""
        found = []
        for visual in link.findall("visual"):
            self._parts_left -= 1
            geometry = visual.find("geometry")
            has_room = self._parts_left >= 0
            mesh = self._mesh(geometry) if has_room and geometry is not None else None
            self._faces_left -= 0 if mesh is None else len(mesh.faces)
            if not has_room or self._faces_left < 0:
                raise ValueError(
                    f"more than {MAX_MESH_PARTS:,} parts or {MAX_MESH_FACES:,} faces; leave some "
                    f"out"
                )
            if mesh is None:
                continue
            colour = self._colour_of(visual)
            if mesh.colours is None and colour is not None:
                mesh = replace(mesh, colours=SurfaceColours.plain(len(mesh.faces), colour))
            found.append(mesh.transformed(place @ _origin(visual)))
        return found

    def _colour_of(self, visual: Any) -> NDArray[np.uint8] | None:
        material = visual.find("material")
        if material is None:
            return None
        own = _colour(material)
        return self._colours.get(str(material.get("name"))) if own is None else own

    def _mesh(self, geometry: Any) -> ReadMesh | None:
        """A mesh file, or a box, cylinder or sphere."""
        for shape in geometry:
            if shape.tag == "mesh":
                return self._file(shape)
            if shape.tag == "box":
                return _of_trimesh(trimesh.creation.box(_numbers(shape.get("size", ""), 3)))
            radius = float(_numbers(shape.get("radius", ""), 1)[0])
            if shape.tag == "sphere":
                return _of_trimesh(trimesh.creation.icosphere(4, radius))
            if shape.tag == "cylinder":
                length = float(_numbers(shape.get("length", ""), 1)[0])
                return _of_trimesh(trimesh.creation.cylinder(radius, length, sections=64))
        return None

    def _file(self, shape: Any) -> ReadMesh | None:
        name = str(shape.get("filename", ""))
        if name not in self._paths:
            self._paths[name] = self._find(name)
        path = self._paths[name]
        if path is None:
            self.missing.append(name)
            self._source.warn(
                "link",
                f"the mesh {name[:100]} is missing in its folder; name its folder (textures)",
            )
            return None
        if path not in self._meshes:
            if path.suffix.lower() == ".urdf":
                raise ValueError("a URDF names a URDF as a mesh")
            part = self._source.beside(path)
            mesh = self._read_part(part)
            for warning in part.warnings:
                self._source.warn(warning.kind, f"{path.name}: {warning.text}")
            mesh = mesh.without_unused_vertices()
            self._meshes[path] = replace(mesh, vertices=mesh.vertices * UNITS[mesh.unit or "m"])
        mesh = self._meshes[path]
        T = np.eye(4)
        T[:3, :3] *= _numbers(shape.get("scale", "1 1 1"), 3)
        return mesh.transformed(T)

    def _find(self, name: str) -> Path | None:
        """``package://robot/meshes/a.stl`` and ``file://`` names: their ends are looked for in the
        folders."""
        scheme, _, rest = name.rpartition("://")
        parts = Path(rest).parts if is_file_name(rest) else ()
        if scheme == "package" and parts:
            self._open_package(parts[0])
        ends = [rest] if not scheme else ["/".join(parts[k:]) for k in range(len(parts))]
        found = next((end for end in ends if self._source.has(end)), None)
        if found is None:
            self._source.find(ends[-1] if ends else name)
            return None
        return self._source.find(found)

    def _open_package(self, name: str) -> None:
        """Look for files in the ROS package too whose folder ``urdf`` this URDF lies in."""
        folder = self._source.folder
        package = folder.parent
        is_package = folder.name in _URDF_FOLDERS or (package / "package.xml").is_file()
        if is_package and package.name == name and package not in self._source.extra:
            self._source.extra.append(package)


def _of_trimesh(mesh: trimesh.Trimesh) -> ReadMesh:
    return ReadMesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
