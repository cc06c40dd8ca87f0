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
    unit_circle,
    with_radius_1,
)


def _piece(rng: Rng) -> Surface:
    """One surface of any kind, about 1 across."""
    size = np.exp(rng.normal(0, 0.45, 3)) * 0.5
    kind = rng.integers(7)
    x, y, z = size
    if kind == 0:
        return box(2 * size, top=rng.uniform(0.3, 1.0))
    if kind == 1:
        return superquadric(size, (rng.uniform(0.1, 1.5), rng.uniform(0.1, 1.5)))
    if kind == 2:
        radii = x * rng.uniform(0.1, 1, 5).repeat(2)
        return lathe(radii, y * np.linspace(-1, 1, 10))
    if kind == 3:
        return disc(x, -y, y)
    if kind == 4:
        n = rng.integers(3, 14)
        places = np.arange(n) + rng.uniform(-0.3, 0.3, n)
        corners = unit_circle(np.sort(2 * np.pi * places / n))
        return extrude(rng.uniform(0.4, 1, (n, 1)) * corners, z)
    if kind == 5:
        return torus(x, rng.uniform(0.1, 0.5) * x)
    sides = rng.choice([4, 6, 12])
    return bar((0, 0, -z), (0, 0, z), 0.1 + 0.2 * x, sides=sides)


def compound(rng: Rng) -> Parts:
    """Overlapping pieces, often mirrored in x."""
    parts = Parts()
    centre = np.zeros(3)
    mirrored = rng.random() < 0.5
    for k in range(rng.integers(2, 8)):
        if rng.random() < 0.3:
            R = random_rotation(rng)
        else:
            axis = rng.integers(3)
            R = rotation(axis, 0.5 * np.pi * rng.integers(4))
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
    for k in range(rng.integers(1, 5)):
        width = rng.uniform(0.3, 1.2)
        depth = rng.uniform(0.3, 1.2)
        height = rng.uniform(0.1, 0.8)
        body = rounded_box(rng, (width, depth, height))
        x, y = rng.normal(0, 0.15, 2)
        parts.add(body, k, (x, y, top + 0.5 * height))
        top += height * rng.uniform(0.8, 1.0)
    return parts


def vessel(rng: Rng) -> Parts:
    """Bottles, jars, vases, lamps: surfaces of revolution, with a lid and at times a handle."""
    parts = Parts()
    n = rng.integers(3, 7)
    heights = np.sort(rng.uniform(0, 1, n))
    radii = rng.uniform(0.1, 0.4, n)
    if rng.random() < 0.6:  # body, shoulder, neck
        body = rng.uniform(0.12, 0.25)
        neck = rng.uniform(0.04, 0.1)
        at = rng.uniform(0.4, 0.75)
        heights = np.array([0, 0.02, at, at + rng.uniform(0.05, 0.2), 0.95])
        radii = np.array([0.9 * body, body, body, neck, neck])
    parts.add(lathe(radii, heights), 0)
    top = heights[-1]
    lid = disc(radii[-1] * 1.1, top, top + rng.uniform(0.03, 0.1))
    parts.add(lid, 1)
    if rng.random() < 0.5:
        label = disc(radii[:3].max() * 1.01, 0.3 * heights[2], heights[2])
        parts.add(label, 2)
    if rng.random() < 0.3:
        handle = torus(0.15, 0.02)
        parts.add(handle, 3, (radii.max(), 0, 0.5), rotation(0, np.pi / 2))
    return parts


def chair(rng: Rng) -> Parts:
    parts = Parts()
    w = rng.uniform(0.4, 0.6)
    d = rng.uniform(0.4, 0.6)
    h = rng.uniform(0.35, 0.6)
    back = rng.uniform(0.3, 0.7)
    thick = rng.uniform(0.03, 0.12)
    leg = rng.uniform(0.015, 0.04)
    seat = rounded_box(rng, (w, d, thick))
    parts.add(seat, 0, (0, 0, h))
    lean = rng.uniform(0, 0.15)
    sides = rng.choice([4, 10])
    if rng.random() < 0.75:
        spread = rng.uniform(1.0, 1.25)
        for x, y in corners_of(0.5 * w - leg, 0.5 * d - leg):
            foot = (spread * x, spread * y, 0)
            parts.add(bar(foot, (x, y, h), leg, sides=sides), 1)
        if rng.random() < 0.4:
            for x in (-0.45 * w, 0.45 * w):
                front = (x, -0.45 * d, h / 2)
                parts.add(bar(front, (x, 0.45 * d, h / 2), leg), 1)
    else:
        hub = (0, 0, 0.1)
        parts.add(bar(hub, (0, 0, h), 1.5 * leg), 1)
        for x, y in 0.5 * w * unit_circle(2 * np.pi * np.arange(5) / 5):
            parts.add(bar(hub, (x, y, 0.03), leg), 1)
    _add_back(parts, rng, (w, d, h, back), thick, leg, lean)
    if rng.random() < 0.4:
        z = h + rng.uniform(0.15, 0.3)
        for x in (-0.5 * w, 0.5 * w):
            rest = rounded_box(rng, (2 * leg + 0.03, d, 0.04))
            parts.add(rest, 1, (x, 0, z))
            parts.add(bar((x, -0.45 * d, h), (x, -0.45 * d, z), leg), 1)
    return parts


