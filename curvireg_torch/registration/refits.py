"""The best pose and its close rivals, fitted once more and compared in detail."""

import torch
from torch import Tensor

from ..evidence import Evidence
from ..fitting.edges import EdgeCrops
from .described import evidence_of, with_details
from .poses import Poses, close_rivals, distinct_poses
from .target import Target
from .work import Work, fitted_poses, with_replaced


def scores_inside(target: Target, evidence: Evidence, outside: Tensor) -> Tensor:
    """(H,) scores with an exact mesh, -inf for poses ``outside`` the limits (H,)."""
    scores = evidence.scores(target.score_weights(exact=True))
    return scores.masked_fill(outside, -torch.inf)


def best_inside(target: Target, evidence: Evidence, outside: Tensor) -> Tensor:
    """(1,) index of the best pose that is not ``outside`` the limits (H,)."""
    return scores_inside(target, evidence, outside).argmax()[None]


def fitted_again(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    poses: Poses,
    evidence: Evidence,
    outside: Tensor,
) -> tuple[Poses, Evidence]:
    """Fit the best pose again from where it is, then its close rivals: fits that differ in effort
    cannot be compared. Results with a higher score are kept."""
    best = best_inside(target, evidence, outside)
    poses, evidence = _refitted(target, work, crops, poses, evidence, best)
    scores = scores_inside(target, evidence, outside)
    settings = target.pipeline.fit
    rivals = close_rivals(poses, scores, work.symmetries, behind=settings.close_score)
    if not len(rivals):
        return poses, evidence
    different = distinct_poses(
        poses[rivals], scores[rivals], work.symmetries, angle=settings.same_pose_angle
    )
    fitted = rivals[different][: settings.close_rivals]
    poses, evidence = _refitted(target, work, crops, poses, evidence, fitted)
    return poses, with_details(target, crops, poses, evidence, int(best), rivals)


def _refitted(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    poses: Poses,
    evidence: Evidence,
    index: Tensor,
) -> tuple[Poses, Evidence]:
    """Fit poses again, and keep the results that have a higher score."""
    fitted = fitted_poses(target, work, crops, poses[index], again=True)
    moved = (poses.T[index] != fitted.T).flatten(1).any(dim=1)
    if not bool(moved.any()):
        return poses, evidence
    new = evidence_of(target, work, fitted)
    weights = target.score_weights(exact=True)
    better = moved & (new.scores(weights) > evidence[index].scores(weights))
    for k in better.nonzero()[:, 0].tolist():
        one = torch.tensor([k])
        poses, evidence = with_replaced(work, poses, evidence, index[one], fitted[one], new[one])
    return poses, evidence
