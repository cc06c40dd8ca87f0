"""The axis that points up when an object stands. Meshes and poses stay in the frame of the file."""

import torch
from torch import Tensor

from ..utils.checks import check_option
from ..utils.choices import UP_AXES


def up_rotation(up: str) -> Tensor:
    """(3, 3) float64 rotation from a frame whose axis ``up`` points up to one whose z axis does.

    glTF's front, +z under y up, becomes -y, the front of PASCAL3D+ at azimuth 0.

    Args:
        up: "x", "y", "z", "-x", "-y" or "-z".

    Example:
        >>> (up_rotation("y") @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)).tolist()
        [0.0, 0.0, 1.0]
    """
    check_option(up, UP_AXES, "up")
    return torch.tensor(UP_AXES[up], dtype=torch.float64)