def _add_back(
    parts: Parts,
    rng: Rng,
    size: tuple[float, float, float, float],
    thick: float,
    leg: float,
    lean: float,
) -> None:
    """A panel, or rods between or along two posts, on the seat of a chair of the size: width, depth
    and height of the seat, and height of the back."""
    w, d, h, back = size
    if rng.random() < 0.5:
        panel = rounded_box(rng, (w, thick * 0.7, back))
        centre = (0, 0.5 * d + 0.5 * lean, h + 0.5 * back)
        parts.add(panel, 0, centre, rotation(0, -lean / back))
        return
    posts = []
    for side in (-1, 1):
        x = side * (0.5 * w - leg)
        post = np.array([(x, 0.5 * d, h), (x, 0.5 * d + lean, h + back)])
        posts.append(post)
        parts.add(bar(*post, leg), 1)
    is_ladder = rng.random() < 0.5
    if is_ladder:
        a, b = posts
        places = np.linspace(0.3, 1, rng.integers(2, 6))
        radius = leg
    else:
        a, b = np.stack(posts, axis=1)
        places = np.linspace(0.0, 1, rng.integers(3, 8))
        radius = 0.7 * leg
    for s in places:
        start = a[0] * (1 - s) + a[1] * s
        end = b[0] * (1 - s) + b[1] * s
        parts.add(bar(start, end, radius), 1)
    if not is_ladder:
        parts.add(bar(b[0], b[1], 1.5 * leg), 1)


def corners_of(x: float, y: float) -> list[tuple[float, float]]:
    """Of a rectangle of half sides ``x`` and ``y``."""
    return [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]


def table(rng: Rng) -> Parts:
    parts = Parts()
    w = rng.uniform(0.6, 1.6)
    d = rng.uniform(0.4, 1.0)
    h = rng.uniform(0.3, 0.8)
    thick = rng.uniform(0.02, 0.08)
    leg = rng.uniform(0.015, 0.06)
    if rng.random() < 0.3:
        top = disc(0.5 * w, 0, thick)
        d = w
        reach = 0.6
    else:
        top = box((w, d, thick))
        reach = 0.9
    parts.add(top, 0, (0, 0, h))
    if rng.random() < 0.7:
        for x, y in corners_of(0.5 * reach * w, 0.5 * reach * d):
            sides = rng.choice([4, 10])
            parts.add(bar((x, y, 0), (x, y, h), leg, sides=sides), 1)
    else:
        parts.add(bar((0, 0, 0), (0, 0, h), 2 * leg), 1)
        parts.add(disc(0.3 * w, 0, 0.03), 1)
    if rng.random() < 0.4:
        drawers = box((0.3 * w, 0.8 * d, 0.6 * h))
        side = rng.choice([-1, 1])
        parts.add(drawers, 2, (0.28 * w * side, 0, 0.65 * h))
    if rng.random() < 0.3:
        board = box((0.9 * w, 0.8 * d, 0.02))
        parts.add(board, 0, (0, 0, 0.3 * h))
    return parts


