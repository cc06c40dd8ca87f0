"""Random rotations and poses from scipy, so that the tests do not lean on the package's own
geometry."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation


def rotations(n, seed):
    return torch.from_numpy(
        Rotation.random(n, random_state=np.random.RandomState(seed)).as_matrix().reshape(n, 3, 3)
    )


def poses(n, seed, *, near=None):
    """(n, 4, 4) float64, about 5 units ahead of the camera; or small disturbances of the poses
    ``near``."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    if near is None:
        T[:, :3, :3] = rotations(n, seed).numpy()
        T[:, :3, 3] = rng.normal(size=(n, 3)) * 0.3 + [0.0, 0.0, 5.0]
        return torch.from_numpy(T)
    T[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.1).as_matrix() @ near[:, :3, :3].numpy()
    )
    T[:, :3, 3] = near[:, :3, 3].numpy() + rng.normal(size=(n, 3)) * 0.05
    return torch.from_numpy(T)
