"""Ray-traced scenes with one object in the centre."""

from dataclasses import dataclass

import cv2
import numpy as np

from ...rendering.embree import RayScene
from .arrangement import Arrangement, PlacedShape, arrange
from .camera_noise import simulate_camera
from .light import shade_points
from .shapes import Shape
from .surfaces import Array

__all__ = ["Scene", "make_scene", "render_scene"]

FINE = 1.5
"""Rays per pixel and axis. Their average gives antialiased edges."""


@dataclass(frozen=True)
class Scene:
    """One photograph-like crop of an object with its ground truth.

    Attributes:
        image: (S, S, 3) uint8 RGB.
        depth: (S, S) float32 depth of the object in radii, without occlusion, 0 = background, as in a bank's view.
        visible: (S, S) bool, pixels in which the object is visible.
        rotation: (3, 3) model -> camera; the camera looks straight at the object.
        distance: distance of the object's centre in radii.
    """

    image: Array
    depth: Array
    visible: Array
    rotation: Array
    distance: float


def make_scene(
    shape: Shape,
    clutter: list[Shape],
    rng: np.random.Generator,
    *,
    size: int = 128,
    margin: float = 0.1,
    upright: float = 0.6,
) -> Scene:
    """Arrange and render a random scene.

    Args:
        shape: the object.
        clutter: other shapes to place around it.
        rng: random generator.
        size: side of the crop in px.
        margin: margin around the object's box, see :class:`BankSettings`.
        upright: probability that the object stands upright; otherwise it has any orientation.
    """
    return render_scene(arrange(shape, clutter, rng, size=size, margin=margin, upright=upright), rng)


def render_scene(arrangement: Arrangement, rng: np.random.Generator) -> Scene:
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
    picture = picture[y0:y1, x0:x1]
    picture = cv2.copyMakeBorder(picture, y0, size - y1, x0, size - x1, cv2.BORDER_REPLICATE)  # as crop_images does
    inside = np.zeros_like(visible)
    inside[y0:y1, x0:x1] = True
    return Scene(simulate_camera(picture, rng), depth, visible & inside, arrangement.rotation, arrangement.distance)


def _rays(K: Array, size: int) -> tuple[Array, Array]:
    v, u = np.mgrid[0:size, 0:size].reshape(2, -1)
    directions = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], -1).astype(np.float32)
    return np.zeros_like(directions), directions


def _render(arrangement: Arrangement, shapes: tuple[PlacedShape, ...]) -> tuple[Array, Array]:
    """(F, F, 3) float32 linear picture of the shapes, F = FINE size, and the pixels in which the first is visible."""
    size = len(arrangement.background)
    K = np.diag([FINE, FINE, 1.0]) @ arrangement.camera_matrix
    K[:2, 2] += 0.5 * (FINE - 1.0)  # pixel centres are whole numbers
    rays = _rays(K, size)
    first = np.cumsum([0] + [len(thing.vertices) for thing in shapes[:-1]])
    vertices = np.concatenate([thing.vertices for thing in shapes])
    faces = np.concatenate([thing.faces + k for thing, k in zip(shapes, first, strict=True)])
    owner = np.concatenate([np.full(len(thing.faces), k) for k, thing in enumerate(shapes)])
    material = np.concatenate([thing.materials for thing in shapes])
    scene = RayScene(vertices, faces)
    depth, triangle, normal = scene.hits(*rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[1][hit] * depth[hit, None]
    normal = normal[hit] / (np.linalg.norm(normal[hit], axis=1, keepdims=True) + 1e-12)
    normal *= -np.sign((normal * points).sum(axis=1, keepdims=True) - 1e-12)
    owner, material = owner[triangle[hit]], material[triangle[hit]]
    local = (points - arrangement.centre) @ arrangement.rotation
    colour = np.empty_like(points)
    gloss, shininess = np.zeros(len(hit)), np.ones(len(hit))
    for k in range(len(shapes)):
        for number, material_of in arrangement.materials[k].items():
            here = (owner == k) & (material == number)
            colour[here] = material_of.colours(local[here])
            gloss[here], shininess[here] = material_of.gloss, material_of.shininess
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
