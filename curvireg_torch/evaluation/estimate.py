"""The pose of one object, from the CADs that the protocol allows."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..matching import Ranking
from ..registration import Registrar, confidence
from .benchmark import Row

__all__ = ["estimate_pose"]


def estimate_pose(
    registrars: Sequence[Registrar], image: Tensor, box: Tensor, camera_matrix: Tensor | None, *, fused: bool
) -> Row:
    """Register one photograph to the best of several meshes.

    Args:
        registrars: one per mesh, of banks with the same views.
        image: (3, H, W) in [0, 1].
        box: (4,) in px.
        camera_matrix: (3, 3) in px or None.
        fused: average the scores of each view over the meshes before the best is searched (no translation then).

    Returns:
        ``rotation`` (3 x 3 numbers), ``translation`` (3 numbers, unit of the mesh, or None), ``score``, ``confidence``,
        ``support`` and ``covariance`` (see :class:`Registration`; None where the contour stage did not run),
        ``mesh``: the place of the chosen mesh among the registrars.

    Raises:
        InvalidInputError, ImageError: see :class:`Registrar`.
    """
    results = [registrar([image], box[None], camera_matrix)[0] for registrar in registrars]
    if fused:
        return _fused(registrars, image, box, [r.ranking for r in results])
    best = max(range(len(results)), key=lambda i: results[i].score)
    result = results[best]
    return {
        "rotation": result.rotation.tolist(),
        "translation": None if result.translation is None else result.translation.tolist(),
        "score": result.score,
        "confidence": result.confidence,
        "support": result.support,
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "mesh": best,
    }


@torch.no_grad()
def _fused(registrars: Sequence[Registrar], image: Tensor, box: Tensor, rankings: list[Ranking]) -> Row:
    """``rankings`` of the meshes' views, one photograph each; the registrars are made with ``refine=False``."""
    scores = torch.cat([ranking.scores for ranking in rankings])
    mean = scores.mean(dim=0)
    order = mean.argsort(descending=True, stable=True)
    chosen = int(scores[:, order[0]].argmax())
    voted = replace(rankings[chosen], scores=mean[None], order=order[None])
    matcher, bank = registrars[chosen].matcher, registrars[chosen].bank
    pose = registrars[chosen].search(matcher.features(matcher.crop([image], box[None])[0]).field, order)
    return {
        "rotation": pose.rotation.tolist(),
        "translation": None,
        "score": pose.score,
        "confidence": float(confidence(voted, bank.rotations)),
        "mesh": chosen,
    }
