"""Points and faces that stand for the surface of a mesh, always the same."""

import numpy as np
import trimesh

from ..utils.arrays import Floats, Integers


def surface_points(mesh: trimesh.Trimesh, count: int, *, seed: int = 0) -> Floats:
    """(count, 3) random points of a surface."""
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def faces_at(area: Floats, fractions: Floats) -> Integers:
    """(N,) the faces, of areas (F,), at fractions (N,) in [0, 1] of the whole surface, one face
    after the other."""
    total = np.cumsum(area)
    return np.asarray(np.searchsorted(total, fractions * total[-1]).clip(max=len(area) - 1))
