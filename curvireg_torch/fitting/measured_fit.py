"""What the edges at fitted poses tell: support, covariance, and the directions that they
determine."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..rendering.contours import Contours
from ..utils.rows import Rows
from .contour_problem import ContourProblem, ContourState
from .edges import EdgeCrops
from .least_squares import pose_covariance

FULL_SIZE_RADII = (4.0, 2.0, 2.0)
"""Search radius for edges in px at full size, one a round."""

SUPPORTED = 0.5
GAINED = 0.2
"""Edge support, or gain of it over the start, from which a fit is trusted; chosen on generated
scenes."""


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
    """

    transform: Tensor
    covariance: Tensor
    edge_support: Tensor
    start_support: Tensor
    observable: Tensor

    @property
    def trustworthy(self) -> Tensor:
        """(N,) bool: edge support of at least 0.5, or 0.2 more than the start's; less where the
        mesh is another."""
        return (self.edge_support >= SUPPORTED) | (self.edge_support - self.start_support >= GAINED)


def measured_fit(
    full: ContourProblem, state: ContourState, support: Tensor, before: Tensor
) -> ContourFit:
    """A fit that ended in a ``state`` with its edge ``support`` (N,), that of its start being
    ``before`` (N,)."""
    edges = full.measured_edges(state, FULL_SIZE_RADII[-1])
    contours = full.contours
    covariance, observable = pose_covariance(
        edges, state.points, state.T, full.K, contours.centre, radius=contours.radius
    )
    return ContourFit(
        state.T, covariance, edge_support=support, start_support=before, observable=observable
    )


@torch.no_grad()
def measure_contours(
    contours: Contours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> ContourFit:
    """What :func:`fit_to_edges` returns for poses ``T`` (N, 4, 4) that are right already: they stay
    as they are."""
    full = ContourProblem.of(contours, crops, K, image_index)
    state = full.state(T)
    support = full.edge_support(state)
    return measured_fit(full, state, support, support)


@torch.no_grad()
def contour_support(
    contours: Contours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> Tensor:
    """(N,) edge support of poses that are not fitted, as :attr:`ContourFit.edge_support` is of
    fitted ones."""
    problem = ContourProblem.of(contours, crops, K, image_index)
    return problem.edge_support(problem.state(T))
