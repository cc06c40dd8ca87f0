"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

from .colour import render_colour
from .factory import BACKENDS, make_renderer, render_depth
from .protocol import DepthRenderer

__all__ = ["BACKENDS", "DepthRenderer", "make_renderer", "render_colour", "render_depth"]
