"""The plane to which the shape of a mesh is most nearly symmetric."""

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from .mesh import measure, mesh_radius, principal_rotation
from .sampling import surface_points

# Points of a surface that are reflected, and the distance from it, as a fraction of its radius,
# within which that fraction of them lies if a mesh is its own mirror image
POINTS = 2000
SAME_SHAPE = 0.03
SAME_POINTS = 0.995


@measure
def reflection_plane(mesh: trimesh.Trimesh) -> Tensor | None:
    """(3,) normal of the plane to which a mesh is most nearly symmetric, of those of the principal
    axes of its surface and of the mesh file's axes; None if it is symmetric to one of them,
    and thus its own mirror image.

    Example:
        >>> reflection_plane(trimesh.creation.box((1, 2, 3))) is None
        True
    """
    centre = np.asarray(mesh.centroid)
    points = surface_points(mesh, POINTS) - centre
    tree = cKDTree(surface_points(mesh, 20 * POINTS, seed=1) - centre)
    normals = np.concatenate([principal_rotation(mesh).numpy(), np.eye(3)])
    means = []
    for normal in normals:
        reflected = points - 2.0 * (points @ normal)[:, None] * normal
        distances, _ = tree.query(reflected)
        if np.quantile(distances, SAME_POINTS) < SAME_SHAPE * mesh_radius(mesh):
            return None
        means.append(distances.mean())
    return torch.from_numpy(normals[int(np.argmin(means))].copy())
