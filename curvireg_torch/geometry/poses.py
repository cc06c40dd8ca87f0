"""Translations in closed form from a box, and poses seen off the optical axis."""

import torch
from torch import Tensor

from .cameras import rotation_towards
from .crops import square_boxes

__all__ = ["pose_from_box"]


def pose_from_box(
    rotation: Tensor, centre: Tensor, view_box: Tensor, view_distance: Tensor, box: Tensor, K: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose of an object whose view, placed off the axis and at another distance, fills a photograph's box.

    The photograph's box is seen along a ray. A camera turned towards that ray sees the object as the view's camera
    does, up to scale: the longer sides of the two boxes give the distance, their centres the offset.

    Args:
        rotation: (..., 3, 3) of the view.
        centre: (3,) of the object in the model frame.
        view_box: (..., 4) the view's box in normalised image coordinates, the object's centre on the axis.
        view_distance: (...) of the centre in the view, model units.
        box: (..., 4) the photograph's box in px.
        K: (..., 3, 3) the photograph's camera matrix.

    Returns:
        rotation (..., 3, 3) and translation (..., 3) in the photograph's camera, model units.
    """
    corners = torch.stack([box[..., :2], box[..., 2:]], dim=-2)
    homogeneous = torch.cat([corners, torch.ones_like(corners[..., :1])], dim=-1)
    rays = homogeneous @ torch.linalg.inv(K).mT  # (..., 2, 3) of the box's corners
    towards = rotation_towards(rays.mean(dim=-2))
    # The corners as the turned camera sees them, as a box again.
    turned = rays @ towards
    turned = turned[..., :2] / turned[..., 2:]
    photo_box = torch.cat([turned.amin(dim=-2), turned.amax(dim=-2)], dim=-1)
    view_square, photo_square = square_boxes(view_box, 0.0), square_boxes(photo_box, 0.0)
    zoom = (view_square[..., 2] - view_square[..., 0]) / (photo_square[..., 2] - photo_square[..., 0])
    photo_centre = 0.5 * (photo_square[..., :2] + photo_square[..., 2:])
    view_centre = 0.5 * (view_square[..., :2] + view_square[..., 2:])
    # The object's centre, on the view's axis, lies this far from the box's centre.
    offset = photo_centre - view_centre / zoom[..., None]
    z = view_distance * zoom
    position = torch.cat([offset * z[..., None], z[..., None]], dim=-1)
    R = towards @ rotation
    translation = (towards @ position[..., None])[..., 0] - (R @ centre[..., None])[..., 0]
    return R, translation
