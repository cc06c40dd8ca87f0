"""Random materials, colours and pictures."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from scripts.scenes.surfaces import Array, Rng


def random_colour(rng: Rng) -> Array:
    """(3,) colour in [0, 1]; half of the colours are nearly grey."""
    grey = rng.uniform(0.03, 0.97)
    tint = rng.normal(0, rng.choice([0.03, 0.25]), 3)
    return np.clip(grey + tint, 0.01, 1.0)


class Material:
    """A random pattern of colours in space, with gloss; ``plain`` is the probability of a uniform
    colour."""

    def __init__(self, rng: Rng, *, plain: float = 0.5) -> None:
        self._first = random_colour(rng)
        self._second = random_colour(rng)
        kinds = ("waves", "stripes", "checks", "cells", "print", "grain")
        self._kind = "plain" if rng.random() < plain else rng.choice(kinds)
        axes = rng.normal(size=(3, 6))
        self._axes = axes * np.exp(rng.uniform(0.3, 2.5))
        self._phases = rng.uniform(0, 2 * np.pi, 6)
        cells = rng.integers(4, 25)
        self._seeds = rng.uniform(-1, 1, (cells, 3))
        self._palette = np.stack([random_colour(rng) for _ in self._seeds])
        self._strength = rng.uniform(0.1, 1.0)
        self.gloss = 0.0 if rng.random() < 0.5 else rng.uniform(0.1, 0.9)
        self.shininess = np.exp(rng.uniform(1.5, 5.0))

    def colours(self, points: Array, uv: Array | None = None) -> Array:
        """(N, 3) colours in [0, 1] of (N, 3) points of an object of radius 1."""
        if self._kind == "plain":
            return np.broadcast_to(self._first, points.shape)
        along = points @ self._axes + self._phases
        if self._kind == "cells":
            squared = ((points[:, None] - self._seeds) ** 2).sum(axis=-1)
            towards = self._palette[squared.argmin(axis=1)] - self._first
            return np.clip(self._first + self._strength * towards, 0, 1)
        if self._kind == "waves":
            weight = 0.5 + 0.5 * np.sin(along).mean(axis=1)
        elif self._kind == "stripes":
            weight = np.sin(along[:, 0]) > np.sin(self._phases[0])
        elif self._kind == "checks":
            weight = np.sin(along[:, :3]).prod(axis=1) > 0
        elif self._kind == "print":  # lines of dashes, like text
            row = np.floor(along[:, 0])
            place = np.floor(3 * along[:, 1])
            letters = np.sin(12.9898 * row + 78.233 * place) * 43758.5453
            is_letter = letters - np.floor(letters) > 0.5
            is_line = np.sin(7.1 * row) > -0.3
            weight = is_letter & is_line & (along[:, 0] - row > 0.4)
        else:
            coarse = np.sin(17.0 * along).mean(axis=1)
            fine = np.sin(31.0 * along[:, ::-1]).mean(axis=1)
            weight = coarse * fine + 0.5
        mixed = self._strength * weight[:, None]
        return self._first + mixed * (self._second - self._first)


def random_picture(rng: Rng, size: int) -> Array:
    """(size, size, 3) float32 flat background in [0, 1]: gradients, clouds, foliage, or a clutter
    of shapes."""
    top = random_colour(rng)
    bottom = random_colour(rng)
    if rng.random() < 0.4:
        bottom = np.clip(top + rng.normal(0, 0.1, 3), 0, 1)
    ramp = np.linspace(0, 1, size)[:, None, None]
    rows = top + ramp * (bottom - top)
    picture = np.broadcast_to(rows, (size, size, 3)).astype(np.float32)
    kind = rng.integers(5)
    if kind in (1, 2):  # clouds or foliage
        noise = np.zeros((size, size, 3), np.float32)
        slope = rng.uniform(0.2, 1.0)
        for octave in range(1, 8):
            n = 2**octave
            grey = rng.normal(size=(n, n, 1))
            cells = (grey + rng.normal(0, 0.3, (n, n, 3))).astype(np.float32)
            layer = cv2.resize(cells, (size, size), interpolation=cv2.INTER_CUBIC)
            noise += layer * 2 ** (-slope * octave)
        noise /= noise.std() + 1e-6
        if kind == 2:
            noise = np.tanh(4 * noise)
        picture = picture + rng.uniform(0.05, 0.35) * noise
    elif kind in (3, 4):
        picture = np.ascontiguousarray(picture)
        most = 40 if kind == 3 else 120
        for _ in range(rng.integers(3, most)):
            _draw_shape(picture, rng)
    return np.ascontiguousarray(np.clip(picture, 0, 1), dtype=np.float32)


def _draw_shape(picture: Array, rng: Rng) -> None:
    """A line, a convex polygon, or an ellipse."""
    size = len(picture)
    colour = random_colour(rng).tolist()
    place = rng.integers(0, size, 2).tolist()
    reach = rng.uniform(0.02, 0.4) * size
    if rng.random() < 0.3:
        end = rng.integers(0, size, 2).tolist()
        cv2.line(picture, place, end, colour, int(rng.integers(1, 5)), cv2.LINE_AA)
    elif rng.random() < 0.5:
        corners = place + rng.normal(0, reach, (rng.integers(3, 6), 2))
        hull = cv2.convexHull(corners.astype(np.int32))
        cv2.fillConvexPoly(picture, hull, colour, cv2.LINE_AA)
    else:
        a, b = rng.uniform(0.2, 1, 2) * reach
        axes = (int(a) + 1, int(b) + 1)
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(picture, place, axes, angle, 0, 360, colour, -1, cv2.LINE_AA)


def random_texture(rng: Rng) -> Array:
    """(256, 256, 3) float32 linear colours that repeat: wooden boards, woven cloth, or a random
    picture."""
    size = 256
    kind = rng.integers(3)
    if kind == 0:
        return random_picture(rng, size)
    first = random_colour(rng)
    second = random_colour(rng)
    y, x = np.mgrid[0:size, 0:size] / size
    if kind == 1:  # cloth: threads above and below each other, in stripes or checks
        threads = 2 * rng.integers(12, 32)
        stripes = rng.integers(1, 6)
        warp = np.sin(2 * np.pi * threads * x)
        weave = 0.5 + 0.5 * warp * np.sin(2 * np.pi * threads * y)
        bands = np.sin(2 * np.pi * stripes * x)
        if rng.random() < 0.5:
            bands = bands * np.sin(2 * np.pi * stripes * y)
        colour = np.where(bands[..., None] > 0, first, second)
        colour = colour * (0.75 + 0.25 * weave[..., None])
        return np.ascontiguousarray(colour, dtype=np.float32)
    grain = np.zeros((size, size), np.float32)  # boards with a grain along the columns
    layers = ((8, 2, 0.5), (64, 4, 0.5), (size // 2, 16, 0.3))
    for rows, columns, strength in layers:
        noise = rng.normal(size=(rows, columns)).astype(np.float32)
        noise = np.pad(noise, 1, mode="wrap")
        high = size // rows
        wide = size // columns
        shape = (size + 2 * wide, size + 2 * high)
        fine = cv2.resize(noise, shape, interpolation=cv2.INTER_CUBIC)
        grain += strength * fine[high : high + size, wide : wide + size]
    tones = rng.normal(0, 0.5, 4)
    grain += tones[np.floor(4 * y).astype(int)]
    gap = np.abs(4 * y - np.round(4 * y)) < 0.012
    brown = rng.uniform(0.4, 1.6) * np.array([0.42, 0.25, 0.13])
    colour = brown * np.exp(0.16 * grain[..., None])
    colour = np.where(gap[..., None], 0.35 * colour, colour)
    return np.ascontiguousarray(colour.clip(0, 1), dtype=np.float32)


def random_rotation(rng: Rng) -> Array:
    """(3, 3) rotation, uniformly distributed because a quaternion of normal numbers has no
    preferred direction."""
    return Rotation.from_quat(rng.normal(size=4), scalar_first=True).as_matrix()
