"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

from .base import BACKENDS, DepthRenderer, make_renderer, render_depth
from .colour import render_colour

__all__ = ["BACKENDS", "DepthRenderer", "make_renderer", "render_colour", "render_depth"]
