"""Viewpoints around an object: grids of angles and near-uniform samplings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_positive, check_tensor
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

    def within(
        self,
        *,
        azimuth: tuple[float, float] = (0.0, 360.0),
        elevation: tuple[float, float] = (-90.0, 90.0),
        theta: tuple[float, float] = (-180.0, 180.0),
    ) -> "ViewSphere":
        """The views inside a range of viewpoints, borders included; :class:`InvalidInputError` if there is none.

        Args:
            azimuth, theta: (from, to) in degrees, upwards modulo 360: (350, 10) are the 20 degrees around 0.
            elevation: (low, high) in degrees.

        Example:
            >>> len(uniform_views(100).within(elevation=(0, 90)))
            50
        """
        inside = _in_arc(self.azimuth, *azimuth) & _in_arc(self.theta, *theta)
        inside &= (self.elevation >= elevation[0]) & (self.elevation <= elevation[1])
        if not bool(inside.any()):
            raise InvalidInputError(
                f"ViewSphere.within: none of {len(self)} views has azimuth in {azimuth}, elevation in {elevation} and "
                f"theta in {theta}; widen the range or sample more finely"
            )
        return self[inside]

    def for_up(self, up: str) -> "ViewSphere":
        """The same views of an object whose axis ``up`` (:func:`up_rotation`) points up, in its own frame."""
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = up_rotation(up)
        return self if up == "z" else self.in_model_frame(T)

    def in_model_frame(self, T_views_from_model: Tensor) -> "ViewSphere":
        """Views of another frame of the model, expressed in the model's frame.

        With :func:`curvireg_torch.mesh.normalization_transform`, a (4, 4) similarity, views follow the principal
        axes of an object while poses stay in the frame of the file.
        """
        check_tensor(T_views_from_model, "T_views_from_model", (4, 4))
        linear = T_views_from_model[:3, :3].double()
        scale = torch.linalg.det(linear)
        R = linear / scale.abs() ** (1 / 3)
        if not (scale > 0 and torch.allclose(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-5)):
            raise InvalidInputError("T_views_from_model: expected a rotation, a scale > 0 and a translation")
        exact = rotation_from_viewpoint(self.azimuth.double(), self.elevation.double(), self.theta.double())
        azimuth, elevation, theta = viewpoint_from_rotation(exact @ R.to(exact.device))
        return ViewSphere(azimuth.to(self.azimuth), elevation.to(self.azimuth), theta.to(self.azimuth), self.distance)


def _in_arc(angle: Tensor, start: float, stop: float) -> Tensor:
    """Whether angles are between ``start`` and ``stop``, upwards modulo 360 degrees."""
    if stop - start >= 360.0:
        return torch.ones_like(angle, dtype=torch.bool)
    # A tolerance keeps rounding from dropping the borders.
    return (angle - start + 1e-3) % 360.0 <= (stop - start) % 360.0 + 2e-3


def _check_elevations(values: Sequence[float], name: str) -> None:
    if not all(-90.0 <= float(v) <= 90.0 for v in values):
        raise InvalidInputError(f"{name}: expected degrees in [-90, 90], got {tuple(values)}")


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
    ranges = {"elevations": elevations, "azimuths": azimuths, "thetas": thetas, "distances": distances}
    for name, values in ranges.items():
        if len(values) == 0:
            raise InvalidInputError(f"{name}: expected at least one value, got none")
    axes = [torch.tensor([float(v) for v in values]) for values in ranges.values()]
    _check_elevations(elevations, "elevations")
    elevation, azimuth, theta, distance = (v.flatten() for v in torch.meshgrid(*axes, indexing="ij"))
    return ViewSphere(azimuth, elevation, theta, distance)


def paper_views(*, object_radius: float = 0.2) -> ViewSphere:
    """The paper's grid: azimuth in steps of 20 degrees, elevation of 50 degrees, distance of 0.3 m up to 2 m.

    The paper states "around 700" views; its steps give 18 x 7 x 6 = 756 if elevation covers the whole circle (0, 50,
    ..., 300 degrees). For the paper's orthographic camera the distance does not matter, and 126 of the views differ.

    Args:
        object_radius: in m, because the paper's distances are metric; below 0.3, the distance of the nearest camera.
    """
    check_positive(object_radius, "object_radius")
    if object_radius >= 0.3:
        raise InvalidInputError(f"object_radius: expected < 0.3 m, the paper's nearest camera, got {object_radius}")
    distances = [0.3 * i / object_radius for i in range(1, 7)]
    grids = []
    for angle in range(0, 350, 50):
        elevation = math.degrees(math.asin(math.sin(math.radians(angle))))
        grid = sample_views(azimuth_step=20.0, elevations=[elevation], distances=distances)
        # Past the pole the camera is on the other side, upside down.
        half = 180.0 if 90 < angle < 270 else 0.0
        grids.append(ViewSphere((grid.azimuth + half) % 360.0, grid.elevation, grid.theta - half, grid.distance))
    return ViewSphere(*(torch.cat([getattr(grid, f.name) for grid in grids]) for f in fields(ViewSphere)))


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
    if count < 1:
        raise InvalidInputError(f"count: expected >= 1, got {count}")
    _check_elevations(elevation_range, "elevation_range")
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
