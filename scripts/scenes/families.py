"""Procedural objects. A family is a function from a random generator to parts; the front points
along -y."""

from collections.abc import Callable

import numpy as np

from scripts.scenes.materials import random_rotation
from scripts.scenes.surfaces import (
    Array,
    Part,
    Rng,
    Surface,
    bar,
    box,
    extrude,
    join,
    lathe,
    rounded_box,
    superquadric,
    torus,
    tube,
)


def rotation(axis: int, angle: float) -> Array:
    """(3, 3) rotation by ``angle`` radians about coordinate axis 0, 1 or 2."""
    c = np.cos(angle)
    s = np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


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
    return bar(
        (0, 0, -size[2]), (0, 0, size[2]), 0.1 + 0.2 * size[0], sides=int(rng.choice([4, 6, 12]))
    )


def compound(rng: Rng) -> list[Part]:
    """Overlapping pieces, often mirrored in x."""
    parts: list[Part] = []
    centre = np.zeros(3)
    mirrored = rng.random() < 0.5
    for k in range(int(rng.integers(2, 8))):
        any_angle = rng.random() < 0.3
        R = (
            random_rotation(rng)
            if any_angle
            else rotation(int(rng.integers(3)), 0.5 * np.pi * rng.integers(4))
        )
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
        parts.append(
            (rounded_box(rng, size).moved((*rng.normal(0, 0.15, 2), top + 0.5 * size[2])), k)
        )
        top += size[2] * rng.uniform(0.8, 1.0)
    return parts


def vessel(rng: Rng) -> list[Part]:
    """Bottles, jars, vases, lamps: surfaces of revolution, with a lid and at times a handle."""
    n = int(rng.integers(3, 7))
    heights = np.sort(rng.uniform(0, 1, n))
    radii = rng.uniform(0.1, 0.4, n)
    if rng.random() < 0.6:  # body, shoulder, neck
        body = rng.uniform(0.12, 0.25)
        neck = rng.uniform(0.04, 0.1)
        at = rng.uniform(0.4, 0.75)
        heights = np.array([0, 0.02, at, at + rng.uniform(0.05, 0.2), 0.95])
        radii = np.array([0.9 * body, body, body, neck, neck])
    parts = [(lathe(radii, heights), 0)]
    parts.append(
        (lathe(np.full(2, radii[-1] * 1.1), heights[-1] + np.array([0, rng.uniform(0.03, 0.1)])), 1)
    )
    if rng.random() < 0.5:
        low = 0.3 * heights[2]
        high = heights[2]
        parts.append((lathe(np.full(2, radii[:3].max() * 1.01), np.array([low, high])), 2))
    if rng.random() < 0.3:
        parts.append((torus(0.15, 0.02).moved((radii.max(), 0, 0.5), rotation(0, np.pi / 2)), 3))
    return parts


def chair(rng: Rng) -> list[Part]:
    w, d, h, back = rng.uniform((0.4, 0.4, 0.35, 0.3), (0.6, 0.6, 0.6, 0.7))
    thick = rng.uniform(0.03, 0.12)
    leg = rng.uniform(0.015, 0.04)
    parts = [(rounded_box(rng, (w, d, thick)).moved((0, 0, h)), 0)]
    lean = rng.uniform(0, 0.15)
    feet = [(sx * (0.5 * w - leg), sy * (0.5 * d - leg)) for sx in (-1, 1) for sy in (-1, 1)]
    sides = int(rng.choice([4, 10]))
    if rng.random() < 0.75:
        spread = rng.uniform(1.0, 1.25)
        parts += [
            (bar((spread * x, spread * y, 0), (x, y, h), leg, sides=sides), 1) for x, y in feet
        ]
        if rng.random() < 0.4:
            parts += [
                (bar((s * 0.45 * w, -0.45 * d, h / 2), (s * 0.45 * w, 0.45 * d, h / 2), leg), 1)
                for s in (-1, 1)
            ]
    else:
        parts.append((bar((0, 0, 0.1), (0, 0, h), 1.5 * leg), 1))
        spokes = 2 * np.pi * np.arange(5) / 5
        parts += [
            (bar((0, 0, 0.1), (0.5 * w * np.cos(t), 0.5 * w * np.sin(t), 0.03), leg), 1)
            for t in spokes
        ]
    sides_x = [s * (0.5 * w - leg) for s in (-1, 1)]
    posts = [np.array([(x, 0.5 * d, h), (x, 0.5 * d + lean, h + back)]) for x in sides_x]
    if rng.random() < 0.5:
        panel = rounded_box(rng, (w, thick * 0.7, back))
        centre = (0, 0.5 * d + 0.5 * lean, h + 0.5 * back)
        parts.append((panel.moved(centre, rotation(0, -lean / back)), 0))
    else:
        parts += [(tube(p, leg), 1) for p in posts]
        horizontal = rng.random() < 0.5
        a, b = posts if horizontal else np.stack(posts, axis=1)
        first, rod, few, many = (0.3, leg, 2, 6) if horizontal else (0.0, 0.7 * leg, 3, 8)
        steps = np.linspace(first, 1, int(rng.integers(few, many)))
        parts += [
            (bar(a[0] * (1 - s) + a[1] * s, b[0] * (1 - s) + b[1] * s, rod), 1) for s in steps
        ]
        if not horizontal:
            parts.append((bar(b[0], b[1], 1.5 * leg), 1))
    if rng.random() < 0.4:
        z = h + rng.uniform(0.15, 0.3)
        for s in (-1, 1):
            parts.append(
                (rounded_box(rng, (2 * leg + 0.03, d, 0.04)).moved((s * 0.5 * w, 0, z)), 1)
            )
            parts.append((bar((s * 0.5 * w, -0.45 * d, h), (s * 0.5 * w, -0.45 * d, z), leg), 1))
    return parts


