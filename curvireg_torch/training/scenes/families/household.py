"""Procedural vessels, packages and creatures."""

import numpy as np

from ..rotations import rotation
from ..surfaces import Part, Rng, bar, box, lathe, superquadric, torus, tube

__all__ = ["creature", "package", "vessel"]


def vessel(rng: Rng) -> list[Part]:
    """Bottles, jars, vases, lamps: surfaces of revolution, with a lid and at times a handle."""
    n = int(rng.integers(3, 7))
    heights = np.sort(rng.uniform(0, 1, n))
    radii = rng.uniform(0.1, 0.4, n)
    if rng.random() < 0.6:  # body, shoulder, neck
        body, neck, at = rng.uniform(0.12, 0.25), rng.uniform(0.04, 0.1), rng.uniform(0.4, 0.75)
        heights = np.array([0, 0.02, at, at + rng.uniform(0.05, 0.2), 0.95])
        radii = np.array([0.9 * body, body, body, neck, neck])
    parts = [(lathe(radii, heights), 0)]
    parts.append((lathe(np.full(2, radii[-1] * 1.1), heights[-1] + np.array([0, rng.uniform(0.03, 0.1)])), 1))
    if rng.random() < 0.5:
        low, high = 0.3 * heights[2], heights[2]
        parts.append((lathe(np.full(2, radii[:3].max() * 1.01), np.array([low, high])), 2))
    if rng.random() < 0.3:
        parts.append((torus(0.15, 0.02).moved((radii.max(), 0, 0.5), rotation(0, np.pi / 2)), 3))
    return parts


def creature(rng: Rng) -> list[Part]:
    """Body, neck, head and limbs of ellipsoids: animals, toys, figures."""
    body = np.array([rng.uniform(0.15, 0.3), rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.35)])
    high = rng.uniform(0.2, 0.6) + body[2]
    ball = (1.0, 1.0)
    parts: list[Part] = [(superquadric(body, ball).moved((0, 0, high), rotation(0, rng.uniform(-0.6, 0.6))), 0)]
    head = np.array([0, -body[1] - rng.uniform(0, 0.2), high + rng.uniform(0, 0.5)])
    parts.append((bar((0, -0.7 * body[1], high), head, rng.uniform(0.05, 0.12)), 0))
    size = rng.uniform((0.1, 0.1, 0.1), (0.2, 0.28, 0.2))
    parts.append((superquadric(size, ball).moved(head), 0))
    for s in (-1, 1):
        ear = superquadric((0.03, 0.05, rng.uniform(0.05, 0.2)), ball)
        at = head + np.array((s * 0.7 * size[0], 0.03, size[2]))
        parts.append((ear.moved(at, rotation(1, s * rng.uniform(0, 0.5))), 1))
        for y in (-0.6, 0.6):
            foot = (s * rng.uniform(0.8, 1.1) * body[0], y * body[1] + rng.normal(0, 0.05), 0)
            parts.append((bar((s * 0.7 * body[0], y * body[1], high), foot, rng.uniform(0.03, 0.08)), 0))
    if rng.random() < 0.6:
        y, tip = body[1], high + rng.uniform(-0.2, 0.4)
        parts.append((tube(np.array([(0, y, high), (0, y + 0.2, high + 0.1), (0, y + 0.3, tip)]), 0.03), 1))
    return parts


def package(rng: Rng) -> list[Part]:
    """Cartons, tins, tubs and bottles with a print: simple bodies that differ mainly in texture."""
    w, d, h = rng.uniform((0.3, 0.15, 0.3), (0.8, 0.5, 1.0))
    kind = rng.integers(4)
    if kind == 0:
        return [(box((w, d, h)), 0)]
    if kind == 1:
        r = 0.4 * w
        return [(lathe([0.9 * r, r, r, 0.9 * r], np.array([0, 0.03, 0.97, 1]) * h), 0)]
    if kind == 2:  # flat bottle with shoulders
        e = (rng.uniform(0.2, 0.6), rng.uniform(0.4, 1.0))
        parts = [(superquadric((0.5 * w, 0.5 * d, 0.5 * h), e), 0)]
        neck = rng.uniform(0.1, 0.3) * w
        top = lathe(np.array([neck, neck, 0.7 * neck]), np.array([0.4, 0.55, 0.7]) * h)
        return [*parts, (top, 1)]
    parts = [(box((w, d, h), top=rng.uniform(0.75, 1.3)), 0)]
    return [*parts, (box((1.05 * w, 1.05 * d, 0.08 * h)).moved((0, 0, 0.52 * h)), 1)]
