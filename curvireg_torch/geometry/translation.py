"""Poses from the box that an object fills."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_camera_matrix, check_finite, check_rotation
from .cameras import boxes_around, projected, rotation_towards, transform

_ITERATIONS = 20
_CONVERGED = 1e-9  # change of the position in an iteration, relative to the position


def pose_from_box(
    points: Tensor, rotation: Tensor, box: Tensor, K: Tensor, *, allocentric: bool = True
) -> tuple[Tensor, Tensor]:
    """Estimate the pose with which the projected points fill a box, with the object in front of the camera.

    Fixed point of two closed-form steps: the sizes of the projected and the given box determine the distance, their
    centres the offset. With the true rotation and box it converges to the true translation; with others, to the best
    scale (least squares over width and height) with equal centres.

    Args:
        points: (P, 3) of the model, for instance the vertices of its convex hull.
        rotation: (..., 3, 3) model -> camera. Allocentric: as seen by a camera that looks straight at the object's
            centre; every step rotates it towards the ray of the object's current centre.
        box: (..., 4) x0, y0, x1, y1 in px.
        K: (..., 3, 3).
        allocentric: whether the rotation is; otherwise it is kept.

    Returns:
        rotation (..., 3, 3) and translation (..., 3) in the photograph's camera, float64, in model units.

    Raises:
        InvalidInputError: a matrix is not a rotation, the box is empty, or the camera matrix is unusable.

    Example:
        >>> cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
        >>> K = torch.tensor([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
        >>> R, t = pose_from_box(cube, torch.eye(3), torch.tensor([25.0, 25, 75, 75]), K)
        >>> [round(v, 3) for v in t.tolist()]
        [0.0, 0.0, 5.0]
    """
    check_finite(rotation, "rotation")
    check_rotation(rotation, "rotation")
    check_camera_matrix(K)
    if not bool((box[..., 2:] > box[..., :2]).all() and box.isfinite().all()):
        raise InvalidInputError(f"box: expected finite X0 < X1 and Y0 < Y1, got {box.tolist()}")
    points, view, box, K = (v.detach().cpu().double() for v in (points, rotation, box, K))
    centre = 0.5 * (points.amin(dim=0) + points.amax(dim=0))
    extent = torch.linalg.vector_norm(points - centre, dim=1).max()
    size, middle = box[..., 2:] - box[..., :2], 0.5 * (box[..., :2] + box[..., 2:])
    inverse = torch.linalg.inv(K)
    # Start far enough away for every point to be in front of the camera.
    z = torch.maximum(2.0 * extent * K[..., 0, 0] / size.amax(dim=-1), 2.0 * extent)
    position = (inverse @ F.pad(middle, (0, 1), value=1.0)[..., None])[..., 0] * z[..., None]
    R, moving = view, torch.ones_like(z, dtype=torch.bool)
    for _ in range(_ITERATIONS):
        # Each pose stops on its own: it does not depend on the others.
        R = torch.where(moving[..., None, None], rotation_towards(position) @ view, R) if allocentric else view
        low, high = boxes_around(projected(points - centre, transform(R, position), K)).split(2, dim=-1)
        zoom = ((high - low) * size).sum(dim=-1, keepdim=True) / (size * size).sum(dim=-1, keepdim=True)
        offset = F.pad(middle - 0.5 * (low + high), (0, 1))
        # Move sideways at the object's depth, then along its ray; never closer than its own extent.
        moved = position + (inverse @ offset[..., None])[..., 0] * position[..., 2:]
        moved = moved * torch.maximum(zoom, 1.05 * extent / moved[..., 2:])
        step = torch.linalg.vector_norm(moved - position, dim=-1)
        position = torch.where(moving[..., None], moved, position)
        moving = moving & (step > _CONVERGED * torch.linalg.vector_norm(position, dim=-1))
        if not bool(moving.any()):
            break
    return R, position - R @ centre
