"""Photographs as poses are compared with them, and the evidence for poses beside them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..evidence import Evidence
from ..fitting.details import compared, contour_details
from ..fitting.devices import on_device
from ..fitting.edges import EdgeCrops
from ..fitting.keypoints import KeypointMatches
from ..fitting.measured_fit import contour_evidence
from ..matching import Ranking
from ..terms import Appearance, QueryFeatures
from .framing import CropFrame
from .hypotheses import Hypotheses
from .target import Target

BACKGROUND = 1.0  # of pictures of the mesh


@dataclass(frozen=True, kw_only=True)
class Described:
    """P photographs as poses are compared with them.

    Attributes:
        query: their boxes, described by the matcher.
        rankings: of the views of the bank, one for each photograph.
        descriptor: (P, D) on a grid twice as fine as the bank's.
        crops: of the boxes, for contour fits; None without them.
        keypoints: those found in each box; None where they do not count.
        frames: in which poses are compared with each photograph; None: each fills a picture by
            itself, as a view of the bank does.
    """

    query: QueryFeatures
    rankings: Sequence[Ranking]
    descriptor: Tensor
    crops: EdgeCrops | None
    keypoints: Sequence[KeypointMatches | None]
    frames: Sequence[CropFrame | None]

    def printed(self, photograph: int) -> float:
        """log (1 + n) with the number n of keypoints that a view of the mesh has; 0 where they do
        not count in a photograph."""
        keypoints = self.keypoints[photograph]
        return 0.0 if keypoints is None else math.log1p(keypoints.per_view)


@torch.no_grad()
def evidence_of(target: Target, described: Described, poses: Hypotheses) -> Evidence:
    """The evidence of poses in their photographs, without details."""
    views, features = _views(target, described, poses)
    descriptor = F.normalize(described.descriptor, dim=1)[poses.photograph.to(views.device)]
    similarity = (F.normalize(views, dim=1) * descriptor).sum(dim=1).double().cpu()
    return Evidence.measured(
        rank=poses.rank,
        similarity=similarity,
        edge_support=poses.edge_support,
        appearance=_appearance(target, described, poses, features),
        keypoints=counting_keypoints(target, described, poses),
        contours=_contours(target, described, poses),
    )


def with_evidence(target: Target, described: Described, poses: Hypotheses) -> Hypotheses:
    """Poses with their :func:`evidence_of`."""
    return replace(poses, evidence=evidence_of(target, described, poses))


def _views(target: Target, described: Described, poses: Hypotheses) -> tuple[Tensor, Tensor | None]:
    """(N, D) descriptors of the poses' views, and the features (N, F) of their pictures where the
    appearance counts."""
    has_frame = torch.tensor([frame is not None for frame in described.frames])
    in_frame = has_frame[poses.photograph] if len(has_frame) else poses.is_outside
    parts = [part for part in (~in_frame, in_frame) if bool(part.any())] or [~in_frame]
    found = [_views_alike(target, described, poses[part]) for part in parts]
    views = torch.cat([view for view, _ in found])
    features = [feature for _, feature in found if feature is not None]
    together = torch.cat(features) if features else None
    if len(parts) == 1:
        return views, together
    back = torch.cat([part.nonzero()[:, 0] for part in parts]).argsort().to(views.device)
    return views[back], None if together is None else together[back]


def _views_alike(
    target: Target, described: Described, poses: Hypotheses
) -> tuple[Tensor, Tensor | None]:
    """The same of poses that are all compared in frames, or all by themselves."""
    frames = [
        frame
        for frame in (described.frames[p] for p in poses.photograph.tolist())
        if frame is not None
    ]
    shaded = bool(described.rankings) and Appearance.name in described.rankings[0].terms
    if frames:
        T = poses.T
        K = torch.stack([frame.transform for frame in frames]) @ poses.cameras
    else:
        T, K, _ = target.describer.cameras(poses.rotation, poses.distance)
    fields, pictures = target.describer.seen_by(T, K, shaded=shaded)
    if frames:
        inside = torch.stack([frame.inside for frame in frames]).to(fields.device)
        fields = fields * inside
        pictures = None if pictures is None else pictures.masked_fill(~inside, BACKGROUND)
    views = target.describer.descriptor(fields)
    return views, None if pictures is None else target.matcher.appearance_of(pictures)


def _appearance(
    target: Target, described: Described, poses: Hypotheses, features: Tensor | None
) -> Tensor:
    """(N,) log appearance scores; 0 without that term."""
    if features is None:
        return torch.zeros(len(poses), dtype=torch.float64)
    return target.matcher.appearance_scores(
        described.query, described.rankings, features, poses.photograph
    )


def counting_keypoints(target: Target, described: Described, poses: Hypotheses) -> Tensor:
    """(N,) number of keypoints that agree with poses, beyond those that agree by chance."""
    count = agreeing_keypoints(described, poses)
    return (count - target.pipeline.fit.chance_keypoints).clamp(min=0.0)


def agreeing_keypoints(described: Described, poses: Hypotheses) -> Tensor:
    """(N,) float64 number of keypoints that agree with poses."""
    count = torch.zeros(len(poses), dtype=torch.float64)
    for photograph, keypoints in enumerate(described.keypoints):
        rows = poses.of(photograph) if keypoints is not None else None
        if rows is not None and keypoints is not None and len(rows):
            agreeing = keypoints.agreeing(poses.T[rows], poses.cameras[rows])
            count[rows] = agreeing.to(count)
    return count


def _contours(target: Target, described: Described, poses: Hypotheses) -> Tensor:
    """(N,) see :func:`.contour_evidence`; 0 without the contour fit."""
    if described.crops is None:
        return torch.zeros(len(poses), dtype=torch.float64)
    contours = target.describer.device_contours
    given = poses.cameras, poses.T, poses.photograph
    return on_device(contour_evidence, contours, described.crops, *given)


def with_details(
    target: Target, crops: EdgeCrops, poses: Hypotheses, best: Tensor, rivals: Tensor
) -> Hypotheses:
    """Poses whose ``rivals`` (R,) are compared in detail with the best one (P,) of the same
    photograph."""
    index = torch.cat([best, rivals])
    some = poses[index]
    contours = target.describer.device_contours
    given = some.cameras, some.T, some.photograph
    seen = on_device(contour_details, contours, crops, *given)
    details = poses.evidence.details.clone()
    for place, row in enumerate(best.tolist()):
        others = (some.photograph == poses.photograph[row]).nonzero()[:, 0]
        others = others[others >= len(best)]
        if len(others):
            scores, _ = compared(seen[torch.cat([torch.tensor([place]), others])])
            details[index[others]] = details[row] + scores[1:, 0].to(details)
    return replace(poses, evidence=replace(poses.evidence, details=details))
