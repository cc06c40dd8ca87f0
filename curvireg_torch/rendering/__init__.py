"""Depth images of meshes behind one protocol; every backend samples the pixel's centre."""

from .depth import make_renderer as make_renderer
from .depth import render_depth as render_depth
from .renderer import DepthRenderer as DepthRenderer
from .shading import render_colour as render_colour
from .shading import shade as shade
