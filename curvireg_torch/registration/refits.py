"""The best pose and its close rivals, fitted once more and compared in detail."""

from dataclasses import replace

import torch
from torch import Tensor

from ..fitting.edges import EdgeCrops
from .candidates import Candidates
from .described import evidence_of, with_details
from .poses import close_rivals, distinct_poses
from .target import Target
from .work import Work, fitted_poses


def refitted(target: Target, work: Work, crops: EdgeCrops, found: Candidates) -> Candidates:
    """Fit the best pose again from where it is, then its close rivals: fits that differ in effort
    cannot be compared. Results with a higher score are kept."""
    weights = target.score_weights(exact=True)
    best = found.best(weights)
    found = _refitted(target, work, crops, found, best)
    scores = found.scores(weights)
    settings = target.pipeline.fit
    rivals = close_rivals(found.poses, scores, work.symmetries, behind=settings.close_score)
    if not len(rivals):
        return found
    different = distinct_poses(
        found.poses[rivals], scores[rivals], work.symmetries, angle=settings.same_pose_angle
    )
    fitted = rivals[different][: settings.close_rivals]
    found = _refitted(target, work, crops, found, fitted)
    compared = with_details(target, crops, found.poses, found.evidence, int(best), rivals)
    return replace(found, evidence=compared)


def _refitted(
    target: Target, work: Work, crops: EdgeCrops, found: Candidates, index: Tensor
) -> Candidates:
    """Fit poses again, and keep the results that have a higher score."""
    before = found[index]
    fitted = fitted_poses(target, work, crops, before.poses, refit=True)
    moved = (before.poses.T != fitted.T).flatten(1).any(dim=1)
    if not bool(moved.any()):
        return found
    new = evidence_of(target, work, fitted)
    weights = target.score_weights(exact=True)
    better = moved & (new.scores(weights) > before.evidence.scores(weights))
    for k in better.nonzero()[:, 0].tolist():
        one = torch.tensor([k])
        found = found.with_fitted(index[one], fitted[one], new[one], work.limits)
    return found
