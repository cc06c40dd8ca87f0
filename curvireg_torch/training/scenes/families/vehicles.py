"""Procedural vehicles, one function per family; the front points along -y."""

import numpy as np
from numpy.typing import ArrayLike

from ..rotations import rotation
from ..surfaces import Array, Part, Rng, Surface, bar, box, lathe, loft, rounded_box, superquadric, torus, tube

__all__ = ["aircraft", "bicycle", "boat", "car", "train"]


def _wheels(rng: Rng, length: float, width: float, radius: float) -> list[Part]:
    across = rotation(1, np.pi / 2)
    heights = np.array([0.0, -0.35, -0.5, -0.3, 0.3, 0.5]) * radius * 0.5
    tyre = lathe(radius * np.array([0.55, 0.6, 0.95, 1, 1, 0.95]), heights)
    hub = lathe(np.full(2, 0.55 * radius), np.array([-0.24, 0.24]) * radius)
    parts: list[Part] = []
    for s in (-1, 1):
        for y in (-rng.uniform(0.27, 0.36), rng.uniform(0.25, 0.35)):
            at = (s * 0.5 * width, y * length, radius)
            parts += [(tyre.moved(at, across), 7), (hub.moved(at, across), 8)]
    return parts


def car(rng: Rng) -> list[Part]:
    """Side outlines of cars, vans, buses and pick-ups, extruded across and narrowed towards the roof."""
    length, width, height = rng.uniform((1.5, 0.65, 0.5), (2.2, 0.85, 0.75))
    radius = rng.uniform(0.14, 0.19)
    bonnet, roof_front, roof_back, boot = rng.uniform((0.12, 0.3, 0.6, 0.82), (0.3, 0.45, 0.85, 1.0))
    belt, nose, tail = rng.uniform((0.5, 0.4, 0.45), (0.62, 0.55, 0.62))
    if rng.random() < 0.3:  # van or bus
        bonnet, roof_front, roof_back, boot, tail = 0.02, rng.uniform(0.08, 0.25), 0.97, 1.0, belt
        height *= rng.uniform(1.0, 1.5)
    low = 0.7 * radius
    pickup = boot < 1.0 and rng.random() < 0.25
    if pickup:  # a short cabin at the end of the body
        roof_front, roof_back, tail = rng.uniform((0.3, 0.5, 0.9 * belt), (0.4, 0.58, belt))
        boot = roof_back + 0.04
    end = [(boot, low)] if pickup else [(1, tail * height), (1, low)]
    body = np.array([(0, low), (0, nose * height), (bonnet, belt * height), (boot, belt * height), *end])
    cabin = np.array([(bonnet, belt * height), (roof_front, height), (roof_back, 0.98 * height), (boot, belt * height)])

    def across(outline: Array, wide: float) -> Surface:
        y, n = (outline[:, 0] - 0.5) * length, len(outline)
        narrow = wide * np.where(outline[:, 1] > belt * height + 1e-6, rng.uniform(0.7, 0.9), 1.0)
        points = np.stack([np.stack([s * 0.5 * narrow, y, outline[:, 1]], -1) for s in (-1, 1)])
        ring = np.arange(n)
        following = (ring + 1) % n
        faces = [np.stack([ring, following, following + n], -1), np.stack([ring, following + n, ring + n], -1)]
        faces += [np.stack([k * n + ring, k * n + following, np.full(n, 2 * n + k)], -1) for k in (0, 1)]
        return Surface(np.concatenate([points.reshape(-1, 3), points.mean(axis=1)]), np.concatenate(faces))

    parts: list[Part] = [(across(body, width), 0), (across(cabin, width), 0)]
    centre = cabin.mean(axis=0)
    if rng.random() < 0.85:  # windows, slightly outside the cabin
        glass = centre + (cabin - centre) * np.array([0.86, 0.75])
        parts.append((across(glass, width * 1.02), 1))
        wide = 0.66 * width
        for a, b in ((cabin[0], cabin[1]), (cabin[3], cabin[2])):
            p, q = a + 0.15 * (b - a), a + 0.88 * (b - a)
            out = np.sign(p[0] - 0.5) * 0.004
            quad = [(s * 0.5 * wide, (e[0] - 0.5 + out) * length, e[1] + 0.004) for e in (p, q) for s in (-1, 1)]
            parts.append((Surface(np.array(quad), np.array([[0, 1, 3], [0, 3, 2]])), 1))
    if pickup:
        parts += _bed(length, width, boot, (low, rng.uniform(0.5, 0.7) * belt * height, tail * height))
    for s in (-1, 1):
        lamp = box((0.2 * width, 0.02, 0.06)).moved((s * 0.35 * width, -0.5 * length, nose * height - 0.05))
        parts += [(lamp, 2), (lamp.moved((0, length, (tail - nose) * height)), 3)]
    return parts + _wheels(rng, length, width, radius)


