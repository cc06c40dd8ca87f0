"""Contours of a mesh at many poses on any device, with visibility by a ray test of all faces."""

import torch
from torch import Tensor

from ..mesh.edges import MeshEdges
from .contours import (
    ASIDE,
    BEHIND,
    CREASE_BEND,
    CREASE_CANDIDATES,
    CREASE_SCALE,
    MAX_CREASES,
    MAX_OCCLUDING,
    NEAR_PLANE,
    OCCLUDING_CANDIDATES,
    OCCLUSION_JUMP,
    VISIBLE_TOLERANCE,
    ContourPoints,
    MeshContours,
)

# Ray tests at a time, of 16 bytes each, and edges of poses at a time
TESTS_AT_A_TIME = 2**25
EDGES_AT_A_TIME = 2**22
# Barycentric coordinate, about, down to which a ray beside a face still hits it: there are no gaps
# between faces
BESIDE_FACE = 1e-6


class DeviceContours:
    """What :class:`.MeshContours` finds, for many poses at a time on one device: its points, but
    for those where a ray grazes an edge.

    Where MeshContours follows the few edges of each contour and casts rays by embree, all edges of
    all poses are examined here, and each ray is tested against all faces, as a GPU does fast.

    Example:
        >>> import trimesh
        >>> contours = MeshContours(trimesh.creation.box((2, 2, 2)))
        >>> K = torch.tensor([[100.0, 0, 63.5], [0, 100.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64)[None]; T[0, 2, 3] = 4.0
        >>> points = DeviceContours(contours, "cpu").points(T, K[None], 128)
        >>> points.model[points.outline].abs().amax(dim=0).round(decimals=4).tolist()
        [1.0, 1.0, 1.0]
    """

    def __init__(self, contours: MeshContours, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.centre = contours.centre.to(self.device)
        self.radius = contours.radius
        self._contours = contours
        self._levels: dict[int, _Edges] = {}

    def points(
        self, T_cam_from_model: Tensor, camera_matrices: Tensor, size: int, *, density: float = 1.0
    ) -> ContourPoints:
        """See :meth:`.MeshContours.points`; tensors are on this device."""
        limit, level = self._contours.level_of(size)
        if limit not in self._levels:
            self._levels[limit] = _Edges(level.edges, self.radius, self.device)
        edges = self._levels[limit]
        K = camera_matrices.expand(len(T_cam_from_model), 3, 3)
        count = max(1, EDGES_AT_A_TIME // len(edges.ends))
        parts = zip(T_cam_from_model.split(count), K.split(count), strict=True)
        found = [_Views(edges, self.centre, T, K, size).points(density) for T, K in parts]
        return ContourPoints.cat(found)


class _Edges:
    """The edges and faces of a simplified mesh on a device, with lengths in object radii."""

    def __init__(self, edges: MeshEdges, radius: float, device: torch.device) -> None:
        def tensor(x: object, dtype: torch.dtype) -> Tensor:
            return torch.as_tensor(x).to(device, dtype)

        self.radius = radius
        self.vertices = tensor(edges.vertices / radius, torch.float64)
        self.faces = tensor(edges.faces, torch.long)
        self.ends = tensor(edges.edges, torch.long)
        self.normals = tensor(edges.normals, torch.float32)
        self.is_crease = tensor(edges.is_crease, torch.bool)
        self.is_smooth = tensor(edges.is_smooth, torch.bool)
        planes, offsets, faces, flips = edges.sides_data()
        self.planes = tensor(planes / radius**2, torch.float64)
        self.offsets = tensor(offsets / radius**3, torch.float64)
        self.edge_faces = tensor(faces, torch.long)
        self.flips = tensor(flips, torch.bool)

    def sides(self, eye: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`.MeshEdges.sides`."""
        behind = self.offsets > eye @ self.planes.T
        pairs = zip(self.edge_faces.T, self.flips, strict=True)
        first, *others = (behind[:, faces] ^ flip for faces, flip in pairs)
        all_same = torch.ones_like(first)
        for other in others:
            all_same &= first == other
        return all_same, first


class _Views:
    """N poses in square crops of ``size`` px; lengths are in object radii."""

    def __init__(self, edges: _Edges, centre: Tensor, T: Tensor, K: Tensor, size: int) -> None:
        self.edges = edges
        self.centre = centre
        self.size = size
        self.R = T[:, :3, :3]
        self.position = (self.R @ centre + T[:, :3, 3]) / edges.radius
        eye = -(self.position[:, None] @ self.R)[:, 0]
        self.on_contour, self.side = edges.sides(eye)
        vertices = edges.vertices @ self.R.mT + self.position[:, None]
        self.rays_of_faces = _ray_equations(vertices, edges.faces)
        self.vertices = vertices.float()
        self.K = K.float()

    def points(self, density: float) -> ContourPoints:
        length = self._lengths()
        contours = self._points_on(
            torch.where(self.on_contour, length, 0.0),
            round(density * OCCLUDING_CANDIDATES),
            round(density * MAX_OCCLUDING),
            occluding=True,
        )
        creases = self._points_on(
            torch.where(self.edges.is_crease & ~self.on_contour, length, 0.0),
            round(density * CREASE_CANDIDATES),
            round(density * MAX_CREASES),
            occluding=False,
        )
        together = (torch.cat(parts, dim=1) for parts in zip(contours, creases, strict=True))
        return ContourPoints(*together)

    def _lengths(self) -> Tensor:
        """(N, E) float32 lengths of edges in px; 0 for those outside the crop and behind the
        camera."""
        x, y, z = self.vertices.unbind(-1)
        is_behind = z <= NEAR_PLANE
        z = z.clamp(min=NEAR_PLANE)
        u = self.K[:, 0, 0, None] * x / z + self.K[:, 0, 2, None]
        v = self.K[:, 1, 1, None] * y / z + self.K[:, 1, 2, None]
        last = self.size - 0.5
        sides = [u < -0.5, v < -0.5, u > last, v > last, is_behind]
        bits = (1, 2, 4, 8, BEHIND)
        beyond = sum(bit * side.to(torch.uint8) for bit, side in zip(bits, sides, strict=True))
        start, end = self.edges.ends.T
        common = beyond[:, start] & beyond[:, end]  # type: ignore[index]
        either = beyond[:, start] | beyond[:, end]  # type: ignore[index]
        is_inside = (common | (either & BEHIND)) == 0
        across = u[:, end] - u[:, start]
        down = v[:, end] - v[:, start]
        return (across.square() + down.square()).sqrt() * is_inside

    def _points_on(
        self, length: Tensor, candidates: int, most: int, *, occluding: bool
    ) -> tuple[Tensor, ...]:
        """At most ``most`` visible points of each pose on edges of lengths (N, E), of
        ``candidates``: the fields of :class:`.ContourPoints`."""
        edge, fraction, valid = _spread(length, candidates)
        at, normal = self._places(edge, fraction)
        if occluding:
            normal = self._smoothed(edge, fraction, normal)
            is_seen, is_outline = self._seen_on_occluding_contours(at, normal, valid)
        else:
            is_seen = self._seen_on_creases(at, normal, valid)
            is_outline = torch.zeros_like(is_seen)
        index, is_point = _evenly(is_seen, most)
        triple = index[..., None].expand(-1, -1, 3)
        from_centre = at.gather(1, triple).double() - self.position[:, None]
        model = self.edges.radius * (from_centre @ self.R) + self.centre
        normals = normal.gather(1, triple[..., :2]).double()
        return model, normals, is_point, is_outline.gather(1, index) & is_point

    def _places(self, edge: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
        """Points (N, M, 3) in the cameras' frames, at fractions of edges (N, M), and the unit
        normals (N, M, 2) across the edges in the image."""
        rows = torch.arange(len(edge), device=edge.device)[:, None]
        ends = self.edges.ends[edge]
        start = self.vertices[rows, ends[..., 0]]
        along = self.vertices[rows, ends[..., 1]] - start
        at = start + fraction[..., None] * along
        sign = torch.where(self.side.gather(1, edge), -1.0, 1.0)
        plane = torch.linalg.cross(start, along)
        return at, self._across(plane) * sign[..., None]

    def _across(self, plane: Tensor) -> Tensor:
        """Unit normals (N, M, 2) of the image lines of planes through the camera, with normals (N,
        M, 3)."""
        focal_lengths = torch.stack([self.K[:, 0, 0], self.K[:, 1, 1]], dim=1)
        normal = plane[..., :2] / focal_lengths[:, None]
        length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        unit: Tensor = normal / length.clamp(min=1e-30)
        return unit

    def _smoothed(self, edge: Tensor, fraction: Tensor, normal: Tensor) -> Tensor:
        """Normals of the smooth surface, where the mesh stands for one."""
        ends = self.edges.ends[edge]
        start = self.edges.normals[ends[..., 0]]
        end = self.edges.normals[ends[..., 1]]
        surface_normal = start + fraction[..., None] * (end - start)
        smooth = self._across(surface_normal @ self.R.float().mT)
        cosine = (smooth * normal).sum(dim=-1, keepdim=True)
        agrees = self.edges.is_smooth[edge][..., None] & (cosine.abs() > 0.5)
        return torch.where(agrees, cosine.sign() * smooth, normal)

    def _pixels(self, at: Tensor) -> Tensor:
        """(N, M, 2) pixels of points (N, M, 3)."""
        return at @ self.K[:, :2].mT / at[..., 2:].clamp(min=NEAR_PLANE)

    def _depth_at(self, pixels: Tensor, wanted: Tensor) -> Tensor:
        """(N, M) depth of the mesh at pixels (N, M, 2) that ``wanted`` (N, M) marks; inf elsewhere
        and beside the mesh."""
        focal_lengths = torch.stack([self.K[:, 0, 0], self.K[:, 1, 1]], dim=1)
        xy = (pixels - self.K[:, None, :2, 2]) / focal_lengths[:, None]
        rays = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        tests = rays.shape[1] * len(self.edges.faces)
        count = max(1, TESTS_AT_A_TIME // max(1, tests))
        parts = zip(rays.split(count), *(e.split(count) for e in self.rays_of_faces), strict=True)
        inverse = torch.cat([_inverse_depth(*part) for part in parts])
        is_hit = wanted & (inverse > 0)
        return torch.where(is_hit, 1.0 / inverse, torch.inf)

    def _seen_on_occluding_contours(
        self, at: Tensor, normal: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor]:
        depth = self._depth_at(self._pixels(at) + ASIDE * normal, valid)
        is_seen = valid & (depth - at[..., 2] > OCCLUSION_JUMP)
        return is_seen, is_seen & depth.isinf()

    def _seen_on_creases(self, at: Tensor, normal: Tensor, valid: Tensor) -> Tensor:
        z = at[..., 2]
        pixel = self._pixels(at)
        step = CREASE_SCALE * self.size
        is_seen = valid & (self._depth_at(pixel, valid) > z - VISIBLE_TOLERANCE)
        ahead = self._depth_at(pixel + step * normal, is_seen)
        back = self._depth_at(pixel - step * normal, is_seen)
        bend = (ahead - 2.0 * z + back).abs() / step * self.K[:, :1, 0] / z
        largest_jump = torch.maximum((ahead - z).abs(), (back - z).abs())
        is_fold: Tensor = is_seen & (bend > CREASE_BEND) & (largest_jump < 2.0 * OCCLUSION_JUMP)
        return is_fold


def _ray_equations(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What tells where rays (x, y, 1) from the cameras hit faces, for float64 vertices (N, V, 3) in
    their frames: three (N, 3, F) float32 vectors.

    With the corners a, b, c of a face, a ray d hits it if d . (b x c), d . (c x a) and d . (a x b)
    have the sign of the determinant of a, b, c; divided by this, their sum is the inverse depth
    there. All are linear in d, so that rays times faces is a matrix product.
    """
    a, b, c = vertices[:, faces].unbind(dim=2)
    crosses = [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)]
    volume = (a * crosses[0]).sum(dim=-1, keepdim=True)
    scale = torch.where(volume.abs() > 1e-12, 1.0 / volume, 0.0)  # 0: seen from the side
    first, second, third = ((scale * cross).float().mT.contiguous() for cross in crosses)
    return first, second, third


def _inverse_depth(rays: Tensor, first: Tensor, second: Tensor, third: Tensor) -> Tensor:
    """(N, M) inverse depth where rays (N, M, 3) hit the first of the faces of
    :func:`_ray_equations`, 0 where they hit none."""
    inverse = torch.bmm(rays, first)
    least = inverse.clone()
    for equations in (second, third):
        coordinate = torch.bmm(rays, equations)
        least = torch.minimum(least, coordinate)
        inverse += coordinate
    return inverse.masked_fill_(least < -BESIDE_FACE, 0.0).amax(dim=-1)


def _spread(length: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """``count`` places for each of N poses, evenly along its edges of lengths (N, E). Returns (N,
    count): the edge, the fraction of its length, whether there is one."""
    length = length.nan_to_num(0.0).double()
    end = length.cumsum(dim=1)
    total = end[:, -1:]
    places = (torch.arange(count, device=length.device, dtype=length.dtype) + 0.5) / count
    target = places * total
    edge = torch.searchsorted(end, target).clamp(max=length.shape[1] - 1)
    length_of_edge = length.gather(1, edge)
    fraction = 1.0 - (end.gather(1, edge) - target) / length_of_edge.clamp(min=1e-30)
    return edge, fraction.clamp(0.0, 1.0).float(), (total > 0).expand_as(edge)


def _evenly(valid: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Indices (N, most) of valid entries (N, M), evenly chosen where there are more, and which are
    not padding."""
    order = (~valid).byte().argsort(dim=1, stable=True)
    count = valid.sum(dim=1, keepdim=True)
    place = torch.arange(most, device=valid.device)[None]
    rank = torch.where(count > most, (place * count.clamp(min=1)) // most, place)
    index = order.gather(1, rank.clamp(max=valid.shape[1] - 1))
    return index, place < count