def sofa(rng: Rng) -> Parts:
    parts = Parts()
    w = rng.uniform(0.8, 2.0)
    d = rng.uniform(0.5, 0.8)
    h = rng.uniform(0.25, 0.4)
    back = rng.uniform(0.3, 0.5)
    arm = rng.uniform(0.08, 0.25)
    deep = rng.uniform(0.12, 0.25)
    base = rounded_box(rng, (w, d, h))
    parts.add(base, 0, (0, 0, 0.5 * h + 0.05))
    rest = rounded_box(rng, (w, deep, h + back))
    lean = rotation(0, -rng.uniform(0, 0.2))
    parts.add(rest, 0, (0, 0.5 * d, 0.5 * (h + back) + 0.05), lean)
    high = h + rng.uniform(0.1, 0.9) * back
    for s in (-1, 1):
        side = rounded_box(rng, (arm, d + deep, high))
        x = s * 0.5 * (w + arm)
        parts.add(side, 0, (x, 0.3 * deep, 0.5 * high + 0.05))
    n = rng.integers(1, 4)
    for x in w * ((np.arange(n) + 0.5) / n - 0.5):
        seat = superquadric((0.48 * w / n, 0.45 * d, 0.08), (0.4, 0.3))
        parts.add(seat, 1, (x, -0.05, h + 0.08))
        if rng.random() < 0.6:
            cushion = superquadric((0.46 * w / n, 0.08, 0.4 * back), (0.4, 0.4))
            parts.add(cushion, 1, (x, 0.5 * d - deep * 0.6, h + 0.5 * back))
    return parts


def screen(rng: Rng) -> Parts:
    parts = Parts()
    w = rng.uniform(0.6, 1.2)
    h = rng.uniform(0.4, 0.8)
    deep = rng.uniform(0.03, 0.12)
    rim = rng.uniform(0.02, 0.06)
    up = rng.uniform(0.05, 0.3) + 0.5 * h
    tilt = rotation(0, rng.uniform(-0.15, 0.15))
    case = rounded_box(rng, (w, deep, h))
    parts.add(case, 0, (0, 0, up), tilt)
    glass = box((w - 2 * rim, 0.01, h - 2 * rim))
    front = tilt @ (0, -0.5 * deep, 0) + (0, 0, up)
    parts.add(glass, 1, front, tilt)
    if rng.random() < 0.35:
        tube = box((0.7 * w, rng.uniform(0.2, 0.6), 0.7 * h), top=0.7)
        parts.add(tube, 0, (0, 0.25, up))
    stand = bar((0, 0.05, 0), (0, 0.05, up), rng.uniform(0.02, 0.06))
    parts.add(stand, 2)
    is_round = rng.random() < 0.5
    foot = disc(0.2, 0, 0.03) if is_round else box((0.5, 0.25, 0.03))
    parts.add(foot, 2, (0, 0.03, 0))
    return parts


def _add_wheels(
    parts: Parts,
    rng: Rng,
    length: float,
    width: float,
    radius: float,
) -> None:
    across = rotation(1, np.pi / 2)
    heights = np.array([0.0, -0.35, -0.5, -0.3, 0.3, 0.5]) * radius * 0.5
    tyre = lathe(radius * np.array([0.55, 0.6, 0.95, 1, 1, 0.95]), heights)
    hub = disc(0.55 * radius, -0.24 * radius, 0.24 * radius)
    for s in (-1, 1):
        front = -rng.uniform(0.27, 0.36)
        rear = rng.uniform(0.25, 0.35)
        for y in (front, rear):
            at = (s * 0.5 * width, y * length, radius)
            parts.add(tyre, 7, at, across)
            parts.add(hub, 8, at, across)