def _bed(length: float, width: float, start: float, heights: tuple[float, float, float]) -> list[Part]:
    """Open bed from the fraction ``start`` of the length; ``heights`` of its underside, floor and rim."""
    low, floor, rim = heights
    thick, long = 0.05 * width, (1 - start) * length
    middle = (0.5 * (start + 1) - 0.5) * length
    wall, at = rim - low, 0.5 * (rim + low)
    base = box((width, long, floor - low)).moved((0, middle, 0.5 * (floor + low)))
    gate = box((width, thick, wall)).moved((0, 0.5 * (length - thick), at))
    sides = [box((thick, long, wall)).moved((s * 0.5 * (width - thick), middle, at)) for s in (-1, 1)]
    return [(part, 0) for part in (base, gate, *sides)]


def bicycle(rng: Rng) -> list[Part]:
    radius, base = rng.uniform(0.28, 0.36), rng.uniform(0.9, 1.1)
    rod, tyre = rng.uniform(0.012, 0.03), rng.uniform(0.015, 0.04)
    across = rotation(1, np.pi / 2)
    back, front = np.array([0, base / 2, radius]), np.array([0, -base / 2, radius])
    crank, seat, head = np.array([0, 0.08, 0.28]), np.array([0, 0.2, 0.78]), np.array([0, -0.32, 0.78])
    low_head = 0.75 * head + 0.25 * front
    parts: list[Part] = []
    for hub in (back, front):
        parts.append((torus(radius, tyre).moved(hub, across), 1))
        if rng.random() < 0.7:
            t = np.pi * np.arange(int(rng.integers(3, 9))) / 8
            rim = radius * np.stack([0 * t, np.cos(t), np.sin(t)], -1)
            parts += [(bar(hub - r, hub + r, 0.004), 2) for r in rim]
    edges = [(back, crank), (back, seat), (seat, crank), (crank, low_head), (seat, head), (head, front)]
    parts += [(bar(a, b, rod), 0) for a, b in edges]
    if rng.random() < 0.35:  # engine and tank
        parts.append((rounded_box(rng, (0.2, 0.4, 0.3)).moved((0, 0, 0.4)), 3))
        parts.append((superquadric((0.12, 0.28, 0.1), (0.8, 0.8)).moved((0, -0.1, 0.75)), 0))
        parts.append((rounded_box(rng, (0.2, 0.5, 0.1)).moved((0, 0.3, 0.75)), 4))
    else:
        saddle = seat + np.array((0, 0, 0.08))
        parts.append((superquadric((0.05, 0.13, 0.03), (0.6, 0.8)).moved(saddle), 4))
        parts.append((bar(seat, saddle, rod), 0))
        parts.append((torus(0.08, 0.01).moved(crank, across), 2))
    grip, wide = head + np.array((0, -0.03, rng.uniform(0.1, 0.25))), rng.uniform(0.2, 0.35)
    parts.append((bar(head, grip, rod), 0))
    parts.append((tube(np.array([grip + np.array((-wide, 0.1, 0)), grip, grip + np.array((wide, 0.1, 0))]), rod), 2))
    return parts


def aircraft(rng: Rng) -> list[Part]:
    r, span = rng.uniform(0.07, 0.13), rng.uniform(0.6, 1.1)
    y = np.array([-1, -0.97, -0.85, -0.5, 0.4, 0.8, 1.0])
    body = lathe(r * np.array([0.05, 0.4, 0.85, 1, 1, 0.6, 0.15]), y).moved(rotation=rotation(0, np.pi / 2))
    parts: list[Part] = [(body.moved(scale=(1, -1, 1)), 0)]

    def wings(root: float, tip: float, half: float, sweep: float, at: ArrayLike, rise: float) -> list[Part]:
        outline = np.array([(-0.5, -0.3), (0.5, -0.3), (0.5, 0.3), (-0.5, 0.3)]) * (1, 0.15)
        solid = loft(np.stack([outline * root, outline * tip + (sweep, rise)]), np.array([0, half]))
        x, y, z = solid.vertices.T
        return [(Surface(np.stack([s * z, x, y], -1), solid.faces).moved(at), 1) for s in (-1, 1)]

    height, sweep = rng.choice([-0.5, 0.0, 0.9]) * r, rng.uniform(0, 0.5)
    root, tip, rise = rng.uniform(0.25, 0.45), rng.uniform(0.08, 0.25), rng.uniform(0, 0.1)
    parts += wings(root, tip, span, sweep, (0, -0.05, height), rise)
    parts += wings(0.2, 0.1, 0.35 * span, 0.6 * sweep, (0, 0.85, rng.choice([0.3, 2.0]) * r), 0.02)
    fin, _ = wings(0.25, 0.12, rng.uniform(0.2, 0.35), 0.15, (0, 0.85, 0), 0.0)[1]
    parts.append((fin.moved((0, 0, 0.5 * r), rotation(1, -np.pi / 2)), 2))
    n = int(rng.integers(0, 3))
    pod = lathe(0.4 * r * np.array([0.7, 1, 1, 0.6]), [-0.15, -0.1, 0.05, 0.15])
    for k in range(n):
        for s in (-1, 1):
            at = (s * span * (k + 1) / (n + 1.5), 0.5 * sweep * (k + 1) / n - 0.2, height - 0.5 * r)
            parts.append((pod.moved(at, rotation(0, np.pi / 2)), 3))
    if n == 0 and rng.random() < 0.6:
        parts.append((box((0.5, 0.02, 0.05)).moved((0, -1.0, 0), rotation(1, rng.uniform(0, np.pi))), 3))
    return parts


