"""Symmetries of a mesh's shape that a small feature of it breaks."""

from dataclasses import dataclass

import torch
import trimesh
from torch import Tensor

from ..geometry.viewpoint import rotation_error
from ..mesh.symmetry import FEATURE_FRACTION, feature_fractions

# Symmetries that are compared, the identity among them: every 30 degrees of a body of revolution
MAX_SIBLINGS = 12

NOTABLE_FRACTION = 0.01
"""Fraction of the surface from which a feature matters: poses that it tells apart are different
answers, also where a photograph does not show it. The pull tab of a can has half of it."""


@dataclass(frozen=True)
class TellingSymmetries:
    """Symmetries of a mesh's shape that a small feature tells from the identity.

    Attributes:
        transforms: (K, 4, 4), the identity first.
        notable: whether the feature has ``NOTABLE_FRACTION`` of the surface.
    """

    transforms: Tensor
    notable: bool = False

    def __len__(self) -> int:
        return len(self.transforms)


def telling_symmetries(mesh: trimesh.Trimesh, symmetries: Tensor) -> TellingSymmetries:
    """Those of the symmetries (S, 4, 4) of a mesh's shape that a small feature tells from the
    identity; at most ``MAX_SIBLINGS``, far from each other."""
    if len(symmetries) == 1:
        return TellingSymmetries(symmetries)
    chosen = spread(symmetries)
    fractions = feature_fractions(mesh, chosen)
    telling = fractions > FEATURE_FRACTION
    telling[0] = True
    return TellingSymmetries(chosen[telling], bool(fractions.max() >= NOTABLE_FRACTION))


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
