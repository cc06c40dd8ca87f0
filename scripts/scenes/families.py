"""Procedural objects. A family is a function from a random generator to parts; the front points
along -y."""

from collections.abc import Callable

import numpy as np

from scripts.scenes.materials import random_rotation
from scripts.scenes.surfaces import (
    Array,
    Parts,
    Rng,
    Surface,
    bar,
    box,
    disc,
    extrude,
    grid,
    lathe,
    rotation,
    rounded_box,
    superquadric,
    torus,
    tube,
    unit_circle,
)


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
        return disc(size[0], -size[1], size[1])
    if kind == 4:
        n = int(rng.integers(3, 14))
        t = np.sort(2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n)
        return extrude(rng.uniform(0.4, 1, (n, 1)) * unit_circle(t), size[2])
    if kind == 5:
        return torus(size[0], rng.uniform(0.1, 0.5) * size[0])
    sides = int(rng.choice([4, 6, 12]))
    return bar((0, 0, -size[2]), (0, 0, size[2]), 0.1 + 0.2 * size[0], sides=sides)


def compound(rng: Rng) -> Parts:
    """Overlapping pieces, often mirrored in x."""
    parts = Parts()
    centre = np.zeros(3)
    mirrored = rng.random() < 0.5
    for k in range(int(rng.integers(2, 8))):
        if rng.random() < 0.3:
            R = random_rotation(rng)
        else:
            R = rotation(int(rng.integers(3)), 0.5 * np.pi * rng.integers(4))
        piece = _piece(rng).moved(centre, R, rng.uniform(0.3, 1.0))
        parts.add(piece, k)
        if mirrored:
            parts.add(Surface(piece.vertices * (-1, 1, 1), piece.faces), k)
        centre = piece.vertices[rng.integers(len(piece.vertices))]
    return parts


def stack(rng: Rng) -> Parts:
    """Boxes side by side and on top of each other, like furniture, houses and machines."""
    parts = Parts()
    top = 0.0
    for k in range(int(rng.integers(1, 5))):
        size = rng.uniform((0.3, 0.3, 0.1), (1.2, 1.2, 0.8))
        body = rounded_box(rng, size)
        parts.add(body, k, (*rng.normal(0, 0.15, 2), top + 0.5 * size[2]))
        top += size[2] * rng.uniform(0.8, 1.0)
    return parts


def vessel(rng: Rng) -> Parts:
    """Bottles, jars, vases, lamps: surfaces of revolution, with a lid and at times a handle."""
    parts = Parts()
    n = int(rng.integers(3, 7))
    heights = np.sort(rng.uniform(0, 1, n))
    radii = rng.uniform(0.1, 0.4, n)
    if rng.random() < 0.6:  # body, shoulder, neck
        body = rng.uniform(0.12, 0.25)
        neck = rng.uniform(0.04, 0.1)
        at = rng.uniform(0.4, 0.75)
        heights = np.array([0, 0.02, at, at + rng.uniform(0.05, 0.2), 0.95])
        radii = np.array([0.9 * body, body, body, neck, neck])
    parts.add(lathe(radii, heights), 0)
    parts.add(disc(radii[-1] * 1.1, heights[-1], heights[-1] + rng.uniform(0.03, 0.1)), 1)
    if rng.random() < 0.5:
        parts.add(disc(radii[:3].max() * 1.01, 0.3 * heights[2], heights[2]), 2)
    if rng.random() < 0.3:
        parts.add(torus(0.15, 0.02), 3, (radii.max(), 0, 0.5), rotation(0, np.pi / 2))
    return parts


