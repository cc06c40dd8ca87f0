"""A generator of photograph-like scenes with known truth, from procedural shapes or the user's meshes."""

from .dataset import GeneratedScenes
from .shapes import FAMILIES, Shape, random_shape, shape_from_mesh

__all__ = ["FAMILIES", "GeneratedScenes", "Shape", "random_shape", "shape_from_mesh"]
