"""Texture fit: pulls poses to where the photograph shows the mesh's own colours.

The contours of a can do not determine its rotation about the axis; its label does.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..rendering import DepthRenderer
from .contour_problem import ContourProblem
from .least_squares import (
    MIN_MATCHES,
    PointMatches,
    apply_twist,
    fit_points,
)
from .measured_fit import FULL_SIZE_RADII, ContourFit, measured_fit

# Corners of a view: how many at most, how many px apart at least, and the least strength as a
# fraction of the strongest one's
MAX_CORNERS = 160
CORNER_SPACING = 5
CORNER_QUALITY = 0.005
HALF_PATCH = 7  # Patches around corners are 15 px wide, and lie within the silhouette
# Least normalised correlation of matching patches, which have weight 0 there and 1 where they are
# equal
MIN_CORRELATION = 0.4
# A match has less weight if, more than so many px aside, another one correlates nearly as well: a
# patch slides along an edge
RIVAL_DISTANCE = 4
CLEAR_MARGIN = 0.1
# Of the two rounds: the search radius in px, the scales of robust weights in px, one a step, and
# with how many samples per pixel and axis the mesh is drawn: more of them in the first round take
# three times as long and find the same poses
FAR_ROUND = (30, (32.0, 16.0, 8.0, 4.0), 1)
NEAR_ROUND = (6, (6.0, 4.0, 2.0), 2)
MATCH_RADIUS = 12  # Search radius in px around a fitted pose whose camera may be wrong
# Distance in px at which a corner counts a quarter, and inlier ratios that a pose needs after the
# first round and after the second: patches seen from another side are found less exactly than those
# of the next frame, and correlate less
PATCH_INLIER_SCALE = 4.0
PROMISING_RATIO = 0.03
CONVINCING_RATIO = 0.15
# Degrees by which poses are turned both ways about an axis that contours do not determine: within
# them, the search of the first round reaches
TURN = 16.0
JOINT_STEPS = 3  # Steps of the fit to both corners and edges
MAX_SUPPORT_LOSS = 0.03  # Edge support that a fit may lose
Draw = Callable[[Tensor, Tensor, tuple[int, int], int], Tensor]


def surface_corners(
    grey: np.ndarray, depth: Tensor, T: Tensor, K: Tensor, *, quality: float, inside: int
) -> tuple[np.ndarray, Tensor]:
    """Corners of ``grey`` (S, S) uint8, (C, 2) whole px in float32, and the points (1, C, 3) of the
    model there. They lie ``inside`` px or more within the outline of the ``depth`` (1, 1, S, S) at
    a pose ``T`` (1, 4, 4) with camera ``K`` (1, 3, 3), and have at least ``quality`` times the
    strength of the strongest."""
    side = 2 * inside + 1
    mask = cv2.erode(
        (depth[0, 0] > 0).to(torch.uint8).numpy(), np.ones((side, side), np.uint8), borderValue=0
    )
    found = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, quality, CORNER_SPACING, mask=mask)
    uv = np.zeros((0, 2), np.float32) if found is None else found[:, 0]
    pixel = torch.from_numpy(uv).double()
    column, row = pixel.round().long().unbind(-1)
    rays = torch.cat([pixel, torch.ones_like(pixel[:, :1])], dim=1) @ torch.linalg.inv(K[0]).mT
    z = depth[0, 0, row, column].double()
    return uv, ((rays * z[:, None] - T[0, :3, 3]) @ T[0, :3, :3])[None]


@torch.no_grad()
def fit_texture(
    draw: Draw,
    renderer: DepthRenderer,
    problem: ContourProblem,
    photograph: Tensor,
    starts: Tensor,
) -> ContourFit | None:
    """Fit one pose to the mesh's colours and to contours together.

    The coloured mesh is drawn at the pose, and patches around its corners are searched in the
    photograph, both in grey, by normalised correlation. Robust least squares move the pose to where
    most of them are found, then to the edges as well; a second round searches nearer. The fit
    counts, and is not None, if in the end more corners are in place than at the start, and enough
    of them, and the edge support is as before.

    ``draw`` gives (N, 3, H, W) pictures of the mesh from poses (N, 4, 4), cameras (N, 3, 3), a size
    (H, W) and samples per pixel and axis. ``problem`` is that of one pose at full size, without a
    mask, ``photograph`` (C, S, S) its crop; ``starts`` (N, 4, 4) are those of
    :func:`rotated_starts`.
    """
    texture = _TextureRounds(draw, renderer, problem, _grey(photograph))
    support = problem.edge_support(problem.state(starts[:1]))
    rounds = [texture.round(start, *FAR_ROUND) for start in starts.split(1)]
    coarse = max(
        (one for one in rounds if one is not None), key=lambda one: one.after, default=None
    )
    if coarse is None or coarse.after < PROMISING_RATIO:
        return None
    fine = texture.round(coarse.T, *NEAR_ROUND)
    before = 0.0 if rounds[0] is None else rounds[0].before
    if fine is None or fine.after < CONVINCING_RATIO or fine.after <= before:
        return None
    state = problem.state(fine.T)
    after = problem.edge_support(state)
    if bool(after < support - MAX_SUPPORT_LOSS):
        return None
    return measured_fit(problem, state, after, support, fine.matches)


def texture_matches(
    draw: Draw, renderer: DepthRenderer, problem: ContourProblem, photograph: Tensor, T: Tensor
) -> PointMatches | None:
    """Where a photograph (C, S, S), the crop of a problem of one pose, shows corners of the mesh's
    colours at a fitted pose ``T`` (1, 4, 4) whose camera may be wrong; None where there are few."""
    texture = _TextureRounds(draw, renderer, problem, _grey(photograph))
    return texture.search(T, MATCH_RADIUS, NEAR_ROUND[2])


def rotated_starts(fit: ContourFit, centre: Tensor) -> Tensor:
    """(1, 4, 4) or (3, 4, 4): the pose of a fit, then turned both ways about the axis that contours
    do not determine, if there is one."""
    T = fit.transform
    if int(fit.observable) == 6 or not bool(fit.covariance.isfinite().all()):
        return T
    axis = torch.linalg.eigh(fit.covariance[0, :3, :3])[1][:, -1]
    twists = torch.zeros(3, 6, dtype=torch.float64)
    twists[1:, :3] = math.radians(TURN) * torch.stack([axis, -axis])
    return apply_twist(T.expand(3, 4, 4), twists, centre)


@dataclass(frozen=True)
class _Round:
    """A pose after a round, what it was fitted to, and the inlier ratios before and after."""

    T: Tensor
    matches: PointMatches
    before: float
    after: float


@dataclass(frozen=True)
class _TextureRounds:
    """One ``photograph`` (S, S) in grey of a contour problem, and the means to draw the mesh into
    it."""

    draw: Draw
    renderer: DepthRenderer
    problem: ContourProblem
    photograph: np.ndarray

    def round(
        self, start: Tensor, radius: int, scales: tuple[float, ...], samples: int
    ) -> _Round | None:
        """None where the view has few corners, or the photograph few of them."""
        K = self.problem.K
        centre = self.problem.centre
        matches = self.search(start, radius, samples)
        if matches is None:
            return None
        T = fit_points(matches, start, K, centre, scales)
        contour_points = self.problem.state(T).points
        for _ in range(JOINT_STEPS):
            points = matches.measurements(T, K, centre, scales[-1])
            T = self.problem.step(contour_points, T, FULL_SIZE_RADII[0], [points])
        before, after = (matches.inlier_ratio(at, K, scale=PATCH_INLIER_SCALE) for at in (start, T))
        return _Round(T, matches, before, after)

    def search(self, T: Tensor, radius: int, samples: int) -> PointMatches | None:
        """Corners of the view at a pose and where they are in the photograph; None if there are
        few."""
        problem = self.problem
        size = (self.problem.size, self.problem.size)
        view = _grey(self.draw(T, problem.K, size, samples)[0])
        depth = self.renderer.render(T, problem.K, size).cpu()
        levels = (255.0 * view).round().astype(np.uint8)
        corners, model = surface_corners(
            levels, depth, T, problem.K, quality=CORNER_QUALITY, inside=HALF_PATCH
        )
        if len(corners) < MIN_MATCHES:
            return None
        offset, weight = match_patches(view, self.photograph, corners.astype(int), radius)
        if int((weight > 0).sum()) < MIN_MATCHES:
            return None
        return PointMatches(
            model, torch.from_numpy(corners + offset)[None], torch.from_numpy(weight)[None]
        )


def _grey(picture: Tensor) -> np.ndarray:
    """(S, S) float32 of a picture (C, S, S): the mean of its channels."""
    return picture.float().mean(dim=0).numpy()


def match_patches(
    view: np.ndarray, photograph: np.ndarray, corners: np.ndarray, radius: int
) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (C, 2) in px to where patches of a view correlate most within a ``radius`` of the
    photograph, both (S, S) float32, around ``corners`` (C, 2), and weights (C,) in [0, 1] of
    these matches."""
    border = HALF_PATCH + radius
    padded = cv2.copyMakeBorder(photograph, border, border, border, border, cv2.BORDER_REFLECT)
    offset = np.zeros((len(corners), 2))
    weight = np.zeros(len(corners))
    for i, (x, y) in enumerate(corners):
        patch = view[y - HALF_PATCH : y + HALF_PATCH + 1, x - HALF_PATCH : x + HALF_PATCH + 1]
        around = padded[y : y + 2 * border + 1, x : x + 2 * border + 1]
        scores = np.nan_to_num(
            cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED), posinf=0.0, neginf=0.0
        )
        v, u = np.unravel_index(scores.argmax(), scores.shape)
        best = float(scores[v, u])
        offset[i] = u - radius + _vertex(scores[v], u), v - radius + _vertex(scores[:, u], v)
        near_v, near_u = (slice(max(k - RIVAL_DISTANCE, 0), k + RIVAL_DISTANCE + 1) for k in (v, u))
        scores[near_v, near_u] = 0.0
        clear = min(max(best - float(scores.max()), 0.0) / CLEAR_MARGIN, 1.0)
        weight[i] = clear * max(best - MIN_CORRELATION, 0.0) / (1.0 - MIN_CORRELATION)
    return offset, weight


def _vertex(values: np.ndarray, k: int) -> float:
    """Offset in [-0.5, 0.5] of the peak of the parabola through three values around the largest."""
    if not 0 < k < len(values) - 1:
        return 0.0
    before, here, behind = values[k - 1 : k + 2].tolist()
    curvature = before - 2.0 * here + behind
    return 0.5 * (before - behind) / curvature if curvature < -1e-9 else 0.0