def chair(rng: Rng) -> Parts:
    parts = Parts()
    w, d, h, back = rng.uniform((0.4, 0.4, 0.35, 0.3), (0.6, 0.6, 0.6, 0.7))
    thick = rng.uniform(0.03, 0.12)
    leg = rng.uniform(0.015, 0.04)
    parts.add(rounded_box(rng, (w, d, thick)), 0, (0, 0, h))
    lean = rng.uniform(0, 0.15)
    sides = int(rng.choice([4, 10]))
    if rng.random() < 0.75:
        spread = rng.uniform(1.0, 1.25)
        for x, y in corners_of(0.5 * w - leg, 0.5 * d - leg):
            parts.add(bar((spread * x, spread * y, 0), (x, y, h), leg, sides=sides), 1)
        if rng.random() < 0.4:
            for x in (-0.45 * w, 0.45 * w):
                parts.add(bar((x, -0.45 * d, h / 2), (x, 0.45 * d, h / 2), leg), 1)
    else:
        parts.add(bar((0, 0, 0.1), (0, 0, h), 1.5 * leg), 1)
        for x, y in 0.5 * w * unit_circle(2 * np.pi * np.arange(5) / 5):
            parts.add(bar((0, 0, 0.1), (x, y, 0.03), leg), 1)
    sides_x = [s * (0.5 * w - leg) for s in (-1, 1)]
    posts = [np.array([(x, 0.5 * d, h), (x, 0.5 * d + lean, h + back)]) for x in sides_x]
    if rng.random() < 0.5:
        panel = rounded_box(rng, (w, thick * 0.7, back))
        centre = (0, 0.5 * d + 0.5 * lean, h + 0.5 * back)
        parts.add(panel, 0, centre, rotation(0, -lean / back))
    else:
        for post in posts:
            parts.add(tube(post, leg), 1)
        horizontal = rng.random() < 0.5
        a, b = posts if horizontal else np.stack(posts, axis=1)
        first, rod, few, many = (0.3, leg, 2, 6) if horizontal else (0.0, 0.7 * leg, 3, 8)
        for s in np.linspace(first, 1, int(rng.integers(few, many))):
            parts.add(bar(a[0] * (1 - s) + a[1] * s, b[0] * (1 - s) + b[1] * s, rod), 1)
        if not horizontal:
            parts.add(bar(b[0], b[1], 1.5 * leg), 1)
    if rng.random() < 0.4:
        z = h + rng.uniform(0.15, 0.3)
        for x in (-0.5 * w, 0.5 * w):
            parts.add(rounded_box(rng, (2 * leg + 0.03, d, 0.04)), 1, (x, 0, z))
            parts.add(bar((x, -0.45 * d, h), (x, -0.45 * d, z), leg), 1)
    return parts


def corners_of(x: float, y: float) -> list[tuple[float, float]]:
    """Of a rectangle of half sides ``x`` and ``y``."""
    return [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]


def table(rng: Rng) -> Parts:
    parts = Parts()
    w, d, h = rng.uniform((0.6, 0.4, 0.3), (1.6, 1.0, 0.8))
    thick = rng.uniform(0.02, 0.08)
    leg = rng.uniform(0.015, 0.06)
    is_round = rng.random() < 0.3
    parts.add(disc(0.5 * w, 0, thick) if is_round else box((w, d, thick)), 0, (0, 0, h))
    d = w if is_round else d
    if rng.random() < 0.7:
        reach = 0.6 if is_round else 0.9
        for x, y in corners_of(0.5 * reach * w, 0.5 * reach * d):
            parts.add(bar((x, y, 0), (x, y, h), leg, sides=int(rng.choice([4, 10]))), 1)
    else:
        parts.add(bar((0, 0, 0), (0, 0, h), 2 * leg), 1)
        parts.add(disc(0.3 * w, 0, 0.03), 1)
    if rng.random() < 0.4:
        drawers = box((0.3 * w, 0.8 * d, 0.6 * h))
        parts.add(drawers, 2, (0.28 * w * rng.choice([-1, 1]), 0, 0.65 * h))
    if rng.random() < 0.3:
        parts.add(box((0.9 * w, 0.8 * d, 0.02)), 0, (0, 0, 0.3 * h))
    return parts


