"""Edges of a mesh and the contours that they form at a pose, without a rendered picture."""

import math

import fast_simplification
import numpy as np
import torch.nn.functional as F
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from ..utils.arrays import Floats, Integers, Singles
from .alignment import are_near
from .sampling import surface_points

WELD = 1e-6  # Vertices nearer than this fraction of the mesh's longest side are one
CREASE_ANGLE = 15.0  # Degrees between two faces from which their common edge is a crease
# Degrees between two faces below which the surface counts as smooth across their edge
SMOOTH_ANGLE = 40.0
# Points of a surface, and of the simplified one, by which lost parts are noticed: more than a
# fraction of the former lies farther than this, in radii, from the latter
LOST_POINTS = 1_000
KEPT_POINTS = 5_000
LOST_FRACTION = 0.02
LOST_DISTANCE = 0.1
# Radius at which such a mesh is simplified again: the tolerances of fast_simplification are
# absolute, and grow until there are few enough faces. Of 95 furniture meshes in metres, cut to 800
# faces, 24 lose a tenth of their surface (beyond 0.05 radii), and 3 at this radius. Scans keep
# their outlines better without it: of 8 photographs of T-LESS all are within 15 degrees, else 4
FINE_RADIUS = 1000.0
# Faces of an edge that are looked at; polygon soups have edges with more than two
MAX_EDGE_FACES = 4


class MeshEdges:
    """Unique edges of a mesh that is simplified to ``max_faces``, the planes of their faces, and
    which of them are creases. Polygon soups work: vertices are welded, doubled faces count once,
    and the orientation of faces does not matter.

    Attributes:
        vertices: (V, 3) float64, relative to ``centre``.
        faces: (F, 3) int.
        edges: (E, 2) vertices of each edge.
        normals: (V, 3) float32 unit vectors, means of the normals of the faces around each vertex.
        is_crease, is_smooth: (E,) bool.
    """

    def __init__(self, mesh: trimesh.Trimesh, centre: Floats, max_faces: int) -> None:
        self.vertices, self.faces = vertices, faces = simplified(mesh, centre, max_faces)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        self._plane = np.cross(b - a, c - a)  # length: twice the area
        self._offset = (self._plane * a).sum(axis=1)
        directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        owner = np.tile(np.arange(len(faces)), 3)
        sign = np.where(directed[:, 0] < directed[:, 1], 1.0, -1.0)
        directed.sort(axis=1)
        row, edge = _unique(directed)
        self.edges = directed[row]
        order = np.argsort(edge, kind="stable")
        first = np.searchsorted(edge[order], np.arange(len(self.edges)))
        count = np.bincount(edge, minlength=len(self.edges))
        # closed meshes have two faces at every edge
        depth = min(MAX_EDGE_FACES, max(2, int(count.max(initial=1))))
        slot = first[:, None] + np.minimum(np.arange(depth), count[:, None] - 1)
        # (E, depth), the last one repeated
        self._edge_faces = owner[order][slot]
        self._signs = signs = sign[order][slot]
        boundary = count == 1
        many = count > 2
        # Unit vectors within the faces, away from the edge: they do not depend on the orientation
        # of faces.
        along = vertices[self.edges[:, 1]] - vertices[self.edges[:, 0]]
        normal = self._plane / np.maximum(np.linalg.norm(self._plane, axis=1), 1e-300)[:, None]
        inward = np.cross(normal[self._edge_faces] * signs[..., None], along[:, None])
        inward /= np.maximum(np.linalg.norm(inward, axis=2), 1e-300)[..., None]
        cosine = (inward[:, 0] * inward[:, 1]).sum(axis=1)
        angle = np.where(boundary, 0.0, np.pi - np.arccos(np.clip(cosine, -1.0, 1.0)))
        self.is_crease = (angle > math.radians(CREASE_ANGLE)) | many
        self.is_smooth = (angle < math.radians(SMOOTH_ANGLE)) & ~boundary & ~many
        total = np.zeros_like(vertices)
        for k in range(3):
            np.add.at(total, faces[:, k], self._plane)
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
        self.normals: Singles = normals.astype(np.float32)

    def side_planes(self) -> Floats:
        """(k, E, 4) float64 planes (n, d) of the faces of each edge, as :func:`occluding_edges`
        looks at them: n . x + d has the sign of ((a - x) x (b - x)) . corner, with the ends a and b
        of the edge and the third corner of the face, seen from x relative to ``centre``."""
        planes = np.concatenate([-self._plane, self._offset[:, None]], axis=1)
        return np.asarray(self._signs.T[..., None] * planes[self._edge_faces.T])