def table(rng: Rng) -> list[Part]:
    w, d, h = rng.uniform((0.6, 0.4, 0.3), (1.6, 1.0, 0.8))
    thick = rng.uniform(0.02, 0.08)
    leg = rng.uniform(0.015, 0.06)
    round_top = rng.random() < 0.3
    top = lathe(np.full(2, 0.5 * w), np.array([0, thick])) if round_top else box((w, d, thick))
    parts = [(top.moved((0, 0, h)), 0)]
    d = w if round_top else d
    if rng.random() < 0.7:
        reach = 0.6 if round_top else 0.9
        feet = [(sx * 0.5 * reach * w, sy * 0.5 * reach * d) for sx in (-1, 1) for sy in (-1, 1)]
        parts += [
            (bar((x, y, 0), (x, y, h), leg, sides=int(rng.choice([4, 10]))), 1) for x, y in feet
        ]
    else:
        parts.append((bar((0, 0, 0), (0, 0, h), 2 * leg), 1))
        parts.append((lathe(np.full(2, 0.3 * w), np.array([0, 0.03])), 1))
    if rng.random() < 0.4:
        parts.append(
            (
                box((0.3 * w, 0.8 * d, 0.6 * h)).moved(
                    (0.28 * w * rng.choice([-1, 1]), 0, 0.65 * h)
                ),
                2,
            )
        )
    if rng.random() < 0.3:
        parts.append((box((0.9 * w, 0.8 * d, 0.02)).moved((0, 0, 0.3 * h)), 0))
    return parts


def sofa(rng: Rng) -> list[Part]:
    w, d, h, back = rng.uniform((0.8, 0.5, 0.25, 0.3), (2.0, 0.8, 0.4, 0.5))
    arm = rng.uniform(0.08, 0.25)
    deep = rng.uniform(0.12, 0.25)
    parts = [(rounded_box(rng, (w, d, h)).moved((0, 0, 0.5 * h + 0.05)), 0)]
    rest = rounded_box(rng, (w, deep, h + back))
    parts.append(
        (rest.moved((0, 0.5 * d, 0.5 * (h + back) + 0.05), rotation(0, -rng.uniform(0, 0.2))), 0)
    )
    rise = rng.uniform(0.1, 0.9) * back
    for s in (-1, 1):
        side = rounded_box(rng, (arm, d + deep, h + rise))
        parts.append((side.moved((s * 0.5 * (w + arm), 0.3 * deep, 0.5 * (h + rise) + 0.05)), 0))
    n = int(rng.integers(1, 4))
    for x in w * ((np.arange(n) + 0.5) / n - 0.5):
        parts.append(
            (
                superquadric((0.48 * w / n, 0.45 * d, 0.08), (0.4, 0.3)).moved(
                    (x, -0.05, h + 0.08)
                ),
                1,
            )
        )
        if rng.random() < 0.6:
            cushion = superquadric((0.46 * w / n, 0.08, 0.4 * back), (0.4, 0.4))
            parts.append((cushion.moved((x, 0.5 * d - deep * 0.6, h + 0.5 * back)), 1))
    return parts


