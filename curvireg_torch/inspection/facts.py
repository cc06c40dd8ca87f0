"""The state of a mesh: size, faces, parts, colours and symmetries, and what is wrong with it, in
words."""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from ..matching.describe import VIEW_FACES
from ..mesh import as_mesh, mesh_radius
from ..mesh.mesh import extreme_points
from ..mesh.sampling import surface_points
from ..utils.aliases import Fields
from ..utils.arrays import Floats
from ..utils.choices import UNITS
from ..utils.likes import MeshLike
from .surface import POINTS, Symmetry, looks_inwards, measured_symmetries, thin_fraction

# From which simplification is advised: reading and the first bank take longer than a photograph
MANY_FACES = 200_000
MANY_PARTS = 50
THIN = 0.02  # Shortest side of the box, as a fraction of the longest, of a thin mesh
# Area of the surface as a fraction of that of its convex hull, below which a mesh is a wire: a
# chair of tubes has 0.1
WIRE_AREA = 0.02
# Standard deviation of the distances from the middle, relative to their mean, below which a mesh is
# a sphere
SPHERE_SPREAD = 0.03
# Metres across between which a mesh is an object that someone photographs
SMALLEST = 0.005
LARGEST = 20.0
ROOM = 2.0  # Metres across from which faces that look inwards are those of a room
MUCH_THIN = 0.3  # Fraction of the surface of thin parts from which a warning says so
CONTINUOUS_TURN = 15.0  # Degrees below which a symmetry is one of a body of revolution


@dataclass(frozen=True)
class MeshFacts:
    """Numbers of a mesh that decide how well it can be registered.

    Attributes:
        unit: that of the mesh, None if unknown.
        extents: (3,) sides of the box, in that unit.
        diameter: twice the radius, in that unit.
        faces, parts: numbers of faces, and of connected parts.
        is_watertight: whether every edge has two faces.
        has_consistent_faces: whether neighbouring faces agree which of their sides is outside.
        doubled_faces: number of faces that exist twice.
        thin: fraction of the surface that belongs to parts thinner than 1 % of the diameter.
        area_of_hull: area of the surface as a fraction of that of the convex hull; a closed convex
            body has 1.
        is_coloured: whether colours vary over the surface.
        symmetries: rotations but the identity that leave the shape as it is.
        up: the axis that points up.
        verdicts: those of the warnings that say how its pose is seen, the gravest last.
        warnings: what is wrong, in words.
        is_hopeless: whether no photograph can show its pose.
    """

    unit: str | None
    extents: tuple[float, ...]
    diameter: float
    faces: int
    parts: int
    is_watertight: bool
    has_consistent_faces: bool
    doubled_faces: int
    thin: float
    area_of_hull: float
    is_coloured: bool
    symmetries: tuple[Symmetry, ...]
    up: str
    verdicts: tuple[str, ...]
    warnings: tuple[str, ...]
    is_hopeless: bool

    def to_dict(self) -> Fields:
        """JSON values; symmetries and warnings are keys of the whole report."""
        return {
            "unit": self.unit,
            "extents": list(self.extents),
            "diameter": self.diameter,
            "faces": self.faces,
            "parts": self.parts,
            "watertight": self.is_watertight,
            "consistent_faces": self.has_consistent_faces,
            "doubled_faces": self.doubled_faces,
            "thin": self.thin,
            "area_of_hull": self.area_of_hull,
            "coloured": self.is_coloured,
        }


def _convex_hull(points: Floats) -> trimesh.Trimesh | None:
    """The convex hull of points; None of flat ones."""
    try:
        return trimesh.convex.convex_hull(points)
    except (QhullError, ValueError):
        return None


