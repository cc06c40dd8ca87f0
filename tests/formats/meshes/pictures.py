"""Pictures for meshes to wear."""

from io import BytesIO

import numpy as np
from PIL import Image


def noise(seed=0):
    """(8, 8, 3) random pixels."""
    return np.random.default_rng(seed).integers(0, 255, (8, 8, 3), np.uint8)


def encoded(pixels, kind="PNG", **how):
    """The file of a picture."""
    file = BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, kind, **how)
    return file.getvalue()


def painted(colour):
    """The file of a picture of one colour."""
    return encoded(np.full((4, 4, 3), colour))