def screen(rng: Rng) -> list[Part]:
    w, h, deep, rim = rng.uniform((0.6, 0.4, 0.03, 0.02), (1.2, 0.8, 0.12, 0.06))
    up = rng.uniform(0.05, 0.3) + 0.5 * h
    tilt = rotation(0, rng.uniform(-0.15, 0.15))
    parts: list[Part] = [(rounded_box(rng, (w, deep, h)).moved((0, 0, up), tilt), 0)]
    parts.append(
        (
            box((w - 2 * rim, 0.01, h - 2 * rim)).moved(
                (0, 0, up) + tilt @ (0, -0.5 * deep, 0), tilt
            ),
            1,
        )
    )
    if rng.random() < 0.35:
        parts.append(
            (box((0.7 * w, rng.uniform(0.2, 0.6), 0.7 * h), top=0.7).moved((0, 0.25, up)), 0)
        )
    parts.append((bar((0, 0.05, 0), (0, 0.05, up), rng.uniform(0.02, 0.06)), 2))
    base = (
        lathe(np.full(2, 0.2), np.array([0, 0.03]))
        if rng.random() < 0.5
        else box((0.5, 0.25, 0.03))
    )
    parts.append((base.moved((0, 0.03, 0)), 2))
    return parts


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
    """Side outlines of cars, vans, buses and pick-ups, extruded across and narrowed towards the
    roof."""
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
    end = [(boot, low)] if pickup else [(1, tail * height), (1, low)]
    body = np.array(
        [(0, low), (0, nose * height), (bonnet, belt * height), (boot, belt * height), *end]
    )
    cabin = np.array(
        [
            (bonnet, belt * height),
            (roof_front, height),
            (roof_back, 0.98 * height),
            (boot, belt * height),
        ]
    )

    def across(outline: Array, wide: float) -> Surface:
        y = (outline[:, 0] - 0.5) * length
        n = len(outline)
        narrow = wide * np.where(outline[:, 1] > belt * height + 1e-6, rng.uniform(0.7, 0.9), 1.0)
        points = np.stack([np.stack([s * 0.5 * narrow, y, outline[:, 1]], -1) for s in (-1, 1)])
        ring = np.arange(n)
        following = (ring + 1) % n
        faces = [
            np.stack([ring, following, following + n], -1),
            np.stack([ring, following + n, ring + n], -1),
        ]
        faces += [
            np.stack([k * n + ring, k * n + following, np.full(n, 2 * n + k)], -1) for k in (0, 1)
        ]
        return Surface(
            np.concatenate([points.reshape(-1, 3), points.mean(axis=1)]), np.concatenate(faces)
        )

    parts: list[Part] = [(across(body, width), 0), (across(cabin, width), 0)]
    centre = cabin.mean(axis=0)
    if rng.random() < 0.85:  # windows, slightly outside the cabin
        glass = centre + (cabin - centre) * np.array([0.86, 0.75])
        parts.append((across(glass, width * 1.02), 1))
        wide = 0.66 * width
        for a, b in ((cabin[0], cabin[1]), (cabin[3], cabin[2])):
            p = a + 0.15 * (b - a)
            q = a + 0.88 * (b - a)
            out = np.sign(p[0] - 0.5) * 0.004
            quad = [
                (s * 0.5 * wide, (e[0] - 0.5 + out) * length, e[1] + 0.004)
                for e in (p, q)
                for s in (-1, 1)
            ]
            parts.append((Surface(np.array(quad), np.array([[0, 1, 3], [0, 3, 2]])), 1))
    if pickup:
        parts += _bed(
            length, width, boot, (low, rng.uniform(0.5, 0.7) * belt * height, tail * height)
        )
    for s in (-1, 1):
        lamp = box((0.2 * width, 0.02, 0.06)).moved(
            (s * 0.35 * width, -0.5 * length, nose * height - 0.05)
        )
        parts += [(lamp, 2), (lamp.moved((0, length, (tail - nose) * height)), 3)]
    return parts + _wheels(rng, length, width, radius)


def _bed(
    length: float, width: float, start: float, heights: tuple[float, float, float]
) -> list[Part]:
    """Open bed from the fraction ``start`` of the length; ``heights`` of its underside, floor and
    rim."""
    low, floor, rim = heights
    thick = 0.05 * width
    long = (1 - start) * length
    middle = (0.5 * (start + 1) - 0.5) * length
    wall = rim - low
    at = 0.5 * (rim + low)
    base = box((width, long, floor - low)).moved((0, middle, 0.5 * (floor + low)))
    gate = box((width, thick, wall)).moved((0, 0.5 * (length - thick), at))
    sides = [
        box((thick, long, wall)).moved((s * 0.5 * (width - thick), middle, at)) for s in (-1, 1)
    ]
    return [(part, 0) for part in (base, gate, *sides)]


FAMILIES: dict[str, Callable[[Rng], list[Part]]] = {
    family.__name__: family for family in (compound, stack, vessel, chair, table, sofa, screen, car)
}


def random_shape(rng: Rng, family: str | None = None) -> tuple[Array, Array, Array]:
    """Vertices (V, 3) of radius 1 around the origin, z up, faces (F, 3) and their material numbers
    (F,).

    The shape is of the named family of ``FAMILIES``, or of a random one.
    """
    names = list(FAMILIES)
    parts = FAMILIES[family or names[rng.integers(len(names))]](rng)
    surface = join([part for part, _ in parts])
    materials = np.concatenate([np.full(len(part.faces), number) for part, number in parts])
    points = surface.vertices * rng.uniform(0.8, 1.25, 3)
    if rng.random() < 0.3:  # lean or taper the whole
        z = (points[:, 2:] - points[:, 2].mean()) / max(float(np.ptp(points[:, 2])), 1e-9)
        points[:, :2] = points[:, :2] * (1 + rng.uniform(-0.3, 0.3) * z) + rng.normal(0, 0.1, 2) * z
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return points / max(float(np.linalg.norm(points, axis=1).max()), 1e-9), surface.faces, materials
