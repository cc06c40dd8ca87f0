"""OpenCV pinhole cameras, projection, and poses from the box that an object fills."""

import math
from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.aliases import Size
from ..utils.checks import (
    check_camera_matrix,
    check_finite,
    check_last_axes,
    check_number,
    check_pose,
    check_rotation,
)
from ..utils.precision import full_precision
from .conversions import cross_matrix, matrix_of_rows

MAX_BOX_ITERATIONS = 20
MIN_BOX_STEP = 1e-9  # change of the position in an iteration, relative to the position


def camera_matrix(
    fx: float, fy: float, cx: float, cy: float, *, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Return the (3, 3) OpenCV camera matrix; all arguments in px.

    Example:
        >>> camera_matrix(800.0, 800.0, 319.5, 239.5)[0].tolist()
        [800.0, 0.0, 319.5]
    """
    fx, fy, cx, cy = (
        check_number(v, name) for v, name in ((fx, "fx"), (fy, "fy"), (cx, "cx"), (cy, "cy"))
    )
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=dtype)
    check_camera_matrix(K)
    return K


def camera_numbers(K: Tensor) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a (3, 3) camera matrix, as :func:`camera_matrix` takes them.

    Example:
        >>> camera_numbers(camera_matrix(800.0, 810.0, 319.5, 239.5))
        (800.0, 810.0, 319.5, 239.5)
    """
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return fx, fy, cx, cy


def camera_of_view(fov: float, size: Size) -> Tensor:
    """(3, 3) float64 camera matrix of a horizontal field of view, 0 < ``fov`` < 180 degrees, and an
    (H, W) in px, with square pixels and the principal point in the centre."""
    if not (isinstance(fov, int | float) and 0.0 < fov < 180.0):
        raise InvalidInputError(
            f"fov: expected 0 < degrees < 180 across the image's width, got {fov!r}"
        )
    H, W = size
    focal = W / 2 / math.tan(math.radians(fov) / 2)
    return camera_matrix(focal, focal, (W - 1) / 2, (H - 1) / 2)


def transform(R: Tensor, t: Tensor) -> Tensor:
    """(..., 4, 4) rigid transform from (..., 3, 3) and (..., 3).

    Example:
        >>> transform(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))[:3, 3].tolist()
        [1.0, 2.0, 3.0]
    """
    top = torch.cat([R, t[..., None]], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=R.dtype, device=R.device).expand(
        *top.shape[:-2], 1, 4
    )
    return torch.cat([top, bottom], dim=-2)


def point_in_cameras(T: Tensor, point: Tensor) -> Tensor:
    """(..., 3) a point (3,) of the model in the cameras of poses (..., 4, 4).

    Example:
        >>> T = transform(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
        >>> point_in_cameras(T, torch.tensor([1.0, 0.0, 0.0])).tolist()
        [1.0, 0.0, 2.0]
    """
    place: Tensor = T[..., :3, :3] @ point + T[..., :3, 3]
    return place


def pose_around(R: Tensor, place: Tensor, point: Tensor) -> Tensor:
    """(..., 4, 4) poses of rotations (..., 3, 3) that have a point (3,) of the model at a ``place``
    (..., 3).

    Example:
        >>> T = pose_around(torch.eye(3), torch.tensor([1.0, 0.0, 2.0]), torch.ones(3))
        >>> T[:3, 3].tolist()
        [0.0, -1.0, 1.0]
    """
    return transform(R, place - R @ point)


@full_precision()
def project_points(
    points: Tensor, T_cam_from_model: Tensor, K: Tensor, *, orthographic: bool = False
) -> Tensor:
    """(..., P, 2) pixel coordinates of model points, as ``cv2.projectPoints`` gives without
    distortion.

    Args:
        points: (P, 3) or (N, P, 3) in model units.
        T_cam_from_model: (N, 4, 4) or (4, 4), rigid and finite.
        K: (N, 3, 3) or (3, 3), without skew.
        orthographic: do not divide by z; focal lengths are in px per model unit.

    Example:
        >>> K = camera_matrix(100.0, 100.0, 50.0, 50.0)
        >>> T = transform(torch.eye(3), torch.tensor([0.0, 0.0, 2.0])).double()
        >>> project_points(torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64), T, K).tolist()
        [[100.0, 50.0]]
    """
    check_last_axes(points, "points", (None, 3))
    check_pose(T_cam_from_model, "T_cam_from_model")
    check_camera_matrix(K)
    given = points, T_cam_from_model, K
    dtype = reduce(torch.promote_types, (x.dtype for x in given))
    return projected(*(x.to(dtype) for x in given), orthographic=orthographic)


def projected(
    points: Tensor, T_cam_from_model: Tensor, K: Tensor, *, orthographic: bool = False
) -> Tensor:
    """:func:`project_points` without its checks, for loops over poses that the library has
    computed."""
    cam = points @ T_cam_from_model[..., :3, :3].mT + T_cam_from_model[..., None, :3, 3]
    xy = cam[..., :2] if orthographic else cam[..., :2] / cam[..., 2:]
    return xy @ K[..., :2, :2].mT + K[..., None, :2, 2]


def projected_boxes(
    points: Tensor, T_cam_from_model: Tensor, K: Tensor, *, orthographic: bool = False
) -> Tensor:
    """(..., 4) boxes x0, y0, x1, y1 around projected model points, which must be in front of a
    perspective camera.

    Example:
        >>> points = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]).double()
        >>> T = transform(torch.eye(3), torch.tensor([0.0, 0.0, 5.0])).double()
        >>> projected_boxes(points, T, camera_matrix(100.0, 100.0, 50.0, 50.0)).tolist()
        [30.0, 30.0, 70.0, 70.0]
    """
    return boxes_around(project_points(points, T_cam_from_model, K, orthographic=orthographic))


def boxes_around(pixels: Tensor) -> Tensor:
    """(..., 4) smallest boxes x0, y0, x1, y1 around (..., P, 2) pixel coordinates."""
    return torch.cat([pixels.amin(dim=-2), pixels.amax(dim=-2)], dim=-1)


def boxes_of(
    points: Tensor, T_cam_from_model: Tensor, K: Tensor, *, orthographic: bool = False
) -> Tensor:
    """(..., 4) :func:`projected_boxes` of points (P, 3), without their checks."""
    T = T_cam_from_model.reshape(-1, 4, 4)
    # A row's largest element is found in a tenth of the time of a column's.
    cam = torch.baddbmm(T[:, :3, 3:], T[:, :3, :3], points.T.expand(len(T), -1, -1))
    xy = cam[:, :2] if orthographic else cam[:, :2] / cam[:, 2:]
    focal = K[..., :2, :2].diagonal(dim1=-2, dim2=-1)
    ends = (end.view(*T_cam_from_model.shape[:-2], 2) for end in (xy.amin(dim=-1), xy.amax(dim=-1)))
    return torch.cat([end * focal + K[..., :2, 2] for end in ends], dim=-1)


def rotation_towards(rays: Tensor) -> Tensor:
    """(..., 3, 3) smallest rotations with ``R (0, 0, 1) = ray / |ray|``, for (..., 3) rays with z >
    0: they turn allocentric rotations into poses.

    Example:
        >>> place = torch.tensor([0.0, 0.0, 4.0])
        >>> torch.equal(rotation_towards(place), torch.eye(3))
        True
    """
    x, y, z = (rays / torch.linalg.vector_norm(rays, dim=-1, keepdim=True)).unbind(-1)
    # Rodrigues with axis (0, 0, 1) x ray = (-y, x, 0): R = I + [v] + [v]^2 / (1 + z).
    f = 1.0 / (1.0 + z)
    rows = [1.0 - f * x * x, -f * x * y, x], [-f * x * y, 1.0 - f * y * y, y], [-x, -y, z]
    return matrix_of_rows(rows)


def turn_with_ray(position: Tensor) -> Tensor:
    """(3, 3) derivative of :func:`rotation_towards` by the position (3,), as rotation vectors: that
    of the rotation between two near positions is the matrix times their difference."""
    distance = torch.linalg.vector_norm(position)
    ray = position / distance
    x, y, z = ray.unbind()
    roll = torch.stack([y, -x, torch.zeros_like(x)]) / (1.0 + z)
    turn: Tensor = (cross_matrix(ray) + torch.outer(ray, roll)) / distance
    return turn


def pose_from_box(
    points: Tensor, rotation: Tensor, box: Tensor, K: Tensor
) -> tuple[Tensor, Tensor]:
    """Estimate the pose with which the projected points fill a box, with the object in front of the
    camera: the fixed point of two closed-form steps. The sizes of the projected and the given box
    determine the distance (least squares over width and height), their centres the offset, towards
    which the rotation turns.

    Args:
        points: (P, 3) of the model, for instance the vertices of its convex hull.
        rotation: (..., 3, 3) model -> camera, as seen by a camera that looks straight at the
            object's centre.
        box: (..., 4) x0, y0, x1, y1 in px.
        K: (..., 3, 3).

    Returns:
        rotation (..., 3, 3) and translation (..., 3) in the photograph's camera, float64, in model
        units.

    Raises:
        InvalidInputError: a matrix is not a rotation, the box is empty, or the camera matrix is
            unusable.

    Example:
        >>> cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3)
        >>> K = camera_matrix(100.0, 100.0, 50.0, 50.0)
        >>> T = transform(torch.eye(3), torch.tensor([0.0, 0.0, 6.0])).double()
        >>> box = projected_boxes(cube, T, K)
        >>> R, t = pose_from_box(cube, torch.eye(3).double(), box, K)
        >>> [round(x, 3) for x in t.tolist()]
        [0.0, 0.0, 6.0]
    """
    check_finite(rotation, "rotation")
    check_rotation(rotation, "rotation")
    check_camera_matrix(K)
    if not bool((box[..., 2:] > box[..., :2]).all() and box.isfinite().all()):
        raise InvalidInputError(f"box: expected finite X0 < X1 and Y0 < Y1, got {box.tolist()}")
    points, view, box, K = (v.detach().cpu().double() for v in (points, rotation, box, K))
    centre = 0.5 * (points.amin(dim=0) + points.amax(dim=0))
    centred = points - centre
    extent = torch.linalg.vector_norm(centred, dim=1).max()
    size = box[..., 2:] - box[..., :2]
    middle = 0.5 * (box[..., :2] + box[..., 2:])
    inverse = torch.linalg.inv(K)
    # Start far enough away for every point to be in front of the camera.
    z = torch.maximum(2.0 * extent * K[..., 0, 0] / size.amax(dim=-1), 2.0 * extent)
    position = (inverse @ F.pad(middle, (0, 1), value=1.0)[..., None])[..., 0] * z[..., None]
    R = view
    moving = torch.ones_like(z, dtype=torch.bool)
    for _ in range(MAX_BOX_ITERATIONS):
        # Each pose stops on its own: it does not depend on the others.
        R = torch.where(moving[..., None, None], rotation_towards(position) @ view, R)
        low, high = boxes_of(centred, transform(R, position), K).split(2, dim=-1)
        zoom = ((high - low) * size).sum(dim=-1, keepdim=True) / (size * size).sum(
            dim=-1, keepdim=True
        )
        offset = F.pad(middle - 0.5 * (low + high), (0, 1))
        # Move sideways at the object's depth, then along its ray; never closer than its own extent.
        moved = position + (inverse @ offset[..., None])[..., 0] * position[..., 2:]
        moved = moved * torch.maximum(zoom, 1.05 * extent / moved[..., 2:])
        step = torch.linalg.vector_norm(moved - position, dim=-1)
        position = torch.where(moving[..., None], moved, position)
        moving = moving & (step > MIN_BOX_STEP * torch.linalg.vector_norm(position, dim=-1))
        if not bool(moving.any()):
            break
    return R, position - R @ centre
