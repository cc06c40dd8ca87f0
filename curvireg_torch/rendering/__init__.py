"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

from .colour import render_colour, shade
from .depth import DepthRenderer, make_renderer, render_depth

__all__ = ["DepthRenderer", "make_renderer", "render_colour", "render_depth", "shade"]
