"""Contours of a mesh at poses, from its edges and a few hundred rays instead of a rendered
picture."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..mesh.edges import MeshEdges
from ..mesh.mesh import mesh_centre, mesh_radius
from ..utils.rows import Rows
from .embree import RasterRenderer, RayScene, float32
from .renderer import DepthRenderer

MAX_OCCLUDING = 256  # Points per pose on occluding contours
MAX_CREASES = 128  # Points per pose on creases
# Places per pose on occluding contours at which visibility is tested; some are hidden
OCCLUDING_CANDIDATES = 640
CREASE_CANDIDATES = 256  # The same on creases
# Distance in px from the contour, on the outer side, at which a ray looks past the object
ASIDE = 1.0
# Least step in depth at an occluding contour, in object radii; smaller ones are dents of the
# surface
OCCLUSION_JUMP = 0.05
# Depth, in object radii, by which a crease may lie behind the surface that its ray hits
VISIBLE_TOLERANCE = 0.02
# Distance from a crease, as a fraction of the crop's side, at which the surface is looked up on
# both sides
CREASE_SCALE = 1.0 / 64.0
# Least change of the surface's slope across a crease at that distance: a fold of 20 degrees seen
# from the front
CREASE_BEND = 0.36
# Side in px of the largest crop for which the mesh is simplified to so many faces; 95 % of its
# surface moves by at most 0.3 px of that crop
LEVELS = ((64, 800), (128, 2500), (256, 8000))
NEAR_PLANE = 1e-3  # Depth in object radii below which points are not projected
BEHIND = 16  # Bit of a vertex nearer than that


@dataclass(frozen=True)
class ContourPoints(Rows):
    """Points (N, P, 3) on the contours of N views, float64 in model units, with unit ``normals``
    (N, P, 2) across the contour in the image; False in ``valid`` (N, P) marks padding. ``outline``
    (N, P) marks points with the background beside them. Normals of occluding contours point
    outward, those of creases have either sign."""

    model: Tensor
    normals: Tensor
    valid: Tensor
    outline: Tensor


class Contours(Protocol):
    """Contours of a mesh at any pose: :class:`MeshContours`, and :class:`.DeviceContours`.

    Attributes:
        device: of its tensors.
        centre, radius: of the object, (3,) and model units.
    """

    device: torch.device
    centre: Tensor
    radius: float

    def points(
        self, T_cam_from_model: Tensor, camera_matrices: Tensor, size: int, *, density: float = 1.0
    ) -> ContourPoints:
        """See :meth:`MeshContours.points`."""
        ...


class _Level:
    """A mesh simplified to at most ``max_faces`` faces, relative to its ``centre`` (3,)."""

    def __init__(
        self, mesh: trimesh.Trimesh, centre: np.ndarray, radius: float, max_faces: int
    ) -> None:
        self.centre = centre
        self.radius = radius
        self.edges = MeshEdges(mesh, centre, max_faces)
        self._vertices = float32(self.edges.vertices)
        self._scene = RayScene(self.edges.vertices / radius, self.edges.faces)

    def mesh(self) -> trimesh.Trimesh:
        """The simplified mesh, in the frame of the given one."""
        vertices = self.edges.vertices + self.centre
        return trimesh.Trimesh(vertices, self.edges.faces, process=False)

    def vertices_in_cameras(self, R: np.ndarray, position: np.ndarray) -> np.ndarray:
        """(N, V, 3) float32 vertices in the cameras' frames, of poses with rotations (N, 3, 3) and
        positions (N, 3) of the centre."""
        vertices: np.ndarray = R @ self._vertices.T + position[..., None]
        return vertices.transpose(0, 2, 1)

    def lengths_in_crop(
        self, vertices: np.ndarray, K: np.ndarray, size: int, pose: np.ndarray, edge: np.ndarray
    ) -> np.ndarray:
        """(M,) float32 lengths in px of edges ``edge`` (M,) in the poses ``pose`` (M,), whose
        vertices (N, V, 3) are in the cameras' frames; 0 for those outside the crop and behind the
        camera."""
        x, y, z = vertices.transpose(2, 0, 1)
        nearest = np.float32(NEAR_PLANE * self.radius)
        is_behind = z <= NEAR_PLANE * self.radius
        z = np.maximum(z, nearest)
        u = K[:, 0, 0, None] * x / z + K[:, 0, 2, None]
        v = K[:, 1, 1, None] * y / z + K[:, 1, 2, None]
        # One bit for each side of the crop beyond which a vertex lies: an edge is outside if its
        # ends share a bit.
        beyond = (
            (u < -0.5)
            + 2 * (v < -0.5)
            + 4 * (u > size - 0.5)
            + 8 * (v > size - 0.5)
            + BEHIND * is_behind
        )
        start, end = pose * u.shape[1] + self.edges.edges[edge].T
        beyond_start = beyond.take(start)
        beyond_end = beyond.take(end)
        is_outside = (beyond_start & beyond_end) | ((beyond_start | beyond_end) & BEHIND)
        across = u.take(end) - u.take(start)
        down = v.take(end) - v.take(start)
        length: np.ndarray = np.sqrt(across * across + down * down)
        length[is_outside != 0] = 0.0
        return length

    def depth_at(
        self, uv: np.ndarray, K: np.ndarray, R: np.ndarray, eye: np.ndarray, wanted: np.ndarray
    ) -> np.ndarray:
        """Depth (N, M) of the mesh at pixels (N, M, 2) that ``wanted`` (N, M) marks; inf elsewhere
        and beside the mesh."""
        focal_lengths = np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)
        rays = np.ones((*wanted.shape, 3), np.float32)
        rays[..., :2] = (uv - K[:, None, :2, 2]) / focal_lengths[:, None]
        rays = rays @ R
        origins = np.repeat(eye / self.radius, wanted.sum(axis=1), axis=0)
        depth = np.full(wanted.shape, np.inf, np.float32)
        depth[wanted] = self._scene.distance(origins, rays[wanted]) * self.radius
        return depth


@dataclass(frozen=True)
class _Views:
    """N poses of a mesh in square crops, as contours are looked for in them.

    Attributes:
        level: the mesh, simplified for the size of the crops.
        size: side of the crops in px.
        R, position, K: (N, 3, 3) rotations, (N, 3) positions of the mesh's centre, (N, 3, 3) camera
            matrices, float32.
        eye: (N, 3) float32 positions of the cameras, relative to the mesh's centre.
        vertices: (N, V, 3) float32 vertices in the cameras' frames.
        side: (N, E) bool, on which side of the plane through camera and edge the faces of the edge
            lie.
    """

    level: _Level
    size: int
    R: np.ndarray
    position: np.ndarray
    K: np.ndarray
    eye: np.ndarray
    vertices: np.ndarray
    side: np.ndarray

    def places(self, edge: np.ndarray, fraction: np.ndarray) -> "_Places":
        """Places on edges (N, M), at fractions (N, M) of their lengths."""
        rows = np.arange(len(edge))[:, None]
        ends = self.level.edges.edges[edge]  # (N, M, 2)
        start = self.vertices[rows, ends[..., 0]]
        along = self.vertices[rows, ends[..., 1]]
        along -= start
        at = start + fraction[..., None] * along
        sign = np.where(self.side[rows, edge], np.float32(-1.0), np.float32(1.0))
        normal = _across(_cross(start, along), self.K) * sign[..., None]
        return _Places(edge, fraction, at, normal)

    def pixels(self, at: np.ndarray) -> np.ndarray:
        """(N, M, 2) pixels of points (N, M, 3) in the cameras' frames."""
        depth = np.maximum(at[..., 2], np.float32(NEAR_PLANE * self.level.radius))
        pixels: np.ndarray = at @ self.K[:, :2].transpose(0, 2, 1) / depth[..., None]
        return pixels

    def depth_at(self, pixels: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """See :meth:`_Level.depth_at`."""
        return self.level.depth_at(pixels, self.K, self.R, self.eye, wanted)

    def smoothed(self, places: "_Places") -> "_Places":
        """Places whose normals are those of the smooth surface, where the mesh stands for one."""
        edges = self.level.edges
        ends = edges.edges[places.edge]
        start = edges.normals[ends[..., 0]]
        end = edges.normals[ends[..., 1]]
        surface_normal = start + places.fraction[..., None] * (end - start)
        smooth = _across(surface_normal @ self.R.transpose(0, 2, 1), self.K)
        product = smooth * places.normal
        cosine = product[..., 0] + product[..., 1]  # an eighth of the time of a sum
        agrees = edges.is_smooth[places.edge] & (np.abs(cosine) > 0.5)
        normal = np.where(agrees[..., None], np.sign(cosine)[..., None] * smooth, places.normal)
        return replace(places, normal=normal)

    def seen_on_occluding_contours(
        self, places: "_Places", valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N, M) bool: which of the ``valid`` places are not hidden and lie in front of something
        farther away, and which of these have the background beside them."""
        outside = self.pixels(places.at) + np.float32(ASIDE) * places.normal
        depth = self.depth_at(outside, valid)
        is_seen = valid & (depth - places.at[..., 2] > OCCLUSION_JUMP * self.level.radius)
        return is_seen, is_seen & np.isinf(depth)

    def seen_on_creases(self, places: "_Places", valid: np.ndarray) -> np.ndarray:
        """(N, M) bool: which of the ``valid`` places are not hidden, and fold the surface at the
        scale of the crop."""
        radius = self.level.radius
        z = places.at[..., 2]
        pixel = self.pixels(places.at)
        step = np.float32(CREASE_SCALE * self.size)
        is_seen = valid & (self.depth_at(pixel, valid) > z - VISIBLE_TOLERANCE * radius)
        aside = step * places.normal
        on_both_sides = np.concatenate([pixel + aside, pixel - aside], axis=1)
        depth = self.depth_at(on_both_sides, np.concatenate([is_seen, is_seen], axis=1))
        ahead, back = np.split(depth, 2, axis=1)
        with np.errstate(invalid="ignore"):
            bend = np.abs(ahead - 2.0 * z + back) / step * self.K[:, :1, 0] / z
            largest_jump = np.maximum(np.abs(ahead - z), np.abs(back - z))
        is_fold: np.ndarray = (
            is_seen & (bend > CREASE_BEND) & (largest_jump < 2.0 * OCCLUSION_JUMP * radius)
        )
        return is_fold


@dataclass(frozen=True)
class _Places:
    """Places (N, M) on edges of N views: the edge, the fraction of its length, the point (N, M, 3)
    in the camera's frame, and the unit normal (N, M, 2) across the edge in the image."""

    edge: np.ndarray
    fraction: np.ndarray
    at: np.ndarray
    normal: np.ndarray


class MeshContours:
    """Occluding contours and creases of a clean mesh (:func:`curvireg_torch.load_mesh`), at any
    pose.

    An edge of the mesh lies on an occluding contour where all of its faces are on one side of it,
    seen from the camera; creases are edges between faces that meet at an angle. Points are placed
    along these edges, evenly in the image. A ray one pixel outside an occluding contour tells the
    outline (nothing hit), an inner occluding contour (hit far behind) and what is hidden (hit in
    front); one at each crease tells whether it is seen.

    Example:
        >>> K = torch.tensor([[100.0, 0, 63.5], [0, 100.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64)[None]; T[0, 2, 3] = 4.0
        >>> points = MeshContours(trimesh.creation.box((2, 2, 2))).points(T, K[None], 128)
        >>> # the outline is that of the face in front
        >>> points.model[points.outline].abs().amax(dim=0).tolist()
        [1.0, 1.0, 1.0]
    """

    device = torch.device("cpu")

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.centre = mesh_centre(mesh)
        self.radius = mesh_radius(mesh)
        self._levels: dict[int, _Level] = {}
        for size, faces in reversed(LEVELS):  # each is simplified from the next finer one
            level = _Level(mesh, self.centre.numpy(), self.radius, faces)
            self._levels[size] = level
            mesh = level.mesh()

    def level_of(self, size: int) -> tuple[int, _Level]:
        """The largest crop that the simplified mesh for crops of ``size`` px serves, and this
        mesh."""
        limit = next((limit for limit, _ in LEVELS if size <= limit), LEVELS[-1][0])
        return limit, self._levels[limit]

    def renderer(self, size: int) -> DepthRenderer:
        """Draws the mesh, simplified for crops of ``size`` px."""
        return RasterRenderer(self.level_of(size)[1].mesh())

    def points(
        self, T_cam_from_model: Tensor, camera_matrices: Tensor, size: int, *, density: float = 1.0
    ) -> ContourPoints:
        """Contour points of N poses (N, 4, 4) in square crops of ``size`` px with cameras (N, 3,
        3); float64, CPU. ``density`` is a fraction of the usual number of points."""
        T = T_cam_from_model.numpy()
        K = camera_matrices.expand(len(T_cam_from_model), 3, 3).numpy()
        _, level = self.level_of(size)
        edges = level.edges
        R = T[:, :3, :3]
        position = R @ self.centre.numpy() + T[:, :3, 3]
        eye = -(position[:, None] @ R)[:, 0]
        on_contour, side = edges.sides(eye)
        vertices = level.vertices_in_cameras(float32(R), float32(position))
        views = _Views(
            level, size, float32(R), float32(position), float32(K), float32(eye), vertices, side
        )
        pose, edge = np.nonzero(on_contour | edges.is_crease)
        length = level.lengths_in_crop(vertices, views.K, size, pose, edge)
        is_occluding = on_contour[pose, edge]

        def points_on(
            chosen: np.ndarray, candidates: int, most: int, *, occluding: bool
        ) -> tuple[np.ndarray, ...]:
            """``most`` points of each pose on the ``chosen`` (M,) edges, of ``candidates`` whose
            visibility is tested: the fields of :class:`ContourPoints`."""
            number, fraction, valid = _spread(
                pose[chosen], length[chosen], len(T), round(density * candidates)
            )
            places = views.places(np.append(edge[chosen], 0)[number], fraction)
            if occluding:
                places = views.smoothed(places)
                is_seen, is_outline = views.seen_on_occluding_contours(places, valid)
            else:
                is_seen = views.seen_on_creases(places, valid)
                is_outline = np.zeros_like(is_seen)
            index, is_point = _evenly(is_seen, round(density * most))
            rows = np.arange(len(T))[:, None]
            from_centre = (places.at[rows, index] - views.position[:, None]).astype(np.float64)
            model = from_centre @ R + self.centre.numpy()
            normals = places.normal[rows, index].astype(np.float64)
            return model, normals, is_point, is_outline[rows, index] & is_point

        contours = points_on(is_occluding, OCCLUDING_CANDIDATES, MAX_OCCLUDING, occluding=True)
        creases = points_on(~is_occluding, CREASE_CANDIDATES, MAX_CREASES, occluding=False)
        together = (np.concatenate(parts, axis=1) for parts in zip(contours, creases, strict=True))
        return ContourPoints(*map(torch.from_numpy, together))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The first two components of the cross products of (N, M, 3)."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    return np.stack([x, y], axis=-1)


def _across(plane: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Unit normals (N, M, 2) of the image lines in which planes through the camera, with normals
    (N, M, 2 or 3), appear."""
    focal_lengths = np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)
    normal = plane[..., :2] / focal_lengths[:, None]
    length = np.hypot(normal[..., :1], normal[..., 1:])
    unit: np.ndarray = normal / np.maximum(length, np.float32(1e-30))
    return unit


def _spread(
    pose: np.ndarray, length: np.ndarray, poses: int, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``count`` places for each of N ``poses``, evenly along its edges of lengths (M,); ``pose``
    (M,) are the edges' poses, ascending. Returns (N, count): the number of the edge, the fraction
    of its length, whether there is one."""
    # Lengths up to each edge; poses after the last edge are within an endless one.
    before = np.zeros(len(length) + 2)
    np.cumsum(length, out=before[1:-1])
    before[-1] = np.inf
    borders = np.searchsorted(pose, np.arange(poses + 1))
    first = borders[:-1, None]
    last = np.maximum(borders[1:, None] - 1, 0)
    total = np.diff(before[borders])[:, None]
    target = before[first] + (np.arange(count) + 0.5) / count * total
    number = np.clip(np.searchsorted(before, target) - 1, first, last)
    start = before[number]
    length_of_edge = before[number + 1] - start
    fraction = (target - start) / np.maximum(length_of_edge, 1e-30)
    has_edges = np.broadcast_to(total > 0, number.shape)
    return number, fraction.clip(0.0, 1.0).astype(np.float32), has_edges


def _evenly(valid: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N, most) of valid entries (N, M), evenly chosen where there are more, and which are
    not padding."""
    count = valid.sum(axis=1, keepdims=True)
    column = np.append(np.nonzero(valid)[1], 0)
    first = count.cumsum()[:, None] - count
    place = np.arange(most)[None]
    rank = np.where(count > most, place * count // most, place)
    is_point = place < count
    return column[np.where(is_point, first + rank, -1)], is_point
