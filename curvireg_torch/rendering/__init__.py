"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

from .depth import make_renderer, render_depth
from .renderer import DepthRenderer
from .shading import render_colour, shade

__all__ = ["DepthRenderer", "make_renderer", "render_colour", "render_depth", "shade"]
