"""Light from the sky and from lamps, with shadows and highlights."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from curvireg_torch.rendering.embree import RayScene
from scripts.scenes.materials import random_colour
from scripts.scenes.surfaces import Array, Rng

SHADOW = 0.1  # fraction of a lamp's light that reaches shadowed points, as indirect light would


class Lamp(NamedTuple):
    """A distant lamp: unit vector (3,) to it, linear light (3,), and whether it casts shadows."""

    towards: Array
    power: Array
    shadows: bool


@dataclass(frozen=True)
class Light:
    """All light of a scene, in the scene's frame or, after :meth:`seen_by`, in a camera's.

    Attributes:
        up: (3,) unit vector to the zenith.
        sky, tint: ambient light and the additional light from above; (3,) colour of both.
        reflection: height of the horizon and (3,) colour above it, mirrored by glossy surfaces;
            None for none.
    """

    up: Array
    sky: tuple[float, float]
    tint: Array
    lamps: tuple[Lamp, ...]
    reflection: tuple[float, Array] | None

    def seen_by(self, R: Array) -> "Light":
        """The light in the frame of a camera with rotation R (3, 3), scene -> camera."""
        beside = np.array([0.3, -0.4, -0.87])
        lamps = [
            lamp._replace(towards=R @ lamp.towards if lamp.towards.any() else beside)
            for lamp in self.lamps
        ]
        return replace(self, up=R @ self.up, lamps=tuple(lamps))


def random_light(rng: Rng) -> Light:
    """Random light of a scene whose z axis points up."""
    up = np.array([0.0, 0.0, 1.0])
    sky = (rng.uniform(0.2, 0.7), rng.uniform(0.0, 0.3))
    tint = 1 + rng.normal(0, 0.05, 3)
    lamps = []
    for _ in range(int(rng.integers(1, 3))):
        towards = rng.normal(size=3) + up * rng.uniform(0, 2)
        power = rng.uniform(0.2, 1.0) * (1 + rng.normal(0, 0.08, 3))
        shadows = bool(rng.random() < 0.6)
        lamps.append(Lamp(towards / np.linalg.norm(towards), power, shadows))
    if rng.random() < 0.5:  # a lamp beside the camera
        lamps[0] = lamps[0]._replace(towards=np.zeros(3))
    reflection = None
    if rng.random() < 0.4:
        horizon = float(rng.uniform(-0.2, 0.5))
        reflection = (horizon, random_colour(rng))
    return Light(up, sky, tint, tuple(lamps), reflection)


def shade_points(
    scene: RayScene,
    points: Array,
    normal: Array,
    colour: Array,
    gloss: Array,
    shininess: Array,
    light: Light,
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
            blocked = np.isfinite(scene.distance(start, np.broadcast_to(lamp.towards, start.shape)))
            facing = facing * np.where(blocked, SHADOW, 1.0)
        half = view + lamp.towards
        half /= np.linalg.norm(half, axis=1, keepdims=True) + 1e-9
        highlight = np.maximum((normal * half).sum(axis=1), 0) ** shininess
        shine = gloss * highlight * (facing > 0)
        radiance = radiance + (colour * facing[:, None] + shine[:, None]) * lamp.power
    if light.reflection is not None:
        horizon, above = light.reflection
        reflection = 2 * (normal * view).sum(axis=1, keepdims=True) * normal - view
        height = reflection @ light.up - horizon
        bright = np.clip(0.5 + 2.0 * height, 0, 1)[:, None] * above
        weight = (0.6 * gloss)[:, None]
        radiance = (1 - weight) * radiance + weight * bright
    return np.maximum(radiance, 0)
