"""Points on the object's surface, found in a new frame by optical flow from an earlier one."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..contours.corners import surface_corners
from ..contours.descent import apply_twist, pixels, project
from .window import Window

__all__ = ["Flow", "Keyframe", "flow_equations", "flow_share", "make_keyframe", "pose_from_flow", "track_points"]

POINTS, APART, QUALITY = 160, 5, 0.01
"""Corners of a keyframe: how many at most, how many px apart at least, and the least strength as a fraction of the
strongest one's."""

INSIDE = 3
"""Distance in px of a corner from the outline: nearer to it, patches show the background."""

PATCH = 15
"""Side of the patches of the optical flow in px."""

RETURN = 1.5
"""Largest distance in px between a corner and where the flow back from its match ends."""

SCALES = (24.0, 12.0, 6.0, 3.0, 2.0, 2.0, 2.0)
"""Scale of the weights in px in each least-squares step: at first all matches count, in the end those that agree."""

LEAST = 8
"""Matches that a pose from flow needs."""

FITS = 2.0
"""Scale of the weights in px of matches that fit a pose."""


@dataclass(frozen=True)
class Keyframe:
    """A frame with a known pose ``T`` (1, 4, 4): its window, and corners ``uv`` (P, 2) px, float32, at the points
    ``model`` (1, P, 3) of the surface."""

    window: Window
    T: Tensor
    uv: np.ndarray
    model: Tensor


@dataclass(frozen=True)
class Flow:
    """The ``model`` points (1, P, 3) that optical flow found at ``uv`` (1, P, 2) px of a window, of ``corners``."""

    model: Tensor
    uv: Tensor
    corners: int

    def moved(self, before: Tensor, after: Tensor) -> "Flow":
        """The same in another window of the photograph: ``before`` and ``after`` are the windows' cameras (1, 3, 3)."""
        A = (after @ torch.linalg.inv(before))[0]
        return Flow(self.model, self.uv @ A[:2, :2].mT + A[:2, 2], self.corners)


def make_keyframe(window: Window, T: Tensor, depth: Tensor) -> Keyframe:
    """Corners inside the object's outline, on its surface.

    Args:
        window: of the frame.
        T: (1, 4, 4) pose in it.
        depth: (1, 1, S, S) of the mesh at that pose.
    """
    uv, model = surface_corners(
        window.grey, depth, T, window.K, count=POINTS, apart=APART, quality=QUALITY, inside=INSIDE
    )
    return Keyframe(window, T, uv, model)


def track_points(keyframe: Keyframe, window: Window, T: Tensor, centre: Tensor, *, levels: int) -> Flow:
    """Corners of a keyframe in a new window, searched where the pose ``T`` (1, 4, 4) projects them.

    Matches from which the flow does not lead back to the corner are dropped. A pyramid of ``levels`` halvings lets the
    search reach further.
    """
    corners = len(keyframe.uv)
    if corners == 0:
        return Flow(keyframe.model, torch.zeros(1, 0, 2, dtype=torch.float64), 0)
    guess = pixels(keyframe.model, T, window.K, centre)[0].float().numpy()
    before, after = keyframe.window.grey, window.grey
    there, found = _optical_flow(before, after, keyframe.uv, guess, levels)
    back, returned = _optical_flow(after, before, there, keyframe.uv, levels)
    kept = torch.from_numpy(found & returned & (np.linalg.norm(back - keyframe.uv, axis=1) < RETURN))
    return Flow(keyframe.model[:, kept], torch.from_numpy(there).double()[None, kept], corners)


def _optical_flow(
    before: np.ndarray, after: np.ndarray, points: np.ndarray, guess: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (P, 2) of one picture are in another, searched at ``guess`` (P, 2); and (P,) whether found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        points,
        guess.copy(),
        winSize=(PATCH, PATCH),
        maxLevel=levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return there, found[:, 0] > 0


def pose_from_flow(flow: Flow, T: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """(1, 4, 4) pose that most matches agree on, by robust least squares from ``T`` (1, 4, 4); ``T`` if there are few.

    Example:
        >>> K = torch.tensor([[[200.0, 0, 128], [0, 200.0, 128], [0, 0, 1]]], dtype=torch.float64)
        >>> start, zero = torch.eye(4, dtype=torch.float64)[None], torch.zeros(3, dtype=torch.float64)
        >>> start[0, 2, 3] = 5.0
        >>> truth = apply_twist(start, torch.tensor([[0.05, -0.04, 0.03, 0.1, -0.1, 0.2]]).double(), zero)
        >>> points = torch.rand(1, 40, 3, dtype=torch.float64) - 0.5
        >>> uv = pixels(points, truth, K, zero)
        >>> uv[:, :12] += 30.0                                                        # matches of something else
        >>> bool((pose_from_flow(Flow(points, uv, 40), start, K, zero) - truth).abs().max() < 1e-3)
        True
    """
    if flow.uv.shape[1] < LEAST:
        return T
    for scale in SCALES:
        A, b = flow_equations(flow, T, K, centre, scale=scale)
        A = A + torch.diag_embed(1e-6 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
        T = apply_twist(T, torch.linalg.solve(A, b), centre)
    return T


def flow_equations(flow: Flow, T: Tensor, K: Tensor, centre: Tensor, *, scale: float = FITS) -> tuple[Tensor, Tensor]:
    """Normal equations (1, 6, 6) and (1, 6) of the matches at a pose, with Geman-McClure weights of ``scale`` px."""
    uv, J = project(flow.model, T, K, centre)
    residual = flow.uv - uv
    WJ = (_weights(residual, scale)[..., None, None] * J).flatten(1, 2)
    return WJ.mT @ J.flatten(1, 2), (WJ.mT @ residual.flatten(1)[..., None])[..., 0]


def flow_share(flow: Flow, T: Tensor, K: Tensor, centre: Tensor) -> float:
    """Fraction of the corners, in [0, 1], whose matches fit the pose ``T`` (1, 4, 4)."""
    return float(_weights(flow.uv - pixels(flow.model, T, K, centre), FITS).sum()) / max(flow.corners, 1)


def _weights(residual: Tensor, scale: float) -> Tensor:
    """(1, P) weights in (0, 1] of residuals (1, P, 2) px."""
    return (1.0 + residual.square().sum(dim=-1) / scale**2) ** -2
