"""Viewpoints around an object: grids of angles and near-uniform samplings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .._checks import check_positive
from ..errors import InvalidInputError
from .viewpoint import rotation_from_viewpoint

__all__ = ["DEFAULT_DISTANCE", "ViewSphere", "sample_views", "uniform_views"]

DEFAULT_DISTANCE = 5.0
"""Distance of a view in units of the object's radius; a 35 mm photograph of an object that fills half of it."""


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


def sample_views(
    *,
    azimuth_step: float = 10.0,
    elevations: Sequence[float] = (-20, -10, 0, 10, 20, 30, 40, 50, 60, 70, 80),
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
    azimuths: Sequence[float] | None = None,
) -> ViewSphere:
    """Grid of viewpoints; the default suits an object that stands upright and is not seen from below.

    Args:
        azimuth_step: degrees; the circle is divided into round(360 / step) equal parts.
        elevations, thetas: degrees.
        distances: in units of the object's radius, > 1.
        azimuths: degrees, instead of the full circle in steps.

    Returns:
        All combinations, distance fastest, then theta, azimuth, elevation. At the poles, where azimuth and theta
        turn about the same axis, nothing is left out.

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
    for name, values in (
        ("azimuths", azimuths),
        ("elevations", elevations),
        ("thetas", thetas),
        ("distances", distances),
    ):
        if len(values) == 0:
            raise InvalidInputError(f"{name}: expected at least one value, got none")
    axes = [torch.tensor([float(v) for v in values]) for values in (elevations, azimuths, thetas, distances)]
    if bool((axes[0].abs() > 90).any()):
        raise InvalidInputError("elevations: expected degrees in [-90, 90]")
    elevation, azimuth, theta, distance = (v.flatten() for v in torch.meshgrid(*axes, indexing="ij"))
    return ViewSphere(azimuth, elevation, theta, distance)


def uniform_views(
    count: int,
    *,
    elevation_range: tuple[float, float] = (-90.0, 90.0),
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
) -> ViewSphere:
    """Near-uniform view directions on (a band of) the sphere, by the Fibonacci spiral.

    ``count`` directions on the full sphere leave no direction farther than about ``170 / sqrt(count)`` degrees from
    its nearest (6.4 degrees for 700).

    Args:
        count: view directions; each comes with every theta and distance.
        elevation_range: degrees.
        thetas: degrees in the image plane.
        distances: in units of the object's radius, > 1.

    Example:
        >>> len(uniform_views(100, thetas=[0, 90, 180, 270]))
        400
    """
    if count < 1:
        raise InvalidInputError(f"count: expected >= 1, got {count}")
    low, high = (math.sin(math.radians(e)) for e in elevation_range)
    if not low <= high:
        raise InvalidInputError(f"elevation_range: expected (low, high), got {elevation_range}")
    i = torch.arange(count, dtype=torch.float64)
    elevation = torch.rad2deg(torch.asin(low + (high - low) * (i + 0.5) / count))
    azimuth = (i * 180.0 * (3.0 - math.sqrt(5.0))) % 360.0
    t, d = (torch.tensor([float(v) for v in values], dtype=torch.float64) for values in (thetas, distances))
    if t.numel() == 0 or d.numel() == 0:
        raise InvalidInputError("thetas, distances: expected at least one value each")
    repeats = t.numel() * d.numel()
    return ViewSphere(
        azimuth.repeat_interleave(repeats).float(),
        elevation.repeat_interleave(repeats).float(),
        t.repeat_interleave(d.numel()).repeat(count).float(),
        d.repeat(count * t.numel()).float(),
    )
