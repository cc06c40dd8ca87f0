"""The pose on the page: a hypothesis, and what the user changed in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error, rotation_from_axis_angle
from ..geometry.cameras import rotation_towards
from ..registration import Hypothesis, Registrar, fit_contours

__all__ = ["DisplayedPose", "fit_displayed", "move_displayed"]


@dataclass(frozen=True)
class DisplayedPose:
    """The pose on the page: a hypothesis with its number from 0, and what the user did to it in words.

    ``chosen``: the user picked it as the answer among those that may be right.
    """

    pose: Hypothesis
    number: int
    edits: tuple[str, ...] = ()
    chosen: bool = False


def move_displayed(
    registrar: Registrar, displayed: DisplayedPose, *, rotation: Sequence[float], translation: Sequence[float]
) -> DisplayedPose:
    """Rotate the object about its centre, in degrees about the camera's x, y and z axes, and move it in its radii.

    Raises:
        InvalidInputError: the object would touch the camera.
    """
    describer = registrar.describer
    T = displayed.pose.projection[0].clone()
    angles, shift = (torch.tensor(list(v), dtype=torch.float64) for v in (rotation, translation))
    centre = T[:3, :3] @ describer.centre + T[:3, 3] + describer.radius * shift
    if float(centre[2]) < 1.2 * describer.radius:
        raise InvalidInputError("the object would touch the camera; move it away")
    T[:3, :3] = rotation_from_axis_angle(torch.deg2rad(angles)) @ T[:3, :3]
    T[:3, 3] = centre - T[:3, :3] @ describer.centre
    edits = [f"rotated {v:g} degrees about {axis}" for v, axis in zip(rotation, "xyz", strict=True) if v]
    edits += [f"moved {v:g} radii along {axis}" for v, axis in zip(translation, "xyz", strict=True) if v]
    return _edited(displayed, describer.centre, T, *edits)


def fit_displayed(registrar: Registrar, displayed: DisplayedPose, image: Tensor, box: Tensor) -> DisplayedPose:
    """Fit the mesh's contours to the edges of an image (3, H, W) with a box (4,), see :func:`fit_contours`."""
    describer = registrar.describer
    T, K = displayed.pose.projection
    fit = fit_contours(
        describer.contours,
        image,
        box,
        K,
        T[None],
        margin=registrar.bank.settings.margin,
    )
    degrees = float(rotation_error(fit.transform[0, :3, :3], T[:3, :3]))
    supports = f"{float(fit.start_support[0]):.2f} to {float(fit.edge_support[0]):.2f}"
    edit = f"contours fitted: rotated {degrees:.1f} degrees, edge support {supports}"
    return _edited(displayed, describer.centre, fit.transform[0], edit)


def _edited(displayed: DisplayedPose, centre: Tensor, T: Tensor, *edits: str) -> DisplayedPose:
    """The pose at (4, 4) ``T_cam_from_model``, without the hypothesis's measurements; ``centre`` (3,) of the mesh."""
    position = T[:3, :3] @ centre + T[:3, 3]
    allocentric = rotation_towards(position).mT @ T[:3, :3]
    has_translation = displayed.pose.translation is not None
    pose = replace(
        displayed.pose,
        rotation=T[:3, :3].clone() if has_translation else allocentric,
        translation=T[:3, 3].clone() if has_translation else None,
        score=float("nan"),
        evidence={},
        allocentric_rotation=allocentric,
        distance=float(torch.linalg.vector_norm(position)),
        projection=(T, displayed.pose.projection[1]),
        edge_support=None,
        covariance=None,
    )
    return replace(displayed, pose=pose, edits=(*displayed.edits, *edits))
