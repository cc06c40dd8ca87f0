"""Mesh files to one cleaned ``trimesh.Trimesh``, its measures, and a normalised model frame."""

import math
import warnings
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from ..errors import MAX_MESH_COORDINATE, MAX_MESH_FACES, MIN_MESH_EXTENT, CurviregWarning, MeshError, MissingFileError
from ..utils.checks import check_option
from ..utils.choices import MESHES, UNITS, UP_AXES
from .colours import SurfaceColours, surface_colours
from .files import read_mesh
from .up import format_up, mesh_up


def load_mesh(path: str | PathLike[str], *, unit: str = "m", up: str | None = None) -> trimesh.Trimesh:
    """Read a mesh file; scenes become one mesh, polygons become triangles, normals are ignored.

    Nothing is rescaled: vertices, and every pose computed from them, stay in the file's frame and unit.

    Args:
        path: .obj, .ply, .stl, .off, .glb or .gltf.
        unit: the file's unit of length ("m", "dm", "cm", "mm", "in", "ft"), kept in ``mesh.units``. An object that
            would be smaller than 5 mm or larger than 100 m gets a warning.
        up: the axis that points up ("x", "y", "z", "-x", "-y", "-z"), kept in ``mesh.metadata["up"]``; None: y for
            glTF, else z.

    Returns:
        Vertices (V, 3) float64, faces (F, 3) without degenerate ones, and textures and other colours as one
        :class:`SurfaceColours` in ``mesh.metadata["colours"]``.

    Raises:
        MissingFileError: the file does not exist.
        MeshError: the file is unreadable, empty, without faces, with NaN or infinite vertices, or beyond
            :mod:`curvireg_torch.errors`.
    """
    check_option(unit, UNITS, "unit")
    path = Path(path)
    up = format_up(path.suffix) if up is None else up
    check_option(up, UP_AXES, "up")
    if not path.is_file():
        raise MissingFileError("no such file; check the path of the mesh", subject=path)
    if path.suffix.lower() not in MESHES:
        raise MeshError(f"expected a mesh file ({', '.join(MESHES)}); convert it first", subject=path)
    mesh = as_mesh(read_mesh(path), name=str(path))
    mesh.units = unit
    mesh.metadata.update(file_name=path.name, up=up)
    size = float(np.linalg.norm(mesh.extents)) * UNITS[unit]
    if not 0.005 <= size <= 100.0:
        message = f"in unit {unit!r} the object is {size:g} m across; if that is wrong, give the unit (mm?)"
        warnings.warn(CurviregWarning(message, subject=path), stacklevel=2)
    return mesh


def as_mesh(source: Any, *, name: str = "mesh") -> trimesh.Trimesh:
    """One clean mesh from a path, a ``trimesh.Trimesh`` or a ``trimesh.Scene``; errors as :func:`load_mesh`."""
    if isinstance(source, str | PathLike):
        return load_mesh(source)
    if isinstance(source, trimesh.Scene):
        try:
            parts = _placed_parts(source)
            source = _concatenate(parts) if parts else None
        except Exception as error:  # singular transforms, unconnected parts, malformed vertices
            raise MeshError(f"its parts cannot be put together ({error}); re-export the file", subject=name) from error
    if not isinstance(source, trimesh.Trimesh):
        raise MeshError(_NO_FACES, subject=name)
    triangles, is_degenerate = _checked_triangles(source, name)
    colours = _colours(source)
    vertices, faces = np.asarray(source.vertices, dtype=np.float64), triangles[~is_degenerate]
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    mesh.remove_unreferenced_vertices()
    unit = mesh_unit(source)
    if unit is not None:  # trimesh keeps None as the word "none"
        mesh.units = unit
    mesh.metadata["up"] = mesh_up(source)
    if colours is not None:
        mesh.metadata["colours"] = colours[~is_degenerate]
    return mesh


_MANY_POINTS = 4096  # of a hull: to project more of them in every view costs more than to cast the rays

_NO_FACES = "expected a mesh with faces, got none; point clouds and curves cannot be rendered"