def boat(rng: Rng) -> list[Part]:
    length, width, depth = rng.uniform((1.6, 0.35, 0.2), (2.2, 0.7, 0.4))
    y = np.linspace(0, 1, 9)
    half = 0.5 * width * np.minimum(1, 2.2 * y ** rng.uniform(0.5, 0.9)) * np.where(y > 0.8, 0.95, 1)
    keel = -depth * np.minimum(1, 3 * y) ** 0.7
    sheer = 0.15 * depth * (1 - y) ** 2 * rng.uniform(0, 3)
    ring = [
        np.stack([s * half * w, (y - 0.5) * length, sheer * (1 - z) + keel * z], -1)
        for s, w, z in ((-1, 1.0, 0.0), (-1, 0.85, 0.6), (-1, 0.02, 1.0), (1, 0.02, 1.0), (1, 0.85, 0.6), (1, 1.0, 0.0))
    ]
    hull = np.stack(ring, 1)
    from_grid = loft(np.zeros((9, 6, 2)), np.zeros(9))
    vertices = np.concatenate([hull.reshape(-1, 3), hull[[0, -1]].mean(axis=1)])
    parts: list[Part] = [(Surface(vertices, from_grid.faces), 0)]
    top = 0.0
    for k in range(int(rng.integers(0, 4))):
        size = np.array([rng.uniform(0.4, 0.8) * width, rng.uniform(0.15, 0.5) * length, rng.uniform(0.08, 0.25)])
        deck = rounded_box(rng, size)
        parts.append((deck.moved((0, rng.uniform(-0.1, 0.2) * length, top + 0.5 * size[2])), 1 + k % 2))
        top += size[2]
    if rng.random() < 0.5:
        mast, high = np.array([0, -0.1 * length, 0]), rng.uniform(0.8, 2.2)
        parts.append((bar(mast, mast + np.array((0, 0, high)), 0.015), 3))
        if rng.random() < 0.7:
            sail = mast + np.array([(0, 0.02, 0.15), (0, 0.4 * length, 0.15), (0.02, 0.02, high)])
            for corners in (sail, sail * (1, -0.9, 1) + (0, 2 * mast[1] * 0.95, 0)):
                parts.append((Surface(corners, np.array([[0, 1, 2]])), 4))
    return parts


def train(rng: Rng) -> list[Part]:
    width, height, cars = rng.uniform(0.28, 0.4), rng.uniform(0.35, 0.5), int(rng.integers(1, 4))
    parts: list[Part] = []
    outline = np.array([(-0.5, 0), (0.5, 0), (0.5, 0.75), (0.35, 1), (-0.35, 1), (-0.5, 0.75)]) * (width, height)
    nose = rng.uniform(0.3, 1.0)
    for k in range(cars):
        length = rng.uniform(0.9, 1.3)
        ends = np.stack([outline * (0.9, nose if k == 0 else 1.0), outline, outline])
        solid = loft(ends, np.array([-0.5, -0.5 + rng.uniform(0.05, 0.3), 0.5]) * length)
        parts.append((Surface(solid.vertices[:, [0, 2, 1]] + (0, 1.2 * k, 0.12), solid.faces), 0))
        band = box((0.01, 0.7 * length, 0.22 * height))
        parts += [(band.moved((s * 0.5 * width, 1.2 * k, 0.12 + 0.6 * height)), 1) for s in (-1, 1)]
        parts += [(box((0.8 * width, 0.25, 0.12)).moved((0, 1.2 * k + y * length, 0.06)), 2) for y in (-0.3, 0.3)]
    parts.append((box((0.7 * width, 0.01, 0.25 * height)).moved((0, -0.52, 0.12 + 0.6 * nose * height)), 1))
    return parts
