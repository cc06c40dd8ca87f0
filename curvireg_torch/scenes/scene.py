"""Scenes with one object in the middle: rays through a random arrangement of shapes."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ..geometry.crops import crop_transforms, square_boxes
from ..geometry.viewpoint import rotation_from_viewpoint
from ..rendering.embree import RayScene
from .camera_noise import photographed
from .materials import Material, random_colour, random_picture
from .shapes import Shape
from .surfaces import Array
from .turns import any_turn

__all__ = ["Scene", "make_scene"]


@dataclass(frozen=True)
class Scene:
    """One photograph-like crop of an object, with its truth.

    Attributes:
        image: (S, S, 3) uint8 RGB.
        depth: (S, S) float32 of the object alone, as a bank's view of it has: unoccluded, 0 = background, in radii.
        visible: (S, S) bool, where the object is seen in the image.
        rotation: (3, 3) model -> camera, the camera looking straight at the object.
        distance: of the object's centre, in radii.
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
    """Arrange, light and photograph.

    Args:
        shape: the object.
        clutter: other shapes to stand behind, beside and before it.
        rng: decides everything.
        size: side of the crop in px.
        margin: room around the object's box, see :class:`BankSettings`.
        upright: probability that the object stands upright; otherwise it has any orientation.
    """
    standing = bool(rng.random() < upright)
    if standing:
        azimuth, elevation = rng.uniform(0, 360), rng.uniform(-12, 60) * rng.choice([0.35, 1.0])
        R = rotation_from_viewpoint(azimuth, elevation, rng.normal(0, 5)).numpy()
    else:
        R = any_turn(rng)
    distance = float(np.exp(rng.uniform(np.log(2.2), np.log(14.0))))
    centre = np.array([0.0, 0.0, distance])
    placed = shape.vertices @ R.T + centre
    K, cut = _crop_camera(placed, rng, size, margin)
    alone = RayScene(placed, shape.faces).distance(*_rays(K, size)).reshape(size, size)
    depth = np.where(np.isfinite(alone), alone, 0.0).astype(np.float32)

    things = [(placed, shape.faces, shape.materials, 0)]
    floor = float((shape.vertices[:, 2]).min())
    above = float(-(R.T @ centre)[2]) > floor + 0.1  # seen from below, the ground would hide everything
    ground = standing and rng.random() < 0.6 and above
    for k, other in enumerate(clutter):
        things.append((*_beside(other, R, centre, floor if ground else None, K, size, rng), k + 1))
    if ground:
        things.append((*_ground(R, centre, floor, rng), 90))
    if rng.random() < 0.3:
        things.append((*_wall(distance, rng), 91))
    # 1.5 rays per pixel and axis, averaged: edges as soft as a sensor's.
    fine = 3 * size // 2
    K_fine = np.diag([1.5, 1.5, 1.0]) @ K
    K_fine[:2, 2] += 0.25  # pixel centres are whole numbers
    rays = _rays(K_fine, fine)
    picture, seen = _render(things, R, centre, rays, fine, rng)
    if seen.mean() < 0.1 * (depth > 0).mean():  # hidden: nothing could be learnt
        picture, seen = _render(things[:1], R, centre, rays, fine, rng)
    picture = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)
    visible = cv2.resize(seen.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA) > 0.5
    picture = picture[cut[1] : cut[3], cut[0] : cut[2]]
    edges = (cut[1], size - cut[3], cut[0], size - cut[2])
    picture = cv2.copyMakeBorder(picture, *edges, cv2.BORDER_REPLICATE)  # beyond the photograph, as crop_images does
    inside = np.zeros_like(visible)
    inside[cut[1] : cut[3], cut[0] : cut[2]] = True
    return Scene(photographed(picture, rng), depth, visible & inside, R, distance)


