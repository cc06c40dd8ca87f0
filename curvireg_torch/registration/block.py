"""A block: photographs under work together, and how their poses are placed, limited and fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..fitting.devices import on_device
from ..fitting.edges import EdgeCrops
from ..fitting.keypoints import KeypointMatches
from ..fitting.measured_fit import measure_contours
from .described import Described, agreeing_keypoints
from .hypotheses import Hypotheses, fit_poses
from .inputs import ImageItem
from .priors import Limits
from .target import Target, nearest_view


@dataclass(frozen=True, kw_only=True)
class Block(Described):
    """P photographs under work.

    Attributes:
        photographs: what is known of each.
        limits: of the poses in each, if there are any.
        exact: whether the mesh is that of this very object.
        symmetries: (S, 4, 4) of the object, or None.
        tried_cameras: (P,) bool, photographs whose camera is unknown: their starts have several.
    """

    photographs: Sequence[ImageItem]
    limits: Sequence[Limits | None]
    exact: bool
    symmetries: Tensor | None
    tried_cameras: Tensor

    def __len__(self) -> int:
        return len(self.photographs)

    @property
    def boxes(self) -> Tensor:
        """(P, 4) float64."""
        return torch.stack([photograph.box for photograph in self.photographs]).double()

    @property
    def cameras(self) -> Tensor:
        """(P, 3, 3) float64 camera matrices, NaN where they are unknown."""
        unknown = torch.full((3, 3), torch.nan, dtype=torch.float64)
        given = [photograph.camera_matrix for photograph in self.photographs]
        return torch.stack([unknown if K is None else K.double() for K in given])

    def with_photographs(self, changed: dict[int, ImageItem]) -> "Block":
        """The block with other photographs in some places."""
        photographs = [changed.get(p, one) for p, one in enumerate(self.photographs)]
        return replace(self, photographs=photographs)

    def moved_inside(self, poses: Hypotheses) -> Hypotheses:
        """Poses, moved into the limits of their photographs."""
        for p, limits in enumerate(self.limits):
            if limits is not None and len(rows := poses.of(p)):
                poses = poses.replaced(rows, limits.moved_inside(poses[rows]))
        return poses

    def keeps(self, poses: Hypotheses) -> Tensor:
        """(N,) bool: whether poses leave the limits of their photographs by no more than the
        tolerances."""
        kept = torch.ones(len(poses), dtype=torch.bool)
        for p, limits in enumerate(self.limits):
            if limits is not None and len(rows := poses.of(p)):
                kept[rows] = limits.keeps(poses[rows])
        return kept


def least_starts(target: Target) -> int:
    return max(target.pipeline.fit.least_hypotheses, target.pipeline.hypotheses)


def poses_of_views(
    target: Target,
    block: Block,
    view: Tensor,
    rank: Tensor,
    photograph: Tensor,
    boxes: Tensor | None = None,
) -> Hypotheses:
    """Views (N,) of the bank put into the boxes of their photographs (N,), or into other ``boxes``
    (N, 4) of these."""
    rotation = target.bank.rotations.cpu()[view].double()
    distance = target.bank.distances.cpu()[view]
    return Hypotheses.in_boxes(
        target.describer,
        block.boxes[photograph] if boxes is None else boxes,
        block.cameras[photograph],
        rotation,
        distance,
        view,
        rank,
        photograph,
    )


def keypoint_poses(target: Target, matches: KeypointMatches | None) -> tuple[Hypotheses, Tensor]:
    """Poses on which keypoints agree, as promising as the best view, and how many, the largest
    number first.

    :meta private:
    """
    found = [] if matches is None else matches.poses()
    T = (
        torch.stack([pose.T for pose in found])
        if found
        else torch.zeros(0, 4, 4, dtype=torch.float64)
    )
    K = torch.eye(3, dtype=torch.float64) if matches is None else torch.from_numpy(matches.K)
    none = torch.zeros(len(T))
    cameras = K.expand(len(T), 3, 3)
    poses = Hypotheses.at(T, cameras, target.describer.centre, none.long(), none.double())
    views = torch.tensor([nearest_view(target, R) for R in poses.rotation], dtype=torch.long)
    return replace(poses, view=views), torch.tensor([float(pose.count) for pose in found])


def fitted_poses(
    target: Target, block: Block, crops: EdgeCrops, starts: Hypotheses, **options: Any
) -> Hypotheses:
    """Fit the contours of ``starts``; one keeps its pose if the fit leaves the keypoints that
    agree with it."""
    settings = target.pipeline.fit
    poses = fit_poses(target.describer, crops, starts, settings=settings, **options)
    if all(keypoints is None for keypoints in block.keypoints):
        return poses
    before = agreeing_keypoints(block, starts)
    after = agreeing_keypoints(block, poses)
    is_left = (before >= settings.min_keypoints) & (after < settings.kept_keypoints * before)
    left = is_left.nonzero()[:, 0]
    if not len(left):
        return poses
    kept = starts[left]
    given = kept.cameras, kept.T, kept.photograph
    seen = on_device(measure_contours, target.describer.device_contours, crops, *given)
    return poses.replaced(left, kept.with_fit(seen, target.describer.centre))
