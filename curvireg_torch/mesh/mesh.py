"""One clean mesh from files, scenes and other meshes, and its measures."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..errors import (
    MAX_MESH_COORDINATE,
    MAX_MESH_FACES,
    MIN_MESH_EXTENT,
    CurviregWarning,
    MeshError,
)
from ..formats.meshes.colours import SurfaceColours, colours_of_parts
from ..formats.meshes.files import read_mesh
from ..formats.meshes.scenes import joined_scene
from ..formats.meshes.source import MeshWarning
from ..utils.aliases import Fields, PathName
from ..utils.arrays import Flags, Floats, Integers
from ..utils.checks import check_option
from ..utils.choices import UNITS, UP_AXES, unit_of_length
from ..utils.likes import MeshLike
from .colours import colours_vary
from .health import precision_warning, stray_faces, stray_warning

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A clean surface with what is known about it, made by :func:`load_mesh` or :func:`as_mesh`. It
    does not change: ``dataclasses.replace`` makes another one.

    Attributes:
        surface: its triangles, not to be changed.
        unit: of lengths, "m", "dm", "cm", "mm", "in" or "ft"; None if it is unknown.
        up: the axis that points up, "x", "y", "z", "-x", "-y" or "-z". The surface and poses stay
            in the file's frame.
        colours: textures and other colours of the faces; None without.
        warnings: what the mesh lacks, or what was changed in it, as :func:`load_mesh` noticed.
        file_name: "" without a file.
        measures: of the mesh, by the names of the functions that compute them; filled as they are
            wanted.

    Example:
        >>> import trimesh
        >>> mesh = Mesh(trimesh.creation.box((1.0, 2.0, 2.0)), unit="cm")
        >>> mesh.vertices.shape, mesh.faces.shape, mesh.extents.tolist(), mesh.has_colours
        ((8, 3), (12, 3), [1.0, 2.0, 2.0], False)
    """

    surface: trimesh.Trimesh
    unit: str | None = None
    up: str = "z"
    colours: SurfaceColours | None = None
    warnings: tuple[MeshWarning, ...] = ()
    file_name: str = ""
    measures: Fields = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.unit is not None:
            check_option(self.unit, UNITS, "unit")
        check_option(self.up, UP_AXES, "up")

    @property
    def vertices(self) -> Floats:
        """(V, 3)."""
        return np.asarray(self.surface.vertices)

    @property
    def faces(self) -> Integers:
        """(F, 3) indices of vertices."""
        return np.asarray(self.surface.faces)

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest coordinates."""
        return np.asarray(self.surface.bounds)

    @property
    def extents(self) -> Floats:
        """(3,) sides of the axis-aligned box."""
        return np.asarray(self.surface.extents)

    @cached_property
    def has_colours(self) -> bool:
        """Whether colours vary over the surface: one plain material is no print. The only place
        where it is decided; symmetries, appearance and fits to colours follow it."""
        return self.colours is not None and colours_vary(self.colours, self.surface.area_faces)


def load_mesh(
    path: PathName,
    *,
    unit: str | None = None,
    up: str | None = None,
    link: str | None = None,
    textures: PathName | None = None,
) -> Mesh:
    """Read a mesh file; scenes become one mesh, polygons become triangles, normals are ignored.

    Nothing is rescaled: vertices, and every pose computed from them, stay in the file's frame and
    unit.

    Args:
        path: .obj, .ply, .stl, .off, .glb, .gltf, .3mf or .urdf; with the extra ``cad`` also .step,
            .stp, .iges, .igs and .dae.
        unit: the file's unit of length ("m", "dm", "cm", "mm", "in", "ft"). None: that which the
            file itself states (STEP, IGES, 3MF, Collada, USD; URDF is in m), else cm for USD, as
            OpenUSD does, and m for other formats. An object below 5 mm or above 100 m gets a
            warning.
        up: the axis that points up ("x", "y", "z", "-x", "-y", "-z"); None: that which the file
            states, else y for glTF and z for other formats.
        link: the link of a URDF whose mesh is read, in the link's frame; None: all links, with all
            joints at zero.
        textures: a further folder in which files are looked for that the mesh names.

    Returns:
        The mesh, without degenerate faces and small parts far away. What it lacks is in its
        ``warnings``, and a :class:`CurviregWarning` each.

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
        >>> mesh.unit, mesh.up, len(mesh.faces)
        ('mm', 'z', 12)
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
    unit = unit or found.unit or found.usual_unit or "m"
    mesh = replace(
        _cleaned(whole, found.colours, found.warnings, str(path)),
        unit=unit,
        up=up or found.up or format_up(path.suffix),
        file_name=path.name,
    )
    length = float(np.linalg.norm(mesh.extents))
    size = length * UNITS[unit]
    if not _is_plausible(size):
        likely = next((name for name in LIKELY_UNITS if _is_plausible(length * UNITS[name])), None)
        question = f" ({likely}?)" if likely else ""
        advice = "" if found.unit else f"; if that is wrong, give the unit{question}"
        message = f"in unit {unit!r} the object is {size:g} m across{advice}"
        kind = "" if found.unit else "unit"
        warnings.warn(CurviregWarning(message, subject=path, kind=kind), stacklevel=2)
    for warning in mesh.warnings:
        warnings.warn(CurviregWarning(warning.text, subject=path), stacklevel=2)
    return mesh


LIKELY_UNITS = ("mm", "m", "cm", "in")  # in which files are written, the most frequent first


