"""Contours of a mesh at poses, from its edges and a few hundred rays instead of a rendered picture."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
import trimesh
from torch import Tensor

from ..mesh.edges import MeshEdges
from ..mesh.mesh import mesh_centre, mesh_radius
from .embree import RayScene, float32

MAX_OCCLUDING, MAX_CREASES = 256, 128  # Points per pose on occluding contours and on creases
OCCLUDING_CANDIDATES, CREASE_CANDIDATES = 640, 256  # Places per pose at which visibility is tested; some are hidden
ASIDE = 1.0  # Distance in px from the contour, on the outer side, at which a ray looks past the object
# Least step in depth at an occluding contour, in object radii; smaller ones are dents of the surface
OCCLUSION_JUMP = 0.05
VISIBLE_TOLERANCE = 0.02  # Depth, in object radii, by which a crease may lie behind the surface that its ray hits
# Distance from a crease, as a fraction of the crop's side, at which the surface is looked up on both sides
CREASE_SCALE = 1.0 / 64.0
# Least change of the surface's slope across a crease at that distance: a fold of 20 degrees seen from the front
CREASE_BEND = 0.36
# Side in px of the largest crop for which the mesh is simplified to so many faces; 95 % of its surface moves by at most
# 0.3 px of that crop
LEVELS = ((64, 800), (128, 2500), (256, 8000))
NEAR_PLANE = 1e-3  # Depth in object radii below which points are not projected


@dataclass(frozen=True)
class ContourPoints:
    """Points (N, P, 3) on the contours of N views, float64 in model units, with unit ``normals`` (N, P, 2) across the
    contour in the image; False in ``valid`` (N, P) marks padding. ``outline`` (N, P) marks points with the background
    beside them. Normals of occluding contours point outward, those of creases have either sign."""

    model: Tensor
    normals: Tensor
    valid: Tensor
    outline: Tensor

    def __getitem__(self, index: Tensor) -> "ContourPoints":
        return ContourPoints(*(getattr(self, f.name)[index] for f in fields(ContourPoints)))

    @staticmethod
    def cat(parts: Sequence["ContourPoints"]) -> "ContourPoints":
        return ContourPoints(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(ContourPoints)))


class _Level:
    """A mesh simplified to at most ``max_faces`` faces, relative to its ``centre`` (3,)."""

    def __init__(self, mesh: trimesh.Trimesh, centre: np.ndarray, radius: float, max_faces: int) -> None:
        self.radius, self.edges = radius, MeshEdges(mesh, centre, max_faces)
        self._vertices = float32(self.edges.vertices)
        self._scene = RayScene(self.edges.vertices / radius, self.edges.faces)

    def seen(
        self, R: np.ndarray, position: np.ndarray, K: np.ndarray, size: int, of: np.ndarray, edge: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N, V, 3) float32 vertices in the cameras' frames, and (M,) float32 lengths in px of edges ``edge`` (M,) of
        the poses ``of`` (M,); 0 for those outside the crop and behind the camera."""
        vertices = R @ self._vertices.T + position[..., None]
        x, y, z = vertices.transpose(1, 0, 2)
        behind = z <= NEAR_PLANE * self.radius
        z = np.maximum(z, np.float32(NEAR_PLANE * self.radius))
        fx, fy, cx, cy = (K[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        u, v = fx * x / z + cx, fy * y / z + cy
        beyond = (u < -0.5) + 2 * (v < -0.5) + 4 * (u > size - 0.5) + 8 * (v > size - 0.5) + 16 * behind
        a, b = of * u.shape[1] + self.edges.edges[edge].T
        (ua, ub), (va, vb), (at_a, at_b) = ((x.take(a), x.take(b)) for x in (u, v, beyond))
        outside = (at_a & at_b) | ((at_a | at_b) & 16)
        length: np.ndarray = np.sqrt((ub - ua) ** 2 + (vb - va) ** 2) * (outside == 0)
        return vertices.transpose(0, 2, 1), length

    def depth_at(self, uv: np.ndarray, K: np.ndarray, R: np.ndarray, eye: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Depth (N, M) of the mesh at pixels (N, M, 2) that ``at`` (N, M) marks; inf elsewhere and beside the mesh."""
        xy = (uv - K[:, None, :2, 2]) / np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)[:, None]
        rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ R
        origins = np.broadcast_to((eye / self.radius)[:, None], rays.shape)
        depth = np.full(at.shape, np.inf, np.float32)
        depth[at] = self._scene.distance(origins[at], rays[at]) * self.radius
        return depth


class MeshContours:
    """Occluding contours and creases of a clean mesh (:func:`curvireg_torch.load_mesh`), at any pose.

    An edge of the mesh lies on an occluding contour where all of its faces are on one side of it, seen from the camera;
    creases are edges between faces that meet at an angle. Points are placed along these edges, evenly in the image. A
    ray one pixel outside an occluding contour tells the outline (nothing hit), an inner occluding contour (hit far
    behind) and what is hidden (hit in front); one at each crease tells whether it is seen.

    Example:
        >>> K = torch.tensor([[100.0, 0, 63.5], [0, 100.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64)[None]; T[0, 2, 3] = 4.0
        >>> points = MeshContours(trimesh.creation.box((2, 2, 2))).points(T, K[None], 128)
        >>> points.model[points.outline].abs().amax(dim=0).tolist()      # the outline is that of the face in front
        [1.0, 1.0, 1.0]
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.centre, self.radius = mesh_centre(mesh), mesh_radius(mesh)
        self._levels: dict[int, _Level] = {}
        for size, faces in reversed(LEVELS):  # each is simplified from the next finer one
            self._levels[size] = level = _Level(mesh, self.centre.numpy(), self.radius, faces)
            mesh = trimesh.Trimesh(level.edges.vertices + self.centre.numpy(), level.edges.faces, process=False)

    def points(
        self, T_cam_from_model: Tensor, camera_matrices: Tensor, size: int, *, density: float = 1.0
    ) -> ContourPoints:
        """Contour points of N poses (N, 4, 4) in square crops of ``size`` px with cameras (N, 3, 3); float64, CPU.
        ``density`` is a fraction of the usual number of points."""
        T, K = T_cam_from_model.numpy(), camera_matrices.expand(len(T_cam_from_model), 3, 3).numpy()
        level = self._levels[next((limit for limit, _ in LEVELS if size <= limit), LEVELS[-1][0])]
        edges = level.edges
        position = T[:, :3, :3] @ self.centre.numpy() + T[:, :3, 3]
        eye = -(position[:, None] @ T[:, :3, :3])[:, 0]
        on_contour, side = edges.sides(eye)
        R, position, K, eye = (float32(each) for each in (T[:, :3, :3], position, K, eye))
        of, edge = np.nonzero(on_contour | edges.is_crease)
        vertices, length = level.seen(R, position, K, size, of, edge)
        is_occluding = on_contour[of, edge]
        rows, parts = np.arange(len(T))[:, None], []
        for chosen, count, most, occluding in (
            (is_occluding, OCCLUDING_CANDIDATES, MAX_OCCLUDING, True),
            (~is_occluding, CREASE_CANDIDATES, MAX_CREASES, False),
        ):
            number, fraction, valid = _spread(of[chosen], length[chosen], len(T), round(density * count))
            index = np.append(edge[chosen], 0)[number]
            ends = edges.edges[index]  # (N, M, 2)
            a, along = vertices[rows, ends[..., 0]], vertices[rows, ends[..., 1]]
            along -= a
            at = a + fraction[..., None] * along
            z = at[..., 2]
            normal = _across(_cross(a, along), K) * np.where(side[rows, index], -1, 1).astype(np.float32)[..., None]
            if occluding:  # of a smooth surface, interpolate the vertices' normals
                n0, n1 = edges.normals[ends[..., 0]], edges.normals[ends[..., 1]]
                smooth = _across((n0 + fraction[..., None] * (n1 - n0)) @ R.transpose(0, 2, 1), K)
                agreement = (smooth * normal).sum(axis=-1)
                agree = edges.is_smooth[index] & (np.abs(agreement) > 0.5)
                normal = np.where(agree[..., None], np.sign(agreement)[..., None] * smooth, normal)
            pixel = at @ K[:, :2].transpose(0, 2, 1) / np.maximum(z, np.float32(NEAR_PLANE * self.radius))[..., None]
            if occluding:
                hit = level.depth_at(pixel + np.float32(ASIDE) * normal, K, R, eye, valid)
                valid &= hit - z > OCCLUSION_JUMP * self.radius
                outline = valid & np.isinf(hit)
            else:
                step = np.float32(CREASE_SCALE * size)
                valid &= level.depth_at(pixel, K, R, eye, valid) > z - VISIBLE_TOLERANCE * self.radius
                ahead, back = (level.depth_at(pixel + k * normal, K, R, eye, valid) for k in (step, -step))
                with np.errstate(invalid="ignore"):
                    bend = np.abs(ahead - 2.0 * z + back) / step * K[:, :1, 0] / z
                    flat = np.maximum(np.abs(ahead - z), np.abs(back - z)) < 2.0 * OCCLUSION_JUMP * self.radius
                valid &= (bend > CREASE_BEND) & flat
                outline = np.zeros_like(valid)
            chosen, valid = _evenly(valid, round(density * most))
            model = (at[rows, chosen] - position[:, None]).astype(np.float64) @ T[:, :3, :3] + self.centre.numpy()
            parts.append((model, normal[rows, chosen].astype(np.float64), valid, outline[rows, chosen] & valid))
        return ContourPoints(*(torch.from_numpy(np.concatenate(each, axis=1)) for each in zip(*parts, strict=True)))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The first two components of the cross products of (N, M, 3)."""
    return np.stack([a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1], a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]], -1)


def _across(plane: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Unit normals (N, M, 2) of the image lines in which planes through the camera, with normals (N, M, 2 or 3),
    appear."""
    n = plane[..., :2] / np.stack([K[:, 0, 0], K[:, 1, 1]], axis=1)[:, None]
    unit: np.ndarray = n / np.maximum(np.hypot(n[..., :1], n[..., 1:]), np.float32(1e-30))
    return unit


def _spread(of: np.ndarray, length: np.ndarray, poses: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``count`` places for each of N ``poses``, evenly along its edges of lengths (M,); ``of`` (M,) are the edges'
    poses, ascending. Returns (N, count): the number of the edge, the fraction of its length, whether there is one."""
    end = np.concatenate([[0.0], np.nan_to_num(length).cumsum(dtype=np.float64)])
    borders = np.searchsorted(of, np.arange(poses + 1))
    start, total = end[borders[:-1], None], np.diff(end[borders])[:, None]
    target = start + (np.arange(count) + 0.5) / count * total
    number = np.clip(np.searchsorted(end, target) - 1, borders[:-1, None], np.maximum(borders[1:, None] - 1, 0))
    fraction = (target - end[number]) / np.maximum(np.diff(end, append=np.inf)[number], 1e-30)
    return number, fraction.clip(0.0, 1.0).astype(np.float32), np.broadcast_to(total > 0, number.shape).copy()


def _evenly(valid: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (N, most) of valid entries (N, M), evenly chosen where there are more, and which are not padding."""
    order = np.argsort(~valid, axis=1, kind="stable")
    count = valid.sum(axis=1, keepdims=True)
    k = np.arange(most)[None]
    rank = np.where(count > most, (k * np.maximum(count, 1)) // most, k)
    return np.take_along_axis(order, np.minimum(rank, valid.shape[1] - 1), axis=1), k < count
