"""The mirror image of a mesh, which a file with a flipped axis has: it can look right from one
side.

Whether it fits a photograph better than the mesh is tested for the best pose. Seen from afar, a
shape and its reflection through a plane that faces the camera have the same outline, and nearly so
if the shape is nearly symmetric to the plane. Only one of the two has the photograph's inner
contours.
"""

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
from .candidates import Candidates
from .confidence import resolution
from .described import DescribedPhotograph, evidence_of
from .poses import Poses, placed, with_short_fit
from .result import DETERMINING_KEYPOINTS, Registration
from .target import Target
from .work import Work

LEAST_CONFIDENCE = 0.5  # from which an answer is compared
DOUBT = 0.3  # factor of the confidence where the mirror image fits better
WARNING = (
    "the mirror image of the mesh fits better than the mesh: check whether an axis of it is flipped"
)


def compared_with_mirror_image(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    best: Candidates,
    result: Registration,
) -> Registration:
    """A result whose ``best`` pose is one. If it is probably right and the mirror image of the mesh
    fits better, it gets a warning, and ``DOUBT`` of its confidence."""
    is_printed = float(best.evidence.keypoints) >= DETERMINING_KEYPOINTS
    # a print that is found is not mirrored
    if (result.confidence or 0.0) < LEAST_CONFIDENCE or is_printed:
        return result
    gain = mirror_gain(target, work, crops, best)
    if gain <= resolution(exact=True):
        return result
    probabilities = tuple(DOUBT * probability for probability in result.probabilities)
    return replace(result, probabilities=probabilities, warnings=(*result.warnings, WARNING))


def mirror_gain(target: Target, work: Work, crops: EdgeCrops, best: Candidates) -> float:
    """By how much the mirror image of the mesh scores more in a photograph than the mesh at its
    ``best`` pose, by shape alone and after a short fit; 0 for a mesh that is its own mirror
    image."""
    plane = reflection_plane(target.bank.mesh)
    if plane is None:
        return 0.0
    image = target.mirror_image
    centre = image.describer.centre
    starts = reflected_poses(best.poses, plane, target.describer.centre, centre)
    fitted, _ = with_short_fit(image.describer, crops, starts)
    photograph = DescribedPhotograph(
        work.query, Ranking.none(), work.descriptor, crops, keypoints=None, frame=work.frame
    )
    seen = evidence_of(image, photograph, placed(fitted, fitted.short_fit, centre))
    weights = target.score_weights(exact=True)
    of_shape = EvidenceWeights.only(similarity=weights.similarity, contours=weights.contours)
    return float(seen.scores(of_shape).max() - best.evidence.scores(of_shape))


def reflected_poses(pose: Poses, plane: Tensor, centre: Tensor, image_centre: Tensor) -> Poses:
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
