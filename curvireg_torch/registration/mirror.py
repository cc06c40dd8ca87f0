"""The mirror image of a mesh, which a file with a flipped axis has: it can look right from one
side.

Whether it fits a photograph better than the mesh is tested for the best pose. Seen from afar, a
shape that is reflected through a plane in its centre has the outline of the shape if the plane
faces the camera, and nearly so if the shape is nearly symmetric to the plane.
"""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from ..evidence import Evidence, EvidenceWeights
from ..fitting.edges import EdgeCrops
from ..geometry.cameras import transform
from ..matching import Ranking
from ..mesh.mesh import MIRROR, cached_in_mesh, mesh_radius
from .confidence import resolution, shares
from .described import DescribedPhotograph, evidence_of
from .poses import Poses, fit_poses, placed, with_quick_fit
from .result import DETERMINING_KEYPOINTS, Registration
from .target import Target
from .work import Work

# Points of a surface that are reflected, and the distance from it, as a fraction of its radius,
# within which that fraction of them lies if a mesh is its own mirror image
POINTS = 2000
SAME_SHAPE = 0.03
SAME_POINTS = 0.995
LEAST_CONFIDENCE = 0.5  # from which an answer is compared
HOPELESS = -1.5  # Gain after a short fit from which a whole one is not tried
WARNING = (
    "the mirror image of the mesh fits better than the mesh: check whether an axis of it is flipped"
)


def compared_with_mirror_image(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    pose: Poses,
    evidence: Evidence,
    result: Registration,
) -> Registration:
    """A result with its best ``pose`` and the evidence of it. If it is probably right and the
    mirror image of the mesh fits better, it gets a warning, and at most half the confidence."""
    is_printed = float(evidence.landmarks) >= DETERMINING_KEYPOINTS
    # a print that is found is not mirrored
    if (result.confidence or 0.0) < LEAST_CONFIDENCE or is_printed:
        return result
    gain = mirror_gain(target, work, crops, pose, evidence)
    if gain <= resolution(exact=True):
        return result
    own, _ = shares(torch.tensor([0.0, gain]), exact=True).tolist()
    probabilities = tuple(own * probability for probability in result.probabilities)
    return replace(result, probabilities=probabilities, warnings=(*result.warnings, WARNING))


def mirror_gain(
    target: Target, work: Work, crops: EdgeCrops, pose: Poses, evidence: Evidence
) -> float:
    """By how much the mirror image of the mesh scores more in a photograph than the mesh at one
    ``pose``, by shape alone; 0 for a mesh that is its own mirror image."""
    planes = reflection_planes(target.bank.mesh)
    if planes is None:
        return 0.0
    image = target.mirror_image
    starts = reflected_poses(pose, planes, target.describer.centre, image.describer.centre)
    quick, _ = with_quick_fit(image.describer, crops, starts)
    near = placed(quick, quick.quick, image.describer.centre)
    photograph = DescribedPhotograph(
        work.query, Ranking.none(), work.descriptor, crops, keypoints=None
    )
    weights = target.score_weights(exact=True)
    of_shape = EvidenceWeights.only(similarity=weights.similarity, contours=weights.contours)

    def gains(poses: Poses) -> Tensor:
        seen = evidence_of(image, photograph, poses)
        return seen.scores(of_shape) - evidence.scores(of_shape)

    gain = gains(near)
    if float(gain.max()) < HOPELESS:
        return float(gain.max())
    settings = target.pipeline.fit
    best = near[gain.argmax()[None]]
    fitted = fit_poses(
        image.describer, crops, best, settings=settings, wide_angles=settings.wide_angles
    )
    return float(gains(fitted).max())


def reflected_poses(pose: Poses, planes: Tensor, centre: Tensor, image_centre: Tensor) -> Poses:
    """Poses at which the mirror image of a mesh is the mesh at one ``pose``, reflected through
    planes in its ``centre`` (3,): those with normals ``planes`` (P, 3) in the model's frame, and
    the one that faces the camera. ``image_centre`` (3,) is the centre of the image."""
    T = pose.T[0]
    position = T[:3, :3] @ centre.to(T) + T[:3, 3]
    towards = F.normalize(T[:3, :3].T @ position, dim=0)
    normals = torch.cat([planes.to(T), towards[None]])
    reflections = torch.eye(3).to(T) - 2.0 * normals[:, :, None] * normals[:, None]
    R = T[:3, :3] @ reflections @ MIRROR.to(T)
    transforms = transform(R, position - R @ image_centre.to(T))
    copies = pose[torch.zeros(len(R), dtype=torch.long)]
    return placed(copies, transforms, image_centre)


@cached_in_mesh
def reflection_planes(mesh: trimesh.Trimesh) -> Tensor | None:
    """(3, 3) normals of the planes in which a mesh is reflected: the principal axes of its surface;
    None if it is its own mirror image in one of them, or in a plane of the mesh file's axes.

    Example:
        >>> reflection_planes(trimesh.creation.box((1, 2, 3))) is None
        True
    """
    centre, axes = _principal_axes(mesh)
    points = trimesh.sample.sample_surface(mesh, POINTS, seed=0)[0] - centre
    tree = cKDTree(trimesh.sample.sample_surface(mesh, 20 * POINTS, seed=1)[0] - centre)
    for normal in np.concatenate([axes, np.eye(3)]):
        reflected = points - 2.0 * (points @ normal)[:, None] * normal
        distance = np.quantile(tree.query(reflected)[0], SAME_POINTS)
        if distance < SAME_SHAPE * mesh_radius(mesh):
            return None
    return torch.from_numpy(axes)


def _principal_axes(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Centroid (3,) of a mesh's surface, and its principal axes (3, 3), one in each row."""
    area = mesh.area_faces[:, None, None]
    centre = np.asarray(mesh.centroid)
    corners = mesh.triangles - centre
    # of a triangle, the integral of x x^T
    total = corners.sum(axis=1, keepdims=True)
    moments = area * (corners.mT @ corners + total.mT @ total) / 12.0
    _, axes = np.linalg.eigh(moments.sum(axis=0))
    return centre, np.ascontiguousarray(axes.T)
