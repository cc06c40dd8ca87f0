"""The contours of the object at a pose, and lines across its silhouette."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ...rendering import DepthRenderer
from ..contours.descent import pixels
from ..contours.points import ContourPoints, contour_points
from .window import SIZE, Window

__all__ = ["Outline", "render_outline"]

BESIDE = 2.5
"""Distance in px from a contour at which the two sides are looked up in the mask."""


@dataclass(frozen=True)
class Outline:
    """The mesh rendered at a pose ``T`` (1, 4, 4): ``depth`` (1, 1, S, S), its contour ``points``, and of those that
    have the background on one side, ``model`` (1, Q, 3) and unit ``normals`` (1, Q, 2) that point there."""

    T: Tensor
    depth: Tensor
    points: ContourPoints
    model: Tensor
    normals: Tensor


def render_outline(renderer: DepthRenderer, window: Window, T: Tensor, centre: Tensor, radius: float) -> Outline:
    """The outline at a pose ``T`` (1, 4, 4) in a window; ``centre`` (3,) and ``radius`` are the object's."""
    depth = renderer.render(T, window.K, (SIZE, SIZE)).cpu()
    points = contour_points(depth, T, window.K, radius=radius)
    uv, n = pixels(points.model, T, window.K, centre)[0], points.normals[0]
    ahead, behind = (_inside(depth, uv + step * n) for step in (BESIDE, -BESIDE))
    silhouette = (ahead ^ behind) & points.valid[0]
    outward = torch.where(ahead, -1.0, 1.0)[:, None] * n
    return Outline(T, depth, points, points.model[:, silhouette], outward[silhouette][None])


def _inside(depth: Tensor, uv: Tensor) -> Tensor:
    """(...) bool: whether pixels (..., 2) show the mesh."""
    x, y = uv.round().long().clamp(0, SIZE - 1).unbind(-1)
    return depth[0, 0, y, x] > 0
