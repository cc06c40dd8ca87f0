"""The mirror image of a mesh, which a file with a flipped axis has: it can look right from one
side.

Whether it fits a photograph better than the mesh is tested for the best pose. Seen from afar, a
shape and its reflection through a plane that faces the camera have the same outline, and nearly so
if the shape is nearly symmetric to the plane. Only one of the two has the photograph's inner
contours.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..evidence import EvidenceWeights
from ..fitting.edges import EdgeCrops
from ..geometry.cameras import transform
from ..matching import Ranking
from ..mesh.mesh import MIRROR
from ..mesh.reflections import reflection_plane
from .block import Block
from .confidence import resolution
from .described import Described, evidence_of
from .hypotheses import Hypotheses, placed, with_short_fit
from .result import DETERMINING_KEYPOINTS, Registration
from .target import Target

LEAST_CONFIDENCE = 0.5  # from which an answer is compared
DOUBT = 0.3  # factor of the confidence where the mirror image fits better
WARNING = (
    "the mirror image of the mesh fits better than the mesh: check whether an axis of it is flipped"
)


def compared_with_mirror_image(
    target: Target,
    block: Block,
    crops: EdgeCrops,
    best: Hypotheses,
    results: Sequence[Registration],
) -> list[Registration]:
    """Results of photographs, whose ``best`` poses are one in each. Where it is probably right and
    the mirror image of the mesh fits better, the result gets a warning, and ``DOUBT`` of its
    confidence."""
    likely = torch.tensor([(result.confidence or 0.0) >= LEAST_CONFIDENCE for result in results])
    # a print that is found is not mirrored
    compared = (likely & (best.evidence.keypoints < DETERMINING_KEYPOINTS)).nonzero()[:, 0]
    found = list(results)
    if not len(compared):
        return found
    gain = mirror_gain(target, block, crops, best[compared])
    for place in compared[gain > resolution(exact=True)].tolist():
        doubted = found[place].scaled(DOUBT)
        found[place] = replace(doubted, warnings=(*doubted.warnings, WARNING))
    return found


def mirror_gain(target: Target, block: Block, crops: EdgeCrops, best: Hypotheses) -> Tensor:
    """(N,) by how much the mirror image of the mesh scores more in a photograph than the mesh at
    its ``best`` pose, by shape alone and after a short fit; 0 for a mesh that is its own mirror
    image."""
    plane = reflection_plane(target.bank.mesh)
    if plane is None:
        return torch.zeros(len(best), dtype=torch.float64)
    image = target.mirror_image
    centre = image.describer.centre
    starts = [
        reflected_poses(one, plane, target.describer.centre, centre)
        for one in (best[row] for row in torch.arange(len(best)).split(1))
    ]
    fitted, _ = with_short_fit(image.describer, crops, Hypotheses.cat(starts))
    described = Described(
        query=block.query,
        rankings=[Ranking.none()] * len(block),
        descriptor=block.descriptor,
        crops=crops,
        keypoints=[None] * len(block),
        frames=block.frames,
    )
    seen = evidence_of(image, described, placed(fitted, fitted.short_fit, centre))
    weights = target.score_weights(exact=True)
    of_shape = EvidenceWeights.only(similarity=weights.similarity, contours=weights.contours)
    highest = seen.scores(of_shape).view(len(best), -1).amax(dim=1)
    return highest - best.evidence.scores(of_shape)


def reflected_poses(
    pose: Hypotheses, plane: Tensor, centre: Tensor, image_centre: Tensor
) -> Hypotheses:
    """Two poses at which the mirror image of a mesh is the mesh at one ``pose``, reflected through
    planes in its ``centre`` (3,): one that faces the camera, and that with the normal ``plane``
    (3,) in the model's frame. ``image_centre`` (3,) is the centre of the image."""
    T = pose.T[0]
    rotation = T[:3, :3]
    position = rotation @ centre.to(T) + T[:3, 3]
    normals = torch.stack([F.normalize(position, dim=0), rotation @ plane.to(T)])
    reflections = torch.eye(3).to(T) - 2.0 * normals[:, :, None] * normals[:, None]
    R = reflections @ rotation @ MIRROR.to(T)
    copies = pose[torch.zeros(len(R), dtype=torch.long)]
    return placed(copies, transform(R, position - R @ image_centre.to(T)), image_centre)
