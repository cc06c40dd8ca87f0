"""Meshes that several tests use."""

import numpy as np
import trimesh


def canister():
    """A closed cylinder of radius 40 and height 120 about z with a narrower neck and two ports on
    its top: round but for these."""
    parts = [
        trimesh.creation.cylinder(40.0, 120.0, sections=48),
        trimesh.creation.cylinder(25.0, 20.0, sections=48).apply_translation((0.0, 0.0, 70.0)),
    ]
    for x, y in ((0.0, 31.0), (22.0, -22.0)):
        port = trimesh.creation.cylinder(6.0, 14.0, sections=16)
        parts.append(port.apply_translation((x, y, 67.0)))
    mesh = trimesh.util.concatenate(parts)
    mesh.vertices = np.asarray(mesh.vertices)
    return mesh


def box_with_block(size, place):
    """A box of 200 x 120 x 80 with a block, whose middle lies at a ``place``."""
    block = trimesh.creation.box(size).apply_translation(place)
    return trimesh.util.concatenate([trimesh.creation.box((200, 120, 80)), block])
