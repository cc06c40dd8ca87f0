"""Final scores of hypotheses after search and contour fit."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..matching import ViewDescriber
from .hypotheses import Hypotheses

__all__ = ["POSE_FEATURES", "WEIGHTS", "rank_feature", "rescore", "similarities"]

POSE_FEATURES = ("rank", "similarity", "edge_support", "appearance")
"""Features of a pose: log S of the view it started from, minus that of the best view; normalised correlation of the
pose's view with the photograph; edge support (0 without the contour fit); log appearance score of the pose (0 without
that term)."""

WEIGHTS, RANK_ALONE = (1.0, 10.0, 10.0, 2.5), (1.0, 0.0, 0.0, 0.0)
"""Weights of the features with an exact mesh and with a similar one, measured in docs/experiments.md under "Which
hypothesis comes first"."""


def rank_feature(starts: Hypotheses) -> Tensor:
    """(H,) float64 log S of the views that hypotheses start from, minus that of their photograph's best view."""
    log = starts.ranking_score.clamp(min=torch.finfo(torch.float64).tiny).log()
    count = int(starts.image_index.max()) + 1 if len(starts) else 0
    best = log.new_full((count,), -torch.inf).scatter_reduce(0, starts.image_index, log, "amax")
    return log - best[starts.image_index]


def rescore(evidence: Tensor, *, exact: bool) -> Tensor:
    """(H,) scores of hypotheses, higher is better, from their (H, 4) :data:`POSE_FEATURES`.

    With the exact mesh, that of this very object, all features count (:data:`WEIGHTS`). With the mesh of a similar
    object, the order of the ranking is kept.
    """
    return evidence @ torch.tensor(WEIGHTS if exact else RANK_ALONE, dtype=evidence.dtype)


def similarities(describers: Sequence[ViewDescriber], descriptors: Tensor, hypotheses: Hypotheses) -> Tensor:
    """(H,) normalised correlations of hypotheses' views with their photographs, of (B, D) descriptors."""
    queries = F.normalize(descriptors, dim=1)
    out = torch.zeros(len(hypotheses), dtype=torch.float64)
    for model, mine in hypotheses.by_model():
        views = describers[model].descriptors(hypotheses.rotation[mine], hypotheses.distance[mine])
        query = queries[hypotheses.image_index[mine].to(queries.device)]
        out[mine] = (F.normalize(views, dim=1) * query).sum(dim=1).double().cpu()
    return out
