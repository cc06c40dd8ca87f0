"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

import warnings

from torch import Tensor

from .base import BACKENDS, DepthRenderer, make_renderer, render_depth
from .colour import render_colour

__all__ = ["BACKENDS", "DepthRenderer", "make_renderer", "render_colour", "render_depth"]


def render_views(
    renderer: DepthRenderer,
    T_cam_from_model: Tensor,
    camera_matrix: Tensor,
    size: tuple[int, int],
    *,
    orthographic: bool = False,
) -> Tensor:
    """Deprecated name of ``renderer.render``."""
    warnings.warn("render_views is deprecated; use renderer.render", DeprecationWarning, stacklevel=2)
    return renderer.render(T_cam_from_model, camera_matrix, size, orthographic=orthographic)
