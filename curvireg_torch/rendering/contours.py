"""Contours of a mesh at many poses, from its edges and a few hundred rays instead of a rendered
picture; on a CPU and on other devices."""

from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from ..mesh.edges import MeshEdges, occluding_edges
from ..mesh.mesh import Mesh, mesh_centre, mesh_radius
from ..utils.rows import Rows
from .embree import RasterRenderer
from .renderer import DepthRenderer
from .visibility import FaceTests, RayCaster

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
LENGTH_UNITS = 2.0**20  # Parts of a px in which lengths of edges are measured
EDGES_AT_A_TIME = 2**22  # Edges of all poses that are looked at together


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


class MeshContours:
    """Occluding contours and creases of a clean mesh (:func:`curvireg_torch.load_mesh`), at many
    poses at a time.

    An edge of the mesh lies on an occluding contour where all of its faces are on one side of it,
    seen from the camera; creases are edges between faces that meet at an angle. Points are placed
    along these edges, evenly in the image. A ray one pixel outside an occluding contour tells the
    outline (nothing hit), an inner occluding contour (hit far behind) and what is hidden (hit in
    front); one at each crease tells whether it is seen. Rays are cast on a CPU, and tested against
    all faces on other devices.

    Attributes:
        device: of all tensors; see :meth:`to`.
        centre, radius: of the object, (3,) and model units.

    Example:
        >>> K = torch.tensor([[100.0, 0, 63.5], [0, 100.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64)[None]; T[0, 2, 3] = 4.0
        >>> points = MeshContours(trimesh.creation.box((2, 2, 2))).points(T, K[None], 128)
        >>> # the outline is that of the face in front
        >>> points.model[points.outline].abs().amax(dim=0).round(decimals=4).tolist()
        [1.0, 1.0, 1.0]
    """

    device = torch.device("cpu")

    def __init__(self, mesh: Mesh | trimesh.Trimesh) -> None:
        self.centre = mesh_centre(mesh)
        self.radius = mesh_radius(mesh)
        self._edges: dict[int, MeshEdges] = {}
        self._levels: dict[int, _Level] = {}
        for size, faces in reversed(LEVELS):  # each is simplified from the next finer one
            self._edges[size] = MeshEdges(mesh, self.centre.numpy(), faces)
            mesh = self._mesh(size)

    def __getstate__(self) -> dict[str, object]:
        """All but what is computed on first use, with ray casters that cannot be copied."""
        return {**vars(self), "_levels": {}}

    def to(self, device: torch.device | str) -> "MeshContours":
        """The contours of the same mesh on a device."""
        if torch.device(device) == self.device:
            return self
        other = copy(self)
        other.device = torch.device(device)
        other.centre = self.centre.to(device)
        other._levels = {}
        return other

    def renderer(self, size: int) -> DepthRenderer:
        """Draws the mesh, simplified for crops of ``size`` px."""
        return RasterRenderer(self._mesh(_limit(size)))

    def points(
        self, T_cam_from_model: Tensor, camera_matrices: Tensor, size: int, *, density: float = 1.0
    ) -> ContourPoints:
        """Contour points of N poses (N, 4, 4) in square crops of ``size`` px with cameras (N, 3,
        3), float64. ``density`` is a fraction of the usual number of points."""
        level = self._level(_limit(size))
        K = camera_matrices.expand(len(T_cam_from_model), 3, 3)
        count = max(1, EDGES_AT_A_TIME // len(level.ends))
        parts = zip(T_cam_from_model.split(count), K.split(count), strict=True)
        found = [_Views(level, self.centre, T, K, size).points(density) for T, K in parts]
        return found[0] if len(found) == 1 else ContourPoints.cat(found)

    def _level(self, limit: int) -> "_Level":
        if limit not in self._levels:
            self._levels[limit] = _Level(self._edges[limit], self.radius, self.device)
        return self._levels[limit]

    def _mesh(self, limit: int) -> trimesh.Trimesh:
        """The simplified mesh, in the frame of the given one."""
        edges = self._edges[limit]
        return trimesh.Trimesh(
            edges.vertices + self.centre.cpu().numpy(), edges.faces, process=False
        )


def _limit(size: int) -> int:
    """The largest crop that the simplified mesh for crops of ``size`` px serves."""
    return next((limit for limit, _ in LEVELS if size <= limit), LEVELS[-1][0])


class _Level:
    """The edges of a simplified mesh on a device, with lengths in object radii."""

    def __init__(self, edges: MeshEdges, radius: float, device: torch.device) -> None:
        self.radius = radius
        self.device = device
        self.vertices = self._tensor(edges.vertices / radius, torch.float32)
        self.starts = self._tensor(edges.edges[:, 0], torch.long).contiguous()
        self.ends = self._tensor(edges.edges[:, 1], torch.long).contiguous()
        self.normals = self._tensor(edges.normals, torch.float32)
        self.creases = self._tensor(edges.is_crease.nonzero()[0], torch.long)
        self.listed = torch.cat([torch.arange(len(self.starts), device=device), self.creases])
        self.is_smooth = self._tensor(edges.is_smooth, torch.bool)
        self.side_planes = self._tensor(edges.side_planes(), torch.float64)
        self.visibility = _visibility(edges.vertices / radius, edges.faces, device)

    def _tensor(self, values: object, dtype: torch.dtype) -> Tensor:
        return torch.as_tensor(values).to(self.device, dtype)


def _visibility(
    vertices: np.ndarray, faces: np.ndarray, device: torch.device
) -> RayCaster | FaceTests:
    if device.type == "cpu":
        return RayCaster(vertices, faces)
    return FaceTests(vertices, faces, device)


@dataclass(frozen=True)
class _Places(Rows):
    """Places (N, M) on edges of N views: the edge, the fraction of its length, the point (N, M, 3)
    in the camera's frame, and the unit normal (N, M, 2) across the edge in the image; False in
    ``valid`` (N, M) where a view has no such edges."""

    edge: Tensor
    fraction: Tensor
    at: Tensor
    normal: Tensor
    valid: Tensor


class _Columns:
    """M columns of a table of views: first those on occluding contours, of kind 0, then those on
    creases, of kind 1. ``sizes`` and ``each`` (2,) tell how many there are of each kind, ``kind``
    (M,) the kind of each column, ``place`` (M,) its number within the kind, of ``of_kind``
    (M,)."""

    def __init__(self, occluding: int, creases: int, device: torch.device) -> None:
        self.sizes = [occluding, creases]
        self.each = torch.tensor(self.sizes, device=device)
        self.kind = torch.arange(2, device=device).repeat_interleave(self.each)
        self.place = torch.arange(len(self.kind), device=device) - occluding * self.kind
        self.of_kind = self.each[self.kind]

    def __len__(self) -> int:
        return len(self.kind)


@lru_cache(maxsize=16)
def _columns(density: float, occluding: int, creases: int, device: torch.device) -> _Columns:
    """A ``density``, the fraction of these numbers."""
    return _Columns(round(density * occluding), round(density * creases), device)


class _Views:
    """N poses of a mesh in square crops of ``size`` px, as contours are looked for in them; lengths
    are in object radii."""

    def __init__(self, level: _Level, centre: Tensor, T: Tensor, K: Tensor, size: int) -> None:
        self.level = level
        self.centre = centre
        self.size = size
        self.R = T[:, :3, :3]
        position = (self.R @ centre + T[:, :3, 3]) / level.radius
        eye = -(position[:, None] @ self.R)[:, 0]
        self.on_contour, self.side = occluding_edges(level.side_planes, level.radius * eye)
        self.rotation = self.R.float()
        self.position = position.float()[:, None]
        self.vertices = torch.baddbmm(
            self.position, level.vertices.expand(len(T), -1, -1), self.rotation.mT
        )
        self.depth_of = level.visibility.seen_from(self.R, position)
        K = K.float()
        self.focal_lengths = torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=1)[:, None]
        self._project_vertices(K[:, None, :2, 2])

    def _project_vertices(self, principal_points: Tensor) -> None:
        """The pixels u + iv of all vertices, and a bit for each side of the crop beyond which one
        lies."""
        pixels = torch.addcmul(principal_points, _rays_to(self.vertices), self.focal_lengths)
        last = self.size - 0.5
        below = (pixels < -0.5).byte()
        above = (pixels > last).byte()
        beyond = below.add_(above, alpha=4)
        is_behind = self.vertices[..., 2] <= NEAR_PLANE
        self.beyond = (beyond[..., 0] + 2 * beyond[..., 1] + BEHIND * is_behind).flatten()
        self.pixels = torch.view_as_complex(pixels).flatten()

    def points(self, density: float) -> ContourPoints:
        """The points on occluding contours, then those on creases."""
        device = self.level.device
        candidates = _columns(density, OCCLUDING_CANDIDATES, CREASE_CANDIDATES, device)
        chosen = _columns(density, MAX_OCCLUDING, MAX_CREASES, device)
        on_crease = candidates.kind > 0
        places = self._smoothed(self._spread(candidates), ~on_crease)
        aside = (ASIDE / self.focal_lengths).masked_fill(on_crease[:, None], 0.0)
        rays = _rays_to(places.at) + aside * places.normal
        depth = self.depth_of(rays, None)
        behind = depth - places.at[..., 2]
        least = torch.where(on_crease, -VISIBLE_TOLERANCE, OCCLUSION_JUMP)
        is_seen = places.valid & (behind > least)
        first, _ = candidates.sizes
        is_seen[:, first:] &= self._is_fold(places[:, first:], rays[:, first:], is_seen[:, first:])
        return self._chosen(places, is_seen, depth.isinf() & ~on_crease, candidates, chosen)

    def _spread(self, columns: _Columns) -> _Places:
        """Places in each view, evenly along its occluding contours and along its creases."""
        level = self.level
        N, V, _ = self.vertices.shape
        is_crease = ~self.on_contour.index_select(1, level.creases)
        pose, number = torch.cat([self.on_contour, is_crease], dim=1).nonzero().unbind(1)
        has_edges = len(pose) > 0
        if not has_edges:
            pose = number = pose.new_zeros(1)
        edge = level.listed.index_select(0, number)
        vertices_before = V * pose
        start = level.starts.index_select(0, edge) + vertices_before
        end = level.ends.index_select(0, edge) + vertices_before
        along = self.pixels.index_select(0, end) - self.pixels.index_select(0, start)
        span = along.abs()
        beyond_start = self.beyond.index_select(0, start)
        beyond_end = self.beyond.index_select(0, end)
        # Outside are edges whose ends share a bit, and those that reach behind the camera.
        outside = (beyond_start & beyond_end) | ((beyond_start | beyond_end) & BEHIND)
        length = span.masked_fill(outside != 0, 0.0).nan_to_num_(0.0, posinf=0.0)
        chain = 2 * pose + (number >= len(level.starts))
        taken, fraction, valid = _spread_evenly(length * has_edges, chain, N, columns)
        size = (N, len(columns))
        chosen = edge.index_select(0, taken).view(size)
        vertices = self.vertices.flatten(0, 1)
        first = vertices.index_select(0, start.index_select(0, taken)).view(*size, 3)
        second = vertices.index_select(0, end.index_select(0, taken)).view(*size, 3)
        at = torch.lerp(first, second, fraction[..., None])
        # across the edge, to the side on which its faces are not
        unit = along / span.clamp(min=1e-30)
        turn = torch.where(self.side.gather(1, chosen), -1j, 1j).to(unit.dtype)
        normal = torch.view_as_real(turn * unit.index_select(0, taken).view(size))
        return _Places(chosen, fraction, at, normal, valid)

    def _smoothed(self, places: _Places, occluding: Tensor) -> _Places:
        """Places (N, M) of which those that are ``occluding`` (M,) have the normals of the smooth
        surface, where the mesh stands for one."""
        level = self.level
        start = _taken(level.normals, _taken(level.starts, places.edge))
        end = _taken(level.normals, _taken(level.ends, places.edge))
        surface_normal = torch.lerp(start, end, places.fraction[..., None])
        smooth = (surface_normal @ self.rotation[:, :2].mT) / self.focal_lengths
        smooth = F.normalize(smooth, dim=-1, eps=1e-30)
        cosine = (smooth * places.normal).sum(dim=-1, keepdim=True)
        is_smooth = _taken(level.is_smooth, places.edge) & occluding
        agrees = is_smooth[..., None] & (cosine.abs() > 0.5)
        normal = torch.where(agrees, cosine.sign() * smooth, places.normal)
        return replace(places, normal=normal)

    def _is_fold(self, places: _Places, rays: Tensor, is_seen: Tensor) -> Tensor:
        """(N, M) bool: which places on creases, to which ``rays`` (N, M, 2) lead, fold the surface
        at the scale of the crop; only where they are seen is it looked up."""
        z = places.at[..., 2]
        step = CREASE_SCALE * self.size
        aside = (step / self.focal_lengths) * places.normal
        on_both_sides = torch.cat([rays + aside, rays - aside], dim=1)
        depth = self.depth_of(on_both_sides, is_seen.repeat(1, 2))
        ahead, back = depth.chunk(2, dim=1)
        bend = (ahead - 2.0 * z + back).abs() * (self.focal_lengths[..., 0] / step) / z
        largest_jump = torch.maximum((ahead - z).abs(), (back - z).abs())
        return (bend > CREASE_BEND) & (largest_jump < 2.0 * OCCLUSION_JUMP)

    def _chosen(
        self,
        places: _Places,
        is_seen: Tensor,
        is_outline: Tensor,
        candidates: _Columns,
        chosen: _Columns,
    ) -> ContourPoints:
        """Of the places that are seen, columns of ``candidates``, the ``chosen`` number of each
        kind."""
        index, is_point = _evenly_chosen(is_seen, candidates, chosen)
        from_centre = (_taken(places.at.flatten(0, 1), index) - self.position).double() @ self.R
        model = torch.add(self.centre, from_centre, alpha=self.level.radius)
        normals = _taken(places.normal.flatten(0, 1), index).double()
        outline = _taken(is_outline.flatten(), index) & is_point
        return ContourPoints(model, normals, is_point, outline)