def _crop_camera(placed: Array, rng: np.random.Generator, size: int, margin: float) -> tuple[Array, list[int]]:
    """Camera matrix of the crop around a jittered box, and the part of the crop that the photograph covers."""
    flat = placed[:, :2] / np.maximum(placed[:, 2:], 0.1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    side = high - low
    jitter = rng.normal(0, rng.choice([0.01, 0.05]), 4)
    box = np.concatenate([low + jitter[:2] * side, high + jitter[2:] * side])
    border = np.array([-np.inf, -np.inf, np.inf, np.inf])
    if rng.random() < 0.2:  # the photograph's border cuts the object
        k = int(rng.integers(4))
        box[k] += (0.5 - k // 2) * 2 * rng.uniform(0.1, 0.45) * side[k % 2]
        border[k] = box[k]
    A = crop_transforms(square_boxes(torch.from_numpy(box), margin), size).numpy()
    corners = np.where(np.isfinite(border), border, 0).reshape(2, 2) @ A[:2, :2] + A[:2, 2]
    whole = np.array([0, 0, size, size])
    cut = np.where(np.isfinite(border), np.round(corners.reshape(-1) + 0.5), whole)
    return A, np.clip(cut, 0, size).astype(int).tolist()


def _rays(K: Array, size: int) -> tuple[Array, Array]:
    v, u = np.mgrid[0:size, 0:size].reshape(2, -1)
    directions = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], -1).astype(np.float32)
    return np.zeros_like(directions), directions


