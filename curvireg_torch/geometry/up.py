"""Which axis of a mesh points up when the object stands. Meshes and poses stay in the file's own frame."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._checks import check_option
from .._choices import UP_AXES

__all__ = ["UP_AXES", "format_up", "mesh_up", "up_rotation", "with_z_up"]


def up_rotation(up: str) -> Tensor:
    """(3, 3) float64 rotation that takes points of a frame whose axis ``up`` points up to one where z does.

    glTF's front, +z under y up, becomes -y, the front of PASCAL3D+ at azimuth 0.

    Args:
        up: "x", "y", "z", "-x", "-y" or "-z".

    Example:
        >>> (up_rotation("y") @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)).tolist()
        [0.0, 0.0, 1.0]
    """
    check_option(up, UP_AXES, "up")
    return torch.tensor(UP_AXES[up], dtype=torch.float64)


def format_up(suffix: str) -> str:
    """The axis that points up in files of a format: y in glTF, by its specification; else z, as in CAD."""
    return "y" if suffix.lower() in (".glb", ".gltf") else "z"


def mesh_up(mesh: Any) -> str:
    """The axis that points up in a mesh of :func:`load_mesh`, "z" in one from elsewhere."""
    return str(mesh.metadata.get("up", "z"))


def with_z_up(mesh: Any) -> Any:
    """The mesh, turned where its z axis does not point up."""
    if mesh_up(mesh) == "z":
        return mesh
    T = np.eye(4)
    T[:3, :3] = up_rotation(mesh_up(mesh)).numpy()
    turned = mesh.copy().apply_transform(T)
    turned.metadata["up"] = "z"
    return turned
