"""Meshes: files of several formats become one trimesh with metadata for unit, up axis and
colours."""

from ..formats.meshes.source import MeshWarning
from .colours import SurfaceColours, has_colours, surface_colours
from .mesh import (
    as_mesh,
    load_mesh,
    mesh_centre,
    mesh_radius,
    mesh_unit,
    mesh_up,
    mesh_warnings,
    normalization_transform,
)
from .symmetry import mesh_symmetries

__all__ = [
    "MeshWarning",
    "SurfaceColours",
    "as_mesh",
    "has_colours",
    "load_mesh",
    "mesh_centre",
    "mesh_radius",
    "mesh_symmetries",
    "mesh_unit",
    "mesh_up",
    "mesh_warnings",
    "normalization_transform",
    "surface_colours",
]
