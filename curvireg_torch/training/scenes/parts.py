"""Parts of a shape: surfaces with a material number."""

from typing import TypeAlias

import numpy as np

from .surfaces import Surface, box, superquadric

__all__ = ["Part", "Rng", "rounded_box"]

Rng: TypeAlias = np.random.Generator
Part: TypeAlias = tuple[Surface, int]
"""A surface and its material number; parts with the same number have the same material."""


def rounded_box(rng: Rng, size: object) -> Surface:
    """A box of side lengths ``size``, with sharp or rounded edges."""
    if rng.random() < 0.5:
        return box(size, top=rng.choice([1.0, rng.uniform(0.7, 1.0)]))
    e = rng.uniform(0.1, 0.5)
    return superquadric(0.5 * np.asarray(size), (e, e))
