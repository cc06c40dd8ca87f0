"""Whether a photograph shows the mirror image of the mesh: a file may have a flipped axis.

In a mirror, a photograph of the mirror image is one of the mesh, so that the mesh is registered in
flipped photographs.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..evidence import EvidenceWeights
from ..fitting.contour_fit import short_fit
from ..fitting.edges import EdgeCrops
from ..matching import Ranking
from ..mesh.reflections import is_its_own_mirror_image
from ..terms import QueryFeatures
from ..utils.segments import best_within
from .block import Block, described, poses_of_best_views, with_evidence
from .confidence import resolution
from .hypotheses import Hypotheses, by_contours, fit_poses, placed, with_short_fit
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
better. There it also has as much edge support after a short fit."""

TRIED_VIEWS = 4
"""Best distinct views in a flipped photograph, which get a short fit."""


def compared_with_mirror_image(
    target: Target,
    block: Block,
    crops: EdgeCrops,
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
    gain = mirror_gain(target, block, crops, best[compared])
    for place in compared[gain > resolution()].tolist():
        doubted = found[place].scaled(MIRROR_DOUBT)
        found[place] = replace(doubted, warnings=(*doubted.warnings, MIRROR_WARNING))
    return found


def mirror_gain(target: Target, block: Block, crops: EdgeCrops, best: Hypotheses) -> Tensor:
    """(N,) by how much the mirror image of the mesh scores more in a photograph than the mesh at
    its ``best`` pose, by shape alone; minus infinity where no view of it is as much alike, or has
    as much edge support after a short fit."""
    highest = torch.full((len(best),), -torch.inf, dtype=torch.float64)
    query, ranking = target.matcher.flipped(block.query[best.photograph])
    likeness = ranking.hog.amax(dim=1).cpu()
    own = torch.cat([block.rankings[p].hog.amax(dim=1) for p in best.photograph.tolist()])
    alike = (likeness - own > -LESS_ALIKE).nonzero()[:, 0]
    if not len(alike):
        return highest
    some = best[alike]
    each = ranking.split()
    rankings = [each[row] for row in alike.tolist()]
    seen, flipped_crops = _in_a_mirror(target, block, some, query[alike], rankings)
    places = list(range(len(some)))
    counts = [TRIED_VIEWS] * len(some)
    starts = poses_of_best_views(target, seen, rankings, places, seen.boxes, counts)
    fitted, support = with_short_fit(target.describer, flipped_crops, starts)
    rows = best_within(support, fitted.photograph)
    _, own_support = by_contours(short_fit, target.describer, crops, some, radii=())
    rows = rows[support[rows] >= own_support]
    if not len(rows):
        return highest
    poses = placed(fitted[rows], fitted.short_fit[rows], target.describer.centre)
    settings = replace(target.pipeline.fit, kept_starts=1)
    poses = fit_poses(target.describer, flipped_crops, poses, settings=settings)
    poses = with_evidence(target, seen, poses)
    weights = target.score_weights(exact=True)
    of_shape = EvidenceWeights.only(similarity=weights.similarity, contours=weights.contours)
    compared = alike[poses.photograph]
    own_scores = best[compared].evidence.scores(of_shape)
    return highest.index_copy(0, compared, poses.evidence.scores(of_shape) - own_scores)


def _in_a_mirror(
    target: Target,
    block: Block,
    best: Hypotheses,
    query: QueryFeatures,
    rankings: Sequence[Ranking],
) -> tuple[Block, EdgeCrops]:
    """The photographs of the ``best`` poses, flipped and described as the ``query``, with the
    cameras of these; and their crops."""
    photographs = [
        flipped(block.photographs[p], K)
        for p, K in zip(best.photograph.tolist(), best.cameras, strict=True)
    ]
    seen = described(target, photographs, query, rankings, contours=True, keypoints=False)
    assert seen.crops is not None
    flipped_block = Block(
        **vars(seen),
        photographs=photographs,
        limits=[None] * len(photographs),
        exact=True,
        symmetries=block.symmetries,
        tried_cameras=torch.zeros(len(photographs), dtype=torch.bool),
    )
    return flipped_block, seen.crops


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
