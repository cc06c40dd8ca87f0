"""Files of poses whose rotation is checked."""

from pathlib import Path

import torch

from ..errors import InvalidInputError
from ..formats import poses
from ..formats.poses import PoseRecord
from ..utils.checks import check_pose


def read_pose(path: Path, *, convention: str = "opencv", mesh: str = "") -> PoseRecord:
    """The pose of an object in a camera, which is rigid; arguments and errors are those of
    :func:`curvireg_torch.formats.poses.read_pose`, and :class:`.InvalidInputError` for one that is
    not."""
    found = poses.read_pose(path, convention=convention, mesh=mesh)
    try:
        check_pose(torch.from_numpy(found.T), "rotation, translation")
    except InvalidInputError as error:
        raise error.with_subject(path) from error
    return found
