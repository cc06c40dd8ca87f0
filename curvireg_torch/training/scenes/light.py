"""Light from the sky and from lamps, with shadows and highlights."""

from dataclasses import dataclass

import numpy as np

from ...rendering.embree import RayScene
from .materials import random_colour
from .surfaces import Array

__all__ = ["Lamp", "Light", "lit", "random_light"]

SHADOW = 0.1
"""Share of a lamp's light that reaches what it cannot see: rooms are not black."""


@dataclass(frozen=True)
class Lamp:
    """Far away.

    Attributes:
        towards: (3,) unit vector from the scene to the lamp, in the camera's frame.
        power: (3,) linear light.
        shadows: whether it casts them.
    """

    towards: Array
    power: Array
    shadows: bool


@dataclass(frozen=True)
class Light:
    """Everything that lights a scene.

    Attributes:
        up: (3,) unit vector to the zenith, in the camera's frame.
        sky: light from everywhere, and how much more comes from above.
        tint: (3,) of the sky.
        lamps: any number.
        mirrored: height of the horizon and (3,) colour above it that glossy things mirror; None for nothing.
    """

    up: Array
    sky: tuple[float, float]
    tint: Array
    lamps: tuple[Lamp, ...]
    mirrored: tuple[float, Array] | None


def random_light(up: Array, rng: np.random.Generator) -> Light:
    """Some light for a scene whose z axis is ``up`` (3,) in the camera's frame.

    Example:
        >>> light = random_light(np.array([0.0, -1.0, 0.0]), np.random.default_rng(0))
        >>> 1 <= len(light.lamps) <= 2
        True
    """
    up = up if rng.random() < 0.7 else np.array([0.0, -1.0, 0.0])
    sky = (rng.uniform(0.2, 0.7), rng.uniform(0.0, 0.3))
    tint = 1 + rng.normal(0, 0.05, 3)
    lamps = []
    for _ in range(int(rng.integers(1, 3))):
        towards = rng.normal(size=3) + up * rng.uniform(0, 2) + np.array([0, 0, -1.0]) * rng.uniform(0, 1.5)
        power = rng.uniform(0.2, 1.0) * (1 + rng.normal(0, 0.08, 3))
        lamps.append(Lamp(towards / np.linalg.norm(towards), power, bool(rng.random() < 0.6)))
    mirrored = (float(rng.uniform(-0.2, 0.5)), random_colour(rng)) if rng.random() < 0.4 else None
    return Light(up, sky, tint, tuple(lamps), mirrored)


def lit(
    scene: RayScene,
    points: Array,
    normal: Array,
    colour: Array,
    gloss: Array,
    shininess: Array,
    light: Light,
) -> Array:
    """(N, 3) linear light that N points of a scene send to a camera at the origin.

    Args:
        scene: what casts shadows.
        points, normal: (N, 3), normals of unit length on the camera's side.
        colour: (N, 3) share of the light that is sent back.
        gloss, shininess: (N,) strength of the highlights and their exponent.
        light: see :func:`random_light`.
    """
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    level, more = light.sky
    answer = colour * (level + more * (normal @ light.up))[:, None] * light.tint
    for lamp in light.lamps:
        facing = np.maximum(normal @ lamp.towards, 0)
        if lamp.shadows:
            start = points + 2e-3 * points[:, 2:].mean() * normal
            blocked = scene.blocked(start, np.broadcast_to(lamp.towards, start.shape))
            facing = facing * np.where(blocked, SHADOW, 1.0)
        half = view + lamp.towards
        half /= np.linalg.norm(half, axis=1, keepdims=True) + 1e-9
        shine = gloss * np.maximum((normal * half).sum(axis=1), 0) ** shininess * (facing > 0)
        answer = answer + (colour * facing[:, None] + shine[:, None]) * lamp.power
    if light.mirrored is not None:  # glossy things mirror a bright or dark surrounding
        horizon, above = light.mirrored
        mirrored = 2 * (normal * view).sum(axis=1, keepdims=True) * normal - view
        bright = np.clip(0.5 + 2.0 * (mirrored @ light.up - horizon), 0, 1)[:, None] * above
        share = (0.6 * gloss)[:, None]
        answer = (1 - share) * answer + share * bright
    return np.maximum(answer, 0)