def car(rng: Rng) -> Parts:
    """Side outlines of cars, vans, buses and pick-ups, extruded across and narrowed towards the
    roof."""
    parts = Parts()
    length = rng.uniform(1.5, 2.2)
    width = rng.uniform(0.65, 0.85)
    height = rng.uniform(0.5, 0.75)
    radius = rng.uniform(0.14, 0.19)
    bonnet = rng.uniform(0.12, 0.3)
    roof_front = rng.uniform(0.3, 0.45)
    roof_back = rng.uniform(0.6, 0.85)
    boot = rng.uniform(0.82, 1.0)
    belt = rng.uniform(0.5, 0.62)
    nose = rng.uniform(0.4, 0.55)
    tail = rng.uniform(0.45, 0.62)
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
        roof_front = rng.uniform(0.3, 0.4)
        roof_back = rng.uniform(0.5, 0.58)
        tail = rng.uniform(0.9 * belt, belt)
        boot = roof_back + 0.04
    middle = belt * height
    end = [(boot, low)] if pickup else [(1, tail * height), (1, low)]
    body = np.array([(0, low), (0, nose * height), (bonnet, middle), (boot, middle), *end])
    roof = [(roof_front, height), (roof_back, 0.98 * height)]
    cabin = np.array([(bonnet, middle), *roof, (boot, middle)])

    def across(outline: Array, wide: float) -> Surface:
        y = (outline[:, 0] - 0.5) * length
        z = outline[:, 1]
        narrow = wide * np.where(z > middle + 1e-6, rng.uniform(0.7, 0.9), 1.0)
        left = np.stack([-0.5 * narrow, y, z], -1)
        right = np.stack([0.5 * narrow, y, z], -1)
        sides = np.stack([left, right])
        shell = grid(sides, caps=False)
        n = len(outline)
        ring = np.arange(n)
        following = (ring + 1) % n
        faces = [shell.faces]
        for side in (0, 1):
            middle_of_side = np.full(n, 2 * n + side)
            faces.append(np.stack([side * n + ring, side * n + following, middle_of_side], -1))
        vertices = np.concatenate([shell.vertices, sides.mean(axis=1)])
        return Surface(vertices, np.concatenate(faces))

    parts.add(across(body, width), 0)
    parts.add(across(cabin, width), 0)
    centre = cabin.mean(axis=0)
    if rng.random() < 0.85:  # windows, slightly outside the cabin
        glass = centre + (cabin - centre) * np.array([0.86, 0.75])
        parts.add(across(glass, width * 1.02), 1)
        wide = 0.66 * width
        front_low, front_high, back_high, back_low = cabin
        for a, b in ((front_low, front_high), (back_low, back_high)):
            low_end = a + 0.15 * (b - a)
            high_end = a + 0.88 * (b - a)
            out = np.sign(low_end[0] - 0.5) * 0.004
            corners = []
            for y, z in (low_end, high_end):
                for s in (-1, 1):
                    corners.append((s * 0.5 * wide, (y - 0.5 + out) * length, z + 0.004))
            pane = Surface(np.array(corners), np.array([[0, 1, 3], [0, 3, 2]]))
            parts.add(pane, 1)
    if pickup:
        floor = rng.uniform(0.5, 0.7) * belt * height
        _add_bed(parts, length, width, boot, (low, floor, tail * height))
    for s in (-1, 1):
        x = s * 0.35 * width
        lamp = box((0.2 * width, 0.02, 0.06))
        lamp = lamp.moved((x, -0.5 * length, nose * height - 0.05))
        parts.add(lamp, 2)
        parts.add(lamp, 3, (0, length, (tail - nose) * height))
    _add_wheels(parts, rng, length, width, radius)
    return parts


def _add_bed(
    parts: Parts,
    length: float,
    width: float,
    start: float,
    heights: tuple[float, float, float],
) -> None:
    """Open bed from the fraction ``start`` of the length; ``heights`` of its underside, floor and
    rim."""
    low, floor, rim = heights
    thick = 0.05 * width
    long = (1 - start) * length
    middle = (0.5 * (start + 1) - 0.5) * length
    wall = rim - low
    at = 0.5 * (rim + low)
    bottom = box((width, long, floor - low))
    parts.add(bottom, 0, (0, middle, 0.5 * (floor + low)))
    flap = box((width, thick, wall))
    parts.add(flap, 0, (0, 0.5 * (length - thick), at))
    side = box((thick, long, wall))
    for s in (-1, 1):
        parts.add(side, 0, (s * 0.5 * (width - thick), middle, at))


FAMILIES: dict[str, Callable[[Rng], Parts]] = {
    family.__name__: family for family in (compound, stack, vessel, chair, table, sofa, screen, car)
}


def random_shape(rng: Rng, family: str | None = None) -> tuple[Array, Array, Array]:
    """Vertices (V, 3) of radius 1 around the origin, z up, faces (F, 3) and their material numbers
    (F,).

    The shape is of the named family of ``FAMILIES``, or of a random one.
    """
    if family is None:
        names = list(FAMILIES)
        family = names[rng.integers(len(names))]
    surface, materials = FAMILIES[family](rng).joined()
    points = surface.vertices * rng.uniform(0.8, 1.25, 3)
    if rng.random() < 0.3:  # taper and lean the whole
        height = max(np.ptp(points[:, 2]), 1e-9)
        z = (points[:, 2:] - points[:, 2].mean()) / height
        taper = 1 + rng.uniform(-0.3, 0.3) * z
        points[:, :2] = points[:, :2] * taper + rng.normal(0, 0.1, 2) * z
    return with_radius_1(points), surface.faces, materials
