"""Printed packages: cans, bottles and boxes whose labels alone tell their sides apart."""

import cv2
import numpy as np
import trimesh

from scripts.scenes.materials import random_colour, random_picture
from scripts.scenes.surfaces import Array, Rng, raised
from scripts.scenes.textured import Texture, TexturedMesh

# size of a label in px
WIDTH = 512
HEIGHT = 256

SIDES = 72
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX)
LETTERS = "ABCDEFGHIKLMNOPRSTUVZ"


def label(rng: Rng) -> Array:
    """(HEIGHT, WIDTH, 3) uint8: bands, a picture, words and small print on one colour."""
    picture = np.full((HEIGHT, WIDTH, 3), 255 * random_colour(rng), np.float32)
    for _ in range(rng.integers(0, 4)):
        top = rng.integers(HEIGHT)
        colour = 255 * random_colour(rng)
        picture[top : top + rng.integers(5, 60)] = colour
    for _ in range(rng.integers(2, 5)):
        side = int(rng.integers(50, 150))
        x = rng.integers(WIDTH - side)
        y = rng.integers(HEIGHT - side)
        picture[y : y + side, x : x + side] = 255 * random_picture(rng, side)
    picture = picture.clip(0, 255).round().astype(np.uint8)
    for _ in range(rng.integers(5, 16)):
        word = "".join(rng.choice(list(LETTERS), rng.integers(2, 9)))
        scale = rng.uniform(0.4, 2.5)
        x = int(rng.integers(WIDTH))
        y = int(rng.integers(20, HEIGHT))
        colour = (255 * random_colour(rng)).tolist()
        font = FONTS[rng.integers(len(FONTS))]
        thick = 1 + int(1.5 * scale)
        cv2.putText(picture, word, (x, y), font, scale, colour, thick, cv2.LINE_AA)
    return picture


def solid_of_revolution(rng: Rng) -> tuple[Array, ...]:
    """Vertices, faces and texture coordinates of a can, or of a bottle with shoulder and neck, of
    height 1."""
    radius = rng.uniform(0.18, 0.5)
    wall = [(radius, 1.0)]
    if rng.random() >= 0.5:
        shoulder = rng.uniform(0.5, 0.75)
        neck = radius * rng.uniform(0.25, 0.5)
        waist = (radius * rng.uniform(0.8, 1.0), 0.5 * shoulder)
        wall = [waist, (radius, shoulder), (neck, 0.85), (neck, 1.0)]
    radii, heights = np.array([(0.0, 0.0), (radius, 0.0), *wall, (0.0, 1.0)]).T
    along = np.append(0.0, np.hypot(np.diff(radii), np.diff(heights)).cumsum())
    around = SIDES + 1  # the first side is also the last
    angle = np.linspace(0.0, 2.0 * np.pi, around)
    ring = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    points = raised(radii[:, None, None] * ring, heights[:, None, None])
    uv = np.stack(np.meshgrid(angle / (2.0 * np.pi), along / along[-1]), axis=-1)
    a = np.arange(len(along) - 1)[:, None] * around + np.arange(SIDES)
    b = a + around
    faces = np.stack([a, a + 1, b + 1, a, b + 1, b], axis=-1).reshape(-1, SIDES, 2, 3)
    return points.reshape(-1, 3), faces.swapaxes(1, 2).reshape(-1, 3), uv.reshape(-1, 2)


def carton(rng: Rng) -> tuple[Array, ...]:
    """Vertices, faces and texture coordinates of a box of height 1, with another part of the label
    on each side."""
    width = rng.uniform(0.3, 0.9)
    depth = rng.uniform(0.15, 0.6)
    solid = trimesh.creation.box((width, depth, 1.0))
    corners = solid.triangles.reshape(6, 6, 3)  # two triangles a side
    uv = np.zeros((6, 6, 2))
    for k, side in enumerate(corners):
        by_extent = np.argsort(np.ptp(side, axis=0))
        flat = side[:, np.sort(by_extent[1:])]
        inside = (flat - flat.min(axis=0)) / np.ptp(flat, axis=0)
        place = np.array([k % 3, k // 3])
        uv[k] = (place + inside) / (3.0, 2.0)
    faces = np.arange(36).reshape(-1, 3)
    return corners.reshape(-1, 3), faces, uv.reshape(-1, 2)


def package(rng: Rng, print_rng: Rng | None) -> TexturedMesh:
    """A printed package, 8 to 25 cm high, in metres; with another print if ``print_rng`` is
    given."""
    vertices, faces, uv = carton(rng) if rng.random() < 0.3 else solid_of_revolution(rng)
    picture = label(rng)
    height = rng.uniform(0.08, 0.25)
    if print_rng is not None:
        picture = label(print_rng)
    linear = (picture.astype(np.float32) / 255) ** 2.2
    return TexturedMesh.from_arrays(vertices * height, faces, [Texture(linear, 0.3)], uv=uv)