def sofa(rng: Rng) -> Parts:
    parts = Parts()
    w, d, h, back = rng.uniform((0.8, 0.5, 0.25, 0.3), (2.0, 0.8, 0.4, 0.5))
    arm = rng.uniform(0.08, 0.25)
    deep = rng.uniform(0.12, 0.25)
    parts.add(rounded_box(rng, (w, d, h)), 0, (0, 0, 0.5 * h + 0.05))
    rest = rounded_box(rng, (w, deep, h + back))
    lean = rotation(0, -rng.uniform(0, 0.2))
    parts.add(rest, 0, (0, 0.5 * d, 0.5 * (h + back) + 0.05), lean)
    rise = rng.uniform(0.1, 0.9) * back
    for s in (-1, 1):
        side = rounded_box(rng, (arm, d + deep, h + rise))
        parts.add(side, 0, (s * 0.5 * (w + arm), 0.3 * deep, 0.5 * (h + rise) + 0.05))
    n = int(rng.integers(1, 4))
    for x in w * ((np.arange(n) + 0.5) / n - 0.5):
        parts.add(superquadric((0.48 * w / n, 0.45 * d, 0.08), (0.4, 0.3)), 1, (x, -0.05, h + 0.08))
        if rng.random() < 0.6:
            cushion = superquadric((0.46 * w / n, 0.08, 0.4 * back), (0.4, 0.4))
            parts.add(cushion, 1, (x, 0.5 * d - deep * 0.6, h + 0.5 * back))
    return parts


def screen(rng: Rng) -> Parts:
    parts = Parts()
    w, h, deep, rim = rng.uniform((0.6, 0.4, 0.03, 0.02), (1.2, 0.8, 0.12, 0.06))
    up = rng.uniform(0.05, 0.3) + 0.5 * h
    tilt = rotation(0, rng.uniform(-0.15, 0.15))
    parts.add(rounded_box(rng, (w, deep, h)), 0, (0, 0, up), tilt)
    glass = box((w - 2 * rim, 0.01, h - 2 * rim))
    parts.add(glass, 1, (0, 0, up) + tilt @ (0, -0.5 * deep, 0), tilt)
    if rng.random() < 0.35:
        parts.add(box((0.7 * w, rng.uniform(0.2, 0.6), 0.7 * h), top=0.7), 0, (0, 0.25, up))
    parts.add(bar((0, 0.05, 0), (0, 0.05, up), rng.uniform(0.02, 0.06)), 2)
    is_round = rng.random() < 0.5
    parts.add(disc(0.2, 0, 0.03) if is_round else box((0.5, 0.25, 0.03)), 2, (0, 0.03, 0))
    return parts


def _add_wheels(parts: Parts, rng: Rng, length: float, width: float, radius: float) -> None:
    across = rotation(1, np.pi / 2)
    heights = np.array([0.0, -0.35, -0.5, -0.3, 0.3, 0.5]) * radius * 0.5
    tyre = lathe(radius * np.array([0.55, 0.6, 0.95, 1, 1, 0.95]), heights)
    hub = disc(0.55 * radius, -0.24 * radius, 0.24 * radius)
    for s in (-1, 1):
        for y in (-rng.uniform(0.27, 0.36), rng.uniform(0.25, 0.35)):
            at = (s * 0.5 * width, y * length, radius)
            parts.add(tyre, 7, at, across)
            parts.add(hub, 8, at, across)


