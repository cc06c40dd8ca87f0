"""Colours of the surface of a mesh: whether they vary, and what they are at its points."""

import cv2
import numpy as np

from ..formats.meshes.colours import SurfaceColours
from ..utils.arrays import Bytes, Floats, Indices, Singles
from .sampling import faces_at

SAMPLES = 20_000  # Points of the surface at which colours are compared
# Colours vary if so large a fraction of the surface differs by so much, of 255, from the median: a
# word on a box is more, noise of a JPEG less
VARIED_FRACTION = 0.002
VARIED_BY = 12
ROW = 1024  # Samples in a row of the map that OpenCV is given, whose sides are limited


def colours_vary(colours: SurfaceColours, areas: Floats) -> bool:
    """Whether colours differ over the surface, whose faces have some areas (F,)."""
    corners = colours.corners.reshape(-1, 3)
    if not len(corners) or (not colours.textures and (corners == corners[0]).all()):
        return False
    rng = np.random.default_rng(0)
    face = faces_at(areas, rng.uniform(0.0, 1.0, SAMPLES)).astype(np.int32)
    u, v = rng.uniform(0.0, 1.0, (2, SAMPLES)).astype(np.float32)
    outside = u + v > 1.0
    u[outside] = 1.0 - u[outside]
    v[outside] = 1.0 - v[outside]
    found = 255.0 * colours_at(colours, face, u, v)
    differs = (np.abs(found - np.median(found, axis=0)) > VARIED_BY).any(axis=1)
    return float(differs.mean()) > VARIED_FRACTION


def colours_at(
    colours: SurfaceColours,
    face: Indices,
    u: Singles,
    v: Singles,
) -> Singles:
    """(N, 3) RGB in [0, 1] at the points (1 - u - v) a + u b + v c of faces with corners a, b,
    c."""
    weights = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float32)
    colour: Singles = np.einsum("ij,ijk->ik", weights, colours.corners[face].astype(np.float32))
    colour /= np.float32(255)
    uv = np.einsum("ij,ijk->ik", weights, colours.uv[face])
    texture = colours.texture[face]
    for k in np.unique(texture[texture >= 0]):
        mask = texture == k
        colour[mask] *= _sample(colours.textures[k], uv[mask])
    return colour


def _sample(texture: Bytes, uv: Singles) -> Singles:
    """(N, 3) in [0, 1]: bilinear, repeating."""
    h, w = texture.shape[:2]
    count = len(uv)
    places = np.zeros((2, -(-count // ROW) * ROW), np.float32)
    places[:, :count] = (uv[:, 0] % 1.0) * w - 0.5, (-uv[:, 1] % 1.0) * h - 0.5
    x, y = places.reshape(2, -1, ROW)
    colours = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(colours.reshape(-1, 3)[:count] / np.float32(255), np.float32)
