"""Limits on the pose in a photograph, applied to views of a bank and to poses."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..geometry.pose_prior import object_frame
from ..matching import ViewBank
from ..mesh import mesh_up
from ..mesh.mesh import mesh_centre, mesh_radius
from .hypotheses import Hypotheses, placed
from .inputs import ImageItem

# Degrees by which the limits are widened for views of a bank: each stands for the poses up to
# halfway to the next
VIEW_SPACING = 7.5
# Degrees by which the contour fit may leave the limits: it measures more precisely than limits are
# usually known
FIT_TOLERANCE = 3.0
AT_LIMIT_ANGLE = 1.0  # Degrees from a limit within which a result is reported to lie at the limit
# The same two for the distance, as fractions of its limits
DISTANCE_TOLERANCE = 0.03
AT_LIMIT_DISTANCE = 0.01
# Fraction of a limit by which the distance at which the mesh fills the box may miss it: boxes are
# not exact
BOX_DISTANCE_TOLERANCE = 0.1


class Limits:
    """The limits of a photograph's ``prior``, for rotations in its own camera; without a camera
    matrix, in one that looks straight at the box. Views are allocentric, and are rotated towards
    the ray through the centre of the box, which is known to ``off_centre`` degrees."""

    def __init__(self, item: ImageItem, bank: ViewBank, *, off_centre: float = 0.0) -> None:
        assert item.prior is not None
        self._off_centre = off_centre
        self.prior = item.prior
        self._bank = bank
        self._frame = object_frame(mesh_up(bank.mesh), item.prior.front)
        self._centre = mesh_centre(bank.mesh)
        self._towards = torch.eye(3, dtype=torch.float64)
        if item.camera_matrix is not None:
            centre = (item.box[:2] + item.box[2:]).double() / 2.0
            ray = torch.linalg.solve(item.camera_matrix.double(), F.pad(centre, (0, 1), value=1.0))
            self._towards = rotation_towards(ray)

    def allowed(self, *, off_centre: float = 0.0) -> Tensor:
        """(N,) bool: views of the bank within the limits; the object may lie ``off_centre`` degrees
        from the ray through its box. Refuses limits that leave no view, or only distances inside
        the object."""
        radius = mesh_radius(self._bank.mesh)
        distance = self.prior.distance
        if distance is not None and distance[1] < radius:
            raise InvalidInputError(
                f"distance: at most {distance[1]:g} from the centre, the camera is inside the "
                f"object, "
                f"whose radius is {radius:.3g}; give distances in the mesh's unit"
            )
        excess = self.prior.excess(self._towards @ self._bank.rotations.cpu().double(), self._frame)
        allowed = excess <= VIEW_SPACING + self._off_centre + off_centre + 1e-4
        if not bool(allowed.any()):
            message = (
                f"no view of the bank lies within {self.prior.to_dict()}; widen it, or leave it out"
            )
            raise InvalidInputError(f"prior: {message}")
        return allowed

    def moved_inside(self, poses: Hypotheses) -> Hypotheses:
        """Poses turned about the object's centre, and moved along the ray through it, as far as
        limits ask for."""
        beyond = self._excess(poses) > 0.0
        far = self._distance_excess(poses) > 0.0
        if not bool((beyond | far).any()):
            return poses
        centre = self._positions(poses.T)
        if self.prior.distance is not None:
            away = torch.linalg.vector_norm(centre, dim=1, keepdim=True)
            centre = (
                torch.where(far[:, None], away.clamp(*self.prior.distance) / away, 1.0) * centre
            )
        R = poses.T[:, :3, :3]
        R = torch.where(beyond[:, None, None], self.prior.nearest(R, self._frame), R)
        moved = pose_around(R, centre, self._centre)
        T = torch.where((beyond | far)[:, None, None], moved, poses.T)
        return placed(poses, T, self._centre)

    def keeps(self, poses: Hypotheses) -> Tensor:
        """(H,) bool: whether poses leave the limits by no more than the tolerances."""
        return (self._excess(poses) <= FIT_TOLERANCE) & (
            self._distance_excess(poses) <= DISTANCE_TOLERANCE
        )

    def contradiction(
        self, best: Hypotheses, filling: Hypotheses, *, better_outside: bool
    ) -> str | None:
        """See :attr:`Registration.prior_contradiction`, of the best pose; ``filling`` is the same
        at the distance at which the mesh fills the box, ``better_outside`` whether a pose outside
        has a higher score."""
        if better_outside or bool(self._distance_excess(filling) > BOX_DISTANCE_TOLERANCE):
            return "better outside"
        at_limit = (
            self._excess(best) > -AT_LIMIT_ANGLE,
            self._distance_excess(best) > -AT_LIMIT_DISTANCE,
        )
        return "at the limit" if any(map(bool, at_limit)) else None

    def _excess(self, poses: Hypotheses) -> Tensor:
        """(H,) degrees by which rotations in the photograph's camera miss the limits, negative
        within."""
        return self.prior.excess(poses.T[:, :3, :3], self._frame)

    def _distance_excess(self, poses: Hypotheses) -> Tensor:
        """(H,) fractions by which the distances of poses miss their limits, negative within; -1
        without limits."""
        away = torch.linalg.vector_norm(self._positions(poses.T), dim=1)
        if self.prior.distance is None:
            return torch.full_like(away, -1.0)
        near, far = self.prior.distance
        return torch.maximum(1.0 - away / near, away / far - 1.0)

    def _positions(self, T: Tensor) -> Tensor:
        """(H, 3) positions of the object's centre in the camera."""
        return point_in_cameras(T, self._centre)
