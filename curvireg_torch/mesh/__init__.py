"""Meshes: files of several formats become one clean surface with its unit, up axis and colours."""

from ..formats.meshes.colours import SurfaceColours
from ..formats.meshes.source import MeshWarning
from .mesh import (
    Mesh,
    as_mesh,
    load_mesh,
    mesh_centre,
    mesh_radius,
    normalization_transform,
)
from .symmetry import mesh_symmetries

__all__ = [
    "Mesh",
    "MeshWarning",
    "SurfaceColours",
    "as_mesh",
    "load_mesh",
    "mesh_centre",
    "mesh_radius",
    "mesh_symmetries",
    "normalization_transform",
]
