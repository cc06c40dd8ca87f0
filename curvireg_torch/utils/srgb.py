"""Colours as pictures store them (sRGB) and as light adds up (linear)."""

import numpy as np

from .arrays import Floats

Colours = Floats


def srgb(linear: Colours) -> Colours:
    """Linear colours as the values in [0, 1] that pictures store; beyond them they are clipped.

    Example:
        >>> srgb(np.array([0.0, 0.2140411, 2.0])).round(3).tolist()
        [0.0, 0.5, 1.0]
    """
    x = np.clip(np.nan_to_num(linear), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def linear_colours(stored: Colours) -> Colours:
    """The inverse of :func:`srgb` for values in [0, 1].

    Example:
        >>> linear_colours(np.array([0.0, 0.5, 1.0])).round(4).tolist()
        [0.0, 0.214, 1.0]
    """
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
