"""The parts of a trimesh scene as one mesh."""

import numpy as np
import trimesh

from .colours import colours_of_parts
from .source import ReadMesh


def joined_scene(scene: trimesh.Scene) -> ReadMesh:
    """One mesh of a scene's parts at their places; ``scene.dump()`` would pack textures into one
    that cannot repeat."""
    geometry = {
        name: part for name, part in scene.geometry.items() if isinstance(part, trimesh.Trimesh)
    }
    colours = dict(zip(geometry, colours_of_parts(geometry.values()), strict=True))
    parts = []
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph.get(node)
        if name in geometry:
            part = ReadMesh.of_surface(geometry[name], colours[name])
            parts.append(part.transformed(np.asarray(place)))
    return ReadMesh.joined(parts)
