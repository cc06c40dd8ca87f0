"""Several photographs of an object in one pose, and their registration together."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from ..data import read_photo
from ..errors import CurviregError
from ..geometry import Camera, undistorted
from ..registration import Registrar, Registration
from ..utils.likes import BoxLike


@dataclass(frozen=True)
class RigView:
    """One of several photographs of an object in one pose."""

    name: str  # as the user calls the photograph
    photo: Path
    box: BoxLike | None  # x0, y0, x1, y1 in px
    camera: Camera
    T_cam_from_world: Tensor  # (4, 4) float64, lengths in the mesh's unit
    image: Tensor | None = None  # its pixels, if it was read


def register_views(
    views: Sequence[RigView], registrar: Registrar, *, as_stored: bool = False
) -> tuple[Registration, list[RigView]]:
    """Register several photographs together, see :meth:`.Registrar.register_views`, without their
    distortion.

    Returns:
        The registration; and the photographs with their pixels without distortion, cameras and
        boxes of these. One that could not be read has no pixels.
    """
    seen = []
    for view in views:
        image = view.image
        # the registrar reports what cannot be read, and goes on without it
        with suppress(CurviregError, OSError):
            image = read_photo(view.photo, as_stored=as_stored).image if image is None else image
        if image is not None:
            try:
                camera = view.camera.at((image.shape[-2], image.shape[-1]))
                straight = undistorted(
                    image, camera, None if view.box is None else torch.tensor(view.box)
                )
            except CurviregError as error:
                raise error.with_subject(view.name) from error
            box = None if straight.box is None else straight.box.tolist()
            view = replace(view, image=straight.image, box=box, camera=camera)
        seen.append(view)
    images = [view.photo if view.image is None else view.image for view in seen]
    boxes = [None if view.image is None else view.box for view in seen]
    matrices = torch.stack([v.camera.matrix for v in seen])
    poses = torch.stack([v.T_cam_from_world for v in seen])
    try:
        return registrar.register_views(images, boxes, matrices, poses), seen
    except CurviregError as error:
        raise error.with_image_names([view.name for view in views]) from error
