"""Contour fit: projected contours of the mesh are pulled onto image edges, by least squares over SE(3)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..filters.operations import central_gradient, fill_missing, smooth
from ..geometry.crops import crop_transforms, image_transforms, square_boxes
from ..rendering.contours import ContourPoints, MeshContours
from ..terms import crop_regions
from ..utils.checks import (
    as_boxes,
    as_numbers,
    check_camera_matrix,
    check_photograph,
    check_pixels,
    check_pose,
    check_tensor,
)
from .least_squares import (
    Measurements,
    apply_twist,
    damped_solution,
    pixels,
    pose_covariance,
    project,
    step_fraction,
)

CROP_SIZE = 256
"""Side of the crop in px; the first rounds use half of it."""

QUARTER_SIZE_RADII = (6.0, 4.0)
FIRST_RADII, SECOND_RADII, FULL_SIZE_RADII = (6.0, 4.0), (3.0, 2.0), (4.0, 2.0, 2.0)
"""Search radius for edges in px, one a round: from all starts and then from the best at half size, and at full size."""

HALF_SIZE_DENSITY = 0.5
"""Contour points at half size, as a fraction of those at full size."""

SAME_POSE_SHIFT = 0.5
"""Mean shift in px at half size below which two fits count as one."""

START_ANGLE, START_ROLL = 8.0, 6.0
"""Degrees by which the pose is rotated left, right, up and down, and about the line of sight, for further starts: about
half the spacing of a bank's views."""

SUPPORTED, GAINED = 0.5, 0.2
"""Edge support, or gain of it over the start, from which a fit is trusted; chosen on generated scenes."""

STEPS_PER_ROUND, SELECTIONS_PER_STEP = 2, 3
"""Least-squares steps per round, and selections of edges per step."""

STALE_SHIFT = 0.3
"""Mean shift of the contour points in px after which the mesh's contours are found again."""

EDGE_DAMPING = 1e-2
"""Levenberg-Marquardt: fraction of the diagonal of J^T W J that is added to it."""

MASK_DISTANCE = 6.0 / 256.0
"""Distance from an edge at which the mask is read on both sides, as a fraction of the crop's side: about 1.5 px of the
learned mask."""

MASK_TRUST = 0.7
"""Weight that an edge loses where the mask contradicts it."""

OUTLINE_WEIGHT = 2.0
"""Weight of the outline relative to creases and inner contours, which prints and reflections imitate."""


class EdgeField:
    """Edges of image crops (B, C, S, S) in [0, 1]; the strongest of several channels counts.

    ``inside`` (B, 1, S, S), if given, is 0 outside the photograph: there are no edges, though crops repeat its border.
    """

    def __init__(self, crops: Tensor, inside: Tensor | None = None) -> None:
        gx, gy = central_gradient(smooth(crops, 1.0))
        self._inside = torch.ones_like(crops[:, :1]) if inside is None else inside.to(crops)
        self._gradient = torch.stack([gx, gy], dim=2).flatten(1, 2) * self._inside
        energy, area = self._gradient.square().sum(dim=(1, 2, 3)), self._inside.sum(dim=(1, 2, 3))
        self._level = (energy / area.clamp(min=1)).sqrt().clamp(min=1e-6)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, image_index: Tensor) -> Tensor:
        """Strength of the image gradient across a contour, at offsets along its normals.

        With g the gradient, m the crop's root mean square gradient and c = ``|n . g| / |g|``, r = ``|n . g| c^4`` gives
        the strength r / (r + m). It is 0 outside the crop; c^4 is one half where n and g differ by 33 degrees.

        Args:
            uv, normals: (N, P, 2) pixels of the crops and unit vectors.
            offsets: (L,) px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float64 in [0, 1).
        """
        gradient = _sampled_lines(self._gradient, uv, normals, offsets, image_index)
        gx, gy = gradient[:, 0::2], gradient[:, 1::2]
        nx, ny = normals.to(gx.dtype)[:, None, :, None].unbind(-1)
        across = (gx * nx + gy * ny).abs()
        cosine = across * (gx * gx + gy * gy).clamp(min=1e-20).rsqrt()
        r = (across * cosine.square().square()).amax(dim=1)
        return (r / (r + self._level[image_index, None, None])).double()

    def counts(self, uv: Tensor, valid: Tensor, image_index: Tensor) -> Tensor:
        """(N, P) bool: ``valid`` points that count when the support of a pose is averaged, all but those outside the
        photograph; but then half of the points at least."""
        S = self._inside.shape[-1]
        x, y = uv.round().long().clamp(0, S - 1).unbind(-1)
        here = valid & (self._inside[image_index[:, None], 0, y, x] > 0)
        enough = 2 * here.sum(dim=1, keepdim=True) >= valid.sum(dim=1, keepdim=True)
        return torch.where(enough, here, valid)


