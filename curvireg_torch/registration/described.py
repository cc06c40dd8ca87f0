"""A photograph as poses are compared with it, and the poses beside it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..evidence import Evidence
from ..fitting.edges import EdgeCrops
from ..fitting.keypoints import KeypointMatches
from ..fitting.together import details_together, evidence_together
from ..matching import Ranking
from ..terms import Appearance, QueryFeatures
from ..utils.company import by_key, compute_together
from .framing import CropFrame
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
        keypoints: those found in the box; None where they do not count.
        frame: in which poses are compared with it; None: each fills a picture by itself, as a view
            of the bank does.
    """

    query: QueryFeatures
    ranking: Ranking
    descriptor: Tensor
    crops: EdgeCrops | None
    keypoints: KeypointMatches | None
    frame: CropFrame | None = field(default=None, kw_only=True)

    @property
    def printed(self) -> float:
        """log (1 + n) with the number n of keypoints that a view of the mesh has; 0 where they do
        not count."""
        return 0.0 if self.keypoints is None else math.log1p(self.keypoints.per_view)


BACKGROUND = 1.0  # of pictures of the mesh
VIEWS = "_described_views"  # attribute of ComparedPoses, computed on first use


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
        _, features = self._views
        if features is None:
            return torch.zeros(len(self.poses), dtype=torch.float64)
        photograph = self.photograph
        return self.target.matcher.appearance_score(photograph.query, photograph.ranking, features)

    @property
    def keypoints(self) -> Tensor:
        keypoints = self.photograph.keypoints
        if keypoints is None:
            return torch.zeros(len(self.poses), dtype=torch.float64)
        count = keypoints.agreeing(self.poses.T, self.poses.cameras)
        return (count - self.target.pipeline.fit.chance_keypoints).clamp(min=0.0)

    @property
    def contours(self) -> Tensor:
        crops = self.photograph.crops
        poses = self.poses
        if crops is None:
            return torch.zeros(len(poses), dtype=torch.float64)
        contours = self.target.describer.device_contours
        return evidence_together(contours, crops, poses.cameras, poses.T, poses.crop_index)

    @property
    def _views(self) -> tuple[Tensor, Tensor | None]:
        """(H, D) descriptors of the poses' views, and the features (H, F) of their pictures where
        the appearance counts."""
        # Not a cached property: in Python 3.11 its lock would keep other photographs waiting, which
        # this one waits for.
        known: dict[str, Any] = self.__dict__
        if VIEWS not in known:
            known[VIEWS] = compute_together(_views_of, self)
        views: tuple[Tensor, Tensor | None] = known[VIEWS]
        return views

    @property
    def views_key(self) -> tuple[int, bool, bool]:
        """What poses have in common whose views are drawn together."""
        photograph = self.photograph
        has_appearance = Appearance.name in photograph.ranking.terms
        return id(self.target.describer), has_appearance, photograph.frame is None


def _views_of(requests: Sequence[ComparedPoses]) -> list[tuple[Tensor, Tensor | None]]:
    return by_key(requests, lambda request: request.views_key, _views_of_one_mesh)


def _views_of_one_mesh(requests: Sequence[ComparedPoses]) -> list[tuple[Tensor, Tensor | None]]:
    target = requests[0].target
    counts = [len(request.poses) for request in requests]
    shaded = Appearance.name in requests[0].photograph.ranking.terms
    T, K = _cameras(requests)
    fields, pictures = target.describer.seen_by(T, K, shaded=shaded)
    if requests[0].photograph.frame is not None:
        inside = _inside(requests).to(fields.device)
        fields = fields * inside
        pictures = None if pictures is None else pictures.masked_fill(~inside, BACKGROUND)
    views = target.describer.descriptor(fields)
    if pictures is None:
        return [(part, None) for part in views.split(counts)]
    features = target.matcher.appearance_of(pictures)
    return list(zip(views.split(counts), features.split(counts), strict=True))


def _cameras(requests: Sequence[ComparedPoses]) -> tuple[Tensor, Tensor]:
    """Poses (N, 4, 4) and camera matrices (N, 3, 3) of the pictures in which poses are compared."""
    if requests[0].photograph.frame is not None:
        cameras = [
            request.photograph.frame.transform @ request.poses.cameras
            for request in requests
            if request.photograph.frame is not None
        ]
        return torch.cat([request.poses.T for request in requests]), torch.cat(cameras)
    rotation = torch.cat([request.poses.rotation for request in requests])
    distance = torch.cat([request.poses.distance for request in requests])
    T, K, _ = requests[0].target.describer.cameras(rotation, distance)
    return T, K


def _inside(requests: Sequence[ComparedPoses]) -> Tensor:
    """(N, 1, S, S) bool pixels of the frames of poses that lie in the photographs."""
    return torch.cat(
        [
            request.photograph.frame.inside.expand(len(request.poses), 1, -1, -1)
            for request in requests
            if request.photograph.frame is not None
        ]
    )


def evidence_of(target: Target, photograph: DescribedPhotograph, poses: Poses) -> Evidence:
    """The evidence of poses in a photograph, without details."""
    return Evidence.of(ComparedPoses(target, photograph, poses))


def with_details(
    target: Target, crops: EdgeCrops, poses: Poses, evidence: Evidence, best: int, rivals: Tensor
) -> Evidence:
    """The evidence of poses, ``rivals`` (R,) of which are compared in detail with the ``best``."""
    index = torch.cat([torch.tensor([best]), rivals])
    some = poses[index]
    contours = target.describer.device_contours
    scores, _ = details_together(contours, crops, some.cameras, some.T, some.crop_index)
    details = evidence.details.clone()
    details[rivals] = details[best] + scores[1:, 0].to(details)
    return replace(evidence, details=details)
