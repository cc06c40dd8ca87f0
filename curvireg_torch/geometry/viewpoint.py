"""PASCAL3D+ viewpoint angles, their rotations, the angle between two rotations, and samplings of
viewpoints.

The PASCAL3D+ camera looks from ``C = d (cos e sin a, -cos e cos a, sin e)`` at the model's origin,
with the model's +z up in the image, rotated by ``theta`` about the optical axis. With the image's y
flipped to OpenCV's that is

    R = diag(1, -1, -1) Rz(theta) Rx(e - 90 deg) Rz(-a),    x_cam = R x_model + t,    t = (0, 0, d).

Other shapes and dtypes, and matrices that are no rotations, raise :class:`InvalidInputError`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import (
    check_integer,
    check_numbers,
    check_option,
    check_positive,
    check_rotation,
)
from ..utils.choices import UP_AXES
from ..utils.rows import Rows
from .conversions import matrix_of_rows


def rotation_from_viewpoint(
    azimuth: Tensor | float, elevation: Tensor | float, theta: Tensor | float = 0.0
) -> Tensor:
    """(..., 3, 3) rotations model -> OpenCV camera of PASCAL3D+ viewpoints; the module states the
    equation.

    Args:
        azimuth, elevation, theta: degrees, numbers or tensors of broadcastable shapes (...); of
            numbers alone the result is float64.

    Example:
        >>> R = rotation_from_viewpoint(0.0, 0.0, 0.0)      # camera on the -y axis, model's z up
        >>> [round(v) for v in R[:, 2].tolist()]
        [0, -1, 0]
    """
    angles = azimuth, elevation, theta
    given = [v for v in angles if isinstance(v, Tensor)]
    # plain numbers take the type of the tensors; alone they are float64, as poses are
    device = given[0].device if given else None
    kinds = [v.dtype if v.is_floating_point() else torch.get_default_dtype() for v in given]
    dtype = reduce(torch.promote_types, kinds) if kinds else torch.float64
    tensors = [torch.as_tensor(v, dtype=dtype, device=device) for v in angles]
    a, e, t = (torch.deg2rad(v) for v in torch.broadcast_tensors(*tensors))
    ca = a.cos()
    sa = a.sin()
    ce = e.cos()
    se = e.sin()
    ct = t.cos()
    st = t.sin()
    # Rows of Rz(theta) Rx(e - 90) Rz(-a), rows two and three negated.
    rows = [
        [ct * ca - st * se * -sa, ct * sa - st * se * ca, -st * ce],
        [-(st * ca + ct * se * -sa), -(st * sa + ct * se * ca), -ct * ce],
        [-ce * sa, ce * ca, -se],
    ]
    return matrix_of_rows(rows)


def viewpoint_from_rotation(R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse of :func:`rotation_from_viewpoint` for (..., 3, 3) rotations.

    Returns:
        azimuth in [0, 360), elevation in [-90, 90], theta in [-180, 180), degrees, each of shape
        (...). At the poles (elevation +-90) theta is 0; close to one, rounding decides the azimuth,
        and theta matches it. :func:`rotation_from_viewpoint` gives R back everywhere, within 5e-5
        rad in float32.

    Example:
        >>> a, e, t = viewpoint_from_rotation(rotation_from_viewpoint(30.0, 20.0, -10.0))
        >>> round(float(a)), round(float(e)), round(float(t))
        (30, 20, -10)
    """
    check_rotation(R, "R")
    # The direction to the camera's centre is -R[2].
    cx = -R[..., 2, 0]
    cy = -R[..., 2, 1]
    cz = -R[..., 2, 2]
    planar = torch.hypot(cx, cy)
    elevation = torch.atan2(cz, planar)
    pole = planar < 4 * torch.finfo(R.dtype).eps
    # At the pole R[0] = (cos(a -+ theta), sin(a -+ theta), 0).
    a = torch.atan2(torch.where(pole, R[..., 0, 1], cx), torch.where(pole, R[..., 0, 0], -cy))
    # The first column of R Rz(a), (cos theta, -sin theta, 0), gives the theta that belongs to this
    # azimuth.
    ca = a.cos()
    sa = a.sin()
    theta = torch.atan2(
        -(R[..., 1, 0] * ca + R[..., 1, 1] * sa), R[..., 0, 0] * ca + R[..., 0, 1] * sa
    )
    theta = torch.where(pole, torch.zeros_like(theta), theta)
    azimuth = torch.rad2deg(a) % 360.0
    theta = (torch.rad2deg(theta) + 180.0) % 360.0 - 180.0
    # x % 360 may round up to 360 itself for a tiny negative x.
    return (
        torch.where(azimuth >= 360.0, torch.zeros_like(azimuth), azimuth),
        torch.rad2deg(elevation),
        theta,
    )


