"""Translations in closed form from a box, and poses seen off the optical axis."""

import torch
from torch import Tensor

from .cameras import rotation_towards

__all__ = ["pose_from_box"]


def pose_from_box(
    rotation: Tensor, centre: Tensor, view_box: Tensor, view_distance: Tensor, box: Tensor, K: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose of an object whose view, placed off the axis and at another distance, fills a photograph's box.

    The centre of the view's box and that of the photograph's are seen along two rays. Cameras turned towards them see
    the object alike, up to scale: the longer sides of the two boxes give the distance, the rays give the rotation.
    Where the view was rendered at the true distance this is exact up to the boxes' own perspective; a view at another
    distance has a box of slightly other shape (``docs/conventions.md`` has numbers).

    Args:
        rotation: (..., 3, 3) of the view.
        centre: (3,) of the object in the model frame.
        view_box: (..., 4) the view's box in normalised image coordinates, the object's centre on the axis.
        view_distance: (...) of the centre in the view, model units.
        box: (..., 4) the photograph's box in px.
        K: (..., 3, 3) the photograph's camera matrix.

    Returns:
        rotation (..., 3, 3) and translation (..., 3) in the photograph's camera, model units.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> view_box = torch.tensor([-0.1, -0.1, 0.1, 0.1])             # seen from 10 units
        >>> box = torch.tensor([220.0, 140, 420, 340])                  # twice as large in the photograph
        >>> R, t = pose_from_box(torch.eye(3), torch.zeros(3), view_box, torch.tensor(10.0), box, K)
        >>> [abs(round(v, 3)) for v in t.tolist()]
        [0.0, 0.0, 5.0]
    """
    view_towards, view_side = _centre_and_side(view_box, torch.eye(3, dtype=K.dtype, device=K.device))
    towards, side = _centre_and_side(box, K)
    # The object's centre in the camera that looks at the view's box; moved along that camera's axis.
    position = view_towards[..., 2, :] * view_distance[..., None]
    position = torch.cat([position[..., :2], (position[..., 2] * view_side / side)[..., None]], dim=-1)
    R = towards @ view_towards.mT @ rotation
    translation = (towards @ position[..., None])[..., 0] - (R @ centre[..., None])[..., 0]
    return R, translation


def _centre_and_side(box: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation towards a box's centre, and the longer side of the box as a camera turned by it sees it."""
    corners = torch.stack([box[..., :2], box[..., 2:]], dim=-2)
    homogeneous = torch.cat([corners, torch.ones_like(corners[..., :1])], dim=-1)
    rays = homogeneous @ torch.linalg.inv(K).mT  # (..., 2, 3) of the box's corners
    towards = rotation_towards(rays.mean(dim=-2))
    turned = rays @ towards
    turned = turned[..., :2] / turned[..., 2:]
    return towards, (turned[..., 1, :] - turned[..., 0, :]).abs().amax(dim=-1)
