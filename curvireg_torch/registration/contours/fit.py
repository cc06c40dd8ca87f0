"""Contour fit: the continuous stage of the refinement, which pulls projected contours onto image edges."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import InvalidInputError
from ...filters.inputs import fill_missing
from ...geometry.crops import crop_transforms, square_boxes
from ...rendering.contours import MeshContours
from ...terms import crop_regions
from ...utils.checks import (
    as_boxes,
    as_numbers,
    check_camera_matrix,
    check_photograph,
    check_pixels,
    check_pose,
    check_tensor,
)
from .covariance import pose_covariance
from .descent import ContourProblem, ContourState, apply_twist
from .mask import ObjectMask
from .points import EdgeField

__all__ = ["ContourFit", "contour_support", "fit_contours"]

SIZE = 256
"""Side of the crop in px; the first rounds use half of it."""

FIRST, SECOND, FINE = (6.0, 4.0), (3.0, 2.0), (4.0, 2.0, 2.0)
"""Search distance for edges in px, one a round: from all starting rotations and then from the best at half size, and
at full size."""

SAME = 0.5
"""Mean shift in px at half size below which two fits count as one."""

START_ANGLE, START_ROLL = 8.0, 6.0
"""Degrees by which the pose is rotated left, right, up and down, and about the line of sight, for further starts: about
half the spacing of a bank's views."""

SUPPORTED, GAINED = 0.5, 0.2
"""Edge support, or gain of it over the start, from which a fit is trusted; chosen on generated scenes."""


@dataclass(frozen=True)
class ContourFit:
    """N poses fitted to photographs.

    Attributes:
        transform: (N, 4, 4) float64 ``T_cam_from_model``.
        covariance: (N, 6, 6) float64, see :func:`fit_contours`; NaN where too few edges were found.
        edge_support: (N,) float64 in [0, 1), mean strength of the edges within about 1 px of the contour points.
        start_support: (N,) edge support of the starts (at half size for starts that are not finished).
        observable: (N,) int64, number of the six directions that the contours determine.
    """

    transform: Tensor
    covariance: Tensor
    edge_support: Tensor
    start_support: Tensor
    observable: Tensor

    def __getitem__(self, index: Tensor) -> "ContourFit":
        return ContourFit(*(getattr(self, f.name)[index] for f in fields(ContourFit)))

    @property
    def trustworthy(self) -> Tensor:
        """(N,) bool: edge support of at least 0.5, or 0.2 more than the start's; less where the mesh is another."""
        return (self.edge_support >= SUPPORTED) | (self.edge_support - self.start_support >= GAINED)