class ObjectMask:
    """Probabilities (B, 1, s, s) that pixels of image crops belong to the object."""

    def __init__(self, probability: Tensor) -> None:
        self._probability = probability.detach().cpu().float()

    def weights(self, uv: Tensor, points: ContourPoints, offsets: Tensor, image_index: Tensor, size: int) -> Tensor:
        """How well edges at offsets along the normals of contour points agree with the mask.

        With p and q the probabilities 6/256 of the crop's side inward and outward of an edge, an edge of the outline
        has weight 2 (0.3 + 0.7 max(p - q, 0)), one within the object 0.3 + 0.7 min(p, q).

        Args:
            uv: (N, P, 2) px of the points in crops of ``size`` px.
            offsets: (L,) px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float64, at most 2.
        """
        aside = MASK_DISTANCE * size
        at = torch.cat([offsets - aside, offsets + aside])
        probability = _sampled_lines(
            self._probability, uv, points.normals, at, image_index, size=size, padding="border"
        )
        inside, outside = probability[:, 0].chunk(2, dim=-1)
        outline, within = (inside - outside).clamp(min=0.0), torch.minimum(inside, outside)
        is_outline = points.outline[..., None]
        agreement = 1.0 - MASK_TRUST + MASK_TRUST * torch.where(is_outline, outline, within)
        return agreement.double() * self.largest_weights(points)[..., None]

    @staticmethod
    def largest_weights(points: ContourPoints) -> Tensor:
        """(N, P) float64 weights of edges that agree with the mask: 2 for the outline, else 1."""
        return torch.where(points.outline, OUTLINE_WEIGHT, 1.0).double()


def _sampled_lines(
    pictures: Tensor,
    uv: Tensor,
    normals: Tensor,
    offsets: Tensor,
    image_index: Tensor,
    *,
    size: int | None = None,
    padding: str = "zeros",
) -> Tensor:
    """(N, C, P, L) float32 values of pictures (B, C, S, S) at offsets (L,) px from points (N, P, 2) along normals.

    ``size`` is the side of the crop in px, to which points and offsets refer, if it is not S.
    """
    scale = 2.0 / (size or pictures.shape[-1])
    start, along = (scale * uv + (0.5 * scale - 1.0)).float(), (scale * normals).float()
    grid = torch.addcmul(start[:, :, None], offsets.float()[:, None], along[:, :, None])
    out = grid.new_empty(len(uv), pictures.shape[1], *grid.shape[1:3])
    for b in image_index.unique().tolist():  # an expanded picture is not copied for every pose
        mine = (image_index == b).nonzero()[:, 0]
        picture = pictures[b].expand(len(mine), -1, -1, -1)
        out[mine] = F.grid_sample(picture, grid[mine], padding_mode=padding, align_corners=False)
    return out


@dataclass(frozen=True)
class ContourState:
    """Poses ``T`` (N, 4, 4), nearby ones ``seen`` at which contours were last found, and the contour points there."""

    T: Tensor
    seen: Tensor
    points: ContourPoints

    def __getitem__(self, index: Tensor) -> "ContourState":
        return ContourState(self.T[index], self.seen[index], self.points[index])

    @staticmethod
    def cat(parts: Sequence["ContourState"]) -> "ContourState":
        T, seen = (torch.cat([getattr(part, name) for part in parts]) for name in ("T", "seen"))
        return ContourState(T, seen, ContourPoints.cat([part.points for part in parts]))


