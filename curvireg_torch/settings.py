"""Settings of views, banks and localization as plain frozen values."""

from dataclasses import dataclass
from typing import Any

from .errors import InvalidInputError
from .geometry import ViewSphere, sample_views, uniform_views
from .geometry.views import DEFAULT_DISTANCE
from .utils.checks import check_option, check_positive

__all__ = ["BankSettings", "LocateSettings", "ViewPolicy"]

CAMERAS = ("perspective", "orthographic")
POSES = ("any", "upright", "given")


DEPTH_FIELDS = ("CS", "ASG", "HFN", "AR")
"""Depth filters, by the paper's names; :mod:`curvireg_torch.matching.fields` builds them."""

FORMULAS = ("geometric", "paper")


@dataclass(frozen=True)
class ViewPolicy:
    """Which viewpoints a bank shows.

    Attributes:
        pose: "any": nothing is known. "upright": the object stands upright and is not seen from far below. "given": the
            views came with the call.
        directions, turn: of "any": directions spread over the sphere, and degrees between turns in the image plane.
        azimuth_step, elevations: of "upright", degrees.
        distance: of the camera from the object's centre, in units of the object's radius.

    Example:
        >>> len(ViewPolicy().sphere()), len(ViewPolicy(pose="upright").sphere())
        (7200, 288)
    """

    pose: str = "any"
    directions: int = 300
    turn: float = 15.0
    azimuth_step: float = 10.0
    elevations: tuple[float, ...] = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    distance: float = DEFAULT_DISTANCE

    def __post_init__(self) -> None:
        check_option(self.pose, POSES, "pose")
        check_positive(self.turn, "turn")
        object.__setattr__(self, "elevations", tuple(float(e) for e in self.elevations))

    def decisive(self) -> dict[str, Any]:
        """The attributes that decide the viewpoints; the others belong to another ``pose``."""
        names = {"any": ("directions", "turn", "distance"), "upright": ("azimuth_step", "elevations", "distance")}
        return {name: getattr(self, name) for name in ("pose", *names.get(self.pose, ()))}

    def sphere(self, up: str = "z") -> ViewSphere:
        """The viewpoints.

        Args:
            up: the mesh's axis that points up when it stands, for "upright" (:func:`curvireg_torch.io.meshes.mesh_up`).

        Raises:
            InvalidInputError: they were given with the call and cannot be made again.
        """
        if self.pose == "given":
            raise InvalidInputError("views: this pipeline's views came with the call; give them again")
        if self.pose == "upright":
            grid = sample_views(azimuth_step=self.azimuth_step, elevations=self.elevations, distances=[self.distance])
            return grid.for_up(up)
        count = max(1, round(360.0 / self.turn))
        turns = [360.0 * i / count for i in range(count)]
        return uniform_views(self.directions, thetas=turns, distances=[self.distance])


@dataclass(frozen=True)
class BankSettings:
    """How views are rendered and described. Photographs are cropped and described the same way.

    Attributes:
        image_size: side of views and crops in px.
        camera: "perspective" or "orthographic".
        margin: room around the object's box, as a share of its longer side.
        depth_field: "CS": :func:`depth_curvilinear_saliency` with ``sigma`` and ``formula``; "ASG", "HFN", "AR": the
            filters that the paper compares it with, as they are.
        grid, bins, block, clip: of :func:`hog`.
        point_share: of :func:`field_points`.
    """

    image_size: int = 128
    camera: str = "perspective"
    margin: float = 0.1
    depth_field: str = "CS"
    sigma: float = 0.8
    formula: str = "geometric"
    grid: int = 8
    bins: int = 9
    block: int = 2
    clip: float = 0.2
    point_fraction: float = 0.04

    def __post_init__(self) -> None:
        check_option(self.camera, CAMERAS, "camera")
        check_option(self.depth_field, DEPTH_FIELDS, "depth_field")
        check_positive(self.margin, "margin", zero_ok=True)
        if self.image_size < self.grid:
            raise InvalidInputError(f"image_size: expected at least grid = {self.grid}, got {self.image_size}")
        check_option(self.formula, FORMULAS, "formula")
        check_positive(self.sigma, "sigma", zero_ok=True)
        if not 1 <= self.block <= self.grid or self.bins < 1 or not 0.0 < self.clip <= 1.0:
            raise InvalidInputError(f"hog: expected 1 <= block <= grid, bins >= 1 and clip in (0, 1], got {self}")


@dataclass(frozen=True)
class LocateSettings:
    """How an object without a box is looked for, see :class:`curvireg_torch.registration.localization.Locator`.

    Attributes:
        views: of each model, that stand for all of its views.
        smallest: longer side of the smallest object that is looked for, as a share of the photograph's.
        proposals: boxes that are proposed.
        followed: the best of them, which are ranked against all views; the surest is registered.
    """

    views: int = 96
    smallest: float = 0.08
    proposals: int = 20
    followed: int = 5

    def __post_init__(self) -> None:
        if min(self.views, self.proposals, self.followed) < 1:
            raise InvalidInputError(f"locate: expected views, proposals and followed >= 1, got {self}")
        if not 0.02 <= self.smallest <= 1.0:
            raise InvalidInputError(f"locate: smallest: expected a share in [0.02, 1], got {self.smallest}")