@torch.no_grad()
def fit_contours(
    contours: MeshContours,
    images: Tensor | Sequence[Tensor],
    boxes: Any,
    camera_matrices: Any,
    starts: Tensor,
    *,
    image_index: Tensor | None = None,
    margin: float = 0.1,
    finish: int | None = None,
    object_mask: Tensor | None = None,
) -> ContourFit:
    """Poses whose contours lie on a photograph's edges, by robust least squares over SE(3).

    At each start, occluding contours and creases of the mesh become 3D points X_i with image normals n_i
    (:class:`.MeshContours`), and edges of similar direction are searched along n_i. With d_i the distance to the
    selected edge and J_i = n_i^T du_i/dxi, every step solves

        (J^T W J + lambda diag(J^T W J)) xi = J^T W d,

    where W is the strength of the edge times Tukey's weight of the residual. Within a step, edges are selected again
    near the predicted position; the search distance shrinks from round to round, and the mesh is rendered again where
    contours have moved. The fit begins at half size from each start and from four poses rotated away from it; the best
    (by edge support, with a mask weighted as below) and the next best that differs from it continue, and end at full
    size. The start is returned where no fit has more of it. All starts of all photographs are rendered together.

    Prints, shadows and clutter have edges too. With an ``object_mask``, an edge counts for the outline as far as the
    object lies on its inner side alone, and for creases and inner contours as far as the object lies on both sides
    (:class:`.ObjectMask`); this weights the least squares and the choice among the fits, not the reported support.

    The covariance is of rotation (rad) about the camera's x, y, z, then translation (model units) along them: with the
    true pose R, t,

        R = exp([w]x) R_fit,   t = t_fit + e,   (w, e) of mean 0 and that covariance,

    see :func:`pose_covariance`; it is scaled by the errors of reliable results on photographs. Computed on the CPU.

    Args:
        contours: of the mesh.
        images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, in [0, 1] or uint8; or one photograph (C, H, W).
            Missing pixels (NaN or infinite) are filled from their neighbours.
        boxes: (B, 4) x0, y0, x1, y1 in px, which need not be exact; (4,) for one photograph.
        camera_matrices: (B, 3, 3) or (3, 3) in px; or (N, 3, 3), one for each start.
        starts: (N, 4, 4) rigid poses, within about 15 degrees.
        image_index: (N,) the photograph of each start; optional for one photograph.
        margin: added around the box, as a fraction of its longer side.
        finish: number of starts of each photograph that are fitted to the end, those with the most support after the
            first rounds; None: all, each as if alone.
        object_mask: (B, 1, s, s) probability that pixels of the square crops, the boxes with their margin, belong to
            the object, for instance of :meth:`LearnedCurvilinearSaliency.mask`.

    Raises:
        InvalidInputError: wrong shapes, a pose that is not rigid and finite, an unusable box or camera matrix.

    Example:
        >>> import curvireg_torch as cr, trimesh
        >>> from curvireg_torch.rendering.contours import MeshContours
        >>> K = torch.tensor([[200.0, 0, 63.5], [0, 200.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64); T[2, 3] = 5.0
        >>> T[:3, :3] = cr.rotation_from_viewpoint(30.0, 20.0, 5.0)
        >>> mesh = trimesh.creation.box((1, 1.5, 2))
        >>> image = (cr.render_depth(mesh, T[None], K, (128, 128))[0] > 0).float()
        >>> start = T.clone(); start[0, 3] = 0.1                                              # 2 % to the right
        >>> box = torch.tensor([24.0, 18, 102, 110])
        >>> fit = fit_contours(MeshContours(mesh), image, box, K, start[None])
        >>> abs(float(fit.transform[0, 0, 3])) < 0.01
        True
    """
    images, boxes, K, image_index = _checked(images, boxes, camera_matrices, starts, image_index)
    if finish is not None and not finish >= 1:
        raise InvalidInputError(f"finish: expected a whole number >= 1 or None, got {finish}")
    T0 = starts.detach().cpu().double()
    if (N := len(T0)) == 0:
        none = T0.new_zeros(0)
        return ContourFit(T0, T0.new_zeros(0, 6, 6), none, none, none.long())
    crops, full = full_size_problem(contours, images, boxes, K, image_index, margin)
    if object_mask is not None:
        check_tensor(object_mask, "object_mask", (len(images), 1, None, None))
        full = replace(full, mask=ObjectMask(object_mask))
    K = torch.tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]], dtype=torch.float64) @ full.K
    half = replace(full, edges=EdgeField(F.avg_pool2d(crops, 2)), K=K, size=SIZE // 2)
    before, weighted_before = half.supports(half.state(T0))
    around = _turned(T0, half.centre)
    M = around.shape[1]
    every = torch.arange(N).repeat_interleave(M)
    fits = half[every].descend(half[every].state(around.flatten(0, 1)), FIRST)
    supports = half[every].supports(fits)[1].view(N, M)
    support, best = supports.max(dim=1)
    first = fits[torch.arange(N) * M + best]
    chosen = torch.ones(N, dtype=torch.bool) if finish is None else _among_best(support, image_index, finish)
    index, others = chosen.nonzero()[:, 0], (~chosen).nonzero()[:, 0]
    source, T = _two_best(half, fits, supports, index)
    # Candidates: the starts, the half-size fits of unfinished starts, and the full-size fits. Ties go to the first.
    owner = torch.cat([index, others, index[source]])
    unfinished = torch.where((support > weighted_before)[others, None, None], first.T[others], T0[others])
    fixed = torch.cat([T0[index], unfinished])
    fitted = full[index[source]]
    state = ContourState.cat([full[owner[: len(fixed)]].state(fixed), fitted.descend(fitted.state(T), FINE)])
    support, weighted = full[owner].supports(state)
    before[index] = support[: len(index)]
    best = torch.where(owner == torch.arange(N)[:, None], weighted, -1.0).argmax(dim=1)
    state, support = state[best], support[best]
    matches = full.matches(state, FINE[-1])
    covariance, observable = pose_covariance(
        matches, state.points, state.T, full.K, contours.centre, radius=contours.radius
    )
    return ContourFit(state.T, covariance, edge_support=support, start_support=before, observable=observable)


@torch.no_grad()
def contour_support(
    contours: MeshContours,
    images: Tensor | Sequence[Tensor],
    boxes: Tensor,
    camera_matrices: Tensor,
    poses: Tensor,
    *,
    image_index: Tensor | None = None,
    margin: float = 0.1,
) -> Tensor:
    """(N,) edge support of poses that are not fitted, as :attr:`ContourFit.edge_support` is of fitted ones.

    Arguments and errors are those of :func:`fit_contours`, with ``poses`` in place of ``starts``.
    """
    images, boxes, K, image_index = _checked(images, boxes, camera_matrices, poses, image_index)
    if len(poses) == 0:
        return torch.zeros(0, dtype=torch.float64)
    _, problem = full_size_problem(contours, images, boxes, K, image_index, margin)
    return problem.edge_support(problem.state(poses.detach().cpu().double()))


def full_size_problem(
    contours: MeshContours,
    images: Sequence[Tensor],
    boxes: Tensor,
    K: Tensor,
    image_index: Tensor,
    margin: float,
) -> tuple[Tensor, ContourProblem]:
    """(B, C, S, S) crops without missing pixels, and the problem on them."""
    crops = fill_missing(crop_regions(images, boxes[:, None], size=SIZE, margin=margin)[:, 0].float())
    K = crop_transforms(square_boxes(boxes, margin), SIZE).double()[image_index] @ K
    check_pixels(crops, "of the box")
    return crops, ContourProblem(contours, EdgeField(crops), image_index, K, SIZE)


def _turned(T: Tensor, centre: Tensor) -> Tensor:
    """(N, M, 4, 4) poses: each of (N, 4, 4), then turned about the camera's x and y axes and about its z axis."""
    angles = torch.tensor([START_ANGLE, -START_ANGLE, START_ANGLE, -START_ANGLE, START_ROLL, -START_ROLL])
    twists = torch.zeros(7, 6, dtype=torch.float64)
    twists[torch.arange(1, 7), torch.tensor([0, 0, 1, 1, 2, 2])] = torch.deg2rad(angles.double())
    N = len(T)
    return apply_twist(T.repeat_interleave(7, 0), twists.repeat(N, 1), centre).view(N, 7, 4, 4)


def _two_best(half: ContourProblem, fits: ContourState, supports: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Refine the best fit of each start ``index`` and the next best that is another pose.

    Returns the number within ``index`` of the start that each pose belongs to, and the poses.
    """
    n, M = len(index), supports.shape[1]
    each, supports = half[index], supports[index]
    of_start = index[:, None] * M + torch.arange(M)
    best, rows = supports.argmax(dim=1), torch.arange(n)
    other, reference = fits[of_start.flatten()], fits[of_start[rows, best].repeat_interleave(M)]
    gap = each[rows.repeat_interleave(M)].mean_shift(reference.points, reference.T, other.T).view(n, M)
    rival, second = torch.where(gap > SAME, supports, -1.0).max(dim=1)
    source = torch.cat([rows, rows[rival >= 0]])
    chosen = of_start[source, torch.cat([best, second[rival >= 0]])]
    return source, each[source].descend(fits[chosen], SECOND).T


def _among_best(support: Tensor, image_index: Tensor, count: int) -> Tensor:
    """(N,) bool: whether fewer than ``count`` other starts of the same photograph have more support."""
    order = torch.arange(len(support))
    ahead = (support > support[:, None]) | ((support == support[:, None]) & (order < order[:, None]))
    return (ahead & (image_index == image_index[:, None])).sum(dim=1) < count


def _checked(
    images: Tensor | Sequence[Tensor], boxes: Any, camera_matrices: Any, poses: Tensor, image_index: Tensor | None
) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Images, and on the CPU boxes (B, 4), camera matrices (N, 3, 3) of the poses and (N,) image indices."""
    check_tensor(poses, "starts", (None, 4, 4))
    check_pose(poses, "starts")
    if isinstance(images, Tensor) and images.ndim == 3:  # one photograph
        box = as_numbers(boxes, "box")
        check_tensor(box, "box", (4,))
        images, boxes = images[None], box[None]
    for image in images:
        check_photograph(image)
    B, N = len(images), len(poses)
    boxes = as_boxes(boxes, B)
    K = as_numbers(camera_matrices, "camera_matrices", dtype=torch.float64)
    check_camera_matrix(K)
    given = len(K) if K.ndim == 3 else 1
    if given not in (1, B, N) or K.ndim not in (2, 3):
        raise InvalidInputError(f"camera_matrices: expected one or {B} matrices (or {N}), got {given}")
    if image_index is None:
        if B != 1:
            raise InvalidInputError(f"image_index: got {B} images; give the index of the image of each start")
        image_index = torch.zeros(N, dtype=torch.long)
    image_index = image_index.detach().cpu()
    if image_index.shape != (N,) or image_index.is_floating_point():
        got = f"{image_index.dtype} of shape {tuple(image_index.shape)}"
        raise InvalidInputError(f"image_index: expected {N} integers, got {got}")
    if N and not 0 <= int(image_index.min()) <= int(image_index.max()) < B:
        raise InvalidInputError(f"image_index: expected indices of {B} images, got {image_index.tolist()}")
    image_index, K = image_index.long(), K.detach().cpu()
    K = K.expand(B, 3, 3)[image_index] if given in (1, B) else K
    return [image.detach() for image in images], boxes.detach().cpu().float(), K, image_index
