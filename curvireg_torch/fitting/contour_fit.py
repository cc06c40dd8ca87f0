"""Contour fit: poses whose projected contours lie on image edges, by least squares over SE(3)."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..pipeline import FitSettings
from ..rendering.contours import MeshContours
from ..utils.checks import (
    as_boxes,
    as_numbers,
    check_camera_matrix,
    check_photograph,
    check_pose,
    check_tensor,
)
from ..utils.likes import BoxesLike, CameraLike
from .contour_problem import COARSE_DENSITY, ContourProblem, ContourState
from .edges import EdgeCrops
from .least_squares import apply_twist
from .measured_fit import FULL_SIZE_RADII, ContourFit, measured_fit

QUARTER_SIZE_RADII = (6.0, 4.0)
FIRST_RADII = (6.0, 4.0)
SECOND_RADII = (3.0, 2.0)
"""Search radius for edges in px, one a round: at a quarter of the size, and at half size from all
starts and then from the best."""

SAME_POSE_SHIFT = 0.5
"""Mean shift in px at half size below which two fits count as one."""


@torch.no_grad()
def fit_contours(
    contours: MeshContours,
    images: Tensor | Sequence[Tensor],
    boxes: BoxesLike,
    camera_matrices: CameraLike,
    starts: Tensor,
    *,
    image_index: Tensor | None = None,
    margin: float = 0.1,
    finish: int | None = None,
    wide_angles: Sequence[float] = (),
    object_mask: Tensor | None = None,
) -> ContourFit:
    """Poses whose contours lie on a photograph's edges, by robust least squares over SE(3).

    At each start, occluding contours and creases of the mesh become 3D points X_i with image
    normals n_i (:class:`.MeshContours`), and edges of similar direction are searched along n_i.
    With d_i the distance to the selected edge and J_i = n_i^T du_i/dxi, every step solves

        (J^T W J + lambda diag(J^T W J)) xi = J^T W d,

    where W is the strength of the edge times Tukey's weight of the residual. Within a step, edges
    are selected again near the predicted position; the search radius shrinks from round to round,
    and the contours are found again where they have moved. The fit begins at half size from each
    start and from six poses rotated away from it, with few points; the three with the most edge
    support after the first round go on. The best of them and the next best that differs from it end
    at full size. If no fit improves the edge support, the start is kept.

    Prints and clutter have edges too. With an ``object_mask`` they are weighted (``ObjectMask``) in
    the least squares and in the choice among the fits, not in the reported support.

    The covariance is of rotation (rad) about the camera's x, y, z, then translation (model units)
    along them: with the true pose R, t,

        R = exp([w]x) R_fit,   t = t_fit + e,   (w, e) of mean 0 and that covariance,

    see ``pose_covariance``; it is scaled by the errors of reliable results on photographs. Computed
    on the CPU.

    Args:
        contours: of the mesh.
        images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, in [0, 1] or uint8; or one
            photograph (C, H, W). Missing pixels (NaN or infinite) are filled from their neighbours.
        boxes: (B, 4) x0, y0, x1, y1 in px, which need not be exact; (4,) for one photograph.
        camera_matrices: (B, 3, 3) or (3, 3) in px; or (N, 3, 3), one for each start.
        starts: (N, 4, 4) rigid poses, within about 15 degrees.
        image_index: (N,) the photograph of each start; optional for one photograph.
        margin: added around the box, as a fraction of its longer side.
        finish: number of starts of each photograph that are fitted to the end, those with the most
            support after the first rounds; None: all, each as if alone, up to rounding.
        wide_angles: degrees by which starts are rotated up, down, left and right, to begin there
            too at a quarter of the size: for starts that may be worse than views of a bank.
        object_mask: (B, 1, s, s) probability that pixels of the square crops, the boxes with their
            margin, belong to the object, for instance of :meth:`LearnedCurvilinearSaliency.mask`.

    Raises:
        InvalidInputError: wrong shapes, a pose that is not rigid and finite, an unusable box or
            camera matrix.

    Example:
        >>> import curvireg_torch as cr, trimesh
        >>> from curvireg_torch.rendering.contours import MeshContours
        >>> K = torch.tensor([[200.0, 0, 63.5], [0, 200.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64); T[2, 3] = 5.0
        >>> T[:3, :3] = cr.rotation_from_viewpoint(30.0, 20.0, 5.0)
        >>> mesh = trimesh.creation.box((1, 1.5, 2))
        >>> image = (cr.render_depth(mesh, T[None], K, (128, 128))[0] > 0).float()
        >>> start = T.clone(); start[0, 3] = 0.1  # 2 % to the right
        >>> box = torch.tensor([24.0, 18, 102, 110])
        >>> fit = fit_contours(MeshContours(mesh), image, box, K, start[None])
        >>> abs(float(fit.transform[0, 0, 3])) < 0.01
        True
    """
    images, boxes, K, image_index = _checked(images, boxes, camera_matrices, starts, image_index)
    if finish is not None and not finish >= 1:
        raise InvalidInputError(f"finish: expected a whole number >= 1 or None, got {finish}")
    T0 = starts.detach().cpu().double()
    if len(T0) == 0:
        none = T0.new_zeros(0)
        return ContourFit(T0, T0.new_zeros(0, 6, 6), none, none, none.long(), none)
    if object_mask is not None:
        check_tensor(object_mask, "object_mask", (len(images), 1, None, None))
    crops = EdgeCrops.cut(images, boxes, margin, object_mask)
    return fit_to_edges(contours, crops, K, T0, image_index, finish=finish, wide_angles=wide_angles)


def fit_to_edges(
    contours: MeshContours,
    crops: EdgeCrops,
    K: Tensor,
    T0: Tensor,
    image_index: Tensor,
    *,
    finish: int | Tensor | None = None,
    wide_angles: Sequence[float] = (),
    short_fits: Tensor | None = None,
    refit: bool = False,
    settings: FitSettings = FitSettings(),
) -> ContourFit:
    """:func:`fit_contours` in crops that are cut, from checked starts, those of many photographs at
    a time.

    Args:
        contours: of the mesh.
        crops: of B photographs.
        K: (N, 3, 3) cameras of the whole photographs.
        T0: (N, 4, 4) starts.
        image_index: (N,) the crop of each start.
        finish: number of starts of each photograph that are fitted to the end, as one number or
            (N,), that of the photograph of each start; None: all.
        wide_angles: degrees, see :func:`fit_contours`.
        short_fits: (N, 4, 4) poses of a :func:`short_fit` from the starts, if there was one.
        refit: the starts are fitted poses, which need no short fit. One is kept if the best fit at
            half size returns to it.
        settings: of the fit.
    """
    full = ContourProblem.of(contours, crops, K, image_index)
    half = ContourProblem.of(contours, crops, K, image_index, factor=2)
    angles = (settings.start_angle, settings.far_angle) if refit else (settings.start_angle,)
    around = _rotated(T0, half.centre, angles, roll=settings.start_roll)
    if not refit:
        if short_fits is None:
            short_fits = _short_fits_around(contours, crops, K, T0, image_index, wide_angles)
        around = torch.cat([around, short_fits.view(len(T0), -1, 4, 4)], dim=1)

    begun = half.state(T0)
    start_support, start_weighted = half.supports(begun)
    promising = _promising(half, around, settings.kept_starts)
    fits, supports = _fitted_at_half_size(half, promising)
    support = supports.amax(dim=1)
    chosen = torch.ones_like(support, dtype=torch.bool)
    if finish is not None:
        chosen = _among_best(support, image_index, finish)
    index = chosen.nonzero()[:, 0]
    source, T = _two_best(half, fits, supports, index)
    if refit:
        shift = half[index].mean_shift(begun.points[index], T0[index], T[: len(index)])
        leaves = (shift > SAME_POSE_SHIFT)[source]
        source = source[leaves]
        T = T[leaves]
    # A start that is not finished ends with its best fit at half size, or stays.
    rows = torch.arange(len(T0), device=T0.device)
    best = fits.T.view(*supports.shape, 4, 4)[rows, supports.argmax(dim=1)]
    improves = ~chosen & (support > start_weighted)
    fixed = torch.where(improves[:, None, None], best, T0)
    state, support, support_of_fixed = _best_at_full_size(full, fixed, T, index[source])
    start_support = torch.where(chosen, support_of_fixed, start_support)
    return measured_fit(full, state, support, start_support)


def _short_fits_around(
    contours: MeshContours,
    crops: EdgeCrops,
    K: Tensor,
    T0: Tensor,
    image_index: Tensor,
    wide_angles: Sequence[float],
) -> Tensor:
    """(N * M, 4, 4) poses of short fits from starts (N, 4, 4) and from these rotated by
    ``wide_angles``."""
    wide = _rotated(T0, contours.centre, wide_angles)
    every = _repeated(len(wide), wide.shape[1], T0.device)
    poses = wide.flatten(0, 1)
    return short_fit(contours, crops, K[every], poses, image_index[every])[0]


def _promising(half: ContourProblem, around: Tensor, count: int) -> Tensor:
    """(N, ``count``, 4, 4), or fewer: of the poses ``around`` (N, M, 4, 4) each start, those with
    the most weighted support after a round with few points, as they are then."""
    N, M, _, _ = around.shape
    coarse = replace(half[_repeated(N, M, around.device)], density=COARSE_DENSITY)
    fits = coarse.moved(coarse.state(around.flatten(0, 1)), FIRST_RADII[0])
    supports = coarse.supports(fits)[1].view(N, M)
    order = supports.argsort(dim=1, descending=True, stable=True)[:, :count]
    return fits.T.view(N, M, 4, 4)[torch.arange(N, device=order.device)[:, None], order]


def _fitted_at_half_size(half: ContourProblem, T: Tensor) -> tuple[ContourState, Tensor]:
    """The fits (N * M) of poses (N, M, 4, 4) at half size, and their weighted supports (N, M)."""
    N, M, _, _ = T.shape
    each = half[_repeated(N, M, T.device)]
    fits = each.descend(each.state(T.flatten(0, 1)), FIRST_RADII[1:])
    return fits, each.supports(fits)[1].view(N, M)


def _best_at_full_size(
    full: ContourProblem, fixed: Tensor, T: Tensor, owner: Tensor
) -> tuple[ContourState, Tensor, Tensor]:
    """Of the ``fixed`` poses (N, 4, 4), one of each start, and the fits at full size from ``T`` (M,
    4, 4), which belong to the starts ``owner`` (M,), the one with the most weighted support, the
    first if several have it: its state and its support (N,); and the supports (N,) of the fixed
    ones."""
    N = len(fixed)
    starts = torch.arange(N, device=owner.device)
    candidates = torch.cat([starts, owner])
    each = full[candidates]
    state = each.state(torch.cat([fixed, T]))
    if len(T):
        fitted = each[N:].descend(state[N:], FULL_SIZE_RADII)
        state = ContourState.cat([state[:N], fitted])
    support, weighted = each.supports(state)
    best = torch.where(candidates == starts[:, None], weighted, -1.0).argmax(dim=1)
    return state[best], support[best], support[:N]


def _repeated(count: int, times: int, device: torch.device) -> Tensor:
    """Each of the rows 0 to ``count`` - 1 so many ``times``."""
    return torch.arange(count, device=device).repeat_interleave(times)


@torch.no_grad()
def short_fit(
    contours: MeshContours,
    crops: EdgeCrops,
    K: Tensor,
    T: Tensor,
    image_index: Tensor | None = None,
    *,
    radii: Sequence[float] = QUARTER_SIZE_RADII,
) -> tuple[Tensor, Tensor]:
    """Poses (N, 4, 4) that a short fit at a quarter of the size reaches from ``T`` (N, 4, 4), in a
    tenth of the time of a fit, and their edge support (N,) with the weights of the mask, which
    tells where a fit is worth it. Without ``radii``, the poses are not fitted."""
    quarter = ContourProblem.of(contours, crops, K, image_index, factor=4)
    state = quarter.descend(quarter.state(T), radii)
    return state.T, quarter.supports(state)[1]


def _rotated(
    T: Tensor, centre: Tensor, angles: Sequence[float], *, roll: float | None = None
) -> Tensor:
    """(N, M, 4, 4) poses: each of (N, 4, 4), then rotated about the camera's x and y axes by
    +-``angles`` degrees, and about its z axis by +-``roll``."""
    axes = torch.eye(6, dtype=T.dtype, device=T.device)[:3]
    both = torch.cat([axes, -axes])
    aside = [angle * both[[0, 3, 1, 4]] for angle in angles] + (
        [] if roll is None else [roll * both[[2, 5]]]
    )
    twists = torch.deg2rad(torch.cat([0.0 * both[:1], *aside]))
    N = len(T)
    M = len(twists)
    return apply_twist(T.repeat_interleave(M, 0), twists.repeat(N, 1), centre).view(N, M, 4, 4)


def _two_best(
    half: ContourProblem, fits: ContourState, supports: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """Refine the best fit of each start ``index`` and the next best that is another pose.

    Returns the number within ``index`` of the start that each pose belongs to, and the poses.
    """
    n = len(index)
    M = supports.shape[1]
    each = half[index]
    supports = supports[index]
    of_start = index[:, None] * M + torch.arange(M, device=index.device)
    best = supports.argmax(dim=1)
    rows = torch.arange(n, device=index.device)
    other = fits[of_start.flatten()]
    reference = fits[of_start[rows, best].repeat_interleave(M)]
    gap = (
        each[rows.repeat_interleave(M)]
        .mean_shift(reference.points, reference.T, other.T)
        .view(n, M)
    )
    rival, second = torch.where(gap > SAME_POSE_SHIFT, supports, -1.0).max(dim=1)
    source = torch.cat([rows, rows[rival >= 0]])
    chosen = of_start[source, torch.cat([best, second[rival >= 0]])]
    return source, each[source].descend(fits[chosen], SECOND_RADII).T


def _among_best(support: Tensor, image_index: Tensor, count: int | Tensor) -> Tensor:
    """(N,) bool: whether fewer than ``count``, a number or (N,), other starts of the same
    photograph have more support."""
    order = torch.arange(len(support), device=support.device)
    ahead = (support > support[:, None]) | (
        (support == support[:, None]) & (order < order[:, None])
    )
    return (ahead & (image_index == image_index[:, None])).sum(dim=1) < count


def _checked(
    images: Tensor | Sequence[Tensor],
    boxes: BoxesLike,
    camera_matrices: CameraLike,
    poses: Tensor,
    image_index: Tensor | None,
) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Images, and on the CPU boxes (B, 4), camera matrices (N, 3, 3) of the poses and (N,) image
    indices."""
    check_tensor(poses, "starts", (None, 4, 4))
    check_pose(poses, "starts")
    if isinstance(images, Tensor) and images.ndim == 3:  # one photograph
        box = as_numbers(boxes, "box")
        check_tensor(box, "box", (4,))
        images = images[None]
        boxes = box[None]
    for image in images:
        check_photograph(image)
    B = len(images)
    N = len(poses)
    boxes = as_boxes(boxes, B)
    K = as_numbers(camera_matrices, "camera_matrices", dtype=torch.float64)
    check_camera_matrix(K)
    given = len(K) if K.ndim == 3 else 1
    if given not in (1, B, N) or K.ndim not in (2, 3):
        raise InvalidInputError(
            f"camera_matrices: expected one or {B} matrices (or {N}), got {given}"
        )
    if image_index is None:
        if B != 1:
            raise InvalidInputError(
                f"image_index: got {B} images; give the index of the image of each start"
            )
        image_index = torch.zeros(N, dtype=torch.long)
    image_index = image_index.detach().cpu()
    if image_index.shape != (N,) or image_index.is_floating_point():
        got = f"{image_index.dtype} of shape {tuple(image_index.shape)}"
        raise InvalidInputError(f"image_index: expected {N} integers, got {got}")
    if N and not 0 <= int(image_index.min()) <= int(image_index.max()) < B:
        raise InvalidInputError(
            f"image_index: expected indices of {B} images, got {image_index.tolist()}"
        )
    image_index = image_index.long()
    K = K.detach().cpu()
    K = K.expand(B, 3, 3)[image_index] if given in (1, B) else K
    return [image.detach() for image in images], boxes.detach().cpu().float(), K, image_index
