"""Several meshes that may be the object in a photograph: their poses are rivals of each other.

Each mesh is registered alone. Then the poses of all of them share one probability, by the scores
that order the poses of one mesh: of two meshes that fit equally well, as one shape in two sizes
does, neither has more than one half. The best poses of two meshes are also compared where their
contours differ, as those of a variant with a part more do.
"""

from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor

from ..errors import CurviregError
from ..evidence import Evidence, EvidenceWeights
from ..fitting.details import ContourDetails, compared, contour_details
from ..fitting.edges import EdgeCrops
from .confidence import shares
from .inputs import ImageItem
from .result import FailedRegistration, Registration
from .target import Target

DETAILED = 5.0
"""Score by which a mesh may be behind the best one to be compared with it in detail."""


def best_of_meshes(
    results: Sequence[Registration | FailedRegistration],
    targets: Sequence[Target],
    item: ImageItem | None = None,
) -> Registration | FailedRegistration:
    """The best of the results of several meshes for one photograph, the ``item``; None for several
    photographs together, which are not compared in detail.

    The probabilities of the best one are those among the poses of all meshes;
    ``mesh_probabilities`` has that of each mesh. Similar meshes have no scores in common: the more
    confident one is the best, and so it is without probabilities, by the score.
    """
    posed = [k for k, result in enumerate(results) if isinstance(result, Registration)]
    if not posed:
        return results[0]
    found = [result for result in results if isinstance(result, Registration)]
    if len(found) == 1:
        return replace(found[0], mesh_index=posed[0])
    if not all(one.probabilities for one in found) or not all(t.is_exact for t in targets):
        order = [(one.confidence or 0.0, one.score) for one in found]
        best = order.index(max(order))
        return replace(found[best], mesh_index=posed[best])
    weights = targets[0].score_weights(exact=True)
    scores = [_rival_scores(one, weights) for one in found]
    if item is not None:
        scores = _compared_in_detail(scores, found, [targets[k] for k in posed], item)
    tops = torch.stack([one.max() for one in scores])
    best = int(tops.argmax())
    share = shares(torch.cat(scores), exact=True)
    of_mesh = torch.stack([part.sum() for part in share.split([len(one) for one in scores])])
    any_right = max(sum(one.probabilities) for one in found)
    every = torch.zeros(len(results), dtype=torch.float64)
    every[torch.tensor(posed)] = any_right * of_mesh
    own = sum(found[best].probabilities)
    factor = float(any_right * of_mesh[best]) / max(own, 1e-12)
    return replace(
        found[best].scaled(factor),
        mesh_index=posed[best],
        mesh_probabilities=tuple(every.tolist()),
    )


def _rival_scores(result: Registration, weights: EvidenceWeights) -> Tensor:
    """(R,) scores of the poses of one mesh that have a probability, the best first."""
    rivals = [
        hypothesis.evidence
        for hypothesis, probability in zip(result.hypotheses, result.probabilities, strict=True)
        if probability > 0.0
    ]
    evidence = Evidence.of_hypotheses(rivals or [result.hypotheses[0].evidence])
    return evidence.scores(weights)


def _compared_in_detail(
    scores: Sequence[Tensor],
    found: Sequence[Registration],
    targets: Sequence[Target],
    item: ImageItem,
) -> list[Tensor]:
    """The scores of each mesh's poses, moved by how far the contours that only its best pose
    predicts speak for it, beside the best mesh."""
    first = max(range(len(scores)), key=lambda k: float(scores[k].max()))
    behind = [float(scores[first].max() - one.max()) for one in scores]
    if found[first].edge_support is None:
        return list(scores)
    chosen = [k for k, gap in enumerate(behind) if k == first or gap < DETAILED]
    if len(chosen) == 1:
        return list(scores)
    try:
        details = [_details_of(targets[k], found[k], item) for k in chosen]
    except CurviregError:  # a box that leaves nothing to compare
        return list(scores)
    gain, _ = compared(joined(details))
    place = chosen.index(first)
    moved = list(scores)
    for row, k in enumerate(chosen):
        moved[k] = scores[k] + gain[row, place]
    return moved


def _details_of(target: Target, result: Registration, item: ImageItem) -> ContourDetails:
    """What the contours of a mesh's best pose are compared by, in the box of the photograph that
    was given, or in which the object was found."""
    box = item.box if result.detection is None else result.detection.box.float()
    crops = EdgeCrops.cut([item.image], box[None], target.bank.settings.margin)
    T, K = result.projection
    index = torch.zeros(1, dtype=torch.long)
    return contour_details(target.describer.contours, crops, K[None], T[None], index)


def joined(details: Sequence[ContourDetails]) -> ContourDetails:
    """Details of several meshes in one table; those with fewer points get invalid ones."""
    most = max(one.uv.shape[1] for one in details)

    def filled(values: Tensor) -> Tensor:
        missing = most - values.shape[1]
        shape = (len(values), missing, *values.shape[2:])
        return torch.cat([values, values.new_zeros(shape)], dim=1)

    columns = {
        field.name: torch.cat([filled(getattr(one, field.name)) for one in details])
        for field in fields(ContourDetails)
    }
    return ContourDetails(**columns)
