"""Objects of which several poses look the same from most sides: what tells them apart is inside,
below, or small."""

from collections.abc import Callable

import numpy as np

from scripts.scenes.surfaces import (
    AROUND,
    Array,
    Rng,
    Surface,
    bar,
    box,
    disc,
    join,
    lathe,
    rotation,
    with_radius_1,
)


def holed(rng: Rng) -> Surface:
    """A body of revolution with one hole in its wall."""
    levels = rng.integers(4, 9)
    radii = rng.uniform(0.3, 0.45) * np.ones(levels)
    if rng.random() < 0.5:
        radii = radii * np.linspace(1.0, rng.uniform(0.6, 1.3), levels)
    heights = np.linspace(0.0, rng.uniform(0.6, 1.6), levels)
    body = lathe(radii, heights)
    row = rng.integers(0, levels - 1)
    columns = rng.integers(3, 8)
    first = rng.integers(AROUND)
    cells = np.arange((levels - 1) * AROUND)
    of_row = cells // AROUND == row
    hidden = of_row & ((cells % AROUND - first) % AROUND < columns)
    kept = np.ones(len(body.faces), bool)
    kept[: 2 * len(cells)] = np.tile(~hidden, 2)  # two triangles a cell, then the caps
    return Surface(body.vertices, body.faces[kept])


def hollow(rng: Rng) -> Surface:
    """A box with a cavity in one half, open below."""
    w = rng.uniform(0.8, 1.4)
    d = rng.uniform(0.4, 0.8)
    h = rng.uniform(0.3, 0.7)
    wall = rng.uniform(0.03, 0.08)
    deep = h - wall
    x = -0.5 * w
    y = 0.5 * d
    corners = np.array([(x, -y, 0), (0.0, -y, 0), (0.0, y, 0), (x, y, 0)])
    half = Surface(corners, np.array([[0, 2, 1], [0, 3, 2]]))
    whole = _without_bottom((w, d, h), (0.0, 0.0, 0.5 * h))
    size = (0.5 * w - 1.5 * wall, d - 2.0 * wall, deep)
    cavity = _without_bottom(size, (0.25 * w, 0.0, 0.5 * deep))
    return join([whole, cavity, half])


def footed(rng: Rng) -> Surface:
    """A box or a disc with a block under one end."""
    w = rng.uniform(0.7, 1.2)
    d = rng.uniform(0.5, 0.7)
    h = rng.uniform(0.15, 0.6)
    round_body = rng.random() < 0.4
    body = _body(w, d, h, 0.5 * w if round_body else None)
    block = box(rng.uniform((0.1, 0.1, 0.03), (0.2, 0.25, 0.08)))
    return join([body, block.moved((0.3 * w, 0, -0.02))])


def marked(rng: Rng) -> Surface:
    """A box or a cylinder with a small cube on one end of its top."""
    w = rng.uniform(0.8, 1.2)
    d = rng.uniform(0.4, 0.7)
    h = rng.uniform(0.3, 0.7)
    round_body = rng.random() < 0.3
    body = _body(w, d, h, 0.4 * w if round_body else None)
    side = rng.uniform(0.05, 0.14)
    at = 0.3 * w if round_body else 0.4 * w - 0.5 * side
    cube = box(side).moved((at, 0, h + 0.5 * side))
    return join([body, cube])


def plated(rng: Rng) -> Surface:
    """A plate or a disc with a flat block, 0.03 to 0.05 radii high, on one end of its top."""
    w = rng.uniform(0.9, 1.2)
    d = rng.uniform(0.6, 0.9)
    h = rng.uniform(0.08, 0.3)
    round_body = rng.random() < 0.3
    body = _body(w, d, h, 0.5 * w if round_body else None)
    radius = 0.5 * np.linalg.norm((w, w if round_body else d, h))
    long = rng.uniform(0.12, 0.3)
    wide = rng.uniform(0.12, 0.3)
    high = rng.uniform(0.03, 0.05) * radius
    at = (0.45 * w - 0.5 * long, 0, h + 0.5 * high)
    block = box((long, wide, high)).moved(at)
    return join([body, block])


def handed(rng: Rng) -> Surface:
    """A bracket that its mirror image does not match, such as a left part."""
    long = rng.uniform(0.8, 1.2)
    wide = rng.uniform(0.3, 0.5)
    thick = rng.uniform(0.08, 0.2)
    plate = box((long, wide, thick))
    high = rng.uniform(0.3, 0.7)
    arm = box((thick, wide, high))
    arm = arm.moved((0.5 * (long - thick), 0, 0.5 * high))
    x = -0.3 * long
    y = 0.5 * wide + rng.uniform(0.3, 0.6)
    pin = bar((x, 0, 0), (x, y, 0), rng.uniform(0.04, 0.09))
    return join([plate, arm, pin])


def _body(
    width: float,
    depth: float,
    height: float,
    radius: float | None,
) -> Surface:
    """A cylinder if there is a radius, else a box; it stands on z = 0."""
    if radius is not None:
        return disc(radius, 0.0, height)
    return box((width, depth, height)).moved((0, 0, 0.5 * height))


def _without_bottom(size: tuple[float, float, float], at: tuple[float, float, float]) -> Surface:
    solid = box(size).moved(at)
    corners = solid.vertices[solid.faces]
    bottom = (corners[..., 2] <= solid.vertices[:, 2].min() + 1e-9).all(axis=1)
    return Surface(solid.vertices, solid.faces[~bottom])


FAMILIES: dict[str, Callable[[Rng], Surface]] = {
    family.__name__: family for family in (holed, hollow, footed, marked, handed, plated)
}


def tied_shape(rng: Rng, family: str) -> tuple[Array, Array]:
    """Vertices (V, 3) of radius 1 around the origin, z up, and faces (F, 3), of a family of
    ``FAMILIES``."""
    surface = FAMILIES[family](rng)
    points = surface.vertices @ rotation(2, rng.uniform(0.0, 2.0 * np.pi)).T
    return with_radius_1(points), surface.faces