def _beside(
    other: Shape, R: Array, centre: Array, floor: float | None, K: Array, size: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Another shape somewhere in the picture: mostly behind the object, at times before it."""
    scale = np.exp(rng.uniform(-1.0, 0.8))
    upright = R @ rotation_from_viewpoint(rng.uniform(0, 360), 90.0, 0.0).numpy()  # about the vertical
    if floor is not None:
        towards = rng.uniform(0, 2 * np.pi)
        reach = rng.uniform(0.8, 3.5)
        where = np.array([reach * np.cos(towards), reach * np.sin(towards), floor - scale * other.vertices[:, 2].min()])
        points = scale * other.vertices @ upright.T + R @ where + centre
        if points[:, 2].min() > 0.3:
            return points, other.faces, other.materials
    front = rng.random() < 0.25
    z = centre[2] + (-1.3 if front else rng.uniform(0.5, 4.0))
    scale = scale * (0.3 if front else 1.0)
    pixel = rng.uniform(-0.1, 1.1, 2) * size
    if front:  # at the rim, so that it covers a part only
        pixel[rng.integers(2)] = size * rng.choice([0.1, 0.9])
    ray = np.array([(pixel[0] - K[0, 2]) / K[0, 0], (pixel[1] - K[1, 2]) / K[1, 1], 1.0])
    points = scale * other.vertices @ (upright if rng.random() < 0.5 else any_turn(rng)).T + ray * max(z, 0.4 + scale)
    return points, other.faces, other.materials


def _ground(R: Array, centre: Array, floor: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    reach = rng.choice([1.6, 4.0, 60.0])
    corners = reach * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0.0)]) + (0, 0, floor - 0.002)
    return corners @ R.T + centre, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int)


def _wall(distance: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    far = distance + rng.uniform(1.2, 5.0)
    slope = rng.normal(0, 0.4)
    x = 3 * far
    corners = np.array(
        [(-x, -x, far - slope * 3), (x, -x, far + slope * 3), (x, x, far + slope * 3), (-x, x, far - slope * 3)]
    )
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int)


def _render(
    things: list[tuple[Array, Array, Array, int]],
    R: Array,
    centre: Array,
    rays: tuple[Array, Array],
    size: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """(size, size, 3) float32 linear picture of all things, and where the first of them is seen."""
    first = np.cumsum([0] + [len(t[0]) for t in things[:-1]])
    vertices = np.concatenate([t[0] for t in things])
    faces = np.concatenate([t[1] + k for t, k in zip(things, first, strict=True)])
    owner = np.concatenate([np.full(len(t[1]), k) for k, t in enumerate(things)])
    material = np.concatenate([t[2] for t in things])
    scene = RayScene(vertices, faces)
    depth, triangle, normal = scene.hits(*rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[1][hit] * depth[hit, None]
    normal = normal[hit] / (np.linalg.norm(normal[hit], axis=1, keepdims=True) + 1e-12)
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    normal *= np.sign((normal * view).sum(axis=1, keepdims=True) + 1e-12)
    triangle = triangle[hit]
    colour = np.empty_like(points)
    gloss, shininess = np.zeros(len(hit)), np.ones(len(hit))
    label = 1000 * owner[triangle] + material[triangle]
    local = (points - centre) @ R
    textured = rng.uniform(0.2, 0.8)
    for name in np.unique(label):
        look = Material(rng, plain=textured)
        here = label == name
        colour[here] = look.colours(local[here])
        gloss[here], shininess[here] = look.gloss, look.shininess
    light = _lighting(scene, points, normal, view, colour, gloss, shininess, R, rng)
    picture = random_picture(rng, size)
    row, column = np.divmod(hit, size)
    picture[row, column] = light
    seen = np.zeros((size, size), bool)
    seen[row, column] = owner[triangle] == 0
    if rng.random() < 0.35:  # depth of field: what is farther off is blurred
        sigma = rng.uniform(0.7, 4.0)
        near = (depth < centre[2] + 1.0).astype(np.float32).reshape(size, size)
        share = cv2.GaussianBlur(near, (0, 0), 0.6)[..., None]
        blurred = cv2.GaussianBlur(picture * (1.0 - near[..., None]), (0, 0), sigma)
        weight = cv2.GaussianBlur(1.0 - near, (0, 0), sigma)[..., None]
        picture = share * picture + (1 - share) * blurred / np.maximum(weight, 1e-3)
    return picture.astype(np.float32), seen


def _lighting(
    scene: RayScene,
    points: Array,
    normal: Array,
    view: Array,
    colour: Array,
    gloss: Array,
    shininess: Array,
    R: Array,
    rng: np.random.Generator,
) -> Array:
    """Light from the sky and from one or two lamps, with shadows and highlights."""
    up = R[:, 2] if rng.random() < 0.7 else np.array([0.0, -1.0, 0.0])
    sky = (rng.uniform(0.2, 0.7) + rng.uniform(0.0, 0.3) * (normal @ up))[:, None] * (1 + rng.normal(0, 0.05, 3))
    light = colour * sky
    for _ in range(int(rng.integers(1, 3))):
        towards = rng.normal(size=3) + up * rng.uniform(0, 2) + np.array([0, 0, -1.0]) * rng.uniform(0, 1.5)
        towards /= np.linalg.norm(towards)
        power = rng.uniform(0.2, 1.0) * (1 + rng.normal(0, 0.08, 3))
        facing = np.maximum(normal @ towards, 0)
        if rng.random() < 0.6:
            start = points + 2e-3 * points[:, 2:].mean() * normal
            blocked = scene.blocked(start, np.broadcast_to(towards, start.shape))
            facing = facing * np.where(blocked, 0.1, 1.0)
        half = view + towards
        half /= np.linalg.norm(half, axis=1, keepdims=True) + 1e-9
        shine = gloss * np.maximum((normal * half).sum(axis=1), 0) ** shininess * (facing > 0)
        light = light + (colour * facing[:, None] + shine[:, None]) * power
    if rng.random() < 0.4:  # glossy things mirror a bright or dark surrounding
        mirrored = 2 * (normal * view).sum(axis=1, keepdims=True) * normal - view
        bright = np.clip(0.5 + 2.0 * (mirrored @ up - rng.uniform(-0.2, 0.5)), 0, 1)[:, None] * random_colour(rng)
        share = (0.6 * gloss)[:, None]
        light = (1 - share) * light + share * bright
    lit: Array = np.maximum(light, 0)
    return lit
