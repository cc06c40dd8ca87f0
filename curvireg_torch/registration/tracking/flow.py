"""Points on the object's surface, tracked from an earlier frame by optical flow."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ..contours.descent import apply_twist, pixels, project
from .window import Window

__all__ = ["Flow", "Keyframe", "make_keyframe", "pose_from_flow", "track_points"]

POINTS, APART, QUALITY = 160, 5, 0.01
"""Corners of a keyframe: most of them, smallest distance in px, and strength as a fraction of the strongest."""

INSIDE = 3
"""Smallest distance in px of a corner from the outline, beyond which the background moves otherwise."""

PATCH, LEVELS = 15, 3
"""Side of the patches of the optical flow in px, and levels of its pyramid above the first."""

RETURN = 1.5
"""Largest distance in px between a point and where the flow back from its match ends."""

SCALES = (24.0, 12.0, 6.0, 3.0, 2.0, 2.0, 2.0)
"""Of the Geman-McClure weights in px, one for each least-squares step: from a convex problem to a robust one."""


@dataclass(frozen=True)
class Keyframe:
    """A frame with a known pose ``T`` (1, 4, 4): its window, and corners ``uv`` (P, 2) on the surface at the model
    points ``model`` (P, 3)."""

    window: Window
    T: Tensor
    uv: np.ndarray
    model: Tensor


@dataclass(frozen=True)
class Flow:
    """Model points (1, P, 3) and where optical flow found them, ``uv`` (1, P, 2) px of the new window."""

    model: Tensor
    uv: Tensor


def make_keyframe(window: Window, T: Tensor, depth: Tensor) -> Keyframe:
    """Corners inside the object's outline, on its surface.

    Args:
        window: of the frame.
        T: (1, 4, 4) pose in it.
        depth: (1, 1, S, S) of the mesh at that pose.
    """
    inside = (depth[0, 0] > 0).to(torch.uint8).numpy()
    inside = cv2.erode(inside, np.ones((2 * INSIDE + 1, 2 * INSIDE + 1), np.uint8), borderValue=0)
    found = cv2.goodFeaturesToTrack(window.grey, POINTS, QUALITY, APART, mask=inside)
    uv = np.zeros((0, 2), np.float32) if found is None else found[:, 0]
    pixel = torch.from_numpy(uv).double()
    z = depth[0, 0, pixel[:, 1].round().long(), pixel[:, 0].round().long()].double()
    rays = torch.cat([pixel, torch.ones_like(pixel[:, :1])], dim=1) @ torch.linalg.inv(window.K[0]).mT
    model = (rays * z[:, None] - T[0, :3, 3]) @ T[0, :3, :3]
    return Keyframe(window, T, uv, model)


def track_points(keyframe: Keyframe, window: Window, T: Tensor, centre: Tensor, *, levels: int = LEVELS) -> Flow:
    """Corners of a keyframe in a new window, where a pose ``T`` (1, 4, 4) predicts them.

    A match whose flow back does not return to its corner is dropped.
    """
    if len(keyframe.uv) == 0:
        return Flow(torch.zeros(1, 0, 3, dtype=torch.float64), torch.zeros(1, 0, 2, dtype=torch.float64))
    guess = pixels(keyframe.model[None], T, window.K, centre)[0].float().numpy()
    options = {"winSize": (PATCH, PATCH), "maxLevel": levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    before, after = keyframe.window.grey, window.grey
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, keyframe.uv, guess.copy(), **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, keyframe.uv.copy(), **options)
    near = np.linalg.norm(back - keyframe.uv, axis=1) < RETURN
    kept = torch.from_numpy((found[:, 0] > 0) & (returned[:, 0] > 0) & near)
    return Flow(keyframe.model[kept][None], torch.from_numpy(there).double()[kept][None])


def pose_from_flow(flow: Flow, T: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """(1, 4, 4) pose of most matches, from a start ``T`` (1, 4, 4), by graduated robust least squares."""
    for scale in SCALES:
        A, b = flow_equations(flow, T, K, centre, scale)
        A = A + torch.diag_embed(1e-6 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
        T = apply_twist(T, torch.linalg.solve(A, b), centre)
    return T


def flow_equations(flow: Flow, T: Tensor, K: Tensor, centre: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Normal equations A (1, 6, 6), b (1, 6) of the matches with Geman-McClure weights."""
    uv, J = project(flow.model, T, K, centre)
    residual = flow.uv - uv
    weight = flow_weights(residual, scale)
    WJ = (weight[..., None, None] * J).flatten(1, 2)
    J = J.flatten(1, 2)
    return WJ.mT @ J, (WJ.mT @ residual.flatten(1)[..., None])[..., 0]


def flow_weights(residual: Tensor, scale: float) -> Tensor:
    """(..., P) weights in (0, 1] of residuals (..., P, 2) px."""
    return (1.0 + residual.square().sum(dim=-1) / scale**2) ** -2
