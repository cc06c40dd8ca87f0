"""Mesh files of other tools: triangles, colours, unit and axis, as numpy arrays."""

from .colours import SurfaceColours as SurfaceColours
from .files import read_mesh as read_mesh
from .source import MeshWarning as MeshWarning
from .source import ReadMesh as ReadMesh