def up_rotation(up: str) -> Tensor:
    """(3, 3) float64 rotation from a frame whose axis ``up`` ("x" to "-z") points up to one whose z
    axis does. glTF's front, +z under y up, becomes -y, PASCAL3D+'s at azimuth 0.

    Example:
        >>> (up_rotation("y") @ torch.tensor([0.0, 1.0, 0.0]).double()).tolist()
        [0.0, 0.0, 1.0]
    """
    check_option(up, UP_AXES, "up")
    return torch.tensor(UP_AXES[up], dtype=torch.float64)


def rotation_error(R1: Tensor, R2: Tensor) -> Tensor:
    """(...) geodesic distances of rotations (..., 3, 3), ``acos((tr(R1^T R2) - 1) / 2)`` in degrees
    in [0, 180].

    Computed as ``2 asin(|R1 - R2|_F / (2 sqrt 2))``, which is accurate near 0; NaN for a missing
    estimate (NaN).

    Example:
        >>> round(float(rotation_error(rotation_from_viewpoint(0.0, 0.0),
        ...     rotation_from_viewpoint(30.0, 0.0))), 3)
        30.0
    """
    check_rotation(R1, "R1")
    check_rotation(R2, "R2")
    chord = torch.linalg.matrix_norm(R1 - R2) / (2.0 * math.sqrt(2.0))
    return torch.rad2deg(2.0 * torch.asin(chord.clamp(max=1.0)))


