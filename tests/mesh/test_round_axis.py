"""Axes of nearly round meshes."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.mesh.round_axis import round_axis
from tests._support.canisters import canister


def handled_mug():
    handle = trimesh.creation.torus(0.9, 0.25)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    handle.apply_translation((1.2, 0.0, 0.0))
    return trimesh.util.concatenate([trimesh.creation.cylinder(1.0, 3.0, sections=48), handle])


def test_the_axis_of_a_canister_goes_through_its_body_and_not_through_its_ports():
    rotation = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.8]))
    mesh = canister()
    mesh.apply_transform(rotation)
    mesh.apply_translation((300.0, -40.0, 70.0))
    axis = round_axis(mesh)
    assert abs(float(axis.direction @ torch.from_numpy(rotation[:3, 2]))) > 0.9995
    to_axis = torch.linalg.cross(
        axis.point - torch.tensor([300.0, -40.0, 70.0]), axis.direction
    ).norm()
    assert float(to_axis) < 1.0, "mm, of a radius of 40"
    assert not axis.ends_are_alike


def test_ends_are_alike_where_a_body_stands_on_either():
    assert round_axis(trimesh.creation.cylinder(1.0, 3.0)).ends_are_alike
    assert not round_axis(trimesh.creation.cone(1.0, 4.0)).ends_are_alike


OTHERS = {
    "square prism": trimesh.creation.box((1, 1, 3)),
    "hexagon": trimesh.creation.cylinder(1.0, 2.0, sections=6),
    "sphere": trimesh.creation.icosphere(),
    "mug": handled_mug(),
}


@pytest.mark.parametrize("mesh", OTHERS.values(), ids=OTHERS)
def test_other_shapes_have_no_axis(mesh):
    assert round_axis(mesh) is None