def car(rng: Rng) -> Parts:
    """Side outlines of cars, vans, buses and pick-ups, extruded across and narrowed towards the
    roof."""
    parts = Parts()
    length, width, height = rng.uniform((1.5, 0.65, 0.5), (2.2, 0.85, 0.75))
    radius = rng.uniform(0.14, 0.19)
    bonnet, roof_front, roof_back, boot = rng.uniform(
        (0.12, 0.3, 0.6, 0.82), (0.3, 0.45, 0.85, 1.0)
    )
    belt, nose, tail = rng.uniform((0.5, 0.4, 0.45), (0.62, 0.55, 0.62))
    if rng.random() < 0.3:  # van or bus
        bonnet = 0.02
        roof_front = rng.uniform(0.08, 0.25)
        roof_back = 0.97
        boot = 1.0
        tail = belt
        height *= rng.uniform(1.0, 1.5)
    low = 0.7 * radius
    pickup = boot < 1.0 and rng.random() < 0.25
    if pickup:  # a short cabin at the end of the body
        roof_front, roof_back, tail = rng.uniform((0.3, 0.5, 0.9 * belt), (0.4, 0.58, belt))
        boot = roof_back + 0.04
    middle = belt * height
    end = [(boot, low)] if pickup else [(1, tail * height), (1, low)]
    body = np.array([(0, low), (0, nose * height), (bonnet, middle), (boot, middle), *end])
    roof = [(roof_front, height), (roof_back, 0.98 * height)]
    cabin = np.array([(bonnet, middle), *roof, (boot, middle)])

    def across(outline: Array, wide: float) -> Surface:
        y = (outline[:, 0] - 0.5) * length
        narrow = wide * np.where(outline[:, 1] > middle + 1e-6, rng.uniform(0.7, 0.9), 1.0)
        sides = np.stack([np.stack([s * 0.5 * narrow, y, outline[:, 1]], -1) for s in (-1, 1)])
        shell = grid(sides, caps=False)
        n = len(outline)
        ring = np.arange(n)
        following = (ring + 1) % n
        ends = [
            np.stack([side * n + ring, side * n + following, np.full(n, 2 * n + side)], -1)
            for side in (0, 1)
        ]
        vertices = np.concatenate([shell.vertices, sides.mean(axis=1)])
        return Surface(vertices, np.concatenate([shell.faces, *ends]))

    parts.add(across(body, width), 0)
    parts.add(across(cabin, width), 0)
    centre = cabin.mean(axis=0)
    if rng.random() < 0.85:  # windows, slightly outside the cabin
        glass = centre + (cabin - centre) * np.array([0.86, 0.75])
        parts.add(across(glass, width * 1.02), 1)
        wide = 0.66 * width
        for a, b in ((cabin[0], cabin[1]), (cabin[3], cabin[2])):
            low_end = a + 0.15 * (b - a)
            high_end = a + 0.88 * (b - a)
            out = np.sign(low_end[0] - 0.5) * 0.004
            quad = [
                (s * 0.5 * wide, (end[0] - 0.5 + out) * length, end[1] + 0.004)
                for end in (low_end, high_end)
                for s in (-1, 1)
            ]
            parts.add(Surface(np.array(quad), np.array([[0, 1, 3], [0, 3, 2]])), 1)
    if pickup:
        floor = rng.uniform(0.5, 0.7) * belt * height
        _add_bed(parts, length, width, boot, (low, floor, tail * height))
    for s in (-1, 1):
        at = (s * 0.35 * width, -0.5 * length, nose * height - 0.05)
        lamp = box((0.2 * width, 0.02, 0.06)).moved(at)
        parts.add(lamp, 2)
        parts.add(lamp, 3, (0, length, (tail - nose) * height))
    _add_wheels(parts, rng, length, width, radius)
    return parts


def _add_bed(
    parts: Parts, length: float, width: float, start: float, heights: tuple[float, float, float]
) -> None:
    """Open bed from the fraction ``start`` of the length; ``heights`` of its underside, floor and
    rim."""
    low, floor, rim = heights
    thick = 0.05 * width
    long = (1 - start) * length
    middle = (0.5 * (start + 1) - 0.5) * length
    wall = rim - low
    at = 0.5 * (rim + low)
    parts.add(box((width, long, floor - low)), 0, (0, middle, 0.5 * (floor + low)))
    parts.add(box((width, thick, wall)), 0, (0, 0.5 * (length - thick), at))
    for s in (-1, 1):
        parts.add(box((thick, long, wall)), 0, (s * 0.5 * (width - thick), middle, at))


FAMILIES: dict[str, Callable[[Rng], Parts]] = {
    family.__name__: family for family in (compound, stack, vessel, chair, table, sofa, screen, car)
}


def random_shape(rng: Rng, family: str | None = None) -> tuple[Array, Array, Array]:
    """Vertices (V, 3) of radius 1 around the origin, z up, faces (F, 3) and their material numbers
    (F,).

    The shape is of the named family of ``FAMILIES``, or of a random one.
    """
    names = list(FAMILIES)
    surface, materials = FAMILIES[family or names[rng.integers(len(names))]](rng).joined()
    points = surface.vertices * rng.uniform(0.8, 1.25, 3)
    if rng.random() < 0.3:  # lean or taper the whole
        z = (points[:, 2:] - points[:, 2].mean()) / max(float(np.ptp(points[:, 2])), 1e-9)
        points[:, :2] = points[:, :2] * (1 + rng.uniform(-0.3, 0.3) * z) + rng.normal(0, 0.1, 2) * z
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return points / max(float(np.linalg.norm(points, axis=1).max()), 1e-9), surface.faces, materials
