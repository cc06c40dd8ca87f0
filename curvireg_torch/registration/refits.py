"""The best pose and its close rivals, fitted once more and compared in detail."""

import torch
from torch import Tensor

from ..fitting.edges import EdgeCrops
from .block import Block, fitted_poses
from .described import with_details, with_evidence
from .hypotheses import Hypotheses, close_rivals, distinct_poses
from .target import Target


def refitted(target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses) -> Hypotheses:
    """Fit the best pose of each photograph again from where it is, then its close rivals: fits that
    differ in effort cannot be compared. Results with a higher score are kept."""
    weights = target.score_weights(exact=True)
    best = poses.best(weights)
    poses = _refitted(target, block, crops, poses, best)
    scores = poses.scores(weights)
    settings = target.pipeline.fit
    close = []
    different = []
    for photograph in poses.photograph[best].tolist():
        rows = poses.of(photograph)
        some = poses[rows]
        rivals = close_rivals(some, scores[rows], block.symmetries, behind=settings.close_score)
        distinct = distinct_poses(
            some[rivals], scores[rows][rivals], block.symmetries, angle=settings.same_pose_angle
        )
        close.append(rows[rivals])
        different.append(rows[rivals[distinct][: settings.close_rivals]])
    rivals = torch.cat(close)
    if not len(rivals):
        return poses
    poses = _refitted(target, block, crops, poses, torch.cat(different))
    return with_details(target, crops, poses, best, rivals)


def _refitted(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses, index: Tensor
) -> Hypotheses:
    """Fit poses again, and keep the results that have a higher score."""
    if not len(index):
        return poses
    before = poses[index]
    fitted = fitted_poses(target, block, crops, before, refit=True)
    moved = (before.T != fitted.T).flatten(1).any(dim=1).nonzero()[:, 0]
    if not len(moved):
        return poses
    new = with_evidence(target, block, fitted[moved])
    weights = target.score_weights(exact=True)
    higher = new.evidence.scores(weights) > before.evidence.scores(weights)[moved]
    better = (higher & block.keeps(new)).nonzero()[:, 0]
    return poses.with_poses(index[moved[better]], new[better])
