"""Meshes with textures or solid patterns, and ray-traced pictures of them."""

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from curvireg_torch.rendering.embree import RayScene
from scripts.scenes.light import Light, shade_points
from scripts.scenes.materials import random_colour
from scripts.scenes.surfaces import Array, Rng

# px, longer side of textures: finer ones would only alias in pictures of this size
MAX_TEXTURE = 512
SUPERSAMPLING = 1.25
MAX_REPEATS = 4  # of a texture that an exported atlas keeps


class Paint(Protocol):
    """Colours of a surface."""

    gloss: float
    shininess: float

    def colours(self, points: Array, uv: Array) -> Array:
        """(N, 3) linear colours at points (N, 3) of the object's frame with texture coordinates (N,
        2)."""


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
        padded = np.pad(self.picture, ((1, 1), (1, 1), (0, 0)), mode="wrap")
        # cv2.remap takes at most 32767 rows
        size = 16384
        out = np.empty((len(uv), 3), np.float32)
        for k in range(0, len(uv), size):
            xy = np.stack([x, y], 1)[k : k + size, None].astype(np.float32) + 0.5
            out[k : k + size] = cv2.remap(padded, xy, None, cv2.INTER_LINEAR)[:, 0]
        return out


def plain_texture(rng: Rng) -> Texture:
    """A random uniform colour."""
    return Texture(random_colour(rng)[None, None].astype(np.float32))


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles (F, 3, 3) in metres, z up; normals (F, 3, 3), texture coordinates (F, 3, 2), and
    paint numbers (F,)."""

    triangles: Array
    normals: Array
    uv: Array
    paint: Array
    paints: tuple[Any, ...]
    hull: Array = field(default=None)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.hull is None:
            points = self.triangles.reshape(-1, 3)
            flat = np.linalg.matrix_rank(points - points[0], tol=1e-6 * np.abs(points).max()) < 3
            object.__setattr__(
                self, "hull", points if flat else points[ConvexHull(points).vertices]
            )

    @classmethod
    def from_arrays(
        cls, vertices: Array, faces: Array, paints: Any, *, uv: Any = None, paint: Any = None
    ) -> Any:
        """A mesh with flat shading; ``uv`` (V, 2) and ``paint`` (F,) may be left out."""
        corners = np.asarray(vertices, float)[faces]
        normals = np.repeat(face_normals(corners)[:, None], 3, axis=1)
        uv = np.zeros((*faces.shape, 2)) if uv is None else np.asarray(uv)[faces]
        return cls(
            corners,
            normals,
            uv,
            np.zeros(len(faces), int) if paint is None else paint,
            tuple(paints),
        )

    @classmethod
    def load(cls, path: Path) -> "TexturedMesh":
        """Read any mesh file with the materials that trimesh finds; coordinates stay in the file's
        unit."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # faces without texture coordinates
            loaded = trimesh.load(path, process=False)
        parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
        columns = ([], [], [], [])
        paints = []
        for number, part in enumerate(
            p for p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces)
        ):
            faces = np.asarray(part.faces)
            corners = np.asarray(part.vertices)[faces]
            normals = part._cache.cache.get("vertex_normals")
            uv = getattr(part.visual, "uv", None)
            flat = np.repeat(face_normals(corners)[:, None], 3, axis=1)
            columns[0].append(corners)
            columns[1].append(flat if normals is None else np.asarray(normals)[faces])
            columns[2].append(np.zeros((*faces.shape, 2)) if uv is None else np.asarray(uv)[faces])
            columns[3].append(np.full(len(faces), number))
            material = getattr(part.visual, "material", None)
            image = getattr(material, "image", None) if uv is not None else None
            diffuse = (
                np.asarray(getattr(material, "diffuse", [160, 160, 160, 255]), float)[:3] / 255
            )
            picture = (
                (np.clip(diffuse, 0.01, 1) ** 2.2)[None, None]
                if image is None
                else linear_texture(image)
            )
            gloss = (
                np.asarray(getattr(material, "specular", [0, 0, 0, 255]), float)[:3].mean() / 255
            )
            paints.append(Texture(picture.astype(np.float32), float(gloss)))
        return cls(*(np.concatenate(c) for c in columns), tuple(paints))

    def recoloured(self, paint: Paint) -> "TexturedMesh":
        """The mesh with one paint everywhere."""
        return replace(self, paint=np.zeros(len(self.triangles), int), paints=(paint,))

    @property
    def radius(self) -> float:
        """Half the diagonal of the box around the mesh."""
        return 0.5 * float(np.linalg.norm(np.ptp(self.hull, axis=0)))

    @property
    def centre(self) -> Array:
        """(3,) middle of the box around the mesh."""
        return 0.5 * (self.hull.min(axis=0) + self.hull.max(axis=0))

    def save_ply(self, path: Path, *, scale: float = 1000.0) -> None:
        """Write a PLY file in mm, with all textures in one picture beside it, as BOP's textured
        models have."""
        uv, picture = self._atlas()
        cv2.imwrite(
            str(path.with_suffix(".png")),
            (255 * picture[..., ::-1] ** (1 / 2.2) + 0.5).astype(np.uint8),
        )
        count = 3 * len(self.triangles)
        columns = ("x", "y", "z", "nx", "ny", "nz", "texture_u", "texture_v")
        header = ["ply", "format binary_little_endian 1.0", f"comment TextureFile {path.stem}.png"]
        header += [f"element vertex {count}", *(f"property float {name}" for name in columns)]
        header += [
            f"element face {count // 3}",
            "property list uchar int vertex_indices",
            "end_header",
            "",
        ]
        normals = self.normals / (np.linalg.norm(self.normals, axis=2, keepdims=True) + 1e-12)
        vertices = (
            np.concatenate([scale * self.triangles, normals, uv], axis=2)
            .reshape(count, 8)
            .astype("<f4")
        )
        faces = np.zeros(count // 3, [("n", "u1"), ("v", "<i4", 3)])
        faces["n"], faces["v"] = 3, np.arange(count).reshape(-1, 3)
        path.write_bytes("\n".join(header).encode() + vertices.tobytes() + faces.tobytes())

    def _atlas(self) -> tuple[Array, Array]:
        """Texture coordinates (F, 3, 2) in one (h, w, 3) picture of all textures, repeated where
        faces need it."""
        uv = self.uv - np.floor(self.uv.min(axis=1, keepdims=True))
        rows = []
        top = []
        width = 0
        for k, texture in enumerate(self.paints):
            here = self.paint == k
            most = float(uv[here].max(initial=1.0))
            n = 1 if most < 1 + 1e-3 else min(MAX_REPEATS, int(np.ceil(most)))
            image = texture.picture
            if image.shape[0] == 1 or n == 1:
                image = cv2.resize(image, (8, 8)) if image.shape[0] == 1 else image
            else:
                side = MAX_TEXTURE // n
                image = cv2.resize(
                    image, (side, min(side, image.shape[0])), interpolation=cv2.INTER_AREA
                )
            rows.append(np.pad(np.tile(image, (n, n, 1)), ((1, 1), (1, 1), (0, 0)), mode="edge"))
            top.append((rows[-1].shape[0] - 2, rows[-1].shape[1] - 2, n))
            width = max(width, rows[-1].shape[1])
        picture = np.concatenate(
            [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), mode="edge") for r in rows]
        )
        first = np.cumsum([0, *(len(r) for r in rows)])
        out = np.zeros_like(uv)
        for k, (high, wide, n) in enumerate(top):
            here = self.paint == k
            part = np.clip(uv[here] / n, 0.0, 1.0)
            out[here, :, 0] = (1 + part[..., 0] * wide) / width
            out[here, :, 1] = 1.0 - (first[k] + 1 + (1.0 - part[..., 1]) * high) / len(picture)
        return out, picture


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