@dataclass(frozen=True)
class ContourProblem:
    """N poses of a mesh, fitted to ``edges`` of crops of ``size`` px with indices (N,) and cameras ``K`` (N, 3, 3); a
    ``mask`` weights the edges."""

    contours: MeshContours
    edges: EdgeField
    image_index: Tensor
    K: Tensor
    size: int
    mask: ObjectMask | None = None
    density: float = 1.0

    @property
    def centre(self) -> Tensor:
        """(3,) of the object, about which poses rotate."""
        return self.contours.centre

    def __getitem__(self, index: Tensor) -> "ContourProblem":
        return replace(self, image_index=self.image_index[index], K=self.K[index])

    def state(self, T: Tensor) -> ContourState:
        """Poses (N, 4, 4) with the mesh's contour points there."""
        return ContourState(T, T, self.contours.points(T, self.K, self.size, density=self.density))

    def descend(self, state: ContourState, radii: Sequence[float]) -> ContourState:
        """Poses after one round for each search radius in px; contours are found again where they moved."""
        for radius in radii:
            T = state.T
            for _ in range(STEPS_PER_ROUND):
                T = self.step(state.points, T, radius)
            state = self.with_current_contours(replace(state, T=T))
        return state

    def with_current_contours(self, state: ContourState) -> ContourState:
        # Decided for each pose separately: a result must not depend on the rest of the batch.
        stale = self.mean_shift(state.points, state.seen, state.T) > STALE_SHIFT
        if not bool(stale.any()):
            return state
        new = self[stale.nonzero()[:, 0]].state(state.T[stale])
        index = torch.where(stale, len(stale) - 1 + stale.cumsum(0), torch.arange(len(stale)))
        return ContourState.cat([state, new])[index]

    def mean_shift(self, points: ContourPoints, before: Tensor, after: Tensor) -> Tensor:
        """(N,) mean shift of the points in px between two poses."""
        shift = pixels(points.model, after, self.K, self.centre) - pixels(points.model, before, self.K, self.centre)
        length = torch.linalg.vector_norm(shift, dim=-1) * points.valid
        mean: Tensor = length.sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)
        return mean

    def step(self, points: ContourPoints, T: Tensor, radius: float, others: Sequence[Measurements] = ()) -> Tensor:
        """(N, 4, 4) poses after a least-squares step towards edges within ``radius`` px and ``others`` measurements."""
        uv, du = project(points.model, T, self.K, self.centre)
        J = (points.normals[..., None, :] @ du)[..., 0, :]
        distance, strength = self._candidates(uv, points, radius)
        if self.mask is not None:
            strength = strength * self.mask.weights(uv, points, _offsets(radius)[1:-1], self.image_index, self.size)
        equations = [other.equations() for other in others]
        step = torch.zeros(len(T), 6, 1, dtype=torch.float64)
        for _ in range(SELECTIONS_PER_STEP):
            residual = distance - J @ step
            index = (strength * torch.exp(-2.0 * (residual / radius) ** 2)).argmax(dim=-1, keepdim=True)
            tukey = (1.0 - (residual.gather(-1, index) / radius) ** 2).clamp(min=0.0) ** 2
            edges = Measurements(J, distance.gather(-1, index), strength.gather(-1, index) * tukey)
            A, b = (sum(parts) for parts in zip(edges.equations(), *equations, strict=True))
            step = self.solution(A, b)[..., None]
        return apply_twist(T, step[..., 0] * self.step_fraction(step[..., 0], T)[:, None], self.centre)

    def solution(self, A: Tensor, b: Tensor) -> Tensor:
        """(N, 6) damped solutions of normal equations (N, 6, 6) and (N, 6, 1)."""
        return damped_solution(A, b, EDGE_DAMPING)

    def step_fraction(self, step: Tensor, T: Tensor) -> Tensor:
        """(N,) see :func:`step_fraction`."""
        return step_fraction(step, T, self.centre)

    def _candidates(self, uv: Tensor, points: ContourPoints, radius: float) -> tuple[Tensor, Tensor]:
        """Distances in px along the normals and strengths, both (N, P, L); the strength is 0 where there is no edge."""
        offsets = _offsets(radius)
        profile = self.edges.strength(uv, points.normals, offsets, self.image_index)
        before, here, behind = profile[..., :-2], profile[..., 1:-1], profile[..., 2:]
        is_peak = (here > before) & (here >= behind) & points.valid[..., None]
        curvature = (before - 2.0 * here + behind).clamp(max=-1e-9)
        vertex = (0.5 * (before - behind) / curvature).clamp(-0.5, 0.5)  # of the parabola through the three values
        return offsets[1:-1] + vertex, torch.where(is_peak, here, 0.0)

    def edge_support(self, state: ContourState) -> Tensor:
        """(N,) mean strength of the edges within about 1 px of the contour points."""
        return self.supports(state)[0]

    def supports(self, state: ContourState) -> tuple[Tensor, Tensor]:
        """(N,) :meth:`edge_support`, and the same with the weights of the mask, if there is one: what fits are compared
        by."""
        points = state.points
        uv = pixels(points.model, state.T, self.K, self.centre)
        offsets = torch.arange(-3, 4, dtype=torch.float64)
        counts = self.edges.counts(uv, points.valid, self.image_index)
        near = self.edges.strength(uv, points.normals, offsets, self.image_index) * torch.exp(-0.5 * offsets**2)
        plain = (near.amax(dim=-1) * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1)
        if self.mask is None:
            return plain, plain
        near = near * self.mask.weights(uv, points, offsets, self.image_index, self.size)
        most = self.mask.largest_weights(points) * counts  # a long outline alone is no support
        return plain, (near.amax(dim=-1) * counts).sum(dim=1) / most.sum(dim=1).clamp(min=1)

    def measured_edges(self, state: ContourState, radius: float) -> Measurements:
        """The edges that a least-squares step without a mask would use."""
        points = state.points
        uv, du = project(points.model, state.T, self.K, self.centre)
        distance, strength = self._candidates(uv, points, radius)
        index = (strength * torch.exp(-0.5 * distance**2)).argmax(dim=-1, keepdim=True)
        d = distance.gather(-1, index)
        W = strength.gather(-1, index) * (1.0 - (d / radius) ** 2).clamp(min=0.0) ** 2
        return Measurements((points.normals[..., None, :] @ du)[..., 0, :], d, W)


