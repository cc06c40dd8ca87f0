"""Mesh files of other tools: triangles, colours, unit and axis, as numpy arrays."""

from .colours import SurfaceColours
from .files import read_mesh
from .source import MeshWarning, ReadMesh

__all__ = ["MeshWarning", "ReadMesh", "SurfaceColours", "read_mesh"]
