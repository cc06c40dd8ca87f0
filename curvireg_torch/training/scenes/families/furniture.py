"""Procedural furniture, one function per family."""

import numpy as np

from ..rotations import rotation
from ..surfaces import Part, Rng, bar, box, lathe, rounded_box, superquadric, tube

__all__ = ["chair", "frame", "screen", "sofa", "table"]


def chair(rng: Rng) -> list[Part]:
    w, d, h, back = rng.uniform((0.4, 0.4, 0.35, 0.3), (0.6, 0.6, 0.6, 0.7))
    thick, leg = rng.uniform(0.03, 0.12), rng.uniform(0.015, 0.04)
    parts = [(rounded_box(rng, (w, d, thick)).moved((0, 0, h)), 0)]
    lean = rng.uniform(0, 0.15)
    feet = [(sx * (0.5 * w - leg), sy * (0.5 * d - leg)) for sx in (-1, 1) for sy in (-1, 1)]
    sides = int(rng.choice([4, 10]))
    if rng.random() < 0.75:
        spread = rng.uniform(1.0, 1.25)
        parts += [(bar((spread * x, spread * y, 0), (x, y, h), leg, sides=sides), 1) for x, y in feet]
        if rng.random() < 0.4:
            parts += [(bar((s * 0.45 * w, -0.45 * d, h / 2), (s * 0.45 * w, 0.45 * d, h / 2), leg), 1) for s in (-1, 1)]
    else:
        parts.append((bar((0, 0, 0.1), (0, 0, h), 1.5 * leg), 1))
        spokes = 2 * np.pi * np.arange(5) / 5
        parts += [(bar((0, 0, 0.1), (0.5 * w * np.cos(t), 0.5 * w * np.sin(t), 0.03), leg), 1) for t in spokes]
    sides_x = [s * (0.5 * w - leg) for s in (-1, 1)]
    posts = [np.array([(x, 0.5 * d, h), (x, 0.5 * d + lean, h + back)]) for x in sides_x]
    if rng.random() < 0.5:
        panel, centre = rounded_box(rng, (w, thick * 0.7, back)), (0, 0.5 * d + 0.5 * lean, h + 0.5 * back)
        parts.append((panel.moved(centre, rotation(0, -lean / back)), 0))
    else:
        parts += [(tube(p, leg), 1) for p in posts]
        horizontal = rng.random() < 0.5
        a, b = posts if horizontal else np.stack(posts, axis=1)
        first, rod, few, many = (0.3, leg, 2, 6) if horizontal else (0.0, 0.7 * leg, 3, 8)
        steps = np.linspace(first, 1, int(rng.integers(few, many)))
        parts += [(bar(a[0] * (1 - s) + a[1] * s, b[0] * (1 - s) + b[1] * s, rod), 1) for s in steps]
        if not horizontal:
            parts.append((bar(b[0], b[1], 1.5 * leg), 1))
    if rng.random() < 0.4:
        z = h + rng.uniform(0.15, 0.3)
        for s in (-1, 1):
            parts.append((rounded_box(rng, (2 * leg + 0.03, d, 0.04)).moved((s * 0.5 * w, 0, z)), 1))
            parts.append((bar((s * 0.5 * w, -0.45 * d, h), (s * 0.5 * w, -0.45 * d, z), leg), 1))
    return parts


def table(rng: Rng) -> list[Part]:
    w, d, h = rng.uniform((0.6, 0.4, 0.3), (1.6, 1.0, 0.8))
    thick, leg = rng.uniform(0.02, 0.08), rng.uniform(0.015, 0.06)
    round_top = rng.random() < 0.3
    top = lathe(np.full(2, 0.5 * w), np.array([0, thick])) if round_top else box((w, d, thick))
    parts = [(top.moved((0, 0, h)), 0)]
    d = w if round_top else d
    if rng.random() < 0.7:
        reach = 0.6 if round_top else 0.9
        feet = [(sx * 0.5 * reach * w, sy * 0.5 * reach * d) for sx in (-1, 1) for sy in (-1, 1)]
        parts += [(bar((x, y, 0), (x, y, h), leg, sides=int(rng.choice([4, 10]))), 1) for x, y in feet]
    else:
        parts.append((bar((0, 0, 0), (0, 0, h), 2 * leg), 1))
        parts.append((lathe(np.full(2, 0.3 * w), np.array([0, 0.03])), 1))
    if rng.random() < 0.4:
        parts.append((box((0.3 * w, 0.8 * d, 0.6 * h)).moved((0.28 * w * rng.choice([-1, 1]), 0, 0.65 * h)), 2))
    if rng.random() < 0.3:
        parts.append((box((0.9 * w, 0.8 * d, 0.02)).moved((0, 0, 0.3 * h)), 0))
    return parts