Problem = TypeVar("Problem", bound=ContourProblem)


def _offsets(radius: float) -> Tensor:
    """Offsets in px at which edges are searched within ``radius`` of a predicted position."""
    far = round(1.5 * radius) + 1
    return torch.arange(-far, far + 1, dtype=torch.float64)


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
    wide_angles: Sequence[float] = (),
    object_mask: Tensor | None = None,
) -> ContourFit:
    """Poses whose contours lie on a photograph's edges, by robust least squares over SE(3).

    At each start, occluding contours and creases of the mesh become 3D points X_i with image normals n_i
    (:class:`.MeshContours`), and edges of similar direction are searched along n_i. With d_i the distance to the
    selected edge and J_i = n_i^T du_i/dxi, every step solves

        (J^T W J + lambda diag(J^T W J)) xi = J^T W d,

    where W is the strength of the edge times Tukey's weight of the residual. Within a step, edges are selected again
    near the predicted position; the search radius shrinks from round to round, and the contours are found again where
    they have moved. The fit begins at half size from each start and from six poses rotated away from it; the best, by
    edge support, and the next best that differs from it continue, and end at full size. If no fit improves the edge
    support, the start is kept.

    Prints and clutter have edges too. With an ``object_mask`` they are weighted (``ObjectMask``) in the least squares
    and in the choice among the fits, not in the reported support.

    The covariance is of rotation (rad) about the camera's x, y, z, then translation (model units) along them: with the
    true pose R, t,

        R = exp([w]x) R_fit,   t = t_fit + e,   (w, e) of mean 0 and that covariance,

    see ``pose_covariance``; it is scaled by the errors of reliable results on photographs. Computed on the CPU.

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
        wide_angles: degrees by which starts are rotated up, down, left and right, to begin there too at a quarter
            of the size: for starts that may be worse than views of a bank.
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
    crops, inside, full = full_size_problem(contours, images, boxes, K, image_index, margin)
    if object_mask is not None:
        check_tensor(object_mask, "object_mask", (len(images), 1, None, None))
        full = replace(full, mask=ObjectMask(object_mask))
    half, quarter = (smaller_problem(full, crops, inside, factor) for factor in (2, 4))
    before, weighted_before = half.supports(half.state(T0))
    wide = _turned(T0, half.centre, wide_angles)
    every = torch.arange(N).repeat_interleave(wide.shape[1])
    wide = quarter[every].descend(quarter[every].state(wide.flatten(0, 1)), QUARTER_SIZE_RADII).T.view(wide.shape)
    around = torch.cat([_turned(T0, half.centre, (START_ANGLE,), roll=START_ROLL), wide], dim=1)
    M = around.shape[1]
    every = torch.arange(N).repeat_interleave(M)
    fits = half[every].descend(half[every].state(around.flatten(0, 1)), FIRST_RADII)
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
    state = ContourState.cat([full[owner[: len(fixed)]].state(fixed), fitted.descend(fitted.state(T), FULL_SIZE_RADII)])
    support, weighted = full[owner].supports(state)
    before[index] = support[: len(index)]
    best = torch.where(owner == torch.arange(N)[:, None], weighted, -1.0).argmax(dim=1)
    state, support = state[best], support[best]
    measured = full.measured_edges(state, FULL_SIZE_RADII[-1])
    covariance, observable = pose_covariance(
        measured, state.points, state.T, full.K, contours.centre, radius=contours.radius
    )
    return ContourFit(state.T, covariance, edge_support=support, start_support=before, observable=observable)


@torch.no_grad()
def quick_support(
    contours: MeshContours, image: Tensor, box: Tensor, K: Tensor, T: Tensor, *, margin: float, mask: Tensor | None
) -> Tensor:
    """(N,) edge support, with the weights of the ``mask``, that poses ``T`` (N, 4, 4) with cameras ``K`` (N, 3, 3)
    reach by a short fit at a quarter of the size; it tells in a tenth of the time which of them are worth a fit."""
    crops, inside, full = full_size_problem(
        contours, [image], box[None], K, torch.zeros(len(T), dtype=torch.long), margin
    )
    quarter = smaller_problem(replace(full, mask=None if mask is None else ObjectMask(mask)), crops, inside, 4)
    return quarter.supports(quarter.descend(quarter.state(T), QUARTER_SIZE_RADII))[1]


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
    _, _, problem = full_size_problem(contours, images, boxes, K, image_index, margin)
    return problem.edge_support(problem.state(poses.detach().cpu().double()))


def full_size_problem(
    contours: MeshContours,
    images: Sequence[Tensor],
    boxes: Tensor,
    K: Tensor,
    image_index: Tensor,
    margin: float,
) -> tuple[Tensor, Tensor, ContourProblem]:
    """(B, C, S, S) crops without missing pixels, (B, 1, S, S) 1 where they show the photograph, and the problem."""
    crops = fill_missing(crop_regions(images, boxes[:, None], size=CROP_SIZE, margin=margin)[:, 0].float())
    K = crop_transforms(square_boxes(boxes, margin), CROP_SIZE).double()[image_index] @ K
    check_pixels(crops, "of the box")
    inside = inside_photographs(images, boxes, CROP_SIZE, margin)
    return crops, inside, ContourProblem(contours, EdgeField(crops, inside), image_index, K, CROP_SIZE)


def smaller_problem(full: Problem, crops: Tensor, inside: Tensor, factor: int) -> Problem:
    """The problem in crops whose sides are smaller by a factor."""
    shrink = torch.diag(torch.tensor([1.0 / factor, 1.0 / factor, 1.0], dtype=torch.float64))
    shrink[:2, 2] = 0.5 / factor - 0.5
    edges = EdgeField(F.avg_pool2d(crops, factor), F.avg_pool2d(inside, factor).floor())
    return replace(full, edges=edges, K=shrink @ full.K, size=full.size // factor, density=HALF_SIZE_DENSITY)


def inside_photographs(images: Sequence[Tensor], boxes: Tensor, size: int, margin: float) -> Tensor:
    """(B, 1, size, size) float32: 1 where crops around (B, 4) boxes show their photograph, 0 where they repeat its
    border."""
    A = image_transforms(square_boxes(boxes, margin), size)
    at = torch.arange(size, dtype=A.dtype)
    x, y = (A[:, k, k, None] * at + A[:, k, 2, None] for k in (0, 1))
    ends = torch.tensor([[image.shape[-1], image.shape[-2]] for image in images], dtype=A.dtype) - 0.5
    across, down = ((p >= -0.5) & (p <= end[:, None]) for p, end in zip((x, y), ends.unbind(-1), strict=True))
    return (down[:, None, :, None] & across[:, None, None, :]).float()


def _turned(T: Tensor, centre: Tensor, angles: Sequence[float], *, roll: float | None = None) -> Tensor:
    """(N, M, 4, 4) poses: each of (N, 4, 4), then turned about the camera's x and y axes by +-``angles`` degrees, and
    about its z axis by +-``roll``."""
    both = torch.cat([torch.eye(6, dtype=torch.float64)[:3], -torch.eye(6, dtype=torch.float64)[:3]])
    aside = [angle * both[[0, 3, 1, 4]] for angle in angles] + ([] if roll is None else [roll * both[[2, 5]]])
    twists = torch.deg2rad(torch.cat([0.0 * both[:1], *aside]))
    N, M = len(T), len(twists)
    return apply_twist(T.repeat_interleave(M, 0), twists.repeat(N, 1), centre).view(N, M, 4, 4)


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
    rival, second = torch.where(gap > SAME_POSE_SHIFT, supports, -1.0).max(dim=1)
    source = torch.cat([rows, rows[rival >= 0]])
    chosen = of_start[source, torch.cat([best, second[rival >= 0]])]
    return source, each[source].descend(fits[chosen], SECOND_RADII).T


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
