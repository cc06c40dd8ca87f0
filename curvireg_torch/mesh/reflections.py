"""Whether a shape is its own mirror image."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from .mesh import measure, mesh_radius, principal_rotation
from .sampling import surface_points

# Points of a surface that are reflected, and the distance from it, as a fraction of its radius,
# within which that fraction of them lies if a mesh is its own mirror image
POINTS = 2000
SAME_SHAPE = 0.03
SAME_POINTS = 0.995


@measure
def is_its_own_mirror_image(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh is symmetric to a plane: one of those of the principal axes of its surface, or
    of the mesh file's axes.

    Example:
        >>> is_its_own_mirror_image(trimesh.creation.box((1, 2, 3)))
        True
    """
    centre = np.asarray(mesh.centroid)
    points = surface_points(mesh, POINTS) - centre
    tree = cKDTree(surface_points(mesh, 20 * POINTS, seed=1) - centre)
    for normal in np.concatenate([principal_rotation(mesh).numpy(), np.eye(3)]):
        reflected = points - 2.0 * (points @ normal)[:, None] * normal
        distances, _ = tree.query(reflected)
        if np.quantile(distances, SAME_POINTS) < SAME_SHAPE * mesh_radius(mesh):
            return True
    return False