def _flat_hull_area(points: Floats) -> float:
    """The area of both sides of the convex hull of flat points."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    try:
        return 2.0 * float(ConvexHull(points @ axes[:2].T).volume)
    except (QhullError, ValueError):  # on a line
        return 0.0


def mesh_facts(mesh: MeshLike) -> MeshFacts:
    """Examine a mesh.

    Example:
        >>> facts = mesh_facts(trimesh.creation.box((1, 2, 3)))
        >>> facts.faces, facts.is_watertight, len(facts.symmetries)
        (12, True, 3)
    """
    mesh = as_mesh(mesh)
    surface = mesh.surface
    unit = mesh.unit
    extents = np.ptp(mesh.vertices, axis=0)
    size = float(np.linalg.norm(extents))
    points = extreme_points(mesh).numpy()
    hull = _convex_hull(points)
    hull_area = _flat_hull_area(points) if hull is None else float(hull.area)
    area_of_hull = float(surface.area / max(hull_area, 1e-300))
    welded = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    welded.merge_vertices()  # files such as STL repeat the corners of each face
    rows = np.sort(welded.faces, axis=1)
    doubled_faces = len(rows) - len(trimesh.grouping.unique_rows(rows)[0])
    corners = trimesh.graph.connected_component_labels(
        welded.edges_unique, node_count=len(welded.vertices)
    )
    part = corners[welded.faces[:, 0]]
    parts = len(np.unique(part))
    symmetries = measured_symmetries(mesh)
    is_coloured = mesh.has_colours
    warnings = [warning.text for warning in mesh.warnings]
    warnings += _size_warnings(size, unit)
    if len(mesh.faces) > MANY_FACES:
        warnings.append(
            f"{len(mesh.faces):,} faces: contours use {VIEW_FACES:,}, and generated photographs "
            f"show it simplified; simplify it to {MANY_FACES:,}, and it loads faster"
        )
    if doubled_faces:
        warnings.append(
            f"{doubled_faces:,} faces exist twice: harmless here, but other programs draw them "
            f"flickering"
        )
    has_consistent_faces = bool(welded.is_winding_consistent)
    if not has_consistent_faces:
        warnings.append(
            "some faces are flipped: harmless here, but other programs draw them as holes"
        )
    if parts > MANY_PARTS:
        warnings.append(
            f"{parts:,} loose parts: leave out what no photograph shows, such as screws inside"
        )
    verdicts = []
    if extents.min() < THIN * extents.max():
        verdicts.append("thin: its pose is uncertain where it is seen from the edge")
    thin = thin_fraction(surface, part)
    if thin > MUCH_THIN:
        verdicts.append(
            f"{100 * thin:.0f} % of its surface is of parts thinner than 1 % of its size: they "
            f"cover few pixels"
        )
    is_sphere = _is_sphere(surface)
    is_large = unit is not None and size * UNITS[unit] > ROOM
    is_room = is_large and hull is not None and looks_inwards(surface, hull)
    is_wire = area_of_hull < WIRE_AREA
    if is_sphere and not is_coloured:
        verdicts.append(
            "a sphere: it looks the same from everywhere, so its rotation cannot be seen"
        )
    elif same := tuple(each for each in symmetries if each.has_same_colours):
        verdicts.append(_symmetry_warning(same))
    if is_wire:
        verdicts.append("hardly any surface, as of a wire: too thin for contours")
    if is_room:
        verdicts.append(
            "its faces look inwards, as a room's do, but only what is seen from outside can be "
            "registered; if it is an object, flip its faces"
        )
    return MeshFacts(
        unit=unit,
        extents=tuple(extents.tolist()),
        diameter=2.0 * mesh_radius(mesh),
        faces=len(mesh.faces),
        parts=parts,
        is_watertight=bool(welded.is_watertight),
        has_consistent_faces=has_consistent_faces,
        doubled_faces=doubled_faces,
        thin=thin,
        area_of_hull=area_of_hull,
        is_coloured=is_coloured,
        symmetries=symmetries,
        up=mesh.up,
        verdicts=tuple(verdicts),
        warnings=(*warnings, *verdicts),
        is_hopeless=is_room or is_wire or (is_sphere and not is_coloured),
    )


def _size_warnings(size: float, unit: str | None) -> list[str]:
    """What is unusual about the size of the box's diagonal, and which unit would be usual."""
    sizes = {name: size * UNITS[name] for name in ("mm", "cm", "m")}
    usual = {name: metres for name, metres in sizes.items() if SMALLEST < metres < LARGEST}
    guess = " or ".join(f"{name} ({metres:.2g} m)" for name, metres in usual.items())
    if unit is None:
        suggested = guess or "none that is usual"
        across = f"{size:.4g} across, which suggests {suggested}"
        return [f"its unit is unknown: {across}; give the unit"]
    metres = size * UNITS[unit]
    if SMALLEST < metres < LARGEST:
        return []
    suggested = f"; usual would be {guess}" if guess else ""
    across = f"{metres:,.0f}" if metres > LARGEST else f"{metres:.2g}"
    return [f"{across} m across: is its unit really {unit}{suggested}?"]


def _is_sphere(mesh: trimesh.Trimesh) -> bool:
    """Whether all points of the surface are about as far from its middle."""
    points = surface_points(mesh, POINTS)
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return bool(distance.std() < SPHERE_SPREAD * distance.mean())


def _symmetry_warning(symmetries: tuple[Symmetry, ...]) -> str:
    if any(symmetry.angle < CONTINUOUS_TURN for symmetry in symmetries):
        return "a body of revolution: its turn about the axis cannot be seen, and is not counted"
    worst = max(symmetry.deviation_percent for symmetry in symmetries)
    count = len(symmetries) + 1
    exactness = f"up to {worst:.2g} % of its diameter"
    return f"it looks the same in {count} orientations ({exactness}): a pose is one of as many"
