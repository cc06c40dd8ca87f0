"""Procedural compounds, stacks, machine parts and lumps."""

import numpy as np

from ..rotations import random_rotation, rotation
from ..surfaces import Part, Rng, Surface, bar, box, extrude, lathe, rounded_box, superquadric, torus

__all__ = ["bracket", "compound", "lump", "stack"]


def _piece(rng: Rng) -> Surface:
    """One surface of any kind, about 1 across."""
    size = np.exp(rng.normal(0, 0.45, 3)) * 0.5
    kind = rng.integers(7)
    if kind == 0:
        return box(2 * size, top=rng.uniform(0.3, 1.0))
    if kind == 1:
        return superquadric(size, (rng.uniform(0.1, 1.5), rng.uniform(0.1, 1.5)))
    if kind == 2:
        return lathe(rng.uniform(0.1, 1, 5).repeat(2) * size[0], np.linspace(-1, 1, 10) * size[1])
    if kind == 3:
        return lathe(np.full(2, size[0]), np.array([-1, 1]) * size[1])
    if kind == 4:
        n = int(rng.integers(3, 14))
        t = np.sort(2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n)
        outline = rng.uniform(0.4, 1, (n, 1)) * np.stack([np.cos(t), np.sin(t)], -1)
        return extrude(outline, size[2])
    if kind == 5:
        return torus(size[0], rng.uniform(0.1, 0.5) * size[0])
    return bar((0, 0, -size[2]), (0, 0, size[2]), 0.1 + 0.2 * size[0], sides=int(rng.choice([4, 6, 12])))


def compound(rng: Rng) -> list[Part]:
    """Overlapping pieces, often mirrored in x."""
    parts: list[Part] = []
    centre, mirrored = np.zeros(3), rng.random() < 0.5
    for k in range(int(rng.integers(2, 8))):
        any_angle = rng.random() < 0.3
        R = random_rotation(rng) if any_angle else rotation(int(rng.integers(3)), 0.5 * np.pi * rng.integers(4))
        piece = _piece(rng).moved(centre, R, rng.uniform(0.3, 1.0))
        parts.append((piece, k))
        if mirrored:
            parts.append((Surface(piece.vertices * (-1, 1, 1), piece.faces), k))
        centre = piece.vertices[rng.integers(len(piece.vertices))]
    return parts


def stack(rng: Rng) -> list[Part]:
    """Boxes side by side and on top of each other, like furniture, houses and machines."""
    parts: list[Part] = []
    top = 0.0
    for k in range(int(rng.integers(1, 5))):
        size = rng.uniform((0.3, 0.3, 0.1), (1.2, 1.2, 0.8))
        parts.append((rounded_box(rng, size).moved((*rng.normal(0, 0.15, 2), top + 0.5 * size[2])), k))
        top += size[2] * rng.uniform(0.8, 1.0)
    return parts


def bracket(rng: Rng) -> list[Part]:
    """Machine parts: plates, ribs, rims of holes, bolts and gears."""
    w, d, t = rng.uniform((0.6, 0.3, 0.05), (1.2, 0.8, 0.15))
    parts: list[Part] = [(box((w, d, t)), 0)]
    parts.append((box((t, d, rng.uniform(0.3, 0.9))).moved((0.5 * w * rng.choice([-1, 0, 1]), 0, 0.25)), 0))
    for k in range(int(rng.integers(1, 5))):
        at = (*(rng.uniform(-0.4, 0.4, 2) * (w, d)), 0.5 * t)
        r, h = rng.uniform(0.04, 0.15), rng.uniform(0.02, 0.4)
        if rng.random() < 0.4:
            teeth = 2 * int(rng.integers(6, 14))
            a = 2 * np.pi * np.arange(2 * teeth) / (2 * teeth)
            radius = 2 * r * np.where(np.arange(2 * teeth) % 4 < 2, 1.0, 0.8)
            parts.append((extrude(radius[:, None] * np.stack([np.cos(a), np.sin(a)], -1), h).moved(at), 1))
        else:
            parts.append((lathe(np.array([r, r, 0.7 * r, 0.7 * r]), np.array([0, h, h, 0.5 * h])).moved(at), k % 2))
    return parts


def lump(rng: Rng) -> list[Part]:
    """Smooth bumpy bodies: stones, fruit, soft toys."""
    parts: list[Part] = []
    for k in range(int(rng.integers(1, 4))):
        ball = superquadric(rng.uniform(0.5, 1.0, 3), (1.0, 1.0))
        waves, phases = rng.normal(0, rng.uniform(1, 4), (3, 6)), rng.uniform(0, 6.3, 6)
        bumps = np.sin(ball.vertices @ waves + phases).mean(axis=1, keepdims=True)
        lump = Surface(ball.vertices * (1 + rng.uniform(0.1, 0.7) * bumps), ball.faces)
        parts.append((lump.moved(rng.normal(0, 0.6, 3) * (k > 0), scale=rng.uniform(0.4, 1) if k else 1.0), k))
    return parts
