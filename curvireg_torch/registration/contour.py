"""Contours of the mesh pulled onto the photograph's edges: the continuous stage of the refinement."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..filters.inputs import fill_missing
from ..geometry import crop_images
from ..rendering import DepthRenderer
from ..utils.checks import (
    as_boxes,
    as_numbers,
    check_camera_matrix,
    check_photograph,
    check_pixels,
    check_pose,
    check_positive,
    check_tensor,
)
from .contour_covariance import pose_covariance
from .contour_descent import Seen, Views, moved
from .contour_points import EdgeField

__all__ = ["ContourFit", "contour_support", "fit_contours"]

SIZE = 256
"""Side of the crop in px; the first rounds use half of it."""

FIRST, SECOND, FINE = (6.0, 4.0), (3.0, 2.0), (6.0, 4.0, 3.0, 2.0, 2.0)
"""How far edges are looked for in px, round by round: from all turns and from the best, at half size, and at full."""

SAME = 0.5
"""Mean distance in px at half size within which two fits count as one."""

TURN = 8.0
"""Degrees to the left, right, up and down of the given pose from which the fit starts too: half the width of what it
draws in, and about the error of a coarse view."""


SUPPORTED, GAINED = 0.5, 0.2
"""Support of a fit that is worth more than its start, and what it gains; chosen on generated scenes."""


@dataclass(frozen=True)
class ContourFit:
    """N poses fitted to one photograph.

    Attributes:
        transform: (N, 4, 4) float64 ``T_cam_from_model``.
        covariance: (N, 6, 6) float64, see :func:`fit_contours`; NaN where too few edges were found.
        support: (N,) float64 in [0, 1): mean strength of the edges within about 1 px of the contour points, weighted by
            distance; 0 where the mesh shows no contour in the crop.
        start_support: (N,) the same of the starts (in a crop half as large, of starts that are not finished).
        observable: (N,) int64, how many of a pose's six directions the contours fix; the covariance of the others is
            that of not knowing them.
        matched: (N,) share of the contour points that lie within 2 px of an edge.
        residual: (N,) root mean square distance of those from their edges, in px of a crop of 256 px.
        moved: (N,) mean way of the contour points from the start, in the same px.
    """

    transform: Tensor
    covariance: Tensor
    edge_support: Tensor
    start_support: Tensor
    observable: Tensor
    matched: Tensor
    residual: Tensor
    moved: Tensor

    @property
    def trustworthy(self) -> Tensor:
        """(N,) bool: whether enough of what the photograph shows fits the mesh to believe its turn.

        Support of at least 0.5, or at least 0.2 more than the start had. Contours of *another* object of the kind gain
        less: there the start's rotation is as good as the fit's.
        """
        return (self.edge_support >= SUPPORTED) | (self.edge_support - self.start_support >= GAINED)


@torch.no_grad()
def fit_contours(
    renderer: DepthRenderer,
    images: Tensor | Sequence[Tensor],
    boxes: Any,
    camera_matrices: Any,
    starts: Tensor,
    *,
    photograph: Tensor | None = None,
    centre: Tensor,
    radius: float,
    margin: float = 0.1,
    finish: int | None = None,
) -> ContourFit:
    """Poses whose contours lie on a photograph's edges, by robust least squares over SE(3).

    Around each start the mesh is rendered, its occluding contours and creases become 3D points X_i with normals n_i in
    the image (:func:`contour_points`), and the photograph is searched along n_i for edges that run as the contour
    does. With d_i the distance to the chosen edge and J_i = n_i^T du_i/dxi, every step solves

        (J^T W J + lambda diag(J^T W J)) xi = J^T W d,

    W being the edge's strength times Tukey's weight of what remains. Strong edges near where the step leads are chosen
    again within a step; the search narrows from round to round, and the mesh is rendered anew where contours have
    moved. From each start and from four poses turned away from it the fit begins at half size; the best (by support)
    and the next best that differs from it go on, and end at full size. The start itself is returned where nothing has
    more support than it has. All starts of all photographs share a round's rendering.

    The order of the covariance is turn (rad) about the camera's x, y, z, then translation (model units) along them:
    with the true pose R, t,

        R = exp([w]x) R_fit,   t = t_fit + e,   (w, e) of mean 0 and that covariance.

    It is :func:`pose_covariance`'s: what contours do not fix (turns of a sphere, a cylinder's about its axis) has a
    standard deviation of pi or of the distance. The least squares know nothing of wrong edges: their covariance is
    scaled by what reliable answers on photographs were off (:mod:`curvireg_torch.registration.calibration`).
    Computed on the CPU.

    Args:
        renderer: of the mesh.
        images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, in [0, 1] or uint8; or one photograph (C, H, W).
            Missing pixels (NaN or infinite) are filled from around them.
        boxes: (B, 4) x0, y0, x1, y1 in px: where to look; need not be exact. (4,) for one photograph.
        camera_matrices: (B, 3, 3) or (3, 3) in px; or (N, 3, 3), one of each start.
        starts: (N, 4, 4) rigid poses, within about 15 degrees.
        photograph: (N,) index of the photograph that a start belongs to; may be left out for one photograph.
        centre, radius: of the object, (3,) and model units.
        margin: room around the box, as a share of its longer side.
        finish: of each photograph's starts only so many are fitted, those with most support after the first rounds from
            themselves alone; the others come back as those rounds left them. None fits all: each as if it were alone.

    Raises:
        InvalidInputError: wrong shapes, a pose that is not rigid and finite, an unusable box or camera matrix.

    Example:
        >>> import curvireg_torch as cr, trimesh
        >>> from curvireg_torch.rendering import make_renderer
        >>> K = torch.tensor([[200.0, 0, 63.5], [0, 200.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64); T[2, 3] = 5.0
        >>> T[:3, :3] = cr.rotation_from_viewpoint(30.0, 20.0, 5.0)
        >>> renderer = make_renderer(trimesh.creation.box((1, 1.5, 2)))
        >>> image = (renderer.render(T[None], K, (128, 128))[0] > 0).float()
        >>> start = T.clone(); start[0, 3] = 0.1                                              # 2 % to the right
        >>> box = torch.tensor([24.0, 18, 102, 110])
        >>> fit = fit_contours(renderer, image, box, K, start[None], centre=torch.zeros(3), radius=1.4)
        >>> abs(float(fit.transform[0, 0, 3])) < 0.01
        True
    """
    images, boxes, K, photograph = _batch(images, boxes, camera_matrices, starts, photograph)
    check_positive(radius, "radius")
    if finish is not None and not finish >= 1:
        raise InvalidInputError(f"finish: expected a whole number >= 1 or None, got {finish}")
    T0, centre = starts.detach().cpu().double(), centre.detach().cpu().double()
    N = len(T0)
    if N == 0:
        none = T0.new_zeros(0)
        return ContourFit(T0, T0.new_zeros(0, 6, 6), none, none, none.long(), none, none, none)
    crops, full = _full_size(renderer, images, boxes, K, photograph, centre, radius, margin)
    K = torch.tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]], dtype=torch.float64) @ full.K
    half = Views(renderer, EdgeField(F.avg_pool2d(crops, 2)), photograph, K, SIZE // 2, centre, radius)
    start = half.seen(T0)
    before = half.edge_support(start)
    first = half.descend(start, FIRST)
    edge_support = half.edge_support(first)
    tried = torch.ones(N, dtype=torch.bool) if finish is None else _among_best(edge_support, photograph, finish)
    index, others = tried.nonzero()[:, 0], (~tried).nonzero()[:, 0]
    of, T = _around(half.of(index), T0[index], first[index], edge_support[index])
    # The starts, and what was only begun with, as they are. Of equals the first wins.
    owner = torch.cat([index, others, index[of]])
    still = torch.cat(
        [T0[index], torch.where((edge_support > before)[others, None, None], first.T[others], T0[others])]
    )
    as_they_are, two = full.of(owner[: len(still)]), full.of(index[of])
    seen = Seen.cat([as_they_are.seen(still), two.descend(two.seen(T), FINE)])
    edge_support = full.of(owner).edge_support(seen)
    before[index] = edge_support[: len(index)]
    best = torch.where(owner == torch.arange(N)[:, None], edge_support, -1.0).argmax(dim=1)
    seen, edge_support = seen[best], edge_support[best]
    found = full.matches(seen, FINE[-1])
    covariance, observable = pose_covariance(found, seen.points, seen.T, full.K, centre, radius=radius)
    weight = found.weight[..., 0]
    mean_square = (weight * found.distance[..., 0].square()).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-12)
    return ContourFit(
        transform=seen.T,
        covariance=covariance,
        edge_support=edge_support,
        start_support=before,
        observable=observable,
        matched=(weight > 0).sum(dim=1) / seen.points.valid.sum(dim=1).clamp(min=1),
        residual=mean_square.sqrt(),
        moved=full.way(seen.points, T0, seen.T),
    )


@torch.no_grad()
def contour_support(
    renderer: DepthRenderer,
    images: Tensor | Sequence[Tensor],
    boxes: Tensor,
    camera_matrices: Tensor,
    poses: Tensor,
    *,
    photograph: Tensor | None = None,
    centre: Tensor,
    radius: float,
    margin: float = 0.1,
) -> Tensor:
    """(N,) support of poses that are taken as they are, as :class:`ContourFit` has it of fitted ones.

    Args and errors: those of :func:`fit_contours`, whose ``starts`` are the ``poses`` here.
    """
    images, boxes, K, photograph = _batch(images, boxes, camera_matrices, poses, photograph)
    if len(poses) == 0:
        return torch.zeros(0, dtype=torch.float64)
    centre = centre.detach().cpu().double()
    _, views = _full_size(renderer, images, boxes, K, photograph, centre, radius, margin)
    return views.edge_support(views.seen(poses.detach().cpu().double()))


def _full_size(
    renderer: DepthRenderer,
    images: Sequence[Tensor],
    boxes: Tensor,
    K: Tensor,
    photograph: Tensor,
    centre: Tensor,
    radius: float,
    margin: float,
) -> tuple[Tensor, Views]:
    """(B, C, S, S) crops without missing pixels, and the poses' views of them."""
    crops, A = crop_images(images, boxes, size=SIZE, margin=margin)
    crops = fill_missing(crops)
    check_pixels(crops, "of the box")
    return crops, Views(renderer, EdgeField(crops), photograph, A.double()[photograph] @ K, SIZE, centre, radius)


def _around(half: Views, T0: Tensor, first: Seen, edge_support: Tensor) -> tuple[Tensor, Tensor]:
    """Poses at half size from what the first rounds made of starts ``T0``, (N, 4, 4), and make of four turns of each:
    the best of five, and the next best that is another pose. Returns which start each belongs to, and the poses."""
    N, every = len(T0), torch.arange(len(T0))
    turns = torch.zeros(4, 6, dtype=torch.float64)
    turns[:, :2] = torch.deg2rad(TURN * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    views = half.of(every.repeat_interleave(4))
    turned = views.descend(views.seen(moved(T0.repeat_interleave(4, 0), turns.repeat(N, 1), half.centre)), FIRST)
    supports = torch.cat([edge_support[:, None], views.edge_support(turned).view(-1, 4)], dim=1)
    five = torch.cat([every[:, None], N + torch.arange(4 * N).view(-1, 4)], dim=1)
    seen, best = Seen.cat([first, turned]), supports.argmax(dim=1)
    other, reference = seen[five.flatten()], seen[five[every, best].repeat_interleave(5)]
    gap = half.of(every.repeat_interleave(5)).way(reference.points, reference.T, other.T).view(-1, 5)
    rival, second = torch.where(gap > SAME, supports, -1.0).max(dim=1)
    owner = torch.cat([every, every[rival >= 0]])
    chosen = five[owner, torch.cat([best, second[rival >= 0]])]
    return owner, half.of(owner).descend(seen[chosen], SECOND).T


def _among_best(edge_support: Tensor, photograph: Tensor, count: int) -> Tensor:
    """(N,) whether fewer than ``count`` other starts of the same photograph have more support."""
    order = torch.arange(len(edge_support))
    ahead = (edge_support > edge_support[:, None]) | (
        (edge_support == edge_support[:, None]) & (order < order[:, None])
    )
    return (ahead & (photograph == photograph[:, None])).sum(dim=1) < count


def _batch(
    images: Tensor | Sequence[Tensor],
    boxes: Any,
    camera_matrices: Any,
    starts: Tensor,
    photograph: Tensor | None,
) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Float images, boxes (B, 4), camera matrices (N, 3, 3) of the starts and (N,) photographs, all on the CPU."""
    check_tensor(starts, "starts", (None, 4, 4))
    check_pose(starts, "starts")
    if isinstance(images, Tensor) and images.ndim == 3:  # one photograph
        box = as_numbers(boxes, "box")
        check_tensor(box, "box", (4,))
        images, boxes = images[None], box[None]
    for image in images:
        check_photograph(image)
    B, N = len(images), len(starts)
    boxes = as_boxes(boxes, B)
    K = as_numbers(camera_matrices, "camera_matrices", least=torch.float64)
    check_camera_matrix(K)
    given = len(K) if K.ndim == 3 else 1
    if given not in (1, B, N) or K.ndim not in (2, 3):
        raise InvalidInputError(f"camera_matrices: expected one or {B} matrices (or {N}), got {given}")
    if photograph is None:
        if B != 1:
            raise InvalidInputError(f"photograph: {B} images; say which of them each start belongs to")
        photograph = torch.zeros(len(starts), dtype=torch.long)
    photograph = photograph.detach().cpu()
    if photograph.shape != starts.shape[:1] or photograph.is_floating_point():
        raise InvalidInputError(
            f"photograph: expected {len(starts)} integers, got {photograph.dtype} of shape {tuple(photograph.shape)}"
        )
    if len(starts) and not 0 <= int(photograph.min()) <= int(photograph.max()) < B:
        raise InvalidInputError(f"photograph: expected indices of {B} images, got {photograph.tolist()}")
    photograph = photograph.long()
    K = K.detach().cpu()
    return (
        [image.detach().cpu().float() / (1 if image.is_floating_point() else 255) for image in images],
        boxes.detach().cpu().float(),
        K.expand(B, 3, 3)[photograph] if given in (1, B) else K,
        photograph,
    )