def _is_plausible(metres: float) -> bool:
    """Whether an object in a photograph may be so large."""
    return 0.005 <= metres <= 100.0


def as_mesh(source: MeshLike, *, name: str = "mesh") -> Mesh:
    """A mesh from a path, a ``trimesh.Trimesh`` or a ``trimesh.Scene``, whose ``units`` are kept;
    a :class:`Mesh` as it is. Errors are those of :func:`load_mesh`.

    Example:
        >>> import trimesh
        >>> len(as_mesh(trimesh.Scene([trimesh.creation.box(), trimesh.creation.box()])).faces)
        24
    """
    if isinstance(source, Mesh):
        return source
    if isinstance(source, str | PathLike):
        return load_mesh(source)
    given: Any = source
    whole = given
    colours = None
    if isinstance(source, trimesh.Scene):
        try:
            found = joined_scene(source)
        except Exception as error:  # singular transforms, unconnected parts, malformed vertices
            raise MeshError(
                f"its parts cannot be put together ({error}); re-export the file", subject=name
            ) from error
        whole = trimesh.Trimesh(found.vertices, found.faces, process=False)
        colours = found.colours
    elif isinstance(source, trimesh.Trimesh):
        (colours,) = colours_of_parts([source])
    mesh = _cleaned(whole, colours, (), name)
    return replace(mesh, unit=_unit_of(given), file_name=given.metadata.get("file_name", ""))


def _cleaned(
    source: Any, colours: SurfaceColours | None, noticed: Sequence[MeshWarning], name: str
) -> Mesh:
    """A surface and its colours without degenerate and stray faces, and what was ``noticed`` in its
    file or now."""
    if not isinstance(source, trimesh.Trimesh) or len(source.faces) == 0:
        raise MeshError(_why_no_faces(source, noticed), subject=name)
    triangles, is_degenerate = checked_triangles(source, name)
    vertices = np.array(source.vertices, dtype=np.float64)  # the source may change
    surface = trimesh.Trimesh(vertices=vertices, faces=triangles[~is_degenerate], process=False)
    colours = None if colours is None else colours[~is_degenerate]
    stray = stray_faces(surface)
    found = [*noticed]
    if stray.any():
        found.append(stray_warning(surface, stray))
        surface = trimesh.Trimesh(vertices=vertices, faces=surface.faces[~stray], process=False)
        colours = None if colours is None else colours[~stray]
    surface.remove_unreferenced_vertices()
    if (rounded := precision_warning(surface)) is not None:
        found.append(rounded)
    return Mesh(surface, colours=colours, warnings=tuple(found))


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


# Points of a hull: to project more of them in every view costs more than to cast the rays
MANY_POINTS = 4096


def checked_triangles(mesh: trimesh.Trimesh, name: str) -> tuple[Integers, Flags]:
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
    if np.abs(corners).max() > MAX_MESH_COORDINATE:
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


def _unit_of(surface: Any) -> str | None:
    """The unit that ``surface.units`` names, as a key of ``UNITS``; None where it names none of
    them."""
    if surface.units in UNITS:
        return str(surface.units)
    try:
        metres = trimesh.units.unit_conversion(surface.units, "meters")
    except (AttributeError, ValueError):
        return None
    return unit_of_length(metres)


def format_up(suffix: str) -> str:
    """The axis that points up in files of a format: y in glTF, by its specification; else z, as in
    CAD."""
    return "y" if suffix.lower() in (".glb", ".gltf") else "z"


def measure(function: Callable[[trimesh.Trimesh], Value]) -> Callable[[Any], Value]:
    """Decorate a function of a surface: a :class:`Mesh` keeps its value among its ``measures``, and
    callers get copies of tensors."""
    name = function.__name__

    @wraps(function)
    def value_of(mesh: Any) -> Value:
        if not isinstance(mesh, Mesh):
            return function(mesh)
        if name not in mesh.measures:
            mesh.measures[name] = function(mesh.surface)
        value = mesh.measures[name]
        return cast(Value, value.clone() if isinstance(value, Tensor) else value)

    return value_of


@measure
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


def box_corners(mesh: Mesh | trimesh.Trimesh) -> Tensor:
    """(8, 3) float64 corners of the axis-aligned box, in model units."""
    return torch.cartesian_prod(*torch.from_numpy(np.array(mesh.bounds, dtype=np.float64)).T)


def mesh_centre(mesh: Mesh | trimesh.Trimesh) -> Tensor:
    """(3,) float64 centre of the axis-aligned box, in model units.

    Example:
        >>> import trimesh
        >>> mesh = trimesh.creation.box((1.0, 2.0, 2.0))
        >>> mesh_centre(mesh.apply_translation([0.0, 0.0, 3.0])).tolist()
        [0.0, 0.0, 3.0]
    """
    return torch.from_numpy(np.asarray(mesh.bounds, dtype=np.float64).mean(axis=0))


def mesh_radius(mesh: Mesh | trimesh.Trimesh) -> float:
    """Half the diagonal of the axis-aligned box, in model units.

    Example:
        >>> import trimesh
        >>> mesh_radius(trimesh.creation.box((1.0, 2.0, 2.0)))
        1.5
    """
    return 0.5 * float(np.linalg.norm(mesh.extents))


@measure
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


def principal_rotation(mesh: Mesh | trimesh.Trimesh) -> Tensor:
    """(3, 3) float64 rotation of :func:`normalization_transform`."""
    R = normalization_transform(mesh)[:3, :3]
    rotation: Tensor = R / torch.linalg.vector_norm(R[0])
    return rotation