def angles_between(R: Tensor, others: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """(M, N) degrees between all of two lists of rotations, up to symmetries.

    One matrix product for many pairs. Unlike those of :func:`rotation_error`, angles near 0 are
    only right within about 0.03 degrees in float32.

    Args:
        R, others: (M, 3, 3) and (N, 3, 3).
        symmetries: (S, 3, 3) or (S, 4, 4) of the model, the identity among them; None: none.

    Example:
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
        >>> group = torch.stack([torch.eye(3), half_turn])
        >>> angles_between(torch.eye(3)[None], half_turn[None]).tolist()
        [[180.0]]
        >>> angles_between(torch.eye(3)[None], half_turn[None], group).tolist()
        [[0.0]]
    """
    equivalent = R[:, None] if symmetries is None else R[:, None] @ symmetries[:, :3, :3].to(R)
    traces = (equivalent.flatten(2) @ others.flatten(1).T).amax(dim=1)
    return torch.rad2deg((0.5 * (traces - 1.0)).clamp(-1.0, 1.0).acos())


# of a view in units of the object's radius: docs/experiments.md compares others
DEFAULT_DISTANCE = 5.0


@dataclass(frozen=True)
class ViewSphere(Rows):
    """N viewpoints in PASCAL3D+ angles.

    Attributes:
        azimuth, elevation, theta: (N,) degrees.
        distance: (N,) camera to object centre, in units of the object's radius (half the diagonal
            of its box).

    Example:
        >>> views = sample_views(azimuth_step=90, elevations=[0, 30])
        >>> len(views), views[:2].azimuth.tolist()
        (8, [0.0, 90.0])
    """

    azimuth: Tensor
    elevation: Tensor
    theta: Tensor
    distance: Tensor

    def __post_init__(self) -> None:
        shapes = {tuple(v.shape) for v in (self.azimuth, self.elevation, self.theta, self.distance)}
        if len(shapes) != 1 or self.azimuth.ndim != 1:
            raise InvalidInputError(
                f"ViewSphere: expected four tensors of one shape (N,), got shapes {sorted(shapes)}"
            )
        if not bool((self.distance > 1).all()):
            raise InvalidInputError(
                "ViewSphere: expected distances > 1 object radius (the camera outside the object)"
            )

    @cached_property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera."""
        return rotation_from_viewpoint(self.azimuth, self.elevation, self.theta)

    def for_up(self, up: str) -> "ViewSphere":
        """Return the same views of an object whose axis ``up`` (:func:`up_rotation`) points up, in
        its own frame."""
        return self if up == "z" else self.in_frame(up_rotation(up))

    def in_frame(self, rotation: Tensor) -> "ViewSphere":
        """Return the same views in the frame that ``rotation`` (3, 3) turns into the frame of
        these."""
        exact = rotation_from_viewpoint(
            self.azimuth.double(), self.elevation.double(), self.theta.double()
        )
        azimuth, elevation, theta = viewpoint_from_rotation(exact @ rotation.to(exact))
        return ViewSphere(
            azimuth.to(self.azimuth),
            elevation.to(self.azimuth),
            theta.to(self.azimuth),
            self.distance,
        )


def sample_views(
    *,
    azimuth_step: float = 10.0,
    elevations: Sequence[float] = (-10, 0, 10, 20, 30, 40, 50, 60),
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
) -> ViewSphere:
    """Grid of viewpoints; by default of an upright object, seen from the side or from above.

    Args:
        azimuth_step: degrees; the circle is divided into ``round(360 / azimuth_step)`` equal parts.
        elevations, thetas: degrees.
        distances: in units of the object's radius, > 1.

    Returns:
        All combinations, distance fastest, then theta, azimuth, elevation. Duplicates at the poles
        stay.

    Example:
        >>> len(sample_views(azimuth_step=20, elevations=[0, 50], thetas=[-10, 0, 10]))
        108
    """
    count = max(1, round(360.0 / check_positive(azimuth_step, "azimuth_step")))
    heights = check_numbers(elevations, "elevations")
    if float(heights.abs().max()) > 90.0:
        raise InvalidInputError(
            f"elevations: expected degrees in [-90, 90], got {heights.tolist()}"
        )
    azimuths = torch.arange(count, dtype=torch.float64) * 360.0 / count
    axes = [
        heights,
        azimuths,
        check_numbers(thetas, "thetas"),
        check_numbers(distances, "distances"),
    ]
    elevation, azimuth, theta, distance = (
        v.flatten().float() for v in torch.meshgrid(*axes, indexing="ij")
    )
    return ViewSphere(azimuth, elevation, theta, distance)


# m, of the object: the paper's distances are metric, its objects are not described
PAPER_RADIUS = 0.2


def paper_views() -> ViewSphere:
    """The paper's grid: azimuth in steps of 20 degrees, elevation of 50 degrees, distance of 0.3 m
    up to 2 m, for an object with a radius of 0.2 m.

    The paper says "around 700" views. Its steps give that number where elevation runs on over the
    poles, around the whole circle (0, 50, ..., 300 degrees): 18 x 7 x 6 = 756. Past a pole the
    camera is upside down. An orthographic camera, as the paper's, does not see the distance: there,
    126 of these views differ.

    Example:
        >>> len(paper_views())
        756
    """
    distances = [0.3 * i / PAPER_RADIUS for i in range(1, 7)]
    grids = []
    for turn in range(0, 350, 50):
        # Past the pole the camera stands on the other side, upside down.
        shift = 180.0 if 90 < turn < 270 else 0.0
        elevation = math.degrees(math.asin(math.sin(math.radians(turn))))
        grid = sample_views(azimuth_step=20.0, elevations=[elevation], distances=distances)
        azimuth = (grid.azimuth + shift) % 360.0
        grids.append(ViewSphere(azimuth, grid.elevation, grid.theta - shift, grid.distance))
    return ViewSphere.cat(grids)


def uniform_views(
    count: int,
    *,
    thetas: Sequence[float] = (0.0,),
    distances: Sequence[float] = (DEFAULT_DISTANCE,),
) -> ViewSphere:
    """``count`` near-uniform view directions on the sphere, by the Fibonacci spiral, each with
    every theta and distance as in :func:`sample_views`. No direction is farther than
    ``157 / sqrt(count)`` degrees from the nearest view (measured for 2 to 3000 directions).

    Example:
        >>> len(uniform_views(100, thetas=[0, 90, 180, 270]))
        400
    """
    check_integer(count, "count")
    axes = (
        torch.arange(count).double(),
        check_numbers(thetas, "thetas"),
        check_numbers(distances, "distances"),
    )
    i, theta, distance = (v.flatten() for v in torch.meshgrid(*axes, indexing="ij"))
    elevation = torch.rad2deg(torch.asin(-1.0 + 2.0 * (i + 0.5) / count))
    azimuth = (i * 180.0 * (3.0 - math.sqrt(5.0))) % 360.0
    return ViewSphere(azimuth.float(), elevation.float(), theta.float(), distance.float())
