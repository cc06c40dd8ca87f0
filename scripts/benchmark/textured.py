"""Textured triangle meshes for ray tracing."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from curvireg_torch.rendering.embree import RayScene
from curvireg_torch.training.scenes.light import Light, random_light, shade_points
from curvireg_torch.training.scenes.materials import random_picture
from curvireg_torch.training.scenes.rotations import random_rotation

MAX_TEXTURE = 384
"""Longer side of textures in px. Finer textures would only alias in pictures of the benchmark's size."""
SUPERSAMPLING = 1.25


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles (F, 3, 3) with normals (F, 3, 3), texture coordinates (F, 3, 2) and a material number (F,) each.

    Per material: ``colours`` (M, 3) in linear light, ``pictures`` (T, T, 3) float32 linear or None, ``gloss`` (M,).
    ``hull`` holds the numbers of the corners on the convex hull, which determine boxes.
    """

    triangles: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    colours: np.ndarray
    pictures: tuple[np.ndarray | None, ...]
    gloss: np.ndarray
    hull: np.ndarray

    @classmethod
    def load(cls, path: Path) -> "TexturedMesh":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # faces without texture coordinates
            loaded = trimesh.load(path, process=False)
        parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
        columns = ([], [], [], [])
        colours, pictures, gloss = [], [], []
        for number, part in enumerate(p for p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces)):
            faces = np.asarray(part.faces)
            corners = np.asarray(part.vertices)[faces]
            normals = part._cache.cache.get("vertex_normals")
            uv = getattr(part.visual, "uv", None)
            material = getattr(part.visual, "material", None)
            image = getattr(material, "image", None) if uv is not None else None
            columns[0].append(corners)
            if normals is None:
                columns[1].append(np.repeat(face_normals(corners)[:, None], 3, axis=1))
            else:
                columns[1].append(np.asarray(normals)[faces])
            columns[2].append(np.zeros((*faces.shape, 2)) if uv is None else np.asarray(uv)[faces])
            columns[3].append(np.full(len(faces), number))
            diffuse = np.asarray(getattr(material, "diffuse", [160, 160, 160, 255]), float)[:3] / 255
            gloss.append(np.asarray(getattr(material, "specular", [0, 0, 0, 255]), float)[:3].mean() / 255)
            colours.append(np.clip(diffuse, 0.01, 1) ** 2.2)
            pictures.append(None if image is None else linear_texture(image))
        arrays = [np.concatenate(c) for c in columns]
        hull = ConvexHull(arrays[0].reshape(-1, 3)).vertices
        return cls(*arrays, np.array(colours), tuple(pictures), np.array(gloss), hull)

    @classmethod
    def plane(cls, corners: list) -> "TexturedMesh":
        """A quadrilateral whose texture coordinates run from 0 to 1."""
        p, uv = np.array(corners, float), np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)])
        index = np.array([[0, 1, 2], [0, 2, 3]])
        normals = np.tile(np.cross(p[1] - p[0], p[3] - p[0]), (2, 3, 1))
        return cls(p[index], normals, uv[index], np.zeros(2, int), np.ones((1, 3)), (None,), np.zeros(1), np.arange(6))

    def with_texture(self, picture: np.ndarray, repeats: float) -> "TexturedMesh":
        return replace(self, uv=self.uv * repeats, pictures=(picture,))

    def with_colour(self, colour: np.ndarray) -> "TexturedMesh":
        """The mesh in one uniform colour, without textures."""
        n = len(self.colours)
        return replace(self, colours=np.tile(colour, (n, 1)), pictures=(None,) * n, gloss=np.full(n, 0.2))

    def hull_points(self) -> np.ndarray:
        """(P, 3) corners of the convex hull."""
        return self.triangles.reshape(-1, 3)[self.hull]

    def rays(self) -> RayScene:
        return RayScene(self.triangles.reshape(-1, 3), np.arange(3 * len(self.triangles)).reshape(-1, 3))

    def radius_and_centre(self) -> tuple[float, np.ndarray]:
        low, high = self.hull_points().min(axis=0), self.hull_points().max(axis=0)
        return 0.5 * float(np.linalg.norm(high - low)), 0.5 * (low + high)

    def floor_offset(self, rotation: np.ndarray) -> np.ndarray:
        """Centre of the object's box, in radii, when the rotated object stands on the floor at the origin."""
        radius, centre = self.radius_and_centre()
        lowest = ((self.hull_points() - centre) @ rotation.T)[:, 2].min() / radius
        return np.array([0.0, 0.0, -lowest])

    def standing(self, rotation: np.ndarray | None, scale: float, about_z: float) -> "TexturedMesh":
        """The object rotated, scaled to radius ``scale`` and placed on the floor above the origin."""
        c, s = np.cos(about_z), np.sin(about_z)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (np.eye(3) if rotation is None else rotation)
        radius, centre = self.radius_and_centre()
        triangles = ((self.triangles - centre) @ R.T / radius + self.floor_offset(R)) * scale
        return replace(self, triangles=triangles, normals=self.normals @ R.T)

    def translated(self, translation) -> "TexturedMesh":
        return replace(self, triangles=self.triangles + np.asarray(translation))

    def transformed(self, R: np.ndarray, t: np.ndarray) -> "TexturedMesh":
        return replace(self, triangles=self.triangles @ R.T + t, normals=self.normals @ R.T)

    def surface(self, number: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear colour (N, 3), unit normal (N, 3) and gloss (N,) at points on the triangles ``number``."""
        corners = self.triangles[number]
        weights = barycentric(corners, points)
        normal = (weights[..., None] * self.normals[number]).sum(axis=1)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 1e-9, normal, face_normals(corners))
        normal = normal / (np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12)
        uv = (weights[..., None] * self.uv[number]).sum(axis=1)
        material = self.material[number]
        colour = self.colours[material].copy()
        for k in np.unique(material):
            if self.pictures[k] is not None:
                mask = material == k
                colour[mask] = sample_texture(self.pictures[k], uv[mask])
        return colour, normal, self.gloss[material]


def face_normals(corners: np.ndarray) -> np.ndarray:
    """(F, 3) normals of triangles (F, 3, 3), not normalised."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def linear_texture(image) -> np.ndarray:
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    rgb = (rgba[..., :3] * rgba[..., 3:] + 0.8 * (1 - rgba[..., 3:])) ** 2.2
    scale = MAX_TEXTURE / max(rgb.shape[:2])
    return cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb


def sample_texture(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear interpolation of a repeating texture; v points up."""
    h, w = picture.shape[:2]
    x, y = uv[:, 0] * w - 0.5, (1 - uv[:, 1]) * h - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    x0, y0 = x0.astype(np.int64) % w, y0.astype(np.int64) % h
    x1, y1 = (x0 + 1) % w, (y0 + 1) % h
    top = picture[y0, x0] * (1 - fx) + picture[y0, x1] * fx
    return top * (1 - fy) + (picture[y1, x0] * (1 - fx) + picture[y1, x1] * fx) * fy


def barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) barycentric coordinates of points (N, 3) in triangles (N, 3, 3)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1) + 1e-30
    u = (np.cross(c - b, points - b) * normal).sum(axis=1) / area
    v = (np.cross(a - c, points - c) * normal).sum(axis=1) / area
    weights = np.clip(np.stack([u, v, 1 - u - v], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def appearance_symmetries(
    model: TexturedMesh, candidates: list[int], rotations: np.ndarray, *, side: int = 32
) -> list[int]:
    """Select the shape symmetries that also preserve the colours, compared in four views."""
    if len(candidates) < 2:
        return candidates
    radius, centre = model.radius_and_centre()
    model = replace(model, triangles=(model.triangles - centre) / radius)
    grid = np.linspace(-1, 1, side)
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    scene = model.rays()
    views = [random_rotation(np.random.default_rng(k)) for k in range(4)]

    def render(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pictures = []
        for view in views:
            frame = view @ R
            starts = np.stack([x, y, np.full(len(x), -2.0)], 1) @ frame
            directions = np.broadcast_to(frame[2], starts.shape)
            depth, triangle, _ = scene.hits(starts, directions)
            hit = np.isfinite(depth)
            colour = np.full((len(x), 3), np.nan)
            points = starts[hit] + depth[hit, None] * directions[hit]
            colour[hit] = model.surface(triangle[hit], points)[0] ** (1 / 2.2)
            pictures.append(cv2.blur(np.nan_to_num(colour).reshape(side, side, 3), (3, 3)).reshape(-1, 3))
        pictures = np.array(pictures)
        return pictures, pictures.sum(axis=-1) > 0

    reference, reference_mask = render(np.eye(3))
    symmetries = []
    for k in candidates:
        picture, mask = render(rotations[k])
        both = reference_mask & mask
        if k == 0 or (np.abs(picture - reference)[both].max(axis=-1) > 0.12).mean() < 0.04:
            symmetries.append(k)
    return symmetries


def render(
    shapes: list[TexturedMesh],
    R,
    t,
    K,
    size: tuple[int, int],
    rng: np.random.Generator,
    *,
    light: Light | None = None,
    background: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear picture (H, W, 3), mask of the first shape in it, and mask of that shape without the others.

    ``light`` and ``background``, a square linear picture of any size behind everything, are random unless given.
    """
    H, W = size
    h, w = round(SUPERSAMPLING * H), round(SUPERSAMPLING * W)
    zoom = np.array([[w / W, 0, 0.5 * (w / W - 1)], [0, h / H, 0.5 * (h / H - 1)], [0, 0, 1.0]])
    M = np.linalg.inv(zoom @ K)
    v, u = np.mgrid[0:h, 0:w].reshape(2, -1)
    rays = (np.stack([u, v, np.ones(len(u))], -1) @ M.T).astype(np.float32)
    start = np.zeros_like(rays)
    placed = [shape.transformed(R, t) for shape in shapes]
    first = np.cumsum([0, *(len(p.triangles) for p in placed)])
    triangles = np.concatenate([p.triangles for p in placed])
    scene = RayScene(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    depth, hit_triangle, _ = scene.hits(start, rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[hit] * depth[hit, None]
    numbers = hit_triangle[hit]
    owner = np.searchsorted(first, numbers, side="right") - 1
    colour, normal = np.zeros_like(points), np.zeros_like(points)
    gloss, shine = np.zeros(len(hit)), np.ones(len(hit))
    for k in np.unique(owner):
        mask = owner == k
        colour[mask], normal[mask], gloss[mask] = placed[k].surface(numbers[mask] - first[k], points[mask])
        shine[mask] = np.exp(rng.uniform(1.5, 5.0))
        gloss[mask] *= rng.uniform(0, 1.5)
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    normal *= np.sign((normal * view).sum(axis=1, keepdims=True) + 1e-12)
    light = random_light(R[:, 2], rng) if light is None else light
    lit = shade_points(scene, points, normal, colour, np.clip(gloss, 0, 1), shine, light)
    side = max(h, w)
    background = random_picture(rng, side) if background is None else cv2.resize(background, (side, side))
    picture = background[:h, :w].reshape(-1, 3).astype(np.float32)
    picture[hit] = lit
    seen = np.zeros(h * w, np.float32)
    seen[hit[owner == 0]] = 1.0
    flat = placed[0].hull_points() @ (zoom @ K).T
    flat = flat[:, :2] / flat[:, 2:]
    near = (
        ((u >= flat[:, 0].min() - 1) & (u <= flat[:, 0].max() + 1))
        & (v >= flat[:, 1].min() - 1)
        & (v <= flat[:, 1].max() + 1)
    )
    whole = np.zeros(h * w, np.float32)
    whole[near] = np.isfinite(placed[0].rays().distance(start[near], rays[near]))

    def downsample(x: np.ndarray) -> np.ndarray:
        return cv2.resize(x.reshape(h, w, -1), (W, H), interpolation=cv2.INTER_AREA)

    return downsample(picture), downsample(seen) > 0.5, downsample(whole) > 0.5
