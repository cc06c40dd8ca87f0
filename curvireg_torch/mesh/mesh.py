"""One clean ``trimesh.Trimesh`` from files, scenes and meshes, and its measures."""

import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import wraps
from os import PathLike
from pathlib import Path
from typing import Any, Self, TypeVar, cast

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from ..errors import (
    MAX_MESH_COORDINATE,
    MAX_MESH_FACES,
    MIN_MESH_EXTENT,
    CurviregWarning,
    MeshError,
)
from ..formats.meshes.files import read_mesh
from ..formats.meshes.scenes import joined_scene
from ..formats.meshes.source import MeshWarning
from ..utils.checks import check_option
from ..utils.choices import UNITS, UP_AXES
from ..utils.likes import MeshLike
from .colours import colours_of_parts
from .health import precision_warning, stray_faces, stray_warning

Found = TypeVar("Found")


def load_mesh(
    path: str | PathLike[str],
    *,
    unit: str | None = None,
    up: str | None = None,
    link: str | None = None,
    textures: str | PathLike[str] | None = None,
) -> trimesh.Trimesh:
    """Read a mesh file; scenes become one mesh, polygons become triangles, normals are ignored.

    Nothing is rescaled: vertices, and every pose computed from them, stay in the file's frame and
    unit.

    Args:
        path: .obj, .ply, .stl, .off, .glb, .gltf, .3mf or .urdf; with the extra ``cad`` also .step,
            .stp, .iges, .igs and .dae.
        unit: the file's unit of length ("m", "dm", "cm", "mm", "in", "ft"), kept in ``mesh.units``.
            None: that which the file itself states (STEP, IGES, 3MF, Collada, USD; URDF is in m),
            else cm for USD, as OpenUSD does, and m for other formats. An object below 5 mm or above
            100 m gets a warning.
        up: the axis that points up ("x", "y", "z", "-x", "-y", "-z"), kept in
            ``mesh.metadata["up"]``; None: that which the file states, else y for glTF and z for
            other formats.
        link: the link of a URDF whose mesh is read, in the link's frame; None: all links, with all
            joints at zero.
        textures: a further folder in which files are looked for that the mesh names.

    Returns:
        Vertices (V, 3) float64, faces (F, 3) without degenerate ones and without small parts far
        away, and textures and other colours as one :class:`SurfaceColours` in
        ``mesh.metadata["colours"]``, which count if they vary (:func:`has_colours`). What the mesh
        lacks is in :func:`mesh_warnings`, and a :class:`CurviregWarning` each.

    Raises:
        MissingFileError: the file does not exist.
        MissingDependencyError: a package is needed for the format.
        MeshError: the file is unreadable, empty, without faces, with NaN or infinite vertices,
            beyond :mod:`curvireg_torch.errors`, or states another unit than ``unit``.

    Example:
        >>> import tempfile, trimesh
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "part.stl"
        ...     _ = trimesh.creation.box((100.0, 200.0, 300.0)).export(path)
        ...     mesh = load_mesh(path, unit="mm")
        >>> mesh_unit(mesh), len(mesh.faces)
        ('mm', 12)
    """
    path = Path(path)
    if unit is not None:
        check_option(unit, UNITS, "unit")
    if up is not None:
        check_option(up, UP_AXES, "up")
    found = read_mesh(path, link=link, textures=textures)
    if unit is not None and found.unit not in (None, unit):
        message = (
            f"the file states its unit, {found.unit}, which is not {unit!r}; leave the unit out"
        )
        raise MeshError(message, subject=path)
    whole = trimesh.Trimesh(found.vertices, found.faces, process=False)
    whole.metadata["colours"] = found.colours
    whole.metadata["warnings"] = found.warnings
    mesh = as_mesh(whole, name=str(path))
    mesh.units = unit or found.unit or found.usual_unit or "m"
    mesh.metadata.update(file_name=path.name, up=up or found.up or format_up(path.suffix))
    length = float(np.linalg.norm(mesh.extents))
    size = length * UNITS[mesh.units]
    if not _is_plausible(size):
        likely = next((name for name in LIKELY_UNITS if _is_plausible(length * UNITS[name])), None)
        advice = "" if found.unit else f"; if that is wrong, give the unit{_question(likely)}"
        message = f"in unit {mesh.units!r} the object is {size:g} m across{advice}"
        kind = "" if found.unit else "unit"
        warnings.warn(CurviregWarning(message, subject=path, kind=kind), stacklevel=2)
    for warning in mesh_warnings(mesh):
        warnings.warn(CurviregWarning(warning.text, subject=path), stacklevel=2)
    return mesh


