"""What may be wrong with the best pose: a symmetry of the shape makes a better one of it, the
photograph shows the mirror image of the mesh, or the pose lies beside the given box or mask."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ..errors import CurviregError
from ..evidence import Evidence, EvidenceWeights
from ..fitting.contour_fit import short_fit
from ..fitting.details import compared, contour_details
from ..fitting.edges import EdgeCrops
from ..geometry.crops import box_share, crop_transforms, square_boxes
from ..geometry.framing import clipped
from ..geometry.viewpoint import rotation_error
from ..matching import Ranking
from ..mesh.reflections import is_its_own_mirror_image
from ..terms import QueryFeatures
from ..utils.segments import best_within
from .block import Block, described, fitted_poses, poses_of_best_views, with_evidence
from .confidence import RIVAL_ANGLE, resolution
from .hypotheses import (
    Hypotheses,
    by_contours,
    fit_poses,
    placed,
    projected_box,
    with_short_fit,
)
from .photograph import Photograph
from .result import DETERMINING_KEYPOINTS, FailedRegistration, Registration
from .target import Target

BETTER = 0.1  # Score by which a sibling replaces the pose: more than rounding


@dataclass(frozen=True)
class Siblings:
    """K poses that symmetries of the shape make of one, the pose itself first.

    Attributes:
        poses: of them, with evidence that is measured in the same way for all, without a fit.
        details: (K, K) :func:`.compare_details` of the row with the column.
        look_different: (K, K) bool.
        weights: of evidence.
    """

    poses: Hypotheses
    details: Tensor
    look_different: Tensor
    weights: EvidenceWeights

    def gain(self, other: int) -> Tensor:
        """(K,) by how much siblings score more than the ``other`` one."""
        scores = self.poses.evidence.scores(self.weights)
        return scores - scores[other] + self.details[:, other]

    def best(self) -> int:
        """Index of the sibling with the highest score; 0 unless it is clearly higher."""
        gain = self.gain(0)
        best = int(gain.argmax())
        return best if float(gain[best]) > BETTER else 0

    def rival(self, best: int, fitted: Evidence, *, notable: bool) -> tuple[Hypotheses, bool]:
        """The sibling with the highest score among those that differ from the ``best`` one in the
        photograph, or in a ``notable`` feature of the mesh that it does not show; none if it is the
        same pose of a symmetric mesh. And whether a small feature of the mesh tells siblings apart
        that the photograph does not show.

        Its evidence is that of the best one as it was ``fitted``, plus their difference without a
        fit.
        """
        poses = self.poses
        angle = rotation_error(poses.T[:, :3, :3], poses.T[best, :3, :3])
        far = angle > RIVAL_ANGLE
        different = far & self.look_different[best]
        alike = far & ~self.look_different[best]
        counted = far if notable else different
        some = counted.nonzero()[:, 0]
        chosen = some[self.gain(best)[some].argsort(descending=True)[:1]]
        own = poses.evidence.table
        evidence = Evidence.from_table(fitted.table + own[chosen] - own[best])
        details = evidence.details + self.details[chosen, best]
        rival = replace(poses[chosen], evidence=replace(evidence, details=details))
        return rival, bool(alike.any())


def _siblings_of(
    target: Target, block: Block, crops: EdgeCrops, best: Hypotheses
) -> list[Siblings]:
    """The siblings of the ``best`` pose of each photograph, by the symmetries of the shape that
    small features tell apart, the identity first."""
    symmetries = target.telling_symmetries.transforms
    count = len(symmetries)
    copies = best[torch.arange(len(best)).repeat_interleave(count)]
    T = copies.T @ symmetries.to(copies.T).repeat(len(best), 1, 1)
    poses = placed(copies, T, target.describer.centre)
    seen = by_contours(contour_details, target.describer, crops, poses)
    poses = with_evidence(target, block, poses)
    weights = target.score_weights(exact=True)
    return [
        Siblings(poses[rows], *compared(seen[rows]), weights=weights)
        for rows in torch.arange(len(poses)).split(count)
    ]


def with_siblings(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses
) -> tuple[Hypotheses, Hypotheses, list[bool]]:
    """Replace the best pose of each photograph by what a symmetry of the shape makes of it, if
    small features say so; return the poses, the strongest rival of each best one among these, and
    for each photograph whether it hides the feature. Given symmetries are trusted."""
    symmetries = target.telling_symmetries
    if len(symmetries) == 1:
        return poses, poses[:0], [False] * len(block)
    best = poses.best(target.score_weights(exact=True))
    siblings = _siblings_of(target, block, crops, poses[best])
    kept = [one.best() for one in siblings]
    moved = torch.tensor([k for k, place in enumerate(kept) if place], dtype=torch.long)
    if len(moved):
        starts = Hypotheses.cat(
            [siblings[k].poses[torch.tensor([kept[k]])] for k in moved.tolist()]
        )
        fitted = fitted_poses(target, block, crops, starts, refit=True)
        fitted = with_evidence(target, block, fitted)
        allowed = block.keeps(fitted)
        poses = poses.with_poses(best[moved[allowed]], fitted[allowed])
    pairs = [
        one.rival(place, poses.evidence[row], notable=symmetries.notable)
        for one, place, row in zip(siblings, kept, best.split(1), strict=True)
    ]
    rivals = Hypotheses.cat([rival for rival, _ in pairs])
    rivals = replace(
        rivals,
        is_outside=torch.zeros_like(rivals.is_outside),
        is_distinct=torch.ones_like(rivals.is_distinct),
        is_sibling=torch.ones_like(rivals.is_sibling),
    )
    return poses, rivals[block.keeps(rivals)], [is_hidden for _, is_hidden in pairs]


# In a mirror, a photograph of the mirror image is one of the mesh: the mesh is registered in
# flipped photographs. A file may have a flipped axis.
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


# Share of the smaller of the given box and that around the pose in the other one, below which the
# pose lies elsewhere: of 246 reliable answers on twelve real sets it is 0.93 or more
LEAST_SHARE = 0.6
BESIDE_BOX = (
    "the pose lies beside the box, perhaps on another copy of the object: check the overlay, and "
    "draw the box around the one that is meant"
)
MASK_SIZE = 64  # side in px of a crop in which a mask is compared with the mesh at the pose
MASK_REACH = 2  # px of it by which a mask may reach beyond the mesh
# Share of a mask that must lie within this reach: of 24 generated objects it is 0.98 where mask and
# pose are right, and at most 0.89 where the mask is shifted by a fifth of the object
LEAST_MASK_SHARE = 0.9
BESIDE_MASK = (
    "the mask reaches far beyond the object at this pose: check that it is of this object alone, "
    "and of this photograph"
)


def compared_with_input(
    meshes: Sequence[Target],
    item: Photograph | CurviregError,
    result: Registration | FailedRegistration,
) -> Registration | FailedRegistration:
    """The result in a photograph, with a warning where its pose lies beside the given box: perhaps
    on another copy of the object, of which the box shows a part; or beside the given mask."""
    if not (isinstance(item, Photograph) and isinstance(result, Registration)):
        return result
    mesh = meshes[result.mesh_index]
    found = []
    box = projected_box(mesh.describer, result.projection)
    if box_share(clipped(box, item.size), item.box.double()) < LEAST_SHARE:
        found.append(BESIDE_BOX)
    if mesh.is_exact and _mask_share(mesh, item, result.projection) < LEAST_MASK_SHARE:
        found.append(BESIDE_MASK)
    return replace(result, warnings=(*result.warnings, *found)) if found else result


def _mask_share(target: Target, item: Photograph, projection: tuple[Tensor, Tensor]) -> float:
    """Share of a photograph's mask that lies on the mesh at a pose, or near it; 1 without one."""
    margin = target.describer.settings.margin
    mask = item.mask_crop(MASK_SIZE, margin)
    if mask is None:
        return 1.0
    T, K = projection
    transform = crop_transforms(square_boxes(item.box[None].float(), margin), MASK_SIZE)
    size = (MASK_SIZE, MASK_SIZE)
    depth = target.describer.renderer.render(T[None], transform.double() @ K, size)
    near = max_pool2d((depth > 0.0).float().cpu(), 2 * MASK_REACH + 1, 1, MASK_REACH)
    white = (mask >= 0.5).float()
    return float((white * near).sum() / white.sum()) if bool(white.any()) else 1.0
