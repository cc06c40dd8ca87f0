"""Results in plain words."""

from torch import Tensor

from ..geometry.pose_prior import object_frame
from ..geometry.viewpoint import viewpoint_from_rotation
from ..utils.choices import SIDE_NAMES
from .answer_set import AnswerSet

__all__ = ["pose_in_words", "verdict"]

STEEP = 70  # degrees of elevation beyond which an object is seen from above or below


def verdict(answers: AnswerSet, reliable: bool) -> str:
    """ "likely" if an answer is reliable, "no match" if "none of them" is more probable than it, otherwise "unsure".

    Example:
        >>> verdict(AnswerSet((0.95, 0.02)), True), verdict(AnswerSet((0.6, 0.3)), False)
        ('likely', 'unsure')
    """
    return "likely" if reliable else "no match" if answers.none > answers.probabilities[0] else "unsure"


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
