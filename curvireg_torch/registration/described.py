"""A photograph as poses are compared with it, and the poses beside it."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from ..evidence import Evidence
from ..fitting.details import compare_details
from ..fitting.edges import EdgeCrops
from ..fitting.landmarks import LandmarkMatches
from ..matching import Ranking
from ..terms import Appearance, QueryFeatures
from .poses import Poses
from .target import Target


@dataclass(frozen=True)
class DescribedPhotograph:
    """A photograph as poses are compared with it.

    Attributes:
        query: its box, described by the matcher.
        ranking: of the views of the bank.
        descriptor: (1, D) on a grid twice as fine as the bank's, or (H, D) if each pose has its own
            box.
        crops: of the box, for contour fits; None without them.
        landmarks: those found in the box; None where they do not count.
    """

    query: QueryFeatures
    ranking: Ranking
    descriptor: Tensor
    crops: EdgeCrops | None
    landmarks: LandmarkMatches | None


@dataclass(frozen=True)
class ComparedPoses:
    """H ``poses`` beside a ``photograph``: a :class:`.SeenPoses`."""

    target: Target
    photograph: DescribedPhotograph
    poses: Poses

    @property
    def rank(self) -> Tensor:
        return self.poses.rank

    @property
    def edge_support(self) -> Tensor:
        return self.poses.edge_support

    @property
    def similarity(self) -> Tensor:
        views, _ = self._views
        descriptor = self.photograph.descriptor
        products = F.normalize(views, dim=1) * F.normalize(descriptor, dim=1)
        return products.sum(dim=1).double().cpu()

    @property
    def appearance(self) -> Tensor:
        _, pictures = self._views
        if pictures is None:
            return torch.zeros(len(self.poses), dtype=torch.float64)
        photograph = self.photograph
        return self.target.matcher.appearance_score(photograph.query, photograph.ranking, pictures)

    @property
    def keypoints(self) -> Tensor:
        landmarks = self.photograph.landmarks
        if landmarks is None:
            return torch.zeros(len(self.poses), dtype=torch.float64)
        count = landmarks.agreeing(self.poses.T, self.poses.cameras)
        return (count - self.target.pipeline.fit.chance_keypoints).clamp(min=0.0)

    @cached_property
    def _views(self) -> tuple[Tensor, Tensor | None]:
        """(H, D) descriptors of the poses' views, and their pictures where the appearance
        counts."""
        describer = self.target.describer
        pose = self.poses.rotation, self.poses.distance
        if Appearance.name not in self.photograph.ranking.terms:
            return describer.descriptors(*pose), None
        return describer.described(*pose)


def evidence_of(target: Target, photograph: DescribedPhotograph, poses: Poses) -> Evidence:
    """The evidence of poses in a photograph, without details."""
    return Evidence.of(ComparedPoses(target, photograph, poses))


def with_details(
    target: Target, crops: EdgeCrops, poses: Poses, evidence: Evidence, best: int, rivals: Tensor
) -> Evidence:
    """The evidence of poses, ``rivals`` (R,) of which are compared in detail with the ``best``."""
    index = torch.cat([torch.tensor([best]), rivals])
    some = poses[index]
    contours = target.describer.contours
    scores, _ = compare_details(contours, crops, some.cameras, some.T, some.crop_index)
    details = evidence.details.clone()
    details[rivals] = details[best] + scores[1:, 0].to(details)
    return replace(evidence, details=details)
