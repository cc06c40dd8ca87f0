"""One photograph under work: what is known of it, and how its poses are found, fitted and
described."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError
from ..fitting.edges import EdgeCrops
from ..fitting.keypoints import KeypointMatches
from ..fitting.measured_fit import measure_contours
from ..utils.company import map_in_company
from ..utils.precision import exact_convolutions
from ..utils.threads import map_on_threads
from .described import DescribedPhotograph
from .inputs import ImageItem
from .poses import Poses, fit_poses
from .priors import Limits
from .result import FailedRegistration
from .target import Target, nearest_view


@dataclass(frozen=True, kw_only=True)
class Work(DescribedPhotograph):
    """A photograph under work.

    Attributes:
        item: what is known of it.
        limits: of its poses, if there are any.
        exact: whether the mesh is that of this very object.
        symmetries: (S, 4, 4) of the object, or None.
        starts: with several cameras if the camera is unknown.
    """

    item: ImageItem
    limits: Limits | None
    exact: bool
    symmetries: Tensor | None
    starts: Poses | None = None


def map_items(
    target: Target,
    items: Sequence[ImageItem | CurviregError],
    function: Callable[[ImageItem, int], Any],
) -> list[Any]:
    """Results of ``function(item, index)`` for all items, a :class:`FailedRegistration` for
    each error.

    On a CPU each photograph has a thread, in which torch uses no further ones: its result is
    the same to the bit, whatever else is registered. On other devices, what the photographs need
    is computed together. Items are read on demand, so that few photographs are in memory.
    """
    target.share()

    def run(index: int) -> Any:
        item = items[index]
        if not isinstance(item, ImageItem):
            return FailedRegistration(item)
        try:
            return function(item, index)
        except CurviregError as error:
            return FailedRegistration(error.with_subject("").of_image(index))

    if target.bank.device.type == "cpu":
        return map_on_threads(run, range(len(items)))
    with exact_convolutions():
        return map_in_company(run, range(len(items)))


def least_starts(target: Target) -> int:
    return max(target.pipeline.fit.least_hypotheses, target.pipeline.hypotheses)


def poses_of_views(target: Target, work: Work, view: Tensor, rank: Tensor) -> Poses:
    return poses_in_box(
        target,
        work,
        target.bank.rotations.cpu()[view].double(),
        target.bank.distances.cpu()[view],
        view,
        rank,
    )


def poses_in_box(target: Target, work: Work, *poses: Tensor) -> Poses:
    return Poses.in_box(target.describer, work.item.box, work.item.camera_matrix, *poses)


def keypoint_poses(target: Target, matches: KeypointMatches | None) -> tuple[Poses, Tensor]:
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
    poses = Poses.at(T, K.expand(len(T), 3, 3), target.describer.centre, none.long(), none.double())
    views = torch.tensor([nearest_view(target, R) for R in poses.rotation], dtype=torch.long)
    return replace(poses, view=views), torch.tensor([float(pose.count) for pose in found])


def fitted_poses(
    target: Target, work: Work, crops: EdgeCrops, starts: Poses, **options: Any
) -> Poses:
    """Fit the contours of ``starts``; one keeps its pose if the fit leaves the keypoints that
    agree with it."""
    settings = target.pipeline.fit
    poses = fit_poses(target.describer, crops, starts, settings=settings, **options)
    if work.keypoints is not None:
        before = work.keypoints.agreeing(starts.T, starts.cameras)
        after = work.keypoints.agreeing(poses.T, poses.cameras)
        is_left = (before >= settings.min_keypoints) & (after < settings.kept_keypoints * before)
        left = is_left.nonzero()[:, 0]
        if len(left):
            kept = starts[left]
            seen = measure_contours(
                target.describer.contours, crops, kept.cameras, kept.T, kept.crop_index
            )
            poses = poses.replaced(left, kept.with_fit(seen, target.describer.centre))
    return poses
