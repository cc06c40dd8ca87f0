"""Poses of objects, from the CADs that the protocol allows."""

from collections.abc import Sequence

import torch

from ..matching import Ranking, ViewMatcher
from ..registration import FailedRegistration, Localization, Registrar, Registration
from ..registration.inputs import ImageItem
from ..terms import QueryFeatures
from .benchmark import Row

__all__ = ["FusedMatcher", "estimate_poses"]


def estimate_poses(registrar: Registrar, items: Sequence[ImageItem], *, boxes: bool = True) -> list[Row]:
    """Register photographs to one mesh, or to the best of several.

    Args:
        registrar: of the bank of the meshes.
        items: photographs with their boxes, all with a camera matrix or all without.
        boxes: whether the registrar is given the boxes; without, it looks for the objects.

    Returns:
        For each ``rotation`` (3 x 3 numbers), ``translation`` (3 numbers, unit of the mesh, or None), ``score``,
        ``confidence``, ``reliable``, ``confidence_features``, ``edge_support``, ``covariance`` and ``projection`` (see
        :class:`Registration`), ``mesh``: the place of the chosen mesh in the bank, and ``rivals``: rotation, score and
        evidence of the other hypotheses; of objects that were looked for, ``found``: the presence and the proposed
        boxes; or ``failed`` with the reason.
    """
    cameras = [item.camera_matrix for item in items if item.camera_matrix is not None]
    results = registrar(
        [item.image for item in items],
        torch.stack([item.box for item in items]) if boxes else None,
        torch.stack(cameras) if cameras else None,
    )
    return [_row(result) for result in results]


def _row(result: Registration | FailedRegistration) -> Row:
    if isinstance(result, FailedRegistration):
        return {"failed": str(result.error)}
    best, *rivals = result.hypotheses
    return {
        "rotation": best.rotation.tolist(),
        "translation": None if best.translation is None else best.translation.tolist(),
        "score": best.score,
        "confidence": result.confidence,
        "reliable": result.reliable,
        "confidence_features": dict(result.confidence_features),
        "edge_support": best.edge_support,
        "evidence": dict(best.evidence),
        "covariance": None if result.covariance is None else result.covariance.tolist(),
        "mesh": best.model,
        "seen_by": [matrix.tolist() for matrix in best.projection],
        **({} if result.localization is None else {"localization": _found(result.localization)}),
        "rivals": [
            {"rotation": r.rotation.tolist(), "score": r.score, "mesh": r.model, "evidence": dict(r.evidence)}
            for r in rivals
        ],
    }


def _found(found: Localization) -> Row:
    return {"presence": found.presence, "boxes": found.boxes.tolist(), "scores": found.scores.tolist()}


class FusedMatcher(ViewMatcher):
    """Scores of each view averaged over the models of a bank, which are all seen from the same views.

    The mean stands at the model that scores best from that view; at the others 0.
    """

    def rank(self, query: QueryFeatures) -> Ranking:
        ranking = super().rank(query)
        scores = ranking.scores.unflatten(1, (len(self.bank.meshes), -1))
        best = scores == scores.amax(dim=1, keepdim=True)
        first = best & (best.cumsum(dim=1) == 1)
        mean = (scores.mean(dim=1, keepdim=True) * first).flatten(1)
        return Ranking(mean, mean.argsort(dim=1, descending=True, stable=True), ranking.terms)
