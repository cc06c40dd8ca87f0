"""Results in plain words."""

from torch import Tensor

from ..geometry.pose_prior import object_frame
from ..geometry.viewpoint import viewpoint_from_rotation
from ..utils.choices import SIDE_NAMES

__all__ = ["UNSURE", "pose_in_words", "verdict"]

STEEP = 70  # degrees of elevation beyond which an object is seen from above or below

UNSURE = 0.5
"""Least confidence of an answer that is more probably right than wrong."""


def verdict(confidence: float, reliable: bool) -> str:
    """ "likely" if an answer is reliable, otherwise "unsure" from ``UNSURE``, below it "no match".

    Example:
        >>> verdict(0.95, True), verdict(0.6, False), verdict(0.1, False)
        ('likely', 'unsure', 'no match')
    """
    return "likely" if reliable else "unsure" if confidence >= UNSURE else "no match"


def pose_in_words(rotation: Tensor, *, up: str = "z", front: str | None = None) -> str:
    """The side from which the object is seen, in degrees that the option ``--azimuth`` takes.

    Args:
        rotation: (3, 3), from the mesh file's axes to the camera.
        up, front: axes of the mesh, see :func:`.object_frame`.

    Example:
        >>> from curvireg_torch.geometry import rotation_from_viewpoint
        >>> pose_in_words(rotation_from_viewpoint(310.0, 20.0, 0.0))
        'seen from the front-left (azimuth 310°), 20° above the horizon'
    """
    R = rotation.detach().cpu().double()
    azimuth, elevation, theta = (round(float(v)) for v in viewpoint_from_rotation(R @ object_frame(up, front).mT))
    side = f"the {SIDE_NAMES[round(azimuth / 45.0) % 8]}"
    if abs(elevation) > STEEP:
        side = "above" if elevation > 0 else "below"
    height = f"{abs(elevation)}° {'above' if elevation > 0 else 'below'} the horizon" if elevation else "level"
    tilt = f", tilted by {abs(theta)}° to the {'left' if theta > 0 else 'right'}" if theta else ""
    return f"seen from {side} (azimuth {azimuth % 360}°), {height}{tilt}"
