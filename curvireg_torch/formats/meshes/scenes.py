"""The parts of a trimesh scene as one mesh."""

import numpy as np
import trimesh

from .colours import colours_of_parts
from .source import ReadMesh


def joined_scene(scene: trimesh.Scene) -> ReadMesh:
    """One mesh of a scene's parts at their places: ``scene.dump()`` takes time with the cube of a
    part's depth, and would pack textures into one that cannot repeat."""
    geometry = {
        name: part for name, part in scene.geometry.items() if isinstance(part, trimesh.Trimesh)
    }
    colours = dict(zip(geometry, colours_of_parts(geometry.values()), strict=True))
    forest = scene.graph.transforms
    world = {scene.graph.base_frame: np.eye(4)}
    parts = []
    for node in scene.graph.nodes_geometry:
        path = [node]
        while path[-1] not in world and path[-1] in forest.parents:
            path.append(forest.parents[path[-1]])
        if path[-1] not in world:  # not below the base frame: trimesh searches the graph
            world[path[-1]] = scene.graph.get(path[-1])[0]
        for child, parent in zip(path[-2::-1], path[:0:-1], strict=True):
            world[child] = world[parent] @ forest.edge_data[parent, child].get("matrix", np.eye(4))
        name = forest.node_data[node]["geometry"]
        if name in geometry:
            vertices = np.array(geometry[name].vertices, np.float64)
            faces = np.array(geometry[name].faces, np.int64)
            parts.append(ReadMesh(vertices, faces, colours[name]).transformed(world[node]))
    return ReadMesh.joined(parts)
