"""Meshes with textures or solid patterns, and ray-traced pictures of them."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from curvireg_torch.rendering.embree import RayScene
from scripts.scenes.light import Light, shade_points
from scripts.scenes.materials import random_colour
from scripts.scenes.surfaces import Array, Rng, middle_of

# px, longer side of textures: finer ones would only alias in pictures of this size
MAX_TEXTURE = 512
SUPERSAMPLING = 1.25
MAX_REPEATS = 4  # of a texture that an exported atlas keeps
PLY_HEADER = """ply
format binary_little_endian 1.0
comment TextureFile {stem}.png
element vertex {vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float texture_u
property float texture_v
element face {faces}
property list uchar int vertex_indices
end_header
"""


@dataclass(frozen=True)
class Texture:
    """A repeating (h, w, 3) float32 linear picture, or a (1, 1, 3) uniform colour; v points up."""

    picture: Array
    gloss: float = 0.2
    shininess: float = 30.0

    def colours(self, points: Array, uv: Array) -> Array:
        h, w = self.picture.shape[:2]
        if h == w == 1:
            return np.broadcast_to(self.picture[0], points.shape)
        x = np.mod(uv[:, 0], 1.0) * w
        y = np.mod(1.0 - uv[:, 1], 1.0) * h
        places = np.stack([x, y], 1)[:, None].astype(np.float32) + 0.5
        padded = np.pad(self.picture, ((1, 1), (1, 1), (0, 0)), mode="wrap")
        out = np.empty((len(uv), 3), np.float32)
        size = 16384  # cv2.remap takes at most 32767 rows
        for k in range(0, len(uv), size):
            block = places[k : k + size]
            out[k : k + size] = cv2.remap(padded, block, None, cv2.INTER_LINEAR)[:, 0]
        return out


def plain_texture(rng: Rng) -> Texture:
    """A random uniform colour."""
    return Texture(random_colour(rng)[None, None].astype(np.float32))


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles (F, 3, 3) in metres, z up; normals (F, 3, 3), texture coordinates (F, 3, 2), and
    paint numbers (F,). A paint is a :class:`Texture` or a material: it has gloss, shininess, and
    colours of points."""

    triangles: Array
    normals: Array
    uv: Array
    paint: Array
    paints: tuple[Any, ...]

    @classmethod
    def from_arrays(
        cls,
        vertices: Array,
        faces: Array,
        paints: Any,
        *,
        uv: Any = None,
        paint: Any = None,
    ) -> Any:
        """A mesh with flat shading; ``uv`` (V, 2) and ``paint`` (F,) may be left out."""
        corners = np.asarray(vertices, float)[faces]
        normals = np.repeat(face_normals(corners)[:, None], 3, axis=1)
        uv = np.zeros((*faces.shape, 2)) if uv is None else np.asarray(uv)[faces]
        paint = np.zeros(len(faces), int) if paint is None else paint
        return cls(corners, normals, uv, paint, tuple(paints))

    @classmethod
    def load(cls, path: Path) -> "TexturedMesh":
        """Read any mesh file with the materials that trimesh finds; coordinates stay in the file's
        unit."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # faces without texture coordinates
            loaded = trimesh.load(path, process=False)
        read = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
        solids = [each for each in read if isinstance(each, trimesh.Trimesh) and len(each.faces)]
        parts = [cls.of_part(solid) for solid in solids]
        return cls(
            np.concatenate([part.triangles for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.uv for part in parts]),
            np.repeat(np.arange(len(parts)), [len(part.paint) for part in parts]),
            tuple(part.paints[0] for part in parts),
        )

    @classmethod
    def of_part(cls, part: trimesh.Trimesh) -> "TexturedMesh":
        """A mesh of one material that trimesh has read."""
        faces = np.asarray(part.faces)
        uv = getattr(part.visual, "uv", None)
        mesh = cls.from_arrays(part.vertices, faces, [paint_of(part)], uv=uv)
        normals = part._cache.cache.get("vertex_normals")  # those of the file
        return mesh if normals is None else replace(mesh, normals=np.asarray(normals)[faces])

    def recoloured(self, paint: Any) -> "TexturedMesh":
        """The mesh with one paint everywhere."""
        return replace(self, paint=np.zeros(len(self.triangles), int), paints=(paint,))

    @cached_property
    def hull(self) -> Array:
        """(P, 3) corners of the convex hull; all corners of a flat mesh."""
        points = self.triangles.reshape(-1, 3)
        tolerance = 1e-6 * np.abs(points).max()
        if np.linalg.matrix_rank(points - points[0], tol=tolerance) < 3:
            return points
        return points[ConvexHull(points).vertices]

    @property
    def radius(self) -> float:
        """Half the diagonal of the box around the mesh."""
        return 0.5 * np.linalg.norm(np.ptp(self.hull, axis=0))

    @property
    def centre(self) -> Array:
        """(3,) middle of the box around the mesh."""
        return middle_of(self.hull)

    def save_ply(self, path: Path) -> None:
        """Write a PLY file in mm, with all textures in one picture beside it, as BOP's textured
        models have."""
        uv, picture = self._atlas()
        coded = (255 * picture[..., ::-1] ** (1 / 2.2) + 0.5).astype(np.uint8)
        cv2.imwrite(str(path.with_suffix(".png")), coded)
        count = 3 * len(self.triangles)
        lengths = np.linalg.norm(self.normals, axis=2, keepdims=True)
        normals = self.normals / (lengths + 1e-12)
        vertices = np.concatenate([1000.0 * self.triangles, normals, uv], axis=2).astype("<f4")
        faces = np.zeros(count // 3, [("n", "u1"), ("v", "<i4", 3)])
        faces["n"] = 3
        faces["v"] = np.arange(count).reshape(-1, 3)
        header = PLY_HEADER.format(stem=path.stem, vertices=count, faces=count // 3)
        path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())

    def _atlas(self) -> tuple[Array, Array]:
        """Texture coordinates (F, 3, 2) in one (h, w, 3) picture of all textures, repeated where
        faces need it."""
        uv = self.uv - np.floor(self.uv.min(axis=1, keepdims=True))
        counts = []
        tiles = []
        for k, texture in enumerate(self.paints):
            most = float(uv[self.paint == k].max(initial=1.0))
            n = 1 if most < 1 + 1e-3 else min(MAX_REPEATS, int(np.ceil(most)))
            image = texture.picture
            if len(image) == 1:
                image = cv2.resize(image, (8, 8))
            elif n > 1:
                side = MAX_TEXTURE // n
                size = (side, min(side, len(image)))
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            counts.append(n)
            tiles.append(np.tile(image, (n, n, 1)))
        width = 2 + max(tile.shape[1] for tile in tiles)
        height = sum(len(tile) + 2 for tile in tiles)
        rows = []
        out = np.zeros_like(uv)
        top = 1  # each has a border of one pixel
        for k, (n, tile) in enumerate(zip(counts, tiles, strict=True)):
            high, wide, _ = tile.shape
            border = ((1, 1), (1, width - wide - 1), (0, 0))
            rows.append(np.pad(tile, border, mode="edge"))
            here = self.paint == k
            part = np.clip(uv[here] / n, 0.0, 1.0)
            out[here, :, 0] = (1 + part[..., 0] * wide) / width
            out[here, :, 1] = 1.0 - (top + (1.0 - part[..., 1]) * high) / height
            top += high + 2
        return out, np.concatenate(rows)


@dataclass(frozen=True)
class Placed:
    """A mesh in the scene: a point x of the mesh lies at ``scale * rotation @ x + offset``.

    ``obj_id`` numbers annotated objects; None for surroundings.
    """

    mesh: TexturedMesh
    rotation: Array
    offset: Array
    scale: float = 1.0
    obj_id: int | None = None

    @classmethod
    def standing(
        cls,
        mesh: TexturedMesh,
        rotation: Array,
        scale: float,
        at: Any = (0.0, 0.0, 0.0),
        **more: Any,
    ) -> Any:
        """The mesh rotated, scaled and put on the plane through ``at``, with its box's middle above
        that point."""
        points = scale * mesh.hull @ rotation.T
        low = points.min(axis=0)
        high = points.max(axis=0)
        middle = np.array([*(0.5 * (low + high)[:2]), low[2]])
        return cls(mesh, rotation, np.asarray(at) - middle, scale, **more)

    def points(self, points: Array) -> Array:
        """Points (..., 3) of the mesh in the scene."""
        return self.scale * points @ self.rotation.T + self.offset

    @property
    def hull(self) -> Array:
        """(P, 3) corners of the convex hull in the scene."""
        return self.points(self.mesh.hull)

    def pose(self, R: Array, t: Array) -> tuple[Array, Array]:
        """Rotation and translation (in the mesh's unit), mesh -> camera, for a camera with scene ->
        camera R, t."""
        return R @ self.rotation, (R @ self.offset + t) / self.scale


def face_normals(corners: Array) -> Array:
    """(F, 3) normals of triangles (F, 3, 3), not normalised."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def paint_of(part: trimesh.Trimesh) -> Texture:
    """The material of a mesh that trimesh has read."""
    material = getattr(part.visual, "material", None)
    has_uv = getattr(part.visual, "uv", None) is not None
    image = getattr(material, "image", None) if has_uv else None
    if image is None:
        diffuse = np.asarray(getattr(material, "diffuse", [160] * 3), float)[:3] / 255
        picture = (np.clip(diffuse, 0.01, 1) ** 2.2)[None, None]
    else:
        picture = linear_texture(image)
    specular = np.asarray(getattr(material, "specular", [0] * 3), float)[:3]
    return Texture(picture.astype(np.float32), float(specular.mean() / 255))


def linear_texture(image: Any) -> Array:
    """(h, w, 3) float32 linear colours of a Pillow picture; transparent parts are light grey."""
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    alpha = rgba[..., 3:]
    rgb = (rgba[..., :3] * alpha + 0.8 * (1 - alpha)) ** 2.2
    scale = MAX_TEXTURE / max(rgb.shape[:2])
    if scale >= 1:
        return rgb
    return cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def barycentric(triangles: Array, points: Array) -> Array:
    """(N, 3) barycentric coordinates of points (N, 3) in triangles (N, 3, 3)."""
    a = triangles[:, 0]
    b = triangles[:, 1]
    c = triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1) + 1e-30
    of_a = np.cross(c - b, points - b)
    of_b = np.cross(a - c, points - c)
    u = (of_a * normal).sum(axis=1) / area
    v = (of_b * normal).sum(axis=1) / area
    weights = np.clip(np.stack([u, v, 1 - u - v], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


class Picture(NamedTuple):
    """A rendered picture (H, W, 3) in linear light, and what is seen of every annotated object, in
    their order.

    ``seen`` and ``whole`` (A, H, W) bool: pixels that show the object, and that would without all
    others. ``depth`` (H, W) of the first object alone, in the scene's unit, 0 = background.
    """

    linear: Array
    seen: Array
    whole: Array
    depth: Array


def render(
    shapes: list[Placed],
    R: Array,
    t: Array,
    K: Array,
    size: tuple[int, int],
    light: Light,
    background: Array,
) -> Picture:
    """Ray-trace shapes as the camera ``K [R | t]`` sees them, before a square linear picture that
    fills the rest."""
    H, W = size
    h = round(SUPERSAMPLING * H)
    w = round(SUPERSAMPLING * W)
    x = w / W
    y = h / H
    zoom = np.array([[x, 0, 0.5 * (x - 1)], [0, y, 0.5 * (y - 1)], [0, 0, 1.0]])
    zoomed = zoom @ K
    pixels = np.mgrid[0:h, 0:w].reshape(2, -1)[::-1].T
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    rays = (homogeneous @ np.linalg.inv(zoomed).T).astype(np.float32)
    start = np.zeros_like(rays)
    corners = [s.points(s.mesh.triangles) @ R.T + t for s in shapes]
    scene = _rays(np.concatenate(corners))
    triangle, _, _, depth = scene.hits(start, rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[hit] * depth[hit, None]
    seen_by_ray = seen_surface(shapes, R, corners, triangle[hit], points)
    side = max(h, w)
    picture = cv2.resize(background, (side, side))[:h, :w].reshape(-1, 3).astype(np.float32)
    picture[hit] = shade_points(scene, points, *seen_by_ray[1:], light)

    def shrink(x: Array) -> Array:
        rows = x.reshape(h, w, -1).astype(np.float32)
        return cv2.resize(rows, (W, H), interpolation=cv2.INTER_AREA)

    def depth_alone(k: int) -> Array:
        near = _in_box(pixels, shapes[k].hull @ R.T + t, zoomed)
        alone = np.zeros(h * w, np.float32)
        if near.any():
            distance = _rays(corners[k]).distance(start[near], rays[near])
            alone[near] = np.nan_to_num(distance, posinf=0.0)
        return alone

    owner = np.full(h * w, -1)
    owner[hit] = seen_by_ray[0]
    annotated = [k for k, shape in enumerate(shapes) if shape.obj_id is not None]
    alone = [depth_alone(k) for k in annotated]
    seen = np.array([shrink(owner == k) > 0.5 for k in annotated])
    whole = np.array([shrink(depth > 0) > 0.5 for depth in alone])
    flat_depth = cv2.resize(alone[0].reshape(h, w), (W, H), interpolation=cv2.INTER_NEAREST)
    return Picture(shrink(picture), seen, whole, flat_depth)


def seen_surface(
    shapes: list[Placed],
    R: Array,
    corners: list[Array],
    numbers: Array,
    points: Array,
) -> tuple[Array, ...]:
    """What rays see at points (N, 3) of triangles with numbers (N,): the number of the shape,
    normal (N, 3) towards the camera, colour (N, 3), gloss and shininess.

    Args:
        R: scene -> camera.
        corners: of each shape the triangles (F, 3, 3), numbered one shape after the other.
    """
    first = np.cumsum([0, *map(len, corners)])
    owner = np.searchsorted(first, numbers, side="right") - 1
    normal = np.zeros_like(points)
    colour = np.zeros_like(points)
    gloss = np.zeros(len(points))
    shininess = np.ones(len(points))
    weights = barycentric(np.concatenate(corners)[numbers], points)[..., None]
    for k in np.unique(owner):
        here = np.flatnonzero(owner == k)
        mesh = shapes[k].mesh
        own = numbers[here] - first[k]
        n = (weights[here] * mesh.normals[own]).sum(axis=1)
        has_normal = np.linalg.norm(n, axis=1, keepdims=True) > 1e-9
        n = np.where(has_normal, n, face_normals(mesh.triangles[own]))
        normal[here] = n @ (R @ shapes[k].rotation).T
        local = (weights[here] * mesh.triangles[own]).sum(axis=1)
        uv = (weights[here] * mesh.uv[own]).sum(axis=1)
        for number in np.unique(mesh.paint[own]):
            part = mesh.paint[own] == number
            paint = mesh.paints[number]
            colour[here[part]] = paint.colours(local[part], uv[part])
            gloss[here[part]] = paint.gloss
            shininess[here[part]] = paint.shininess
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    normal *= np.sign(-(normal * points).sum(axis=1, keepdims=True) + 1e-12)
    return owner, normal, colour, np.clip(gloss, 0, 1), shininess


def _in_box(pixels: Array, hull: Array, K: Array) -> Array:
    """(N,) whether pixels (N, 2) may show an object with a hull (P, 3) in the camera's frame."""
    if hull[:, 2].min() <= 1e-6:
        return np.full(len(pixels), True)
    flat = hull @ K.T
    flat = flat[:, :2] / flat[:, 2:]
    inside = (pixels >= flat.min(axis=0) - 1) & (pixels <= flat.max(axis=0) + 1)
    return inside.all(axis=1)


def _rays(triangles: Array) -> RayScene:
    return RayScene(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
