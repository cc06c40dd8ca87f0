"""Limits on the poses of a batch of photographs, applied to views of a bank and to poses."""

from collections.abc import Iterator, Sequence
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
from .inputs import ImageItem
from .poses import Poses

__all__ = ["BatchPriors"]

VIEW_SPACING = 7.5
"""Degrees by which the limits are widened for views of a bank: each stands for the poses up to halfway to the next."""

FIT_TOLERANCE = 3.0
"""Degrees by which the contour fit may leave the limits: it measures more precisely than limits are usually known."""

AT_LIMIT_ANGLE = 1.0
"""Degrees from a limit within which a result is reported to lie at the limit."""

DISTANCE_TOLERANCE, AT_LIMIT_DISTANCE = 0.03, 0.01
"""The same two for the distance, as fractions of its limits."""

BOX_DISTANCE_TOLERANCE = 0.1
"""Fraction of a limit by which the distance at which the mesh fills the box may miss it: boxes are not exact."""

MOVES_INTO_LIMITS = 8
"""Times that a rotation is moved into all limits one after the other: a later limit may undo an earlier one."""


class BatchPriors:
    """Limits on the poses of B photographs, all with a camera matrix or all without.

    The limits hold for rotations in the photograph's own camera; without a camera matrix, in one that looks straight at
    the box. Views are allocentric, and are rotated towards the ray through the centre of the box.
    """

    def __init__(self, items: Sequence[ImageItem], bank: ViewBank) -> None:
        self._priors = [item.prior for item in items]
        self._up, self._centre, self._radius = mesh_up(bank.mesh), mesh_centre(bank.mesh), mesh_radius(bank.mesh)
        self._towards = torch.eye(3, dtype=torch.float64).repeat(len(items), 1, 1)
        matrices = [item.camera_matrix.double() for item in items if item.camera_matrix is not None]
        if matrices:
            boxes = torch.stack([item.box for item in items])
            centres = (boxes[:, :2] + boxes[:, 2:]).double() / 2.0
            rays = torch.linalg.solve(torch.stack(matrices), F.pad(centres, (0, 1), value=1.0))
            self._towards = rotation_towards(rays)

    def allowed(self, bank: ViewBank, *, off_centre: float = 0.0) -> Tensor:
        """(B, N) bool: views of the bank within the limits; objects may lie ``off_centre`` degrees from the rays
        through their boxes.

        Raises:
            InvalidInputError: the limits of a photograph leave no view, or all distances are inside the object.
        """
        views = bank.rotations.cpu().double()
        out = torch.ones(len(self._priors), len(views), dtype=torch.bool)
        for b, prior in enumerate(self._priors):
            if prior is None:
                continue
            if prior.distance is not None and prior.distance[1] < self._radius:
                raise InvalidInputError(
                    f"distance: at most {prior.distance[1]:g} from the centre, the camera is inside the object, "
                    f"whose radius is {self._radius:.3g}; give distances in the mesh's unit"
                )
            excess = prior.excess(self._towards[b] @ views, self._frame(prior))
            out[b] = excess <= VIEW_SPACING + off_centre + 1e-4
            if not bool(out[b].any()):
                message = f"no view of the bank lies within {prior.to_dict()}; widen it, or leave it out"
                raise InvalidInputError(f"prior: {message}")
        return out

    def moved_inside(self, image_index: Tensor, rotation: Tensor) -> Tensor:
        """Allocentric rotations (H, 3, 3), each moved into the limits of its photograph, no further than it must be."""
        rotation = rotation.clone()
        for h, prior in self._each(image_index):
            Q, frame = self._towards[int(image_index[h])], self._frame(prior)
            for _ in range(MOVES_INTO_LIMITS):
                if float(prior.excess(Q @ rotation[h], frame)) <= 0.0:
                    break
                rotation[h] = Q.mT @ prior.nearest(Q @ rotation[h], frame)
        return rotation

    def at_distance(self, poses: Poses) -> Poses:
        """Poses moved along the ray through the object's centre, no further than limits on the distance ask for."""
        T = poses.T.clone()
        for h, (near, far), centre, away in self._each_distance(poses):
            T[h, :3, 3] += (min(max(away, near), far) / away - 1.0) * centre
        return replace(poses, T=T)

    def keeps(self, poses: Poses) -> Tensor:
        """(H,) bool: whether poses leave the limits by no more than the tolerances."""
        return (self._excess(poses) <= FIT_TOLERANCE) & (self._distance_excess(poses) <= DISTANCE_TOLERANCE)

    def limits_of(self, b: int) -> PosePrior | None:
        """The limits of one photograph."""
        return self._priors[b]

    def contradiction(self, best: Poses, filling: Poses, *, better_outside: bool) -> str | None:
        """How the best pose of a photograph contradicts its limits, see :attr:`Registration.prior_contradiction`.

        Args:
            best: one pose.
            filling: the same, at the distance at which the mesh fills the box.
            better_outside: whether a pose outside the limits has a higher score.
        """
        if better_outside or bool(self._distance_excess(filling) > BOX_DISTANCE_TOLERANCE):
            return "better outside"
        excess, distance_excess = float(self._excess(best)), float(self._distance_excess(best))
        return "at the limit" if excess > -AT_LIMIT_ANGLE or distance_excess > -AT_LIMIT_DISTANCE else None

    def _excess(self, poses: Poses) -> Tensor:
        """(H,) degrees by which rotations in the photographs' cameras miss the limits; -180 without limits."""
        out = torch.full((len(poses),), -180.0, dtype=torch.float64)
        for h, prior in self._each(poses.image_index):
            out[h] = prior.excess(poses.T[h, :3, :3], self._frame(prior))
        return out

    def _distance_excess(self, poses: Poses) -> Tensor:
        """(H,) fractions by which the distances of poses miss their limits, negative within."""
        out = torch.full((len(poses),), -1.0, dtype=torch.float64)
        for h, (near, far), _, away in self._each_distance(poses):
            out[h] = max(1.0 - away / near, away / far - 1.0)
        return out

    def _frame(self, prior: PosePrior) -> Tensor:
        return object_frame(self._up, prior.front)

    def _each(self, image_index: Tensor) -> Iterator[tuple[int, PosePrior]]:
        """Index and limits of each pose whose photograph has some."""
        for h, b in enumerate(image_index.tolist()):
            if (prior := self._priors[b]) is not None:
                yield h, prior

    def _each_distance(self, poses: Poses) -> Iterator[tuple[int, tuple[float, float], Tensor, float]]:
        """Index, limits, object's centre (3,) in the camera and its distance, where the distance is limited."""
        for h, prior in self._each(poses.image_index):
            if prior.distance is not None:
                centre = poses.T[h, :3, :3] @ self._centre.to(poses.T) + poses.T[h, :3, 3]
                yield h, prior.distance, centre, float(centre.norm())
