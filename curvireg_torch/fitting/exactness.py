"""How exact a pose is, in two numbers: the errors of rotation and distance that nine in ten answers
stay within."""

import math
from dataclasses import dataclass

import torch
from scipy.special import gammaincinv
from torch import Tensor

from ..calibration import CALIBRATION
from ..geometry.cameras import turn_with_ray
from ..geometry.conversions import cross_matrix

LEVEL = 0.9
UNKNOWN = 1.0
"""Radians of standard deviation from which the rotation about an axis counts as unknown; it is left
out, as that of a body of revolution has to be."""


@dataclass(frozen=True)
class Exactness:
    """Errors that nine in ten answers stay within.

    Attributes:
        rotation_deg: degrees of rotation about all axes that are known.
        distance_percent: of the distance.
        allocentric_deg: degrees of the rotation that a camera would see that looks straight at the
            object.

    Example:
        >>> Exactness(2.6, 1.9, 2.5).words
        'to about 3 degrees and 2 % of the distance'
    """

    rotation_deg: float
    distance_percent: float
    allocentric_deg: float

    @property
    def words(self) -> str:
        """The first two in words."""
        percent = _one_digit(self.distance_percent)
        return f"to about {degrees_in_words(self.rotation_deg)} and {percent} % of the distance"


def exactness_of(
    covariance: Tensor,
    rotation: Tensor,
    translation: Tensor,
    allocentric_rotation: Tensor,
    distance: float,
) -> Exactness:
    """The exactness of a pose, from its ``covariance`` (6, 6) of rotation and translation, see
    :class:`.Hypothesis`, whose attributes the others are.

    The errors' squares are taken as gamma distributed with the mean and the variance that normally
    distributed errors give them.
    """
    ray = rotation @ allocentric_rotation.mT[:, 2]  # towards the object's centre
    position = distance * ray
    identity = torch.eye(3, dtype=torch.float64)
    # the centre moves by e + w x arm
    arm = position - translation
    centre = torch.cat([-cross_matrix(arm), identity], dim=1)
    along = ray @ centre
    # what turns with the ray is no error of the allocentric rotation
    turn = torch.cat([identity, torch.zeros(3, 3, dtype=torch.float64)], dim=1)
    seen = turn - turn_with_ray(position) @ centre
    scale = CALIBRATION["radius"]
    return Exactness(
        rotation_deg=scale["rotation"] * _radius_deg(turn @ covariance @ turn.mT),
        distance_percent=scale["distance"]
        * 100.0
        * _radius(along @ covariance @ along[:, None], 1.0)
        / distance,
        allocentric_deg=scale["rotation"] * _radius_deg(seen @ covariance @ seen.mT),
    )


def _radius_deg(covariance: Tensor) -> float:
    """Degrees that a rotation with a covariance (3, 3) in rad stays within."""
    variances = torch.linalg.eigvalsh(covariance.double()).clamp(min=0.0)
    known = variances[variances < UNKNOWN**2]
    if not len(known):
        return 180.0
    mean = float(known.sum())
    spread = 2.0 * float(known.square().sum())
    freedom = 2.0 * mean**2 / max(spread, 1e-300)
    return min(math.degrees(_radius(torch.tensor(mean), freedom)), 180.0)


def _radius(mean: Tensor, freedom: float) -> float:
    """The length that is exceeded by one in ten, of which the square has this ``mean`` and a
    chi-squared distribution of so many degrees of ``freedom``."""
    quantile = 2.0 * float(gammaincinv(0.5 * freedom, LEVEL))
    return math.sqrt(max(float(mean), 0.0) * quantile / freedom)


def degrees_in_words(value: float) -> str:
    """Degrees with one digit.

    Example:
        >>> degrees_in_words(11.2), degrees_in_words(1.3)
        ('10 degrees', '1 degree')
    """
    degrees = _one_digit(value)
    return f"{degrees} degree{'s' * (degrees != '1')}"


def _one_digit(value: float) -> str:
    """A number above 0 with one digit, of at least 0.1: 0.3, 3, 20."""
    return f"{float(f'{max(value, 0.1):.1g}'):g}"
