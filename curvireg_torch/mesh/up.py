"""The axis of a mesh that points up when the object stands. Meshes and poses stay in the frame of the file."""

from typing import Any

import numpy as np

from ..geometry.viewpoint import up_rotation


def format_up(suffix: str) -> str:
    """The axis that points up in files of a format: y in glTF, by its specification; else z, as in CAD."""
    return "y" if suffix.lower() in (".glb", ".gltf") else "z"


def mesh_up(mesh: Any) -> str:
    """The up axis that :func:`load_mesh` noted, "z" for meshes from elsewhere."""
    return str(mesh.metadata.get("up", "z"))


def with_z_up(mesh: Any) -> Any:
    """The mesh, or a rotated copy whose z axis points up."""
    if mesh_up(mesh) == "z":
        return mesh
    T = np.eye(4)
    T[:3, :3] = up_rotation(mesh_up(mesh)).numpy()
    rotated = mesh.copy().apply_transform(T)
    rotated.metadata["up"] = "z"
    return rotated
