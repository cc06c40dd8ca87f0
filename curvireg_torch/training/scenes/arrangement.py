"""Random arrangement of a scene before it is rendered: shapes, materials, light and camera."""

from dataclasses import dataclass

import numpy as np
import torch

from ...geometry.crops import crop_transforms, square_boxes
from ...geometry.viewpoint import rotation_from_viewpoint
from .light import Light, random_light
from .materials import Material, random_picture
from .rotations import random_rotation
from .shapes import Shape
from .surfaces import Array, Rng

__all__ = ["Arrangement", "arrange"]

MARGIN = 0.1  # around the object's box, as in BankSettings


@dataclass(frozen=True)
class Arrangement:
    """A scene before it is rendered.

    Attributes:
        rotation: (3, 3) model -> camera of the object; the camera looks straight at it.
        distance: of the object's centre, in radii.
        shapes: the object first, then its surroundings; in the camera's frame and in radii of the object.
        materials: one dictionary per shape, from material number to material.
        camera_matrix, size: (3, 3) of the crop around the object's box, and its side in px.
        photo_area: x0, y0, x1, y1 in px, the part of the crop that lies within the photograph.
        background: (B, B, 3) linear picture behind everything, B = 3 size // 2.
        defocus: blur of the distant background in px; 0 = none.
    """

    rotation: Array
    distance: float
    shapes: tuple[Shape, ...]
    materials: tuple[dict[int, Material], ...]
    light: Light
    camera_matrix: Array
    size: int
    photo_area: tuple[int, int, int, int]
    background: Array
    defocus: float


def arrange(shape: Shape, clutter: list[Shape], rng: Rng, *, size: int = 128, upright: float = 0.6) -> Arrangement:
    """Draw a random arrangement of a shape among clutter.

    ``size`` is the side of the crop in px, ``upright`` the probability that the object stands upright.
    """
    standing = bool(rng.random() < upright)
    if standing:
        azimuth, elevation = rng.uniform(0, 360), rng.uniform(-12, 60) * rng.choice([0.35, 1.0])
        R = rotation_from_viewpoint(azimuth, elevation, rng.normal(0, 5)).numpy()
    else:
        R = random_rotation(rng)
    distance = float(np.exp(rng.uniform(np.log(2.2), np.log(14.0))))
    centre = np.array([0.0, 0.0, distance])
    placed = shape._replace(vertices=shape.vertices @ R.T + centre)
    K, photo_area = _crop_camera(placed.vertices, rng, size)
    shapes = [placed]
    floor = float((shape.vertices[:, 2]).min())
    above = float(-(R.T @ centre)[2]) > floor + 0.1  # the ground would hide everything from a camera below it
    ground = standing and rng.random() < 0.6 and above
    shapes += [_beside(other, R, centre, floor if ground else None, K, size, rng) for other in clutter]
    if ground:
        shapes.append(_ground(R, centre, floor, rng))
    if rng.random() < 0.3:
        shapes.append(_wall(distance, rng))
    plain = rng.uniform(0.2, 0.8)
    materials = tuple({int(k): Material(rng, plain=plain) for k in np.unique(one.materials)} for one in shapes)
    light = random_light(R[:, 2], rng)
    background = random_picture(rng, 3 * size // 2)
    defocus = float(rng.uniform(0.7, 4.0)) if rng.random() < 0.35 else 0.0
    return Arrangement(R, distance, tuple(shapes), materials, light, K, size, photo_area, background, defocus)


def _crop_camera(placed: Array, rng: Rng, size: int) -> tuple[Array, tuple[int, int, int, int]]:
    """Camera matrix of the crop around a jittered box, and the part of the crop that lies within the photograph."""
    flat = placed[:, :2] / np.maximum(placed[:, 2:], 0.1)
    side = np.ptp(flat, axis=0)
    box = np.concatenate([flat.min(axis=0), flat.max(axis=0)])
    box += rng.normal(0, rng.choice([0.01, 0.05]), 4) * np.tile(side, 2)
    border = np.array([-np.inf, -np.inf, np.inf, np.inf])
    if rng.random() < 0.2:  # the photograph's border cuts the object
        k = int(rng.integers(4))
        box[k] += (0.5 - k // 2) * 2 * rng.uniform(0.1, 0.45) * side[k % 2]
        border[k] = box[k]
    A = crop_transforms(square_boxes(torch.from_numpy(box), MARGIN), size).numpy()
    corners = np.where(np.isfinite(border), border, 0).reshape(2, 2) @ A[:2, :2] + A[:2, 2]
    whole = np.array([0, 0, size, size])
    area = np.where(np.isfinite(border), np.round(corners.reshape(-1) + 0.5), whole)
    x0, y0, x1, y1 = np.clip(area, 0, size).astype(int).tolist()
    return A, (x0, y0, x1, y1)


def _beside(other: Shape, R: Array, centre: Array, floor: float | None, K: Array, size: int, rng: Rng) -> Shape:
    """Place another shape in the picture: mostly behind the object, sometimes in front of it."""
    scale = np.exp(rng.uniform(-1.0, 0.8))
    upright = R @ rotation_from_viewpoint(rng.uniform(0, 360), 90.0, 0.0).numpy()  # about the vertical
    if floor is not None:
        towards = rng.uniform(0, 2 * np.pi)
        reach = rng.uniform(0.8, 3.5)
        where = np.array([reach * np.cos(towards), reach * np.sin(towards), floor - scale * other.vertices[:, 2].min()])
        points = scale * other.vertices @ upright.T + R @ where + centre
        if points[:, 2].min() > 0.3:
            return other._replace(vertices=points)
    front = rng.random() < 0.25
    z = centre[2] + (-1.3 if front else rng.uniform(0.5, 4.0))
    scale *= 0.3 if front else 1.0
    pixel = rng.uniform(-0.1, 1.1, 2) * size
    if front:  # near the border, so that it hides only a part of the object
        pixel[rng.integers(2)] = size * rng.choice([0.1, 0.9])
    ray = np.array([(pixel[0] - K[0, 2]) / K[0, 0], (pixel[1] - K[1, 2]) / K[1, 1], 1.0])
    R = upright if rng.random() < 0.5 else random_rotation(rng)
    return other._replace(vertices=scale * other.vertices @ R.T + ray * max(z, 0.4 + scale))


def _ground(R: Array, centre: Array, floor: float, rng: Rng) -> Shape:
    reach = rng.choice([1.6, 4.0, 60.0])
    corners = reach * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0.0)]) + (0, 0, floor - 0.002)
    return _quadrilateral(corners @ R.T + centre)


def _wall(distance: float, rng: Rng) -> Shape:
    far = distance + rng.uniform(1.2, 5.0)
    slope = rng.normal(0, 0.4)
    x, left, right = 3 * far, far - slope * 3, far + slope * 3
    return _quadrilateral(np.array([(-x, -x, left), (x, -x, right), (x, x, right), (-x, x, left)]))


def _quadrilateral(corners: Array) -> Shape:
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int))