def occluding_edges(side_planes: Tensor, eye: Tensor) -> tuple[Tensor, Tensor]:
    """Which edges are on the occluding contour, seen from cameras ``eye`` (N, 3) relative to the
    centre: (N, E) bool, whether the third corners of all faces lie on one side of the plane through
    camera and edge; and (N, E) bool, whether this is the side that the ``side_planes`` (k, E, 4) of
    :meth:`MeshEdges.side_planes` point to."""
    k, E, _ = side_planes.shape
    distance = F.pad(eye, (0, 1), value=1.0) @ side_planes.view(k * E, 4).mT
    sides = (distance > 0).view(-1, k, E)
    first = sides[:, 0]
    all_same = sides[:, 1] == first
    for other in range(2, k):
        all_same &= sides[:, other] == first
    return all_same, first


def encloses_volumes(mesh: trimesh.Trimesh) -> bool:
    """Whether each edge has two faces, which run along it in opposite directions, apart from faces
    without area, and every connected surface has its outer side outside."""
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)
    _, number = _unique(
        np.round(vertices / max(np.ptp(vertices, axis=0).max() * WELD, 1e-300)).astype(np.int64)
    )
    corners = number[faces]
    has_area = (corners != np.roll(corners, -1, axis=1)).all(axis=1)
    welded = trimesh.Trimesh(vertices, corners[has_area], process=False)
    if not (has_area.any() and welded.is_watertight and welded.is_winding_consistent):
        return False
    label = trimesh.graph.connected_component_labels(welded.edges, node_count=len(vertices))
    body = label[welded.faces[:, 0]]
    volume = np.bincount(body, np.linalg.det(vertices[faces[has_area]] - vertices.mean(axis=0)))
    return bool((volume[np.unique(body)] > 0).all())


def simplified(mesh: trimesh.Trimesh, centre: Floats, max_faces: int) -> tuple[Floats, Integers]:
    """Vertices (V, 3) float64 relative to ``centre`` and faces (F, 3) of a mesh, welded, F at most
    about ``max_faces``; more where fewer would lose parts of it."""
    vertices, faces = _welded(
        np.asarray(mesh.vertices, np.float64) - centre, np.asarray(mesh.faces)
    )
    if len(faces) <= max_faces:
        return vertices, faces
    found = _collapsed(vertices, faces, max_faces)
    if not _has_lost_parts(vertices, faces, *found):
        return found
    scale = FINE_RADIUS / np.abs(vertices).max()
    points, triangles = _collapsed(scale * vertices, faces, max_faces)
    return points / scale, triangles


def _collapsed(vertices: Floats, faces: Integers, max_faces: int) -> tuple[Floats, Integers]:
    """Vertices and faces after edges were collapsed, welded."""
    points, triangles = fast_simplification.simplify(
        vertices.astype(np.float32), faces.astype(np.int32), target_count=max_faces
    )
    return _welded(points.astype(np.float64), triangles)


def _has_lost_parts(vertices: Floats, faces: Integers, points: Floats, triangles: Integers) -> bool:
    """Whether a simplified surface has nothing near a part of the whole one."""
    if not len(triangles):
        return True
    whole = surface_points(trimesh.Trimesh(vertices, faces, process=False), LOST_POINTS)
    left = surface_points(trimesh.Trimesh(points, triangles, process=False), KEPT_POINTS, seed=1)
    tolerance = LOST_DISTANCE * np.abs(vertices).max()
    return bool((~are_near(cKDTree(left), whole, tolerance)).mean() > LOST_FRACTION)


def _welded(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """Vertices at the same place joined, and each triangle once, without those of no area."""
    cell = np.ptp(vertices, axis=0).max() * WELD
    index, inverse = _unique(np.round(vertices / cell).astype(np.int64))
    a, b, c = inverse[faces].T
    has_area = (a != b) & (b != c) & (c != a)
    # parts that are smaller than a cell: welding would leave nothing of the mesh
    if not has_area.any():
        return vertices, faces
    vertices = vertices[index]
    faces = inverse[faces][has_area]
    first, _ = _unique(np.sort(faces, axis=1))
    return vertices, faces[np.sort(first)]


def _unique(rows: Integers) -> tuple[Integers, Integers]:
    """Indices of the distinct rows of whole numbers (N, K), in lexical order, so that edges of one
    vertex are neighbours, and the number of each row among them; much faster than ``np.unique``
    with an axis."""
    index, inverse = trimesh.grouping.unique_rows(rows)
    order = np.lexsort(rows[index].T[::-1])
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return index[order], number[inverse]
