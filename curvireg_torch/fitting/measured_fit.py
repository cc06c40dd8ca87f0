"""What the edges at fitted poses tell: support, covariance, and the directions that they
determine."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..rendering.contours import MeshContours
from ..utils.rows import Rows
from .contour_problem import ContourProblem, ContourState
from .edges import EdgeCrops
from .least_squares import Measurements, PointMatches, pixels, pose_covariance, project

FULL_SIZE_RADII = (4.0, 2.0, 2.0)
"""Search radius for edges in px at full size, one a round."""

SUPPORTED = 0.5
GAINED = 0.2
"""Edge support, or gain of it over the start, from which a fit is trusted; chosen on generated
scenes."""

CHANCE_SHIFT = 10.0
"""Shift of contour points in px of a crop, in ``CHANCE_DIRECTIONS``, after which they lie on
edges by chance."""
CHANCE_DIRECTIONS = 8


@dataclass(frozen=True)
class ContourFit(Rows):
    """N poses fitted to photographs.

    Attributes:
        transform: (N, 4, 4) float64 ``T_cam_from_model``.
        covariance: (N, 6, 6) float64, see :func:`fit_contours`; NaN where too few edges were found.
        edge_support: (N,) float64 in [0, 1), mean strength of the edges within about 1 px of the
            contour points.
        start_support: (N,) edge support of the starts (at half size for starts that are not
            finished).
        observable: (N,) int64, number of the six directions that the contours determine.
        edge_excess: (N,) float64, see :func:`edge_excess`.

    Example:
        >>> T = torch.eye(4).repeat(2, 1, 1)
        >>> covariance = torch.zeros(2, 6, 6)
        >>> support = torch.tensor([0.6, 0.3])
        >>> before = torch.tensor([0.2, 0.2])
        >>> observable = torch.tensor([6, 6])
        >>> fit = ContourFit(T, covariance, support, before, observable, edge_excess=support)
        >>> fit.trustworthy.tolist()
        [True, False]
    """

    transform: Tensor
    covariance: Tensor
    edge_support: Tensor
    start_support: Tensor
    observable: Tensor
    edge_excess: Tensor

    @property
    def trustworthy(self) -> Tensor:
        """(N,) bool: edge support of at least 0.5, or 0.2 more than the start's; less where the
        mesh is another."""
        return (self.edge_support >= SUPPORTED) | (self.edge_support - self.start_support >= GAINED)


def measured_fit(
    full: ContourProblem,
    state: ContourState,
    support: Tensor,
    before: Tensor,
    matches: PointMatches | None = None,
) -> ContourFit:
    """A fit, to edges and to ``matches`` if there are any, that ended in a ``state`` with its edge
    ``support`` (N,), that of its start being ``before`` (N,)."""
    measured, points = full.measured(state, FULL_SIZE_RADII[-1], matches)
    contours = full.contours
    covariance, observable = pose_covariance(
        measured, points, state.T, full.K, contours.centre, radius=contours.radius
    )
    return ContourFit(
        state.T,
        covariance,
        edge_support=support,
        start_support=before,
        observable=observable,
        edge_excess=edge_excess(full, state),
    )


@torch.no_grad()
def measure_contours(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> ContourFit:
    """What :func:`fit_to_edges` returns for poses ``T`` (N, 4, 4) that are right already: they stay
    as they are."""
    full = ContourProblem.of(contours, crops, K, image_index)
    state = full.state(T)
    support = full.edge_support(state)
    return measured_fit(full, state, support, support)


@torch.no_grad()
def edges_at(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> tuple[Tensor, Tensor]:
    """Edge support (N,) and :func:`edge_excess` (N,) of poses ``T`` (N, 4, 4) that are not fitted,
    as :class:`ContourFit` has them of fitted ones."""
    problem = ContourProblem.of(contours, crops, K, image_index)
    state = problem.state(T)
    return problem.edge_support(state), edge_excess(problem, state)


@torch.no_grad()
def ideal_covariance(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> Tensor:
    """(N, 6, 6) covariance that :class:`ContourFit` would have of poses ``T`` (N, 4, 4) if an edge
    lay at each contour point. A motion that is open then, no photograph of the pose determines to
    first order."""
    problem = ContourProblem.of(contours, crops, K, image_index)
    points = problem.state(T).points
    _, J = project(points.model, points.normals, T, problem.K, contours.centre)
    weight = points.valid[..., None].to(J)
    edges = Measurements(J, torch.zeros_like(weight), weight)
    return pose_covariance(edges, points, T, problem.K, contours.centre, radius=contours.radius)[0]


def edge_excess(problem: ContourProblem, state: ContourState) -> Tensor:
    """How far the edges under the contours of poses exceed what chance puts there.

    The mean strength of the edges at the outline, minus that at the same points shifted, plus the
    same of creases and inner contours, which counts less where there are fewer of them than points
    of the outline. Unlike edge support, it does not fall with the number of weak inner contours
    that a pose predicts, as long as they are there.

    Args:
        problem: of N poses at full size.
        state: of the poses, with their contour points.

    Returns:
        (N,) float64, about -0.3 to 1.5; near 0 for a pose that is far off.
    """
    points = state.points
    uv = pixels(points.model, state.T, problem.K)
    angle = torch.arange(CHANCE_DIRECTIONS) * (2.0 * math.pi / CHANCE_DIRECTIONS)
    shifts = CHANCE_SHIFT * torch.stack([angle.cos(), angle.sin()], dim=1).to(uv)
    places = torch.cat([uv[None], uv + shifts[:, None, None]])  # as predicted, and shifted
    copies = len(places)
    every = torch.arange(len(uv), device=uv.device).repeat(copies)
    normals = points.normals.repeat(copies, 1, 1)
    strength = problem[every].strength_near(places.flatten(0, 1), normals)
    strength = strength.unflatten(0, (copies, len(uv)))
    counted = points.valid & (problem.edges.counts(uv, points.valid, problem.image_index) > 0)
    excess = strength[0] - strength[1:].mean(dim=0)
    on_outline = counted & points.outline
    within = counted & ~points.outline
    outline_points = on_outline.sum(dim=1)
    most_points = torch.maximum(outline_points, within.sum(dim=1))
    of_outline = (excess * on_outline).sum(dim=1) / outline_points.clamp(min=1)
    of_inner = (excess * within).sum(dim=1) / most_points.clamp(min=1)
    excess_of_both: Tensor = of_outline + of_inner
    return excess_of_both
