"""Ray-traced scenes with one object in the centre, as an imperfect camera records them."""

from typing import NamedTuple

import cv2
import numpy as np

from ...rendering.embree import RayScene
from .arrangement import Arrangement
from .light import shade_points
from .shapes import Shape
from .surfaces import Array, Rng, Surface, join

__all__ = ["Scene", "render_scene", "simulate_camera"]

FINE = 1.5  # rays per pixel and axis; their average gives antialiased edges


class Scene(NamedTuple):
    """A crop (S, S, 3) uint8 RGB, the object's depth (S, S) in radii without occlusion, and where it is visible."""

    image: Array
    depth: Array
    visible: Array


def render_scene(arrangement: Arrangement, rng: Rng) -> Scene:
    """Render an arrangement and simulate a camera, whose random imperfections are drawn from ``rng``."""
    size, K = arrangement.size, arrangement.camera_matrix
    body = arrangement.shapes[0]
    alone = RayScene(body.vertices, body.faces).distance(*_rays(K, size)).reshape(size, size)
    depth = np.where(np.isfinite(alone), alone, 0.0).astype(np.float32)
    picture, seen = _render(arrangement, arrangement.shapes)
    if seen.mean() < 0.1 * (depth > 0).mean():  # fully hidden objects are of no use for training
        picture, seen = _render(arrangement, arrangement.shapes[:1])
    picture = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)
    visible = cv2.resize(seen.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA) > 0.5
    x0, y0, x1, y1 = arrangement.photo_area
    border = y0, size - y1, x0, size - x1
    picture = cv2.copyMakeBorder(picture[y0:y1, x0:x1], *border, cv2.BORDER_REPLICATE)  # as crop_images does
    inside = np.pad(np.ones((y1 - y0, x1 - x0), bool), (border[:2], border[2:]))
    return Scene(simulate_camera(picture, rng), depth, visible & inside)


def _rays(K: Array, size: int) -> tuple[Array, Array]:
    v, u = np.mgrid[0:size, 0:size].reshape(2, -1)
    directions = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], -1).astype(np.float32)
    return np.zeros_like(directions), directions


def _render(arrangement: Arrangement, shapes: tuple[Shape, ...]) -> tuple[Array, Array]:
    """(F, F, 3) float32 linear picture of the shapes, F = FINE size, and the pixels in which the first is visible."""
    size = len(arrangement.background)
    K = np.diag([FINE, FINE, 1.0]) @ arrangement.camera_matrix
    K[:2, 2] += 0.5 * (FINE - 1.0)  # pixel centres are whole numbers
    rays = _rays(K, size)
    surface = join([Surface(shape.vertices, shape.faces) for shape in shapes])
    owner = np.repeat(np.arange(len(shapes)), [len(shape.faces) for shape in shapes])
    material = np.concatenate([shape.materials for shape in shapes])
    scene = RayScene(surface.vertices, surface.faces)
    depth, triangle, normal = scene.hits(*rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[1][hit] * depth[hit, None]
    normal = normal[hit] / (np.linalg.norm(normal[hit], axis=1, keepdims=True) + 1e-12)
    normal *= -np.sign((normal * points).sum(axis=1, keepdims=True) - 1e-12)
    owner, material = owner[triangle[hit]], material[triangle[hit]]
    local = (points - (0.0, 0.0, arrangement.distance)) @ arrangement.rotation
    colour = np.empty_like(points)
    gloss, shininess = np.zeros(len(hit)), np.ones(len(hit))
    for k, materials in enumerate(arrangement.materials[: len(shapes)]):
        for number, paint in materials.items():
            here = (owner == k) & (material == number)
            colour[here] = paint.colours(local[here])
            gloss[here], shininess[here] = paint.gloss, paint.shininess
    picture = arrangement.background.copy()
    row, column = np.divmod(hit, size)
    picture[row, column] = shade_points(scene, points, normal, colour, gloss, shininess, arrangement.light)
    seen = np.zeros((size, size), bool)
    seen[row, column] = owner == 0
    if arrangement.defocus > 0:  # depth of field: the distant background is blurred
        near = (depth < arrangement.distance + 1.0).astype(np.float32).reshape(size, size)
        sharp = cv2.GaussianBlur(near, (0, 0), 0.6)[..., None]
        blurred = cv2.GaussianBlur(picture * (1.0 - near[..., None]), (0, 0), arrangement.defocus)
        weight = cv2.GaussianBlur(1.0 - near, (0, 0), arrangement.defocus)[..., None]
        picture = sharp * picture + (1 - sharp) * blurred / np.maximum(weight, 1e-3)
    return picture.astype(np.float32), seen


def simulate_camera(picture: Array, rng: Rng) -> Array:
    """Apply random exposure, white balance, blur, downsampling, noise and JPEG compression to a rendered picture.

    ``picture`` is (H, W, 3) float32 linear light in [0, 1]; the result is uint8.
    """
    height, width = picture.shape[:2]
    gain = rng.uniform(0.45, 0.75) / (np.percentile(picture, rng.uniform(60, 95)) + 1e-3)
    picture = picture * gain * (1 + rng.normal(0, 0.06, 3))
    picture = np.clip(picture, 0, 1) ** rng.uniform(0.5, 1.1)
    if rng.random() < 0.15:
        picture = np.broadcast_to(picture.mean(axis=2, keepdims=True), picture.shape)
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    if rng.random() < 0.5:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.6))
    if rng.random() < 0.1:
        length = int(rng.integers(3, 8))
        kernel = np.zeros((length, length), np.float32)
        cv2.line(kernel, (length // 2, length // 2), rng.integers(0, length, 2).tolist(), 1.0)
        picture = cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    if rng.random() < 0.35:  # low resolution
        scale = rng.uniform(0.35, 0.9)
        few = cv2.resize(picture, (int(width * scale), int(height * scale)), interpolation=cv2.INTER_AREA)
        picture = cv2.resize(few, (width, height))
    picture = picture + rng.normal(0, np.exp(rng.uniform(-6.5, -3.0)), picture.shape)
    coded: Array = (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(30, 96))]
        coded = np.asarray(cv2.imdecode(cv2.imencode(".jpg", coded, quality)[1], cv2.IMREAD_COLOR))
    return coded
