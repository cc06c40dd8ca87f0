"""The best pose and its close rivals, fitted once more and compared in detail."""

import torch
from torch import Tensor

from ..fitting.edges import EdgeCrops
from .poses import CLOSE_RIVALS, Poses, close_rivals, distinct_poses, pose_scores, with_details
from .target import Target
from .work import Work, features_of, fitted_poses, with_replaced


def best_inside(features: Tensor, outside: Tensor) -> Tensor:
    """(1,) index of the best pose that is not ``outside`` the limits (H,)."""
    return pose_scores(features, exact=True).masked_fill(outside, -torch.inf).argmax()[None]


def fitted_again(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    poses: Poses,
    features: Tensor,
    outside: Tensor,
) -> tuple[Poses, Tensor]:
    """Fit the best pose again from where it is, then its close rivals: fits that differ in effort
    cannot be compared. Results with a higher score are kept."""
    best = best_inside(features, outside)
    poses, features = _refitted(target, work, crops, poses, features, best)
    scores = pose_scores(features, exact=True).masked_fill(outside, -torch.inf)
    rivals = close_rivals(poses, scores, work.symmetries)
    if not len(rivals):
        return poses, features
    different = distinct_poses(poses[rivals], scores[rivals], work.symmetries)
    poses, features = _refitted(
        target, work, crops, poses, features, rivals[different][:CLOSE_RIVALS]
    )
    return poses, with_details(target.describer, crops, poses, features, int(best), rivals)


def _refitted(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    poses: Poses,
    features: Tensor,
    index: Tensor,
) -> tuple[Poses, Tensor]:
    """Fit poses again, and keep the results that have a higher score."""
    fitted = fitted_poses(target, work, crops, poses[index], again=True)
    moved = (poses.T[index] != fitted.T).flatten(1).any(dim=1)
    if not bool(moved.any()):
        return poses, features
    new = features_of(target, work, fitted)
    better = moved & (pose_scores(new, exact=True) > pose_scores(features[index], exact=True))
    for k in better.nonzero()[:, 0].tolist():
        one = torch.tensor([k])
        poses, features = with_replaced(work, poses, features, index[one], fitted[one], new[one])
    return poses, features