def _taken(values: Tensor, index: Tensor) -> Tensor:
    """``values[index]`` for (M, ...) and an index of any shape, in a seventh of the time."""
    taken = values.index_select(0, index.flatten())
    return taken.view(*index.shape, *values.shape[1:])


def _rays_to(at: Tensor) -> Tensor:
    """(N, M, 2) x and y of the rays (x, y, 1) to points (N, M, 3) in the cameras' frames."""
    return at[..., :2] / at[..., 2:].clamp(min=NEAR_PLANE)


def _spread_evenly(
    length: Tensor, chain: Tensor, views: int, columns: _Columns
) -> tuple[Tensor, Tensor, Tensor]:
    """Places in the ``columns`` of N ``views``, evenly along chains of edges of lengths (E,).
    ``chain`` (E,) is twice the view of an edge plus its kind, and ascends. Returns the numbers (N *
    M,) of the edges, and, (N, M), the fractions of their lengths, and whether there are edges."""
    # in whole units, whose sums are exact: places of a pose do not depend on the other poses
    length = (LENGTH_UNITS * length.double()).round()
    end = length.cumsum(dim=0)
    border = torch.searchsorted(chain, torch.arange(2 * views + 1, device=chain.device))
    before = F.pad(end, (1, 0))[border]
    total = before.diff()
    count = columns.each.repeat(views)
    # Place k lies at (k + 1/2) / count of a chain's length: the number of places up to each edge's
    # end, in all chains
    rate = torch.where(total > 0, count / total, 0.0)
    earlier = count.cumsum(dim=0) - count
    passed = (
        (end - before.index_select(0, chain)) * rate.index_select(0, chain) + 0.5
    ).long() + earlier.index_select(0, chain)
    size = (views, len(columns))
    passed[-1] = views * len(columns)
    places = torch.diff(passed, prepend=passed.new_zeros(1))
    number = torch.repeat_interleave(places, output_size=views * len(columns))
    first = before[:-1].view(views, 2).index_select(1, columns.kind)
    whole = total.view(views, 2).index_select(1, columns.kind)
    target = (columns.place.float() + 0.5) / columns.of_kind * whole
    # within the chain: sums over all chains would round the target otherwise
    behind = end.index_select(0, number).view(size) - first - target
    length_there = length.index_select(0, number).view(size)
    fraction = 1.0 - behind / length_there.clamp(min=1e-30)
    return number, fraction.clamp(0.0, 1.0).float(), whole > 0


def _evenly_chosen(valid: Tensor, candidates: _Columns, chosen: _Columns) -> tuple[Tensor, Tensor]:
    """Indices (N, M) into the flat (N * L,) of valid entries (N, L), ``candidates`` of each kind:
    the ``chosen`` number of it, evenly where there are more; and which are not padding."""
    by_kind = valid.split(candidates.sizes, dim=1)
    count = torch.stack([of_kind.sum(dim=1) for of_kind in by_kind], dim=1)
    first = (count.flatten().cumsum(dim=0).view_as(count) - count).index_select(1, chosen.kind)
    count = count.index_select(1, chosen.kind)
    rank = torch.where(count > chosen.of_kind, chosen.place * count // chosen.of_kind, chosen.place)
    is_point = chosen.place < count
    entry = F.pad(valid.flatten().nonzero()[:, 0], (0, 1))
    index = _taken(entry, torch.where(is_point, first + rank, 0))
    padding = valid.shape[1] * torch.arange(len(valid), device=valid.device)[:, None]
    return torch.where(is_point, index, padding), is_point
