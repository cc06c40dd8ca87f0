"""Meshes: files of several formats become one trimesh with metadata for unit, up axis and
colours."""

from ..formats.meshes.source import MeshWarning as MeshWarning
from .colours import SurfaceColours as SurfaceColours
from .colours import has_colours as has_colours
from .colours import surface_colours as surface_colours
from .mesh import as_mesh as as_mesh
from .mesh import load_mesh as load_mesh
from .mesh import mesh_centre as mesh_centre
from .mesh import mesh_radius as mesh_radius
from .mesh import mesh_unit as mesh_unit
from .mesh import mesh_up as mesh_up
from .mesh import mesh_warnings as mesh_warnings
from .mesh import normalization_transform as normalization_transform
from .symmetry import mesh_symmetries as mesh_symmetries
