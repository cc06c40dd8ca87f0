"""Texture fit: pulls poses to where the photograph shows the mesh's own colours.

The contours of a can do not determine its rotation about the axis; its label does.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
import torch
from torch import Tensor

from ...rendering import DepthRenderer
from ...rendering.contours import ContourPoints, MeshContours
from .corners import surface_corners
from .covariance import pose_covariance
from .descent import ContourProblem, ContourState, Matches, apply_twist, pixels, project
from .fit import FINE, ContourFit, full_size_problem

__all__ = ["fit_texture", "turned"]

CORNERS, APART, QUALITY = 160, 5, 0.005
"""Corners of a view: how many at most, how many px apart at least, and the least strength as a fraction of the
strongest one's."""

HALF = 7
"""Patches around corners are 15 px wide, and lie within the silhouette."""

CORRELATED = 0.4
"""Least normalised correlation of matching patches, which have weight 0 there and 1 where they are equal."""

ASIDE, LEAD = 4, 0.1
"""A match has less weight if, more than so many px aside, another one correlates nearly as well: a patch slides along
an edge."""

FAR, NEAR = (30, (32.0, 16.0, 8.0, 4.0)), (6, (6.0, 4.0, 2.0))
"""Of the two rounds: the search distance in px, and the scales of robust weights in px, one a step."""

PROMISING, ENOUGH = 0.1, 0.3
"""Fractions of the corners that must be in place after the two rounds."""

TURN = 16.0
"""Degrees by which poses are turned both ways about an axis that contours do not determine: within them, the search of
the first round reaches."""

LEAST = 8
"""Matches that a fit needs."""

IN_PLACE = 2.0
"""Distance in px within which a corner is where the pose has it."""

WEIGHT, JOINT_STEPS = 1.0, 3
"""Weight of a match beside that of an edge, and steps of the fit to both."""

LOST = 0.03
"""Edge support that a fit may lose."""


Draw = Callable[[Tensor, Tensor, tuple[int, int]], Tensor]


@dataclass(frozen=True)
class _Patches:
    """Corners of a view: ``model`` points (1, C, 3), where the photograph shows them, ``uv`` (1, C, 2) px, and the
    ``weight`` (1, C) in [0, 1] of that match."""

    model: Tensor
    uv: Tensor
    weight: Tensor

    def equations(self, T: Tensor, problem: ContourProblem, scale: float) -> tuple[Tensor, Tensor]:
        """Normal equations (1, 6, 6) and (1, 6) at a pose (1, 4, 4), with Geman-McClure weights of ``scale`` px."""
        matches = self.matches(T, problem, scale)
        WJ = matches.weight * matches.J
        return WJ.mT @ matches.J, (WJ.mT @ matches.distance)[..., 0]

    def matches(self, T: Tensor, problem: ContourProblem, scale: float) -> Matches:
        """Two equations for each corner, along x and y."""
        uv, J = project(self.model, T, problem.K, problem.centre)
        residual = self.uv - uv
        weight = self.weight * (1.0 + residual.square().sum(dim=-1) / scale**2) ** -2
        return Matches(J.flatten(1, 2), residual.flatten(1)[..., None], weight.repeat_interleave(2, 1)[..., None])

    def in_place(self, T: Tensor, problem: ContourProblem) -> float:
        """Fraction of the corners that are found where the pose has them."""
        gap = torch.linalg.vector_norm(self.uv - pixels(self.model, T, problem.K, problem.centre), dim=-1)
        return float(((self.weight > 0) & (gap < IN_PLACE)).double().mean())


@torch.no_grad()
def fit_texture(
    draw: Draw,
    renderer: DepthRenderer,
    contours: MeshContours,
    images: Sequence[Tensor],
    boxes: Tensor,
    camera_matrices: Tensor,
    starts: Tensor,
    *,
    image_index: Tensor,
    margin: float,
) -> ContourFit | None:
    """Fit one pose to the mesh's colours and to contours together.

    The coloured mesh is drawn at the pose, and patches around its corners are searched in the photograph by normalised
    correlation, which the strength of the light does not change. Robust least squares move the pose to where most of
    them are found, then to the edges as well; a second round searches nearer. The fit counts if in the end more corners
    are in place than at the start, three in ten of them at least, and the edge support is as before.

    Args:
        draw: (N, 3, H, W) pictures of the mesh from poses (N, 4, 4), cameras (N, 3, 3) and a size (H, W).
        starts: (N, 4, 4) the pose whose contours are fitted, and others that may be better (:func:`turned`).

    Returns:
        The fit, with the covariance from edges and patches; None where it does not count.
    """
    crops, problem = full_size_problem(contours, images, boxes, camera_matrices, image_index, margin)
    photograph, support = _pixels_of(crops[0]), problem.edge_support(problem.state(starts[:1]))
    rounds = [_round(draw, renderer, problem, photograph, start, *FAR) for start in starts.split(1)]
    coarse = max((one for one in rounds if one is not None), key=lambda one: one.after, default=None)
    if coarse is None or coarse.after < PROMISING:
        return None
    fine = _round(draw, renderer, problem, photograph, coarse.T, *NEAR)
    before = 0.0 if rounds[0] is None else rounds[0].before
    if fine is None or fine.after < ENOUGH or fine.after <= before:
        return None
    state = problem.state(fine.T)
    after = problem.edge_support(state)
    if bool(after < support - LOST):
        return None
    covariance, observable = _covariance(problem, state, fine.patches)
    return ContourFit(fine.T, covariance, edge_support=after, start_support=support, observable=observable)


