"""Triangles with their own colours, as rays meet them."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from curvireg_torch.rendering.embree import RayScene
from curvireg_torch.training.scenes.rotations import random_rotation

LARGEST = 384
"""Side of textures in px: finer ones would only alias in pictures of this size."""


@dataclass(frozen=True)
class Textured:
    """Triangles (F, 3, 3), their corners' normals (F, 3, 3) and texture places (F, 3, 2), and a material each.

    ``colours`` (M, 3) are linear, ``pictures`` (T, T, 3) float32 linear or None, ``gloss`` (M,). ``hull`` numbers the
    corners on the convex hull, which decide boxes.
    """

    triangles: np.ndarray
    normals: np.ndarray
    places: np.ndarray
    material: np.ndarray
    colours: np.ndarray
    pictures: tuple[np.ndarray | None, ...]
    gloss: np.ndarray
    hull: np.ndarray

    @classmethod
    def load(cls, path: Path) -> "Textured":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of faces without a place in the texture
            loaded = trimesh.load(path, process=False)
        parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
        columns = ([], [], [], [])
        colours, pictures, gloss = [], [], []
        for number, part in enumerate(p for p in parts if isinstance(p, trimesh.Trimesh) and len(p.faces)):
            faces = np.asarray(part.faces)
            corners = np.asarray(part.vertices)[faces]
            flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            flat = np.repeat(flat[:, None], 3, axis=1)
            given = part._cache.cache.get("vertex_normals")
            given = flat if given is None else np.asarray(given)[faces]
            uv = getattr(part.visual, "uv", None)
            material = getattr(part.visual, "material", None)
            image = getattr(material, "image", None) if uv is not None else None
            columns[0].append(corners)
            columns[1].append(given)
            columns[2].append(np.zeros((*faces.shape, 2)) if uv is None else np.asarray(uv)[faces])
            columns[3].append(np.full(len(faces), number))
            diffuse = np.asarray(getattr(material, "diffuse", [160, 160, 160, 255]), float)[:3] / 255
            shiny = np.asarray(getattr(material, "specular", [0, 0, 0, 255]), float)[:3].mean() / 255
            colours.append(np.clip(diffuse, 0.01, 1) ** 2.2)
            pictures.append(None if image is None else _linear(image))
            gloss.append(shiny)
        made = [np.concatenate(c) for c in columns]
        return cls(
            *made, np.array(colours), tuple(pictures), np.array(gloss), ConvexHull(made[0].reshape(-1, 3)).vertices
        )

    @classmethod
    def plane(cls, corners: list) -> "Textured":
        """A quadrilateral, its texture's square from corner to corner."""
        p, uv = np.array(corners, float), np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)])
        index = np.array([[0, 1, 2], [0, 2, 3]])
        normal = np.cross(p[1] - p[0], p[3] - p[0])
        return cls(
            p[index],
            np.tile(normal, (2, 3, 1)),
            uv[index],
            np.zeros(2, int),
            np.ones((1, 3)),
            (None,),
            np.zeros(1),
            np.arange(6),
        )

    def papered(self, picture: np.ndarray, repeats: float) -> "Textured":
        return replace(self, places=self.places * repeats, pictures=(picture,))

    def painted(self, colour: np.ndarray) -> "Textured":
        """The same in one colour: bare plastic, plaster or metal."""
        n = len(self.colours)
        return replace(self, colours=np.tile(colour, (n, 1)), pictures=(None,) * n, gloss=np.full(n, 0.2))

    def points(self) -> np.ndarray:
        """(P, 3) corners of the convex hull."""
        return self.triangles.reshape(-1, 3)[self.hull]

    def rays(self) -> RayScene:
        return RayScene(self.triangles.reshape(-1, 3), np.arange(3 * len(self.triangles)).reshape(-1, 3))

    def radius_and_centre(self) -> tuple[float, np.ndarray]:
        low, high = self.points().min(axis=0), self.points().max(axis=0)
        return 0.5 * float(np.linalg.norm(high - low)), 0.5 * (low + high)

    def placement(self, turn: np.ndarray) -> np.ndarray:
        """Where the middle of the object's box lies once it is turned and stands on the floor, in radii."""
        radius, centre = self.radius_and_centre()
        lowest = ((self.points() - centre) @ turn.T)[:, 2].min() / radius
        return np.array([0.0, 0.0, -lowest])

    def standing(self, turn: np.ndarray | None, scale: float, about_z: float) -> "Textured":
        """Radius ``scale``, turned, and put on the floor above the origin."""
        c, s = np.cos(about_z), np.sin(about_z)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (np.eye(3) if turn is None else turn)
        radius, centre = self.radius_and_centre()
        moved = ((self.triangles - centre) @ R.T / radius + self.placement(R)) * scale
        return replace(self, triangles=moved, normals=self.normals @ R.T)

    def shifted(self, shift) -> "Textured":
        return replace(self, triangles=self.triangles + np.asarray(shift))

    def with_pose_prior(self, R: np.ndarray, t: np.ndarray) -> "Textured":
        return replace(self, triangles=self.triangles @ R.T + t, normals=self.normals @ R.T)

    def surface(self, number: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear colour (N, 3), unit normal (N, 3) and gloss (N,) at points of the triangles ``number``."""
        weights = _barycentric(self.triangles[number], points)
        normal = (weights[..., None] * self.normals[number]).sum(axis=1)
        corners = self.triangles[number]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 1e-9, normal, flat)
        normal = normal / (np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12)
        place = (weights[..., None] * self.places[number]).sum(axis=1)
        material = self.material[number]
        colour = self.colours[material].copy()
        for k in np.unique(material):
            if self.pictures[k] is not None:
                here = material == k
                colour[here] = _looked_up(self.pictures[k], place[here])
        return colour, normal, self.gloss[material]


def _linear(image) -> np.ndarray:
    rgba = np.asarray(image.convert("RGBA"), np.float32) / 255
    rgb = (rgba[..., :3] * rgba[..., 3:] + 0.8 * (1 - rgba[..., 3:])) ** 2.2
    shrink = LARGEST / max(rgb.shape[:2])
    return cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb


def _looked_up(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Bilinear, repeated without end; v points up."""
    h, w = picture.shape[:2]
    x, y = place[:, 0] * w - 0.5, (1 - place[:, 1]) * h - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    x0, y0 = x0.astype(np.int64) % w, y0.astype(np.int64) % h
    x1, y1 = (x0 + 1) % w, (y0 + 1) % h
    top = picture[y0, x0] * (1 - fx) + picture[y0, x1] * fx
    return top * (1 - fy) + (picture[y1, x0] * (1 - fx) + picture[y1, x1] * fx) * fy


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1) + 1e-30
    u = (np.cross(c - b, points - b) * normal).sum(axis=1) / area
    v = (np.cross(a - c, points - c) * normal).sum(axis=1) / area
    weights = np.clip(np.stack([u, v, 1 - u - v], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def look_symmetries(model: Textured, candidates: list[int], turns: np.ndarray, *, side: int = 32) -> list[int]:
    """Those of the shape's symmetries that also leave the colours where they were, seen from four sides."""
    if len(candidates) < 2:
        return candidates
    radius, centre = model.radius_and_centre()
    model = replace(model, triangles=(model.triangles - centre) / radius)
    grid = np.linspace(-1, 1, side)
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    scene = model.rays()
    views = [random_rotation(np.random.default_rng(k)) for k in range(4)]

    def seen(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    reference, there = seen(np.eye(3))
    kept = []
    for k in candidates:
        picture, here = seen(turns[k])
        both = there & here
        if k == 0 or (np.abs(picture - reference)[both].max(axis=-1) > 0.12).mean() < 0.04:
            kept.append(k)
    return kept