def sofa(rng: Rng) -> list[Part]:
    w, d, h, back = rng.uniform((0.8, 0.5, 0.25, 0.3), (2.0, 0.8, 0.4, 0.5))
    arm, deep = rng.uniform(0.08, 0.25), rng.uniform(0.12, 0.25)
    parts = [(rounded_box(rng, (w, d, h)).moved((0, 0, 0.5 * h + 0.05)), 0)]
    rest = rounded_box(rng, (w, deep, h + back))
    parts.append((rest.moved((0, 0.5 * d, 0.5 * (h + back) + 0.05), rotation(0, -rng.uniform(0, 0.2))), 0))
    rise = rng.uniform(0.1, 0.9) * back
    for s in (-1, 1):
        side = rounded_box(rng, (arm, d + deep, h + rise))
        parts.append((side.moved((s * 0.5 * (w + arm), 0.3 * deep, 0.5 * (h + rise) + 0.05)), 0))
    n = int(rng.integers(1, 4))
    for x in w * ((np.arange(n) + 0.5) / n - 0.5):
        parts.append((superquadric((0.48 * w / n, 0.45 * d, 0.08), (0.4, 0.3)).moved((x, -0.05, h + 0.08)), 1))
        if rng.random() < 0.6:
            cushion = superquadric((0.46 * w / n, 0.08, 0.4 * back), (0.4, 0.4))
            parts.append((cushion.moved((x, 0.5 * d - deep * 0.6, h + 0.5 * back)), 1))
    return parts


def screen(rng: Rng) -> list[Part]:
    w, h, deep, rim = rng.uniform((0.6, 0.4, 0.03, 0.02), (1.2, 0.8, 0.12, 0.06))
    up = rng.uniform(0.05, 0.3) + 0.5 * h
    tilt = rotation(0, rng.uniform(-0.15, 0.15))
    parts: list[Part] = [(rounded_box(rng, (w, deep, h)).moved((0, 0, up), tilt), 0)]
    parts.append((box((w - 2 * rim, 0.01, h - 2 * rim)).moved((0, 0, up) + tilt @ (0, -0.5 * deep, 0), tilt), 1))
    if rng.random() < 0.35:
        parts.append((box((0.7 * w, rng.uniform(0.2, 0.6), 0.7 * h), top=0.7).moved((0, 0.25, up)), 0))
    parts.append((bar((0, 0.05, 0), (0, 0.05, up), rng.uniform(0.02, 0.06)), 2))
    base = lathe(np.full(2, 0.2), np.array([0, 0.03])) if rng.random() < 0.5 else box((0.5, 0.25, 0.03))
    parts.append((base.moved((0, 0.03, 0)), 2))
    return parts


def frame(rng: Rng) -> list[Part]:
    """Shelves, scaffolds, lamps on legs: rods between random corners, with some panels."""
    w, d, h = rng.uniform((0.4, 0.3, 0.5), (1.0, 0.8, 1.5))
    rod = rng.uniform(0.01, 0.04)
    corners = [(sx * w / 2, sy * d / 2) for sx in (-1, 1) for sy in (-1, 1)]
    parts: list[Part] = [(bar((x, y, 0), (x, y, h), rod, sides=4), 0) for x, y in corners]
    for z in np.linspace(0.1, 1, int(rng.integers(2, 6))) * h:
        if rng.random() < 0.6:
            parts.append((box((w, d, 0.02)).moved((0, 0, z)), 1))
        else:
            edges = ((0, 1), (1, 3), (3, 2), (2, 0))
            parts += [(bar((*corners[i], z), (*corners[j], z), rod, sides=4), 0) for i, j in edges]
    for _ in range(int(rng.integers(0, 4))):
        a, b = rng.uniform(-0.5, 0.5, (2, 3)) * (w, d, h) + (0, 0, 0.5 * h)
        parts.append((bar(a, b, rod), 0))
    return parts