LIKELY_UNITS = ("mm", "m", "cm", "in")  # in which files are written, the most frequent first


def _is_plausible(metres: float) -> bool:
    """Whether an object in a photograph may be so large."""
    return 0.005 <= metres <= 100.0


def _question(unit: str | None) -> str:
    return "" if unit is None else f" ({unit}?)"


def as_mesh(source: MeshLike, *, name: str = "mesh") -> trimesh.Trimesh:
    """One clean mesh from a path, a ``trimesh.Trimesh`` or a ``trimesh.Scene``; errors as
    :func:`load_mesh`.

    Example:
        >>> import trimesh
        >>> len(as_mesh(trimesh.Scene([trimesh.creation.box(), trimesh.creation.box()])).faces)
        24
    """
    if isinstance(source, str | PathLike):
        return load_mesh(source)
    noticed = list(mesh_warnings(source)) if isinstance(source, trimesh.Trimesh) else []
    if isinstance(source, trimesh.Scene):
        try:
            source, colours = joined_scene(source)
        except Exception as error:  # singular transforms, unconnected parts, malformed vertices
            raise MeshError(
                f"its parts cannot be put together ({error}); re-export the file", subject=name
            ) from error
    elif isinstance(source, trimesh.Trimesh):
        (colours,) = colours_of_parts([source])
    if not isinstance(source, trimesh.Trimesh) or len(source.faces) == 0:
        raise MeshError(_why_no_faces(source, noticed), subject=name)
    triangles, is_degenerate = checked_triangles(source, name)
    vertices = np.asarray(source.vertices, dtype=np.float64)
    mesh = trimesh.Trimesh(vertices=vertices, faces=triangles[~is_degenerate], process=False)
    colours = None if colours is None else colours[~is_degenerate]
    stray = stray_faces(mesh)
    if stray.any():
        noticed.append(stray_warning(mesh, stray))
        mesh = trimesh.Trimesh(vertices=vertices, faces=mesh.faces[~stray], process=False)
        colours = None if colours is None else colours[~stray]
    mesh.remove_unreferenced_vertices()
    noticed += [
        warning
        for warning in [precision_warning(mesh)]
        if warning is not None and warning not in noticed
    ]
    unit = mesh_unit(source)
    if unit is not None:  # trimesh keeps None as the word "none"
        mesh.units = unit
    mesh.metadata.update(file_name=source.metadata.get("file_name", ""), up=mesh_up(source))
    if noticed:
        mesh.metadata["warnings"] = tuple(noticed)
    if colours is not None:
        mesh.metadata["colours"] = colours
    return mesh


def _why_no_faces(source: object, noticed: Sequence[MeshWarning]) -> str:
    """What a mesh without faces is instead, or what was left out of it."""
    if noticed:
        return f"has no faces: {noticed[0].text}"
    points = len(source.vertices) if isinstance(source, trimesh.Trimesh) else 0
    if points:
        return (
            f"has {points:,} points and no faces: a cloud of points, splats or lines, which cannot "
            f"be rendered; reconstruct its surface, or export a mesh"
        )
    return "expected a mesh with faces, got none; points and curves cannot be rendered"


def mesh_warnings(mesh: trimesh.Trimesh) -> tuple[MeshWarning, ...]:
    """What a mesh lacks, or what was changed in it, as :func:`load_mesh` noticed.

    Example:
        >>> import trimesh
        >>> mesh_warnings(trimesh.creation.box())
        ()
    """
    found = mesh.metadata.get("warnings", ())
    return tuple(warning for warning in found if isinstance(warning, MeshWarning))


# Points of a hull: to project more of them in every view costs more than to cast the rays
MANY_POINTS = 4096


