"""What a mesh's surface is like: symmetries of shape and colours, thin parts, and faces that look
inwards."""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from ..geometry import rotation_error
from ..mesh import Mesh, SurfaceColours, as_mesh, mesh_symmetries
from ..mesh.colours import VARIED_BY, VARIED_FRACTION, colours_at
from ..mesh.mesh import mesh_radius
from ..mesh.sampling import surface_points
from ..rendering.embree import RayScene
from ..utils.aliases import Fields
from ..utils.arrays import Floats, Integers
from ..utils.likes import MeshLike

POINTS = 2_000  # of the surface, of which samples consist
DENSER = 20  # Times so many points that others are compared with
# Times the fraction of neighbours with other colours up to which a symmetry keeps the colours
BORDERS = 1.5
# Powers of a symmetry, 2 to 8, that keep the colours too: small turns move a print by little
POWERS = 3
# Fractions of the diameter: thickness of a thin part, and how far inside a ray begins
THIN_PART = 0.01
INSIDE = 1e-5
# A room: so much of the convex hull is covered by faces within so many diameters of it, of which so
# many look inwards; hulls of more faces are round
ON_HULL = 0.02
COVERED = 0.5
INWARD = 0.9
MANY_HULL_FACES = 2_000


@dataclass(frozen=True)
class Symmetry:
    """A rotation that maps a mesh to itself.

    Attributes:
        transform: (4, 4) float64 of the model frame.
        angle: degrees.
        deviation_percent: mean distance of the rotated surface from the surface, in percent of the
            diameter.
        has_same_colours: whether it maps the colours to themselves too, or there are none.
    """

    transform: Tensor
    angle: float
    deviation_percent: float
    has_same_colours: bool

    def to_dict(self) -> Fields:
        return {
            "transform": self.transform.tolist(),
            "angle_deg": self.angle,
            "deviation_percent": self.deviation_percent,
            "same_colours": self.has_same_colours,
        }


def measured_symmetries(mesh: Mesh) -> tuple[Symmetry, ...]:
    """Rotations but the identity that leave the shape as it is, how exactly they do, and whether
    they leave the colours."""
    transforms = mesh_symmetries(mesh)
    if len(transforms) == 1:
        return ()
    surface = _ColouredPoints(mesh)
    angles = rotation_error(transforms[:, :3, :3], torch.eye(3, dtype=torch.float64)).tolist()
    return tuple(
        Symmetry(transform, angle, *surface.compared(transform))
        for transform, angle in zip(transforms[1:], angles[1:], strict=True)
    )


def look_symmetries(mesh: MeshLike) -> Tensor:
    """(S, 4, 4) rotations of a mesh that leave its shape and its colours as they are, the identity
    first.

    Example:
        >>> look_symmetries(trimesh.creation.box((1, 2, 3))).shape
        torch.Size([4, 4, 4])
    """
    same = [each.transform for each in measured_symmetries(as_mesh(mesh)) if each.has_same_colours]
    return torch.stack([torch.eye(4, dtype=torch.float64), *same])


def coloured_points(mesh: Mesh, colours: SurfaceColours, count: int) -> tuple[Floats, Floats]:
    """(N, 3) points of a mesh's surface, and their colours in [0, 1]."""
    points, faces = trimesh.sample.sample_surface(mesh.surface, count, seed=0)
    weights = trimesh.triangles.points_to_barycentric(mesh.surface.triangles[faces], points)
    return np.asarray(points), colours_at(colours, faces, *weights[:, 1:].T).astype(float)


class _ColouredPoints:
    """Points of a mesh's surface, and their colours if these vary."""

    def __init__(self, mesh: Mesh) -> None:
        self.colours = None
        if mesh.colours is not None and mesh.has_colours:
            self.points, self.colours = coloured_points(mesh, mesh.colours, DENSER * POINTS)
        else:
            self.points = surface_points(mesh.surface, DENSER * POINTS)
        self.tree = cKDTree(self.points)
        self.diameter = 2.0 * mesh_radius(mesh)
        self.some = self.points[::DENSER]
        # of points on one and the same surface
        distance, nearest = self.tree.query(self.some, k=2)
        self.spacing = float(distance[:, 1].mean())
        self.differing = self._differing(nearest[:, 1])

    def compared(self, transform: Tensor) -> tuple[float, bool]:
        """How far a rotation moves the points off the surface, in percent of the diameter, and
        whether it and its powers move them to points of their own colour."""
        distance, nearest = self._moved(transform)
        deviation = max(float(distance.mean()) - self.spacing, 0.0)
        # neighbours differ along the borders of a print
        most = BORDERS * self.differing + VARIED_FRACTION
        is_same = self._differing(nearest) <= most
        for _ in range(POWERS if self.colours is not None else 0):
            transform = transform @ transform
            is_same = is_same and self._differing(self._moved(transform)[1]) <= most
        return 100.0 * deviation / self.diameter, is_same

    def _moved(self, transform: Tensor) -> tuple[Floats, Integers]:
        """Distances from the surface of some points that are moved, and the points nearest to
        them."""
        moved = self.some @ transform[:3, :3].numpy().T + transform[:3, 3].numpy()
        distance, nearest = self.tree.query(moved)
        return distance, nearest

    def _differing(self, nearest: Integers) -> float:
        """Fraction of some points whose colours differ from those of others."""
        if self.colours is None:
            return 0.0
        difference = np.abs(self.colours[nearest] - self.colours[::DENSER]).max(axis=1)
        return float((difference > VARIED_BY / 255.0).mean())


def thin_fraction(mesh: trimesh.Trimesh, part: Integers) -> float:
    """Fraction of the surface behind which its own part, a number for each face (F,), is thinner
    than 1 % of the mesh's diameter.

    Example:
        >>> thin_fraction(trimesh.creation.box((1.0, 1.0, 0.001)), np.zeros(12, int)) > 0.9
        True
    """
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    diameter = 2.0 * mesh_radius(mesh)
    inwards = -mesh.face_normals[faces]
    # float32 rays need coordinates of about 1
    scene = RayScene((mesh.vertices - mesh.bounds.mean(axis=0)) / diameter, mesh.faces)
    starts = (points - mesh.bounds.mean(axis=0)) / diameter + INSIDE * inwards
    hit, _, _, distance = scene.hits(starts, inwards)
    # a part that reaches into another is not thin where it enters
    is_own = (hit >= 0) & (part[hit] == part[faces])
    return float((is_own & (distance < THIN_PART)).mean())


def looks_inwards(mesh: trimesh.Trimesh, hull: trimesh.Trimesh) -> bool:
    """Whether most of a mesh's convex hull is covered by faces that look inwards, as walls of a
    room do.

    Example:
        >>> box = trimesh.creation.box((5, 4, 3))
        >>> room = trimesh.Trimesh(box.vertices, box.faces[:, ::-1])
        >>> looks_inwards(box, box), looks_inwards(room, box)
        (False, True)
    """
    if len(hull.faces) > MANY_HULL_FACES:
        return False
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    offsets = (hull.face_normals * hull.triangles_center).sum(axis=1)
    depths = points @ hull.face_normals.T - offsets
    nearest = depths.argmax(axis=1)
    near = depths.max(axis=1) > -ON_HULL * 2.0 * mesh_radius(mesh)
    if near.mean() * mesh.area < COVERED * hull.area:
        return False
    cosines = (mesh.face_normals[faces] * hull.face_normals[nearest]).sum(axis=1)
    return bool((cosines[near] < 0.0).mean() > INWARD)
