"""Whether a photograph shows the mirror image of the mesh: a file may have a flipped axis.

In a mirror, a photograph of the mirror image is one of the mesh, so that the mesh is registered in
flipped photographs.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..evidence import EvidenceWeights
from ..matching import Ranking
from ..mesh.reflections import is_its_own_mirror_image
from ..terms import QueryFeatures
from .block import Block, described, fitted_poses, poses_of_views, with_evidence
from .confidence import resolution
from .hypotheses import Hypotheses, best_views, placed, with_short_fit
from .photograph import Photograph
from .result import DETERMINING_KEYPOINTS, Registration
from .target import Target

LEAST_CONFIDENCE = 0.5  # from which an answer is compared
MIRROR_DOUBT = 0.3  # factor of the confidence where the mirror image fits better
MIRROR_WARNING = (
    "the mirror image of the mesh fits better than the mesh: check whether an axis of it is flipped"
)

LESS_ALIKE = 0.015
"""By how much less alike than in the photograph a view may be in the flipped one for the mirror
image to come into question: 0.012 in generated photographs of mirrored meshes in which it fits
better."""

TRIED_VIEWS = 4
"""Best distinct views in a flipped photograph, which get a short fit."""

PROMISING = 1.5
"""Score by which the mirror image may be behind the fitted mesh after a short fit to be fitted as
well, by which it gained 0 to 3.7 in 21 generated photographs of mirrored meshes."""


def compared_with_mirror_image(
    target: Target,
    block: Block,
    best: Hypotheses,
    results: Sequence[Registration],
) -> list[Registration]:
    """Results of photographs, whose ``best`` poses are one in each. Where it is probably right and
    the mirror image of the mesh fits better, the result gets a warning, and ``MIRROR_DOUBT`` of its
    confidence."""
    found = list(results)
    likely = torch.tensor([(result.confidence or 0.0) >= LEAST_CONFIDENCE for result in results])
    # a print that is found is not mirrored
    compared = (likely & (best.evidence.keypoints < DETERMINING_KEYPOINTS)).nonzero()[:, 0]
    if not len(compared) or is_its_own_mirror_image(target.bank.mesh):
        return found
    gain = mirror_gain(target, block, best[compared])
    for place in compared[gain > resolution()].tolist():
        doubted = found[place].scaled(MIRROR_DOUBT)
        found[place] = replace(doubted, warnings=(*doubted.warnings, MIRROR_WARNING))
    return found


def mirror_gain(target: Target, block: Block, best: Hypotheses) -> Tensor:
    """(N,) by how much the mirror image of the mesh scores more in a photograph than the mesh at
    its ``best`` pose, by shape alone; minus infinity where no view is as much alike."""
    highest = torch.full((len(best),), -torch.inf, dtype=torch.float64)
    query = target.matcher.flipped(block.query, best.photograph)
    rankings = target.matcher.rank_shapes(query).split()
    alike = [
        row
        for row, (p, ranking) in enumerate(zip(best.photograph.tolist(), rankings, strict=True))
        if float(ranking.hog.max() - block.rankings[p].hog.max()) > -LESS_ALIKE
    ]
    if not alike:
        return highest
    seen = _in_a_mirror(target, block, best, query, rankings)
    crops = seen.crops
    assert crops is not None
    starts = Hypotheses.cat([_of_best_views(target, seen, row) for row in alike])
    weights = target.score_weights(exact=True)
    of_shape = EvidenceWeights.only(similarity=weights.similarity, contours=weights.contours)
    own = best.evidence.scores(of_shape)
    fitted, _ = with_short_fit(target.describer, crops, starts)
    fitted = placed(fitted, fitted.short_fit, target.describer.centre)
    fitted = with_evidence(target, seen, fitted)
    fitted = fitted[fitted.best(of_shape)]
    gain = fitted.evidence.scores(of_shape) - own[fitted.photograph]
    near = (gain > -PROMISING).nonzero()[:, 0]
    if len(near):
        poses = fitted_poses(target, seen, crops, fitted[near], refit=True)
        poses = with_evidence(target, seen, poses)
        gain[near] = poses.evidence.scores(of_shape) - own[poses.photograph]
    return highest.index_copy(0, fitted.photograph, gain)


def _in_a_mirror(
    target: Target,
    block: Block,
    best: Hypotheses,
    query: QueryFeatures,
    rankings: Sequence[Ranking],
) -> Block:
    """The photographs of the ``best`` poses, flipped, with the cameras of these."""
    photographs = [
        flipped(block.photographs[p], K)
        for p, K in zip(best.photograph.tolist(), best.cameras, strict=True)
    ]
    seen = described(target, photographs, query, rankings, contours=True, keypoints=False)
    return Block(
        **vars(seen),
        photographs=photographs,
        limits=[None] * len(photographs),
        exact=True,
        symmetries=block.symmetries,
        tried_cameras=torch.zeros(len(photographs), dtype=torch.bool),
    )


def _of_best_views(target: Target, block: Block, photograph: int) -> Hypotheses:
    """Poses of the best views in one photograph."""
    view, rank = best_views(
        block.rankings[photograph], target.bank, count=TRIED_VIEWS, symmetries=block.symmetries
    )
    return poses_of_views(target, block, view, rank, torch.full_like(view, photograph))


def flipped(item: Photograph, K: Tensor) -> Photograph:
    """A photograph by a camera with the matrix ``K`` (3, 3), as a mirror shows it."""
    last = item.size[1] - 1
    x0, y0, x1, y1 = item.box.unbind()
    K = K.clone()
    K[0, 2] = last - K[0, 2]
    return replace(
        item.by(K),
        image=item.image.flip(-1),
        box=torch.stack([last - x1, y0, last - x0, y1]),
        mask=None if item.mask is None else item.mask.flip(-1),
    )
