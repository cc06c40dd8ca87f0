"""Viewpoints around an object: grids of angles and near-uniform samplings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import as_numbers, check_integer, check_positive
from .viewpoint import rotation_from_viewpoint, up_rotation, viewpoint_from_rotation

DEFAULT_DISTANCE = 5.0
"""Distance of a view in units of the object's radius: ``docs/experiments.md`` compares others."""


@dataclass(frozen=True)
class ViewSphere:
    """N viewpoints in PASCAL3D+ angles.

    Attributes:
        azimuth, elevation, theta: (N,) degrees.
        distance: (N,) camera to object centre, in units of the object's radius (half the diagonal of its box).
    """

    azimuth: Tensor
    elevation: Tensor
    theta: Tensor
    distance: Tensor

    def __post_init__(self) -> None:
        shapes = {tuple(v.shape) for v in (self.azimuth, self.elevation, self.theta, self.distance)}
        if len(shapes) != 1 or self.azimuth.ndim != 1:
            raise InvalidInputError(f"ViewSphere: expected four tensors of one shape (N,), got shapes {sorted(shapes)}")
        if not bool((self.distance > 1).all()):
            raise InvalidInputError("ViewSphere: expected distances > 1 object radius (the camera outside the object)")

    def __len__(self) -> int:
        return self.azimuth.numel()

    def __getitem__(self, index: Tensor | slice) -> "ViewSphere":
        return ViewSphere(self.azimuth[index], self.elevation[index], self.theta[index], self.distance[index])

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera."""
        return rotation_from_viewpoint(self.azimuth, self.elevation, self.theta)

    def for_up(self, up: str) -> "ViewSphere":
        """Return the same views of an object whose axis ``up`` (:func:`up_rotation`) points up, in its own frame."""
        if up == "z":
            return self
        exact = rotation_from_viewpoint(self.azimuth.double(), self.elevation.double(), self.theta.double())
        azimuth, elevation, theta = viewpoint_from_rotation(exact @ up_rotation(up).to(exact.device))
        return ViewSphere(azimuth.to(self.azimuth), elevation.to(self.azimuth), theta.to(self.azimuth), self.distance)


def _numbers(values: Sequence[float], name: str, *, largest: float = math.inf) -> Tensor:
    """(N,) numbers, N >= 1, of at most ``largest`` from 0."""
    numbers = as_numbers(list(values) if isinstance(values, range) else values, name, dtype=torch.float64).flatten()
    if not len(numbers):
        raise InvalidInputError(f"{name}: expected at least one value, got none")
    if not bool((numbers.abs() <= largest).all()):
        raise InvalidInputError(f"{name}: expected degrees in [-90, 90], got {numbers.tolist()}")
    return numbers


def sample_views(
    *,
    azimuth_step: float = 10.0,
    elevations: Sequence[float] = (-10, 0, 10, 20, 30, 40, 50, 60),
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
    azimuths: Sequence[float] | None = None,
) -> ViewSphere:
    """Grid of viewpoints; by default of an upright object, seen from the side or from above.

    Args:
        azimuth_step: degrees; the circle is divided into ``round(360 / azimuth_step)`` equal parts.
        elevations, thetas: degrees.
        distances: in units of the object's radius, > 1.
        azimuths: degrees, instead of the full circle in steps.

    Returns:
        All combinations, distance fastest, then theta, azimuth, elevation. Duplicates at the poles stay.

    Raises:
        InvalidInputError: an empty range, a step that is not positive, or a distance <= 1.

    Example:
        >>> len(sample_views(azimuth_step=20, elevations=[0, 50], thetas=[-10, 0, 10]))
        108
    """
    check_positive(azimuth_step, "azimuth_step")
    if azimuths is None:
        count = max(1, round(360.0 / azimuth_step))
        azimuths = [360.0 * i / count for i in range(count)]
    ranges = {"azimuths": azimuths, "thetas": thetas, "distances": distances}
    axes = [_numbers(elevations, "elevations", largest=90.0), *(_numbers(v, name) for name, v in ranges.items())]
    elevation, azimuth, theta, distance = (v.flatten().float() for v in torch.meshgrid(*axes, indexing="ij"))
    return ViewSphere(azimuth, elevation, theta, distance)


def uniform_views(
    count: int,
    *,
    elevation_range: tuple[float, float] = (-90.0, 90.0),
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
) -> ViewSphere:
    """Near-uniform view directions on (a band of) the sphere, by the Fibonacci spiral.

    On the full sphere no direction is farther than ``157 / sqrt(count)`` degrees from the nearest view (measured for 2
    to 3000 directions). With thetas in steps of ``s`` degrees no rotation is farther than that + ``s / 2``.

    Args:
        count: number of view directions; each is combined with every theta and distance.
        elevation_range: (low, high) in degrees, within [-90, 90].
        thetas: in-plane rotations in degrees.
        distances: in units of the object's radius, > 1.

    Raises:
        InvalidInputError: count < 1, an empty range or one beyond [-90, 90], an empty option, or a distance <= 1.

    Example:
        >>> len(uniform_views(100, thetas=[0, 90, 180, 270]))
        400
    """
    check_integer(count, "count")
    limits = _numbers(elevation_range, "elevation_range", largest=90.0).tolist()
    low, high = math.sin(math.radians(limits[0])), math.sin(math.radians(limits[-1]))
    if len(limits) != 2 or not low <= high:
        raise InvalidInputError(f"elevation_range: expected (low, high), got {elevation_range}")
    i = torch.arange(count, dtype=torch.float64)
    elevation = torch.rad2deg(torch.asin(low + (high - low) * (i + 0.5) / count))
    azimuth = (i * 180.0 * (3.0 - math.sqrt(5.0))) % 360.0
    t, d = _numbers(thetas, "thetas"), _numbers(distances, "distances")
    repeats = t.numel() * d.numel()
    return ViewSphere(
        azimuth.repeat_interleave(repeats).float(),
        elevation.repeat_interleave(repeats).float(),
        t.repeat_interleave(d.numel()).repeat(count).float(),
        d.repeat(count * t.numel()).float(),
    )
