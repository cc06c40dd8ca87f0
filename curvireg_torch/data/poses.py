"""Files of poses as tensors, whose rotation is checked."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..formats import poses
from ..utils.checks import check_pose


@dataclass(frozen=True, eq=False)
class PoseFile:
    """A pose that a file holds.

    Attributes:
        T: (4, 4) float64 model -> OpenCV camera, rigid.
        unit: of the translation, "m" or "mm", where the format fixes it; None: that of the mesh.
        confidence: of the pose, if the file has one.
    """

    T: Tensor
    unit: str | None = None
    confidence: float | None = None


def read_pose(path: Path, *, convention: str = "opencv", mesh: str = "") -> PoseFile:
    """The pose of an object in a camera; arguments and errors are those of
    :func:`curvireg_torch.formats.poses.read_pose`, and :class:`.InvalidInputError` for one that is
    not rigid."""
    found = poses.read_pose(path, convention=convention, mesh=mesh)
    T = torch.from_numpy(found.T)
    try:
        check_pose(T, "rotation, translation")
    except InvalidInputError as error:
        raise error.with_subject(path) from error
    return PoseFile(T, found.unit, found.confidence)
