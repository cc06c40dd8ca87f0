"""Symmetries of a mesh's shape that a small feature of it breaks."""

import torch
import trimesh
from torch import Tensor

from ..geometry.viewpoint import rotation_error
from ..mesh.symmetry import FEATURE_FRACTION, feature_fractions

# Symmetries that are compared, the identity among them: every 30 degrees of a body of revolution
MAX_SIBLINGS = 12


def telling_symmetries(mesh: trimesh.Trimesh, symmetries: Tensor) -> Tensor:
    """(K, 4, 4) those of the symmetries (S, 4, 4) of a mesh's shape that a small feature tells from
    the identity, which is the first; at most ``MAX_SIBLINGS``, far from each other."""
    chosen = spread(symmetries)
    telling = feature_fractions(mesh, chosen) > FEATURE_FRACTION
    telling[0] = True
    return chosen[telling]


def spread(symmetries: Tensor) -> Tensor:
    """At most ``MAX_SIBLINGS`` of the symmetries (S, 4, 4), the identity first, far from each
    other."""
    R = symmetries[:, :3, :3].double()
    chosen = [0]
    nearest = rotation_error(R, R[0])
    while len(chosen) < min(MAX_SIBLINGS, len(R)):
        farthest = int(nearest.argmax())
        chosen.append(farthest)
        nearest = torch.minimum(nearest, rotation_error(R, R[farthest]))
    return symmetries[torch.tensor(chosen)]
