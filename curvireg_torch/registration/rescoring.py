"""Which of the hypotheses is it, now that each has been followed to its end?"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..matching import ViewDescriber
from .hypotheses import Hypotheses

__all__ = ["POSE_FEATURES", "WEIGHTS", "gather_pose_features", "rescore", "similarities"]

POSE_FEATURES = ("rank", "similarity", "edge_support", "appearance")
"""Of a hypothesis: log S of the view it comes from, less that of the best view; normalised correlation of the pose that
was found; strength of the photograph's edges under its contours (0 without the contour stage); how much the pose that
was found looks like the photograph, as log S_look (0 without that term)."""

WEIGHTS, RANK_ALONE = (1.0, 5.0, 10.0, 1.0), (1.0, 0.0, 0.0, 0.0)
"""See docs/accuracy.md."""


def gather_pose_features(
    starts: Hypotheses, similarity: Tensor, edge_support: Tensor, appearance_scores: Tensor
) -> Tensor:
    """(H, 4) float64, see :data:`POSE_FEATURES`.

    Args:
        starts: as they were ranked, their score being S.
        similarity: (H,) of the poses that were found.
        support: (H,) of the contour stage, 0 without it.
        looks: (H,) log S_look, 0 without that term.
    """
    log = starts.score.clamp(min=torch.finfo(torch.float64).tiny).log()
    count = int(starts.photograph.max()) + 1 if len(starts) else 0
    best = log.new_full((count,), -torch.inf).scatter_reduce(0, starts.photograph, log, "amax")
    rank = log - best[starts.photograph]
    return torch.stack([rank, similarity, edge_support, appearance_scores], dim=1)


def rescore(evidence: Tensor, *, with_camera: bool) -> Tensor:
    """(H,) scores of hypotheses from (H, 4) evidence: the higher, the sooner believed.

    Where the camera is known the mesh is taken to be the object's own, and what was found of it counts
    (:data:`WEIGHTS`). Where it is not, the mesh is often another object of the kind, and the ranking's order stands.
    """
    return evidence @ torch.tensor(WEIGHTS if with_camera else RANK_ALONE, dtype=evidence.dtype)


def similarities(describers: Sequence[ViewDescriber], descriptors: Tensor, found: Hypotheses) -> Tensor:
    """(H,) normalised correlations of hypotheses' views with their photographs.

    Args:
        describers: of the bank's models.
        descriptors: (B, D) of the photographs' fields, as the describers make them.
    """
    queries = F.normalize(descriptors, dim=1)
    out = torch.zeros(len(found), dtype=torch.float64)
    for model in found.model.unique().tolist():
        mine = (found.model == model).nonzero()[:, 0]
        views = F.normalize(describers[model].descriptors(found.rotation[mine], found.distance[mine]), dim=1)
        out[mine] = (views * queries[found.photograph[mine].to(queries.device)]).sum(dim=1).double().cpu()
    return out