def _checked_triangles(mesh: trimesh.Trimesh, name: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(F, 3) faces, and (F,) whether a face has no area."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) == 0:
        raise MeshError(_NO_FACES, subject=name)
    if len(faces) > MAX_MESH_FACES:
        raise MeshError(f"{len(faces):,} faces, more than {MAX_MESH_FACES:,}; simplify it", subject=name)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(
            f"expected vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}", subject=name
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError("faces name vertices that do not exist; the file is damaged, re-export it", subject=name)
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        count = int((~np.isfinite(corners).all(axis=(1, 2))).sum())
        raise MeshError(f"{count} faces have NaN or infinite vertices; repair the mesh", subject=name)
    if float(np.abs(corners).max()) > MAX_MESH_COORDINATE:
        raise MeshError(f"vertices farther than {MAX_MESH_COORDINATE:g} from the origin; repair the mesh", subject=name)
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    if 0 < extent < MIN_MESH_EXTENT:
        raise MeshError(f"only {extent:.1g} units across; scale it up, or export it in a smaller unit", subject=name)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not (area > 0).any():
        raise MeshError("every face is degenerate (area 0); repair the mesh", subject=name)
    return faces, ~(area > 0)


def mesh_unit(mesh: trimesh.Trimesh) -> str | None:
    """The unit that ``mesh.units`` names, as a key of ``UNITS``; None where it names none of them.

    Example:
        >>> mesh = trimesh.creation.box()
        >>> mesh.units = "millimeters"
        >>> mesh_unit(mesh)
        'mm'
    """
    if mesh.units in UNITS:
        return str(mesh.units)
    try:
        metres = trimesh.units.unit_conversion(mesh.units, "meters")
    except (AttributeError, ValueError):
        return None
    return next((unit for unit, length in UNITS.items() if math.isclose(metres, length, rel_tol=1e-6)), None)


def _placed_parts(scene: trimesh.Scene) -> list[trimesh.Trimesh]:
    """The transformed meshes of a scene: ``scene.dump()`` takes time with the cube of a part's depth."""
    forest = scene.graph.transforms
    world = {scene.graph.base_frame: np.eye(4)}
    parts = []
    for node in scene.graph.nodes_geometry:
        path = [node]
        while path[-1] not in world and path[-1] in forest.parents:
            path.append(forest.parents[path[-1]])
        if path[-1] not in world:  # not below the base frame: trimesh searches the graph
            world[path[-1]] = scene.graph.get(path[-1])[0]
        for child, parent in zip(path[-2::-1], path[:0:-1], strict=True):
            world[child] = world[parent] @ forest.edge_data[parent, child].get("matrix", np.eye(4))
        part = scene.geometry[forest.node_data[node]["geometry"]]
        if isinstance(part, trimesh.Trimesh):
            parts.append(part.copy().apply_transform(world[node]))
    return parts


def _colours(mesh: trimesh.Trimesh) -> SurfaceColours | None:
    try:
        colours = surface_colours(mesh)
        if colours is not None and len(colours) != len(mesh.faces):
            raise ValueError(f"{len(colours)} for {len(mesh.faces)} faces")
        return colours
    except Exception as error:  # files may hold anything
        warnings.warn(f"the mesh's colours cannot be used ({error}); it is drawn in grey", stacklevel=2)
        return None


def _concatenate(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several. Their textures stay apart: trimesh would pack them into one that cannot repeat."""
    colours = [_colours(part) for part in parts]
    for part in parts:
        part.visual = trimesh.visual.ColorVisuals()
    mesh = trimesh.util.concatenate(parts)
    if any(c is not None for c in colours):
        known = [c or SurfaceColours.plain(len(part.faces)) for c, part in zip(colours, parts, strict=True)]
        mesh.metadata["colours"] = SurfaceColours.concatenate(known)
    return mesh


def extreme_points(mesh: trimesh.Trimesh) -> Tensor:
    """(P, 3) float64 vertices of the convex hull, which determine projected boxes.

    Of more than 4096 of them, those that are outermost in one of 2562 directions of the object scaled to equal extents:
    sides of boxes move by about 0.1 % of their length at most.
    """
    points = np.array(mesh.vertices, dtype=np.float64)
    with suppress(QhullError, ValueError):  # flat objects, and fewer than four points
        points = points[ConvexHull(points).vertices]
    if len(points) > _MANY_POINTS:
        directions = trimesh.creation.icosphere(subdivisions=4).vertices
        scaled, _, _ = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        outermost = [(some @ scaled.T).argmax(axis=1) for some in np.array_split(directions, 32)]  # bounded memory
        points = points[np.unique(np.concatenate(outermost))]
    return torch.from_numpy(points)


def box_corners(mesh: trimesh.Trimesh) -> Tensor:
    """(8, 3) float64 corners of the axis-aligned box, in model units."""
    return torch.cartesian_prod(*torch.from_numpy(np.array(mesh.bounds, dtype=np.float64)).T)


def mesh_centre(mesh: trimesh.Trimesh) -> Tensor:
    """(3,) float64 centre of the axis-aligned box, in model units."""
    return torch.from_numpy(np.asarray(mesh.bounds, dtype=np.float64).mean(axis=0))


def mesh_radius(mesh: trimesh.Trimesh) -> float:
    """Half the diagonal of the axis-aligned box, in model units."""
    return 0.5 * float(np.linalg.norm(mesh.extents))


def normalization_transform(mesh: trimesh.Trimesh, *, align_axes: bool = False) -> Tensor:
    """(4, 4) float64 similarity from the model's frame to a normalised frame.

    The area-weighted centroid goes to the origin and the farthest vertex to distance 1. With ``align_axes`` (the
    paper's normalisation) the principal axes of the surface go to x, y, z in decreasing order of variance. The third
    moments of the surface along x and y are positive; z completes a right-handed frame.

    Example:
        >>> T = normalization_transform(trimesh.creation.box((2.0, 4.0, 4.0)))
        >>> round(1 / float(T[0, 0]), 6)                                        # half the diagonal
        3.0
    """
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    area = np.asarray(mesh.area_faces, dtype=np.float64)
    centroid = np.average(corners.mean(axis=1), axis=0, weights=area)
    R = np.eye(3)
    if align_axes:
        # Edge midpoints integrate the second moments of a triangle exactly.
        points = (0.5 * (corners + np.roll(corners, 1, axis=1)) - centroid).reshape(-1, 3)
        weights = np.repeat(area / area.sum() / 3.0, 3)
        _, axes = np.linalg.eigh((points * weights[:, None]).T @ points)
        R = axes.T[::-1].copy()
        third = ((points @ R.T) ** 3 * weights[:, None]).sum(axis=0)
        R[:2] *= np.where(third[:2] < 0, -1.0, 1.0)[:, None]
        R[2] = np.cross(R[0], R[1])
    scale = 1.0 / np.linalg.norm(mesh.vertices - centroid, axis=1).max()
    T = np.eye(4)
    T[:3, :3] = scale * R
    T[:3, 3] = -scale * (R @ centroid)
    return torch.from_numpy(T)
