"""Light from the sky and from lamps, with shadows and highlights."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...rendering.embree import RayScene
from .materials import random_colour
from .surfaces import Array, Rng

__all__ = ["Lamp", "Light", "random_light", "shade_points"]

SHADOW = 0.1  # fraction of a lamp's light that reaches shadowed points, as indirect light would


class Lamp(NamedTuple):
    """A distant lamp: unit vector (3,) to it in the camera's frame, linear light (3,), and whether it casts shadows."""

    towards: Array
    power: Array
    shadows: bool


@dataclass(frozen=True)
class Light:
    """All light of a scene.

    Attributes:
        up: (3,) unit vector to the zenith, in the camera's frame.
        sky, tint: ambient light and the additional light from above; (3,) colour of both.
        reflection: height of the horizon and (3,) colour above it, mirrored by glossy surfaces; None for none.
    """

    up: Array
    sky: tuple[float, float]
    tint: Array
    lamps: tuple[Lamp, ...]
    reflection: tuple[float, Array] | None


def random_light(up: Array, rng: Rng) -> Light:
    """Random light for a scene whose z axis is ``up`` (3,) in the camera's frame."""
    up = up if rng.random() < 0.7 else np.array([0.0, -1.0, 0.0])
    sky = (rng.uniform(0.2, 0.7), rng.uniform(0.0, 0.3))
    tint = 1 + rng.normal(0, 0.05, 3)
    lamps = []
    for _ in range(int(rng.integers(1, 3))):
        towards = rng.normal(size=3) + up * rng.uniform(0, 2) + np.array([0, 0, -1.0]) * rng.uniform(0, 1.5)
        power = rng.uniform(0.2, 1.0) * (1 + rng.normal(0, 0.08, 3))
        lamps.append(Lamp(towards / np.linalg.norm(towards), power, bool(rng.random() < 0.6)))
    reflection = (float(rng.uniform(-0.2, 0.5)), random_colour(rng)) if rng.random() < 0.4 else None
    return Light(up, sky, tint, tuple(lamps), reflection)


def shade_points(
    scene: RayScene, points: Array, normal: Array, colour: Array, gloss: Array, shininess: Array, light: Light
) -> Array:
    """(N, 3) linear light that N surface points send to a camera at the origin.

    Args:
        scene: geometry that casts shadows.
        points, normal: (N, 3); normals have unit length and face the camera.
        colour: (N, 3) albedo.
        gloss, shininess: (N,) strength and exponent of the highlights.
        light: of :func:`random_light`.
    """
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    level, more = light.sky
    radiance = colour * (level + more * (normal @ light.up))[:, None] * light.tint
    for lamp in light.lamps:
        facing = np.maximum(normal @ lamp.towards, 0)
        if lamp.shadows:
            start = points + 2e-3 * points[:, 2:].mean() * normal
            blocked = scene.blocked(start, np.broadcast_to(lamp.towards, start.shape))
            facing = facing * np.where(blocked, SHADOW, 1.0)
        half = view + lamp.towards
        half /= np.linalg.norm(half, axis=1, keepdims=True) + 1e-9
        shine = gloss * np.maximum((normal * half).sum(axis=1), 0) ** shininess * (facing > 0)
        radiance = radiance + (colour * facing[:, None] + shine[:, None]) * lamp.power
    if light.reflection is not None:
        horizon, above = light.reflection
        reflection = 2 * (normal * view).sum(axis=1, keepdims=True) * normal - view
        bright = np.clip(0.5 + 2.0 * (reflection @ light.up - horizon), 0, 1)[:, None] * above
        weight = (0.6 * gloss)[:, None]
        radiance = (1 - weight) * radiance + weight * bright
    return np.maximum(radiance, 0)
