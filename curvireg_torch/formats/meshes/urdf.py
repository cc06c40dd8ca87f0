"""URDF: the visible meshes of a robot's links, all joints at zero, as one rigid mesh; or those of
one link.

yourdfpy reads the same tree of joints. It would replace some 60 lines here, not the search for
meshes, their bounds and colours, and would bring lxml as another dependency.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.transformations import compose_matrix

from ...errors import MAX_TABLE_BYTES, MeshError
from ...utils.aliases import Fields
from ...utils.arrays import Floats
from ...utils.choices import UNITS
from ..xml_files import read_xml
from .colours import SurfaceColours, byte_colours
from .limits import check_faces, check_parts
from .source import MeshSource, ReadMesh, fixed_numbers, is_file_name

_URDF_FOLDERS = ("robots", "urdf")  # of ROS packages, beside their meshes
ReadPart = Callable[[MeshSource], ReadMesh]
Colour = tuple[Any, ...]


def read_urdf(source: MeshSource, read_part: ReadPart, link: str | None = None) -> ReadMesh:
    """Read the meshes that a URDF names, in metres, in the frame of its root link or of ``link``; z
    is up."""
    if source.path.stat().st_size > MAX_TABLE_BYTES:
        raise ValueError(f"larger than {MAX_TABLE_BYTES:,} bytes")
    robot = read_xml(source.data())
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
    return replace(ReadMesh.joined(parts), unit="m", up="z")


def _places(robot: Any, links: Fields) -> dict[str, Floats]:
    """The place of each link in the root's frame, all joints at zero."""
    above: dict[str, tuple[str, Floats]] = {}
    for joint in robot.findall("joint"):
        parent = joint.find("parent")
        child = joint.find("child")
        if parent is None or child is None:
            raise ValueError("a joint without parent or child")
        above[str(child.get("link"))] = (str(parent.get("link")), _origin(joint))
    below = defaultdict(list)
    for name, (parent_name, _) in above.items():
        below[parent_name].append(name)
    places = {name: np.eye(4) for name in {*links, *below} - above.keys()}
    waiting = [*places]
    for parent_name in waiting:  # which grows
        for name in below[parent_name]:
            places[name] = places[parent_name] @ above[name][1]
        waiting += below[parent_name]
    if not links.keys() <= places.keys():
        raise ValueError("its joints form a circle")
    return {name: places[name] for name in links}


def _origin(element: Any) -> Floats:
    """(4, 4) of an ``origin``: roll, pitch and yaw about fixed axes, and a translation."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    rpy = fixed_numbers(origin.get("rpy", "0 0 0"), 3)
    xyz = fixed_numbers(origin.get("xyz", "0 0 0"), 3)
    return np.asarray(compose_matrix(angles=rpy, translate=xyz))


def _colour(material: Any) -> Colour | None:
    """The bytes of a material's ``color``, None without one."""
    colour = material.find("color")
    if colour is None:
        return None
    return tuple(byte_colours(fixed_numbers(colour.get("rgba", "1 1 1 1"), 4)[:3]))


class _Parts:
    """The visible parts of links; each mesh file is read once."""

    def __init__(
        self, source: MeshSource, read_part: ReadPart, colours: dict[str, Colour | None]
    ) -> None:
        self._source = source
        self._read_part = read_part
        self._colours = colours
        self._meshes: dict[str, ReadMesh | None] = {}
        self.missing: list[str] = []
        self._faces = 0
        self._visuals = 0

    def of_link(self, link: Any, place: Floats) -> list[ReadMesh]:
        """The visible parts of a link that lies at ``place``."""
        found = []
        for visual in link.findall("visual"):
            self._visuals += 1
            check_parts(self._visuals)
            mesh = self._mesh(visual)
            if mesh is None:
                continue
            self._faces += len(mesh.faces)
            check_faces(self._faces)
            material = visual.find("material")
            if mesh.colours is None and material is not None:
                colour = _colour(material) or self._colours.get(str(material.get("name")))
                if colour is not None:
                    mesh = replace(mesh, colours=SurfaceColours.plain(len(mesh.faces), colour))
            found.append(mesh.transformed(place @ _origin(visual)))
        return found

    def _mesh(self, visual: Any) -> ReadMesh | None:
        """A mesh file, or a box, sphere, cylinder or capsule; None, with a warning, of others."""
        for shape in visual.findall("geometry/*"):
            if shape.tag == "mesh":
                return self._file(shape)
            if shape.tag == "box":
                size = fixed_numbers(shape.get("size", ""), 3)
                return ReadMesh.of_surface(trimesh.creation.box(size))
            if shape.tag not in ("sphere", "cylinder", "capsule"):
                text = f"its shape {shape.tag[:50]} is not read and is left out"
                self._source.warn("link", text)
                continue
            (radius,) = fixed_numbers(shape.get("radius", ""), 1)
            if shape.tag == "sphere":
                return ReadMesh.of_surface(trimesh.creation.icosphere(4, radius))
            (length,) = fixed_numbers(shape.get("length", ""), 1)
            if shape.tag == "cylinder":
                cylinder = trimesh.creation.cylinder(radius, length, sections=64)
                return ReadMesh.of_surface(cylinder)
            return ReadMesh.of_surface(trimesh.creation.capsule(length, radius, count=(64, 64)))
        return None

    def _file(self, shape: Any) -> ReadMesh | None:
        name = str(shape.get("filename", ""))
        if name not in self._meshes:
            self._meshes[name] = self._read(name)
        mesh = self._meshes[name]
        scale = fixed_numbers(shape.get("scale", "1 1 1"), 3)
        return None if mesh is None else mesh.transformed(np.diag([*scale, 1.0]))

    def _read(self, name: str) -> ReadMesh | None:
        """The mesh of a file in metres; None, with a warning, without the file."""
        path = self._find(name)
        if path is None:
            self.missing.append(name)
            self._source.warn(
                "link",
                f"the mesh {name[:100]} is missing in its folder; name its folder (textures)",
            )
            return None
        if path.suffix.lower() == ".urdf":
            raise ValueError("a URDF names a URDF as a mesh")
        part = self._source.beside(path)
        mesh = self._read_part(part).without_unused_vertices()
        for warning in part.warnings:
            self._source.warn(warning.kind, f"{path.name}: {warning.text}")
        return replace(mesh, vertices=mesh.vertices * UNITS[mesh.unit or "m"])

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
