"""A mesh for examples."""

import math

import numpy as np
import trimesh

__all__ = ["example_mesh"]

RED, STEEL, WOOD, RUBBER = (196, 44, 34, 255), (120, 124, 130, 255), (222, 190, 138, 255), (44, 44, 48, 255)
PAINT = [STEEL, RED, RED, WOOD, WOOD, WOOD, STEEL, *[RUBBER] * 6]  # of the parts, in their order


def example_mesh(*, painted: bool = False) -> trimesh.Trimesh:
    """A toy truck, 0.25 m long, without symmetries; z up, front along -y, in metres.

    With ``painted``, its faces have colours.
    """
    box, cylinder = trimesh.creation.box, trimesh.creation.cylinder
    shift = trimesh.transformations.translation_matrix
    across = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    parts = [
        box((0.09, 0.25, 0.02), transform=shift((0, 0, 0.045))),  # frame
        box((0.09, 0.06, 0.075), transform=shift((0, -0.09, 0.09))),  # cabin
        box((0.085, 0.03, 0.03), transform=shift((0, -0.133, 0.07))),  # bonnet
        box((0.1, 0.15, 0.012), transform=shift((0, 0.045, 0.06))),  # bed
        box((0.008, 0.15, 0.035), transform=shift((0.046, 0.045, 0.08))),  # one high side
        box((0.1, 0.008, 0.05), transform=shift((0, 0.118, 0.085))),  # tailgate
        cylinder(0.008, 0.1, transform=shift((-0.035, -0.05, 0.13))),  # chimney
    ]
    for x in (-0.05, 0.05):
        parts += [cylinder(0.03, 0.02, transform=shift((x, y, 0.03)) @ across) for y in (-0.085, 0.055, 0.1)]
    mesh = trimesh.util.concatenate(parts)
    if painted:
        mesh.visual.face_colors = np.repeat(np.array(PAINT, np.uint8), [len(part.faces) for part in parts], axis=0)
    mesh.units = "m"
    return mesh
