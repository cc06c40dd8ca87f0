"""Settings of views, banks and localization as plain frozen values."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .errors import InvalidInputError
from .geometry import ViewSphere, sample_views, uniform_views
from .geometry.views import DEFAULT_DISTANCE
from .utils.checks import check_option, check_positive
from .utils.registry import Registry

__all__ = ["DEPTH_FIELDS", "BankSettings", "LocateSettings", "ViewPolicy"]

DEPTH_FIELDS: Registry[Callable[..., Any]] = Registry(
    "depth_field",
    {
        "CS": "curvireg_torch.filters:DepthCurvilinearSaliency",
        "ASG": "curvireg_torch.filters:AverageShadingGradient",
        "HFN": "curvireg_torch.filters:HessianFrobeniusNorm",
        "AR": "curvireg_torch.filters:ApparentRidges",
    },
)
"""Depth filters by the paper's names: modules (N, 1, S, S) -> (N, 2, S, S) that are built without arguments."""


@dataclass(frozen=True)
class ViewPolicy:
    """Which viewpoints a bank contains.

    Attributes:
        pose: "any": nothing is known. "upright": the object stands upright and is not seen from far below. "given": the
            views were passed by the caller.
        directions, theta_step: of "any": number of viewing directions on the sphere, and degrees between in-plane
            rotations.
        azimuth_step, elevations: of "upright", degrees.
        distance: of the camera from the object's centre, in object radii.

    Example:
        >>> len(ViewPolicy().sphere()), len(ViewPolicy(pose="upright").sphere())
        (7200, 288)
    """

    pose: str = "any"
    directions: int = 300
    theta_step: float = 15.0
    azimuth_step: float = 10.0
    elevations: tuple[float, ...] = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    distance: float = DEFAULT_DISTANCE

    def __post_init__(self) -> None:
        check_option(self.pose, ("any", "upright", "given"), "pose")
        check_positive(self.theta_step, "theta_step")
        object.__setattr__(self, "elevations", tuple(float(e) for e in self.elevations))

    def key_fields(self) -> dict[str, Any]:
        """The attributes that decide the viewpoints; the others belong to another ``pose``."""
        names = {"any": ("directions", "theta_step", "distance"), "upright": ("azimuth_step", "elevations", "distance")}
        return {name: getattr(self, name) for name in ("pose", *names.get(self.pose, ()))}

    def sphere(self, up: str = "z") -> ViewSphere:
        """The viewpoints; ``up`` is the axis of the mesh that points up, for "upright"."""
        if self.pose == "given":
            raise InvalidInputError("views: the views of this pipeline were passed by the caller; pass them again")
        if self.pose == "upright":
            grid = sample_views(azimuth_step=self.azimuth_step, elevations=self.elevations, distances=[self.distance])
            return grid.for_up(up)
        count = max(1, round(360.0 / self.theta_step))
        thetas = [360.0 * i / count for i in range(count)]
        return uniform_views(self.directions, thetas=thetas, distances=[self.distance])


@dataclass(frozen=True)
class BankSettings:
    """How views are rendered and described. Photographs are cropped and described in the same way.

    Attributes:
        image_size: side of views and crops in px.
        camera: "perspective" or "orthographic".
        margin: space around the object's box, as a fraction of its longer side.
        depth_field: name in :data:`DEPTH_FIELDS`. "CS" is :func:`depth_curvilinear_saliency` with ``sigma`` and
            ``formula``; the others, with which the paper compares it, use their defaults.
        grid, bins, block, clip: of :func:`hog`.
        point_fraction: of :func:`field_points`.
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
        check_option(self.camera, ("perspective", "orthographic"), "camera")
        DEPTH_FIELDS.check(self.depth_field)
        check_positive(self.margin, "margin", zero_ok=True)
        if self.image_size < self.grid:
            raise InvalidInputError(f"image_size: expected at least grid = {self.grid}, got {self.image_size}")
        check_option(self.formula, ("geometric", "paper"), "formula")
        check_positive(self.sigma, "sigma", zero_ok=True)
        if not 1 <= self.block <= self.grid or self.bins < 1 or not 0.0 < self.clip <= 1.0:
            raise InvalidInputError(f"hog: expected 1 <= block <= grid, bins >= 1 and clip in (0, 1], got {self}")


@dataclass(frozen=True)
class LocateSettings:
    """How an object without a box is searched for, see :class:`curvireg_torch.registration.locator.Locator`.

    Attributes:
        views: of each model, that represent all of its views.
        min_size: longer side of the smallest object that is searched for, as a fraction of the photograph's.
        proposals: boxes that are proposed.
        candidates: the best proposals, which are ranked against all views; the most confident one is registered.
    """

    views: int = 96
    min_size: float = 0.08
    proposals: int = 20
    candidates: int = 5

    def __post_init__(self) -> None:
        if min(self.views, self.proposals, self.candidates) < 1:
            raise InvalidInputError(f"locate: expected views, proposals and candidates >= 1, got {self}")
        if not 0.02 <= self.min_size <= 1.0:
            raise InvalidInputError(f"locate: min_size: expected a fraction in [0.02, 1], got {self.min_size}")