def checked_triangles(
    mesh: trimesh.Trimesh, name: str
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(F, 3) faces, and (F,) whether a face has no area; :class:`MeshError` for triangles that are
    no mesh."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) > MAX_MESH_FACES:
        raise MeshError(
            f"{len(faces):,} faces, more than {MAX_MESH_FACES:,}; simplify it", subject=name
        )
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        message = (
            f"expected vertices (V, 3) and faces (F, 3), got {vertices.shape} and {faces.shape}"
        )
        raise MeshError(message, subject=name)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(
            "faces name vertices that do not exist; the file is damaged, re-export it", subject=name
        )
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        count = int((~np.isfinite(corners).all(axis=(1, 2))).sum())
        raise MeshError(
            f"{count} faces have NaN or infinite vertices; repair the mesh", subject=name
        )
    if float(np.abs(corners).max()) > MAX_MESH_COORDINATE:
        raise MeshError(
            f"vertices farther than {MAX_MESH_COORDINATE:g} from the origin; repair the mesh",
            subject=name,
        )
    # 20 times as fast as by one reduction
    extent = max(float(np.ptp(corners[..., axis])) for axis in range(3))
    if 0 < extent < MIN_MESH_EXTENT:
        raise MeshError(
            f"only {extent:.1g} units across; scale it up, or export it in a smaller unit",
            subject=name,
        )
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    if not (area > 0).any():
        raise MeshError("every face is degenerate (area 0); repair the mesh", subject=name)
    return faces, ~(area > 0)


def mesh_unit(mesh: trimesh.Trimesh) -> str | None:
    """The unit that ``mesh.units`` names, as a key of ``UNITS``; None where it names none of
    them.

    Example:
        >>> import trimesh
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
    return next(
        (unit for unit, length in UNITS.items() if math.isclose(metres, length, rel_tol=1e-6)), None
    )


def format_up(suffix: str) -> str:
    """The axis that points up in files of a format: y in glTF, by its specification; else z, as in
    CAD."""
    return "y" if suffix.lower() in (".glb", ".gltf") else "z"


def mesh_up(mesh: trimesh.Trimesh) -> str:
    """The axis that :func:`load_mesh` noted, "z" for meshes from elsewhere; mesh and poses stay in
    the file's frame.

    Example:
        >>> import trimesh
        >>> mesh_up(trimesh.creation.box())
        'z'
    """
    return str(mesh.metadata.get("up", "z"))


MIRROR = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
"""The reflection that makes the mirror image of a mesh: of its x axis."""


def mirrored(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mirror image of a mesh's shape, without colours."""
    vertices = np.asarray(mesh.vertices) @ MIRROR.numpy()
    return trimesh.Trimesh(vertices, mesh.faces[:, [0, 2, 1]], process=False)


class _Measures(dict[str, Any]):
    """Measures of a geometry, by name. Copies of a mesh share them: one may be the mesh itself, and
    none changes."""

    def __deepcopy__(self, memo: Any) -> Self:
        return self


def measures_of(mesh: trimesh.Trimesh) -> dict[str, Any]:
    """What is known of a mesh with these vertices and faces, by the names of the functions that
    measure it; it travels with the mesh, as its metadata do. Banks store such values.

    Example:
        >>> import trimesh
        >>> mesh = trimesh.creation.box()
        >>> points, known = extreme_points(mesh), list(measures_of(mesh))
        >>> known, list(measures_of(mesh.apply_scale(2.0)))
        (['extreme_points'], [])
    """
    geometry = hash(mesh)
    of_geometry, known = mesh.metadata.get("measures", (None, None))
    if of_geometry != geometry:
        known = _Measures()
        mesh.metadata["measures"] = geometry, known
    return cast(dict[str, Any], known)


def cached_in_mesh(
    function: Callable[[trimesh.Trimesh], Found],
) -> Callable[[trimesh.Trimesh], Found]:
    """Decorate a function of a mesh whose value is one of :func:`measures_of` it; callers get
    copies of tensors."""
    name = function.__name__

    @wraps(function)
    def value_of(mesh: trimesh.Trimesh) -> Found:
        known = measures_of(mesh)
        if name not in known:
            known[name] = function(mesh)
        value = known[name]
        return cast(Found, value.clone() if isinstance(value, Tensor) else value)

    return value_of


@cached_in_mesh
def extreme_points(mesh: trimesh.Trimesh) -> Tensor:
    """(P, 3) float64 vertices of the convex hull, which determine projected boxes. Of more than
    4096 of them, those outermost in 2562 directions of the object scaled to equal extents: sides of
    boxes move by 0.1 % at most."""
    from scipy.spatial import ConvexHull, QhullError

    points = np.array(mesh.vertices, dtype=np.float64)
    with suppress(QhullError, ValueError):  # flat objects, and fewer than four points
        points = points[ConvexHull(points).vertices]
    if len(points) > MANY_POINTS:
        directions = trimesh.creation.icosphere(subdivisions=4).vertices
        scaled, _, _ = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        # bounded memory
        outermost = [(some @ scaled.T).argmax(axis=1) for some in np.array_split(directions, 32)]
        points = points[np.unique(np.concatenate(outermost))]
    return torch.from_numpy(points)


def box_corners(mesh: trimesh.Trimesh) -> Tensor:
    """(8, 3) float64 corners of the axis-aligned box, in model units."""
    return torch.cartesian_prod(*torch.from_numpy(np.array(mesh.bounds, dtype=np.float64)).T)


def mesh_centre(mesh: trimesh.Trimesh) -> Tensor:
    """(3,) float64 centre of the axis-aligned box, in model units.

    Example:
        >>> import trimesh
        >>> mesh = trimesh.creation.box((1.0, 2.0, 2.0))
        >>> mesh_centre(mesh.apply_translation([0.0, 0.0, 3.0])).tolist()
        [0.0, 0.0, 3.0]
    """
    return torch.from_numpy(np.asarray(mesh.bounds, dtype=np.float64).mean(axis=0))


def mesh_radius(mesh: trimesh.Trimesh) -> float:
    """Half the diagonal of the axis-aligned box, in model units.

    Example:
        >>> import trimesh
        >>> mesh_radius(trimesh.creation.box((1.0, 2.0, 2.0)))
        1.5
    """
    return 0.5 * float(np.linalg.norm(mesh.extents))


def normalization_transform(mesh: trimesh.Trimesh) -> Tensor:
    """(4, 4) float64 similarity from the model's frame to the paper's normalised frame.

    The area-weighted centroid goes to the origin and the farthest vertex to distance 1; the
    principal axes of the surface go to x, y, z in decreasing order of variance. The third moments
    of the surface along x and y are positive, and z completes a right-handed frame. Of axes with
    equal variance, rounding decides.

    Example:
        >>> T = normalization_transform(trimesh.creation.box((2.0, 4.0, 4.0)))
        >>> round(1 / float(torch.linalg.det(T[:3, :3])) ** (1 / 3), 6)        # half the diagonal
        3.0
    """
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    area = np.asarray(mesh.area_faces, dtype=np.float64)
    centroid = np.average(corners.mean(axis=1), axis=0, weights=area)
    # Edge midpoints integrate the second moments of a triangle exactly.
    points = (0.5 * (corners + np.roll(corners, 1, axis=1)) - centroid).reshape(-1, 3)
    weights = np.repeat(area / area.sum() / 3.0, 3)
    _, axes = np.linalg.eigh((points * weights[:, None]).T @ points)
    R = axes.T[::-1].copy()
    along = points @ R.T
    third = weights @ (along * along * along)  # a power takes longer
    R[:2] *= np.where(third[:2] < 0, -1.0, 1.0)[:, None]
    R[2] = np.cross(R[0], R[1])
    scale = 1.0 / np.linalg.norm(mesh.vertices - centroid, axis=1).max()
    T = np.eye(4)
    T[:3, :3] = scale * R
    T[:3, 3] = -scale * (R @ centroid)
    return torch.from_numpy(T)


@cached_in_mesh
def principal_rotation(mesh: trimesh.Trimesh) -> Tensor:
    """(3, 3) float64 rotation of :func:`normalization_transform`."""
    R = normalization_transform(mesh)[:3, :3]
    rotation: Tensor = R / torch.linalg.vector_norm(R[0])
    return rotation
