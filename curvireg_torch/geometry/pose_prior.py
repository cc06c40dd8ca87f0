"""What is known about the pose in advance: ranges of viewpoint and distance, a rotation nearby,
which way is up."""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.aliases import Fields
from ..utils.checks import as_numbers, check_number, check_numbers, check_option, check_rotation
from ..utils.choices import SIDE_NAMES, UP_AXES
from .conversions import axis_angle_from_rotation, rotation_from_axis_angle
from .viewpoint import rotation_error, rotation_from_viewpoint, up_rotation, viewpoint_from_rotation

# Azimuth in degrees from which a side of the object is seen; right and left as in a photograph of
# its front
SIDES = {name: 45.0 * k for k, name in enumerate(SIDE_NAMES)}
SIDE_WIDTH = 45.0  # degrees of azimuth to either side of the middle that a named side covers
MAX_MOVES = 20  # alternating moves into limits that hold together


@dataclass(frozen=True)
class PosePrior:
    """Limits on the pose that hold for a photograph; all that are given must hold.

    Angles are those of :func:`viewpoint_from_rotation` for an object with z up whose front is at
    azimuth 0. How far a pose misses a limit is measured as a rotation: near the poles, a wrong
    azimuth hardly counts. Methods take rotations of the mesh file's axes and ``frame``, the
    rotation of these axes to the object's (:func:`object_frame`).

    Attributes:
        azimuth: (low, high) in degrees, counted upwards from low to high: (300, 60) goes through 0.
        elevation: (low, high) in degrees within [-90, 90].
        theta: (low, high) of the in-plane rotation in degrees, counted upwards as the azimuth is.
        viewpoint: (azimuth, elevation, theta) in degrees; the pose lies within ``within`` degrees
            of it.
        rotation: (3, 3) from the mesh file's axes to the camera; the pose lies within ``within``
            degrees of it.
        within: tolerance in degrees of ``viewpoint`` and ``rotation``; needed by each of them.
        distance: (near, far) of the object's centre in the mesh's unit; needs a camera matrix.
        front: the mesh's axis that points out of its front, for :func:`object_frame`.

    Raises:
        InvalidInputError: a range that is not two finite numbers, an empty prior, ``within``
            missing or out of range.

    Example:
        >>> prior = PosePrior(azimuth=(300, 60), elevation=(0, 45))
        >>> R = rotation_from_viewpoint(torch.tensor([350.0, 80.0]), 20.0)
        >>> [round(degrees, 1) for degrees in prior.excess(R).tolist()]
        [-20.0, 18.7]
    """

    azimuth: tuple[float, float] | None = None
    elevation: tuple[float, float] | None = None
    theta: tuple[float, float] | None = None
    viewpoint: tuple[float, float, float] | None = None
    rotation: Any = None
    within: float | None = None
    distance: tuple[float, float] | None = None
    front: str | None = None

    def __post_init__(self) -> None:
        for name in ("azimuth", "elevation", "theta", "distance", "viewpoint"):
            if getattr(self, name) is not None:
                numbers = check_numbers(getattr(self, name), name, 3 if name == "viewpoint" else 2)
                object.__setattr__(self, name, tuple(numbers.tolist()))
        if (
            self.elevation is not None
            and not -90.0 <= self.elevation[0] <= self.elevation[1] <= 90.0
        ):
            raise InvalidInputError(
                f"elevation: expected -90 <= low <= high <= 90, got {self.elevation}"
            )
        check_distance(self.distance)
        if self.rotation is not None:
            R = as_numbers(self.rotation, "rotation", dtype=torch.float64)
            if R.shape != (3, 3):
                raise InvalidInputError(f"rotation: expected (3, 3), got {tuple(R.shape)}")
            check_rotation(R, "rotation")
            object.__setattr__(self, "rotation", tuple(map(tuple, R.tolist())))
        if self.front is not None:
            check_option(self.front, UP_AXES, "front")
        if (self.rotation is not None or self.viewpoint is not None) != (self.within is not None):
            raise InvalidInputError(
                "within: expected degrees beside rotation or viewpoint, and only there"
            )
        if self.within is not None and not 0.0 < check_number(self.within, "within") <= 180.0:
            raise InvalidInputError(f"within: expected degrees in (0, 180], got {self.within}")
        if not self.to_dict().keys() - {"front"}:
            raise InvalidInputError(
                "prior: expected at least one limit, got none; leave the prior out"
            )

    @classmethod
    def side(cls, name: str) -> "PosePrior":
        """The side of the object that faces the camera: one of ``SIDES``, 45 degrees to either side
        of it."""
        check_option(name, SIDES, "side")
        return cls(azimuth=((SIDES[name] - SIDE_WIDTH) % 360.0, (SIDES[name] + SIDE_WIDTH) % 360.0))

    def to_dict(self) -> Fields:
        """The limits that are given, as plain numbers and texts."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in plain.items() if value is not None}

    def excess(self, rotations: Tensor, frame: Tensor | None = None) -> Tensor:
        """(...) degrees by which (..., 3, 3) rotations miss the worst of the limits on rotations.
        Negative within all limits: minus the distance to the nearest of them, at least -180."""
        worst = torch.full_like(rotations[..., 0, 0], -180.0)
        if self.azimuth or self.elevation or self.theta:
            azimuth, elevation, theta = viewpoint_from_rotation(_in_object_frame(rotations, frame))
            if self.azimuth is not None:
                worst = torch.maximum(worst, _outside(azimuth, self.azimuth, elevation))
            for bound, beyond in zip(self.elevation or (), (1.0, -1.0), strict=False):
                if beyond * bound > -90.0:  # no pose misses a bound at a pole
                    worst = torch.maximum(worst, beyond * (bound - elevation))
            if self.theta is not None:
                worst = torch.maximum(worst, _outside(theta, self.theta, elevation))
        for R in self._centres(rotations, frame):
            worst = torch.maximum(worst, rotation_error(rotations, R) - (self.within or 0.0))
        return worst

    def nearest(self, rotations: Tensor, frame: Tensor | None = None) -> Tensor:
        """Return (..., 3, 3) rotations moved into the limits, one after the other in rounds; those
        within stay."""
        moved = rotations
        for _ in range(MAX_MOVES):
            outside = self.excess(moved, frame) > 1e-6
            if not bool(outside.any()):
                break
            moved = torch.where(outside[..., None, None], self._moved_once(moved, frame), moved)
        return moved

    def _moved_once(self, moved: Tensor, frame: Tensor | None) -> Tensor:
        if self.azimuth or self.elevation or self.theta:
            R = _in_object_frame(moved, frame)
            R = R if self.azimuth is None else _moved_to_azimuth(R, self.azimuth)
            azimuth, elevation, theta = viewpoint_from_rotation(R)
            elevation = elevation if self.elevation is None else elevation.clamp(*self.elevation)
            theta = theta if self.theta is None else _clamped(theta, self.theta)
            R = rotation_from_viewpoint(azimuth, elevation, theta)
            moved = R if frame is None else R @ frame.to(R)
        for R in self._centres(moved, frame):
            vector = axis_angle_from_rotation(moved @ R.mT)
            angle = torch.rad2deg(torch.linalg.vector_norm(vector, dim=-1, keepdim=True))
            shorter = vector * ((self.within or 0.0) / angle.clamp(min=1e-9)).clamp(max=1.0)
            moved = torch.where(
                (angle > (self.within or 0.0))[..., None],
                rotation_from_axis_angle(shorter) @ R,
                moved,
            )
        return moved

    def _centres(self, like: Tensor, frame: Tensor | None) -> list[Tensor]:
        """(3, 3) rotations around which the pose lies."""
        centres = []
        if self.viewpoint is not None:
            R = rotation_from_viewpoint(*torch.tensor(self.viewpoint, dtype=torch.float64).to(like))
            centres.append(R if frame is None else R @ frame.to(R))
        if self.rotation is not None:
            centres.append(torch.tensor(self.rotation, dtype=torch.float64).to(like))
        return centres


def object_frame(up: str = "z", front: str | None = None) -> Tensor:
    """(3, 3) float64 rotation from a mesh file's axes to those of :class:`PosePrior`: z up, the
    front at azimuth 0.

    ``up`` and ``front`` name axes of the mesh, such as "z" or "-y"; the default front is "-y" where
    z is up, as in PASCAL3D+, and what :func:`up_rotation` turns to it where another axis is. Other
    names, and front and up on the same axis, raise :class:`InvalidInputError`.

    Example:
        >>> (object_frame("y", "z") @ torch.tensor([0.0, 0.0, 1.0],
        ...     dtype=torch.float64)).round().tolist()
        [0.0, -1.0, 0.0]
    """
    R = up_rotation(up)
    if front is None:
        return R
    check_option(front, UP_AXES, "front")
    axis = torch.zeros(3, dtype=torch.float64)
    axis["xyz".index(front[-1])] = -1.0 if front.startswith("-") else 1.0
    x, y, z = (R @ axis).tolist()
    if abs(z) > 0.5:
        raise InvalidInputError(
            f"front: expected another axis than the one that points up ({up}), got {front!r}"
        )
    # Rotate about z until the front points along -y, where the camera of azimuth 0 stands.
    angle = torch.tensor([0.0, 0.0, -math.pi / 2 - math.atan2(y, x)], dtype=torch.float64)
    return rotation_from_axis_angle(angle) @ R


def check_distance(distance: tuple[float, ...] | None) -> None:
    """Raise :class:`InvalidInputError` for a range of distances that is not 0 < NEAR <= FAR."""
    if distance is not None and not 0.0 < distance[0] <= distance[1] < math.inf:
        raise InvalidInputError(
            f"distance: expected 0 < NEAR <= FAR, got {distance[0]:g} {distance[1]:g}"
        )


def _in_object_frame(rotations: Tensor, frame: Tensor | None) -> Tensor:
    return rotations if frame is None else rotations @ frame.mT.to(rotations)


def _position(angle: Tensor, limits: tuple[float, ...]) -> tuple[Tensor, float]:
    """Degrees from the lower limit upwards, in [0, 360), and the width of the range."""
    low, high = limits
    width = 360.0 if abs(high - low) >= 360.0 else (high - low) % 360.0
    return (angle - low) % 360.0, width


def _outside(angle: Tensor, limits: tuple[float, ...], elevation: Tensor) -> Tensor:
    r"""Least rotation in degrees that brings an azimuth or theta to the nearer limit, negative
    within the range. An azimuth :math:`\delta` degrees beyond a limit is that of a direction
    :math:`d` from the limit's meridian, :math:`\sin d = \cos e \sin \delta`; beyond 90 degrees the
    nearest point is the pole. So for theta and the up axis, which :math:`e` tilts towards the
    camera."""
    beyond, width = _position(angle, limits)
    if width == 360.0:
        return torch.full_like(angle, -180.0)
    inside = beyond <= width
    delta = torch.where(
        inside, torch.minimum(beyond, width - beyond), torch.minimum(beyond - width, 360.0 - beyond)
    )
    e = torch.deg2rad(elevation)
    d = torch.deg2rad(delta.clamp(max=90.0))
    rotation = torch.rad2deg((e.cos() * d.sin()).clamp(max=1.0).asin())
    return torch.where(inside, -rotation, rotation)


def _moved_to_azimuth(R: Tensor, limits: tuple[float, ...]) -> Tensor:
    """(..., 3, 3) rotations whose camera moves on the shortest arc into a range of azimuths."""
    azimuth, elevation, _ = viewpoint_from_rotation(R)
    delta = torch.deg2rad(_clamped(azimuth, limits) - azimuth)
    e = torch.deg2rad(elevation)
    # Elevation of the nearest point of the limit's meridian; short of the pole, where the azimuth
    # is undefined.
    foot = torch.atan2(e.sin(), e.cos() * delta.cos().clamp(min=1e-6))
    camera = -R[..., 2, :]
    nearest = -rotation_from_viewpoint(_clamped(azimuth, limits), torch.rad2deg(foot))[..., 2, :]
    axis = torch.linalg.cross(camera, nearest)
    sine = torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    angle = torch.atan2(sine, (camera * nearest).sum(dim=-1, keepdim=True))
    return R @ rotation_from_axis_angle(axis / sine.clamp(min=1e-12) * angle).mT


def _clamped(angle: Tensor, limits: tuple[float, ...]) -> Tensor:
    """The nearest angle of a circular range."""
    beyond, width = _position(angle, limits)
    to_high = beyond - width <= 360.0 - beyond
    moved = torch.where(
        to_high, torch.full_like(angle, limits[0] + width), torch.full_like(angle, limits[0])
    )
    return torch.where(beyond <= width, angle, moved)