def linear_texture(image: Any) -> Array:
    """(h, w, 3) float32 linear colours of a Pillow picture; transparent parts are light grey."""
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    rgb = (rgba[..., :3] * rgba[..., 3:] + 0.8 * (1 - rgba[..., 3:])) ** 2.2
    scale = MAX_TEXTURE / max(rgb.shape[:2])
    return (
        cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else rgb
    )


def barycentric(triangles: Array, points: Array) -> Array:
    """(N, 3) barycentric coordinates of points (N, 3) in triangles (N, 3, 3)."""
    a = triangles[:, 0]
    b = triangles[:, 1]
    c = triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1) + 1e-30
    u = (np.cross(c - b, points - b) * normal).sum(axis=1) / area
    v = (np.cross(a - c, points - c) * normal).sum(axis=1) / area
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
    zoom = np.array([[w / W, 0, 0.5 * (w / W - 1)], [0, h / H, 0.5 * (h / H - 1)], [0, 0, 1.0]])
    v, u = np.mgrid[0:h, 0:w].reshape(2, -1)
    rays = (np.stack([u, v, np.ones(len(u))], -1) @ np.linalg.inv(zoom @ K).T).astype(np.float32)
    start = np.zeros_like(rays)
    corners = [s.points(s.mesh.triangles) @ R.T + t for s in shapes]
    first = np.cumsum([0, *map(len, corners)])
    triangles = np.concatenate(corners)
    scene = _rays(triangles)
    triangle, _, _, depth = scene.hits(start, rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[hit] * depth[hit, None]
    numbers = triangle[hit]
    owner = np.searchsorted(first, numbers, side="right") - 1
    colour = np.zeros_like(points)
    normal = np.zeros_like(points)
    gloss = np.zeros(len(hit))
    shine = np.ones(len(hit))
    weights = barycentric(triangles[numbers], points)
    for k in np.unique(owner):
        here = np.flatnonzero(owner == k)
        mesh = shapes[k].mesh
        own = numbers[here] - first[k]
        w3 = weights[here, :, None]
        n = (w3 * mesh.normals[own]).sum(axis=1)
        n = np.where(
            np.linalg.norm(n, axis=1, keepdims=True) > 1e-9, n, face_normals(mesh.triangles[own])
        )
        normal[here] = n @ (R @ shapes[k].rotation).T
        local = (w3 * mesh.triangles[own]).sum(axis=1)
        uv = (w3 * mesh.uv[own]).sum(axis=1)
        for number in np.unique(mesh.paint[own]):
            part = mesh.paint[own] == number
            paint = mesh.paints[number]
            colour[here[part]] = paint.colours(local[part], uv[part])
            gloss[here[part]], shine[here[part]] = paint.gloss, paint.shininess
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    normal *= np.sign(-(normal * points).sum(axis=1, keepdims=True) + 1e-12)
    side = max(h, w)
    picture = cv2.resize(background, (side, side))[:h, :w].reshape(-1, 3).astype(np.float32)
    picture[hit] = shade_points(scene, points, normal, colour, np.clip(gloss, 0, 1), shine, light)

    def shrink(x: Array) -> Array:
        return cv2.resize(
            x.reshape(h, w, -1).astype(np.float32), (W, H), interpolation=cv2.INTER_AREA
        )

    annotated = [k for k, shape in enumerate(shapes) if shape.obj_id is not None]
    seen, whole = np.zeros((2, len(annotated), H, W), bool)
    alone = np.zeros(h * w, np.float32)
    for i, k in enumerate(annotated):
        mask = np.zeros(h * w, np.float32)
        mask[hit[owner == k]] = 1.0
        seen[i] = shrink(mask) > 0.5
        hull = shapes[k].hull @ R.T + t
        near = np.full(h * w, True)
        if hull[:, 2].min() > 1e-6:
            flat = hull @ (zoom @ K).T
            flat = flat[:, :2] / flat[:, 2:]
            low = flat.min(axis=0) - 1
            high = flat.max(axis=0) + 1
            near = (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
        distance = np.zeros(h * w, np.float32)
        if near.any():
            distance[near] = np.nan_to_num(
                _rays(corners[k]).distance(start[near], rays[near]), posinf=0.0
            )
        whole[i] = shrink(distance > 0) > 0.5
        alone = distance if i == 0 else alone
    flat_depth = cv2.resize(alone.reshape(h, w), (W, H), interpolation=cv2.INTER_NEAREST)
    return Picture(shrink(picture), seen, whole, flat_depth)


def _rays(triangles: Array) -> RayScene:
    return RayScene(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
