"""Pose priors of a batch of photographs, applied to views of a bank and to hypotheses."""

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry.cameras import rotation_towards
from ..geometry.pose_prior import PosePrior, object_frame
from ..matching import ViewBank
from ..mesh import mesh_up
from ..mesh.mesh import mesh_centre, mesh_radius
from .hypotheses import Hypotheses
from .inputs import ImageItem
from .results import Registration

__all__ = ["BatchPriors"]

VIEW_SPACING = 7.5
"""Degrees by which the limits are widened for views of a bank: each stands for the poses up to halfway to the next."""

TOLERANCE = 3.0
"""Degrees by which the contour fit may leave the limits: it measures more precisely than limits are usually known."""

AT_LIMIT = 1.0
"""Degrees from a limit within which a result is reported to lie at the limit."""

DISTANCE_TOLERANCE, AT_DISTANCE = 0.03, 0.01
"""The same two for the distance, as fractions of its limits."""

BOX_TOLERANCE = 0.1
"""Fraction of a limit by which the distance at which the mesh fills the box may miss it: boxes are not exact."""

LOW_RATIO = 0.25
"""Ratio of the best scores with and without the prior below which the photograph contradicts the prior."""


class BatchPriors:
    """Limits on the poses of B photographs, all with a camera matrix or all without.

    The limits hold for rotations in the photograph's own camera. Views and hypotheses are allocentric, and are rotated
    towards the ray through the centre of the box.
    """

    def __init__(self, items: Sequence[ImageItem], bank: ViewBank) -> None:
        self._priors = [item.prior for item in items]
        self._meshes, self._ups = bank.meshes, [mesh_up(mesh) for mesh in bank.meshes]
        self._towards = torch.eye(3, dtype=torch.float64).repeat(len(items), 1, 1)
        matrices = [item.camera_matrix.double() for item in items if item.camera_matrix is not None]
        if matrices:
            boxes = torch.stack([item.box for item in items])
            centres = (boxes[:, :2] + boxes[:, 2:]).double() / 2.0
            rays = torch.linalg.solve(torch.stack(matrices), F.pad(centres, (0, 1), value=1.0))
            self._towards = rotation_towards(rays)

    def log_prior(self, bank: ViewBank, *, off_centre: float = 0.0) -> Tensor:
        """(B, N) of the views of a bank; objects may lie ``off_centre`` degrees from the rays through their boxes.

        Raises:
            InvalidInputError: the limits of a photograph leave no view, or all distances are inside the object.
        """
        least = min(map(mesh_radius, self._meshes))
        views, model = bank.rotations.cpu().double(), bank.model.cpu()
        out = torch.zeros(len(self._priors), len(views), dtype=torch.float64)
        for b, prior in enumerate(self._priors):
            if prior is None:
                continue
            if prior.distance is not None and prior.distance[1] < least:
                raise InvalidInputError(
                    f"distance: at most {prior.distance[1]:g} from the centre, the camera is inside the object, "
                    f"whose radius is {least:.3g}; give distances in the mesh's unit"
                )
            for m in model.unique().tolist():
                mine = model == m
                frame = object_frame(self._ups[m], prior.front)
                out[b, mine] = prior.log_prior(self._towards[b] @ views[mine], frame, margin=VIEW_SPACING + off_centre)
            if bool((out[b] == -torch.inf).all()):
                raise InvalidInputError(
                    f"prior: no view of the bank lies within {prior.to_dict()}; widen it, or leave it out"
                )
        return out

    def moved_inside(self, hypotheses: Hypotheses) -> Hypotheses:
        """Hypotheses with rotations moved into hard limits, each no further than it must be."""
        rotation = hypotheses.rotation.clone()
        for h, prior, frame, Q in self._each(hypotheses):
            if float(prior.excess(Q @ rotation[h], frame)) > 0.0:
                rotation[h] = Q.mT @ prior.nearest(Q @ rotation[h], frame)
        return replace(hypotheses, rotation=rotation)

    def allow(self, hypotheses: Hypotheses, candidates: Tensor) -> Tensor:
        """(H, C) bool: whether (H, C, 3, 3) rotations lie within the hard limits of their hypotheses' photographs."""
        allowed = torch.ones(candidates.shape[:2], dtype=torch.bool)
        for h, prior, frame, Q in self._each(hypotheses):
            allowed[h] = prior.excess(Q @ candidates[h], frame) <= 1e-3
        return allowed

    def excess(self, hypotheses: Hypotheses, rotations: Tensor) -> Tensor:
        """(H,) degrees by which (H, 3, 3) rotations in the photographs' cameras miss the limits."""
        out = torch.zeros(len(hypotheses), dtype=torch.float64)
        for h, prior, frame, _ in self._each(hypotheses):
            out[h] = prior.excess(rotations[h], frame)
        return out

    def at_distance(self, hypotheses: Hypotheses, T: Tensor) -> Tensor:
        """(H, 4, 4) poses moved along the ray through the object's centre, no further than limits on it ask for."""
        moved = T.clone()
        for h, (near, far), centre, away in self._each_distance(hypotheses, T):
            moved[h, :3, 3] += (min(max(away, near), far) / away - 1.0) * centre
        return moved

    def keeps(self, hypotheses: Hypotheses, T: Tensor) -> Tensor:
        """(H,) bool: whether fitted (H, 4, 4) poses leave the hard limits by no more than the tolerances."""
        keep = self.excess(hypotheses, T[:, :3, :3]) <= TOLERANCE
        return keep & (self._distance_excess(hypotheses, T) <= DISTANCE_TOLERANCE)

    def note(self, registration: Registration, best: Hypotheses, T: Tensor, T_filling: Tensor) -> Registration:
        """The registration with its prior, and how its best hypothesis contradicts it.

        Args:
            registration: of one photograph.
            best: its hypothesis, one.
            T, T_filling: (1, 4, 4) its pose, and the one at which the mesh fills the box.
        """
        prior, ratio = self._priors[int(best.image_index)], registration.ranking.prior_ratio
        if prior is None:
            return registration
        excess, distance_excess = self.excess(best, T[:, :3, :3]), self._distance_excess(best, T)
        contradiction = None
        if float(excess) > -AT_LIMIT or float(distance_excess) > -AT_DISTANCE:
            contradiction = "at the limit"
        if (ratio is not None and float(ratio) < LOW_RATIO) or self._distance_excess(best, T_filling) > BOX_TOLERANCE:
            contradiction = "better outside"
        return replace(registration, prior=prior, prior_contradiction=contradiction)

    def _distance_excess(self, hypotheses: Hypotheses, T: Tensor) -> Tensor:
        """(H,) fractions by which the distances of (H, 4, 4) poses miss their limits, negative within."""
        out = torch.full((len(hypotheses),), -1.0, dtype=torch.float64)
        for h, (near, far), _, away in self._each_distance(hypotheses, T):
            out[h] = max(1.0 - away / near, away / far - 1.0)
        return out

    def _each_distance(self, hypotheses: Hypotheses, T: Tensor) -> list[tuple[int, tuple[float, float], Tensor, float]]:
        """Index, limits, object's centre (3,) in the camera and its distance, where the distance is limited."""
        known = []
        for h, prior, _, _ in self._each(hypotheses):
            if prior.distance is not None:
                mesh = self._meshes[int(hypotheses.model[h])]
                centre = T[h, :3, :3] @ mesh_centre(mesh).to(T) + T[h, :3, 3]
                known.append((h, prior.distance, centre, float(centre.norm())))
        return known

    def _each(self, hypotheses: Hypotheses) -> list[tuple[int, PosePrior, Tensor, Tensor]]:
        """Index, prior, frame of the mesh and rotation towards the box of each hypothesis that has a prior."""
        known = []
        for h, (b, m) in enumerate(zip(hypotheses.image_index.tolist(), hypotheses.model.tolist(), strict=True)):
            prior = self._priors[b]
            if prior is not None:
                known.append((h, prior, object_frame(self._ups[m], prior.front), self._towards[b]))
        return known