def turned(fit: ContourFit, centre: Tensor) -> Tensor:
    """(1, 4, 4) or (3, 4, 4): the pose of a fit, then turned both ways about the axis that contours do not determine,
    if there is one."""
    T = fit.transform
    if int(fit.observable) == 6 or not bool(fit.covariance.isfinite().all()):
        return T
    axis = torch.linalg.eigh(fit.covariance[0, :3, :3])[1][:, -1]
    twists = torch.zeros(3, 6, dtype=torch.float64)
    twists[1:, :3] = math.radians(TURN) * torch.stack([axis, -axis])
    return apply_twist(T.expand(3, 4, 4), twists, centre)


@dataclass(frozen=True)
class _Round:
    """A pose after a round, what it was fitted to, and the fractions of the corners in place before and after."""

    T: Tensor
    patches: _Patches
    before: float
    after: float


def _round(
    draw: Draw,
    renderer: DepthRenderer,
    problem: ContourProblem,
    photograph: np.ndarray,
    start: Tensor,
    reach: int,
    scales: tuple[float, ...],
) -> _Round | None:
    """None where the view has few corners, or the photograph few of them."""
    view, T = _pixels_of(draw(start, problem.K, (problem.size, problem.size))[0]), start
    patches = _search(renderer, view, photograph, problem, T, reach)
    if patches is None:
        return None
    for scale in scales:
        A, b = patches.equations(T, problem, scale)
        A = A + torch.diag_embed(1e-4 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
        T = apply_twist(T, torch.linalg.solve(A, b), problem.centre)
    edges = problem.state(T).points
    for _ in range(JOINT_STEPS):
        A, b = patches.equations(T, problem, scales[-1])
        T = problem.step(edges, T, FINE[0], (WEIGHT * A, WEIGHT * b))
    return _Round(T, patches, patches.in_place(start, problem), patches.in_place(T, problem))


def _pixels_of(picture: Tensor) -> np.ndarray:
    """(S, S, 3) float32 of (C, S, S), C = 1 or 3."""
    return np.ascontiguousarray(picture.expand(3, -1, -1).permute(1, 2, 0).float().numpy())


def _search(
    renderer: DepthRenderer, view: np.ndarray, photograph: np.ndarray, problem: ContourProblem, T: Tensor, reach: int
) -> _Patches | None:
    """Corners of a view and where they are in the photograph, within ``reach`` px; None if there are few."""
    size = (problem.size, problem.size)
    depth = renderer.render(T, problem.K, size).cpu()
    grey = (255.0 * view.mean(axis=2)).round().astype(np.uint8)
    corners, model = surface_corners(
        grey, depth, T, problem.K, count=CORNERS, apart=APART, quality=QUALITY, inside=HALF
    )
    if len(corners) < LEAST:
        return None
    offset, certainty = _match(view, photograph, corners[:, 0].astype(int), corners[:, 1].astype(int), reach)
    weight = torch.from_numpy(certainty)
    if int((weight > 0).sum()) < LEAST:
        return None
    return _Patches(model, torch.from_numpy(corners + offset)[None], weight[None])


def _match(
    view: np.ndarray, photograph: np.ndarray, x: np.ndarray, y: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (C, 2) in px to where patches correlate most, and weights (C,) in [0, 1] of these matches."""
    border = HALF + reach
    padded = cv2.copyMakeBorder(photograph, border, border, border, border, cv2.BORDER_REFLECT)
    offset, weight = np.zeros((len(x), 2)), np.zeros(len(x))
    for i, (column, row) in enumerate(zip(x, y, strict=True)):
        patch = view[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]
        around = padded[row : row + 2 * border + 1, column : column + 2 * border + 1]
        scores = np.nan_to_num(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED), posinf=0.0, neginf=0.0)
        v, u = np.unravel_index(scores.argmax(), scores.shape)
        best = float(scores[v, u])
        offset[i] = u - reach + _vertex(scores[v], u), v - reach + _vertex(scores[:, u], v)
        scores[max(v - ASIDE, 0) : v + ASIDE + 1, max(u - ASIDE, 0) : u + ASIDE + 1] = 0.0
        clear = min(max(best - float(scores.max()), 0.0) / LEAD, 1.0)
        weight[i] = clear * max(best - CORRELATED, 0.0) / (1.0 - CORRELATED)
    return offset, weight


def _vertex(values: np.ndarray, k: int) -> float:
    """Offset in [-0.5, 0.5] of the peak of the parabola through three values around the largest."""
    if not 0 < k < len(values) - 1:
        return 0.0
    before, here, behind = values[k - 1 : k + 2].tolist()
    curvature = before - 2.0 * here + behind
    return 0.5 * (before - behind) / curvature if curvature < -1e-9 else 0.0


def _covariance(problem: ContourProblem, state: ContourState, patches: _Patches) -> tuple[Tensor, Tensor]:
    """:func:`pose_covariance` of edges and of the matches of a texture, as points with normals along x and y."""
    edges = problem.matches(state, FINE[-1])
    texture = patches.matches(state.T, problem, NEAR[1][-1])
    count = patches.model.shape[1]
    seen = torch.ones(1, 2 * count, dtype=torch.bool)
    axes = torch.eye(2, dtype=torch.float64).repeat(count, 1)[None]
    points = ContourPoints(patches.model.repeat_interleave(2, 1), axes, seen, ~seen)
    parts = (("J", texture.J), ("distance", texture.distance), ("weight", WEIGHT * texture.weight))
    both = Matches(*(torch.cat([getattr(edges, name), value], dim=1) for name, value in parts))
    joined = ContourPoints(
        *(torch.cat([getattr(some, f.name) for some in (state.points, points)], dim=1) for f in fields(ContourPoints))
    )
    return pose_covariance(both, joined, state.T, problem.K, problem.centre, radius=problem.contours.radius)
