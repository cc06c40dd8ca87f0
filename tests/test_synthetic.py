"""Synthetic photographs: what is drawn agrees with the pose and the box that come with it."""

import numpy as np
import pytest
import torch

from curvireg_torch import Registrar, rotation_error, synthetic
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.rendering import render_depth
from curvireg_torch.synthetic import demo_scene, example_mesh, random_pose, synthesize_photograph
from tests._support import CAMERA, SIZE, eye, refused, seeded


def test_photograph_shows_the_colours_of_the_mesh_at_its_pose_which_must_show_the_object():
    generator = seeded(3)
    mesh = example_mesh()
    paint = np.array([[255, 0, 255, 255], [180, 0, 180, 255]], np.uint8)
    mesh.visual.face_colors = paint[np.arange(len(mesh.faces)) % 2]
    T = random_pose(mesh, CAMERA, SIZE, generator, elevations=(15.0, 45.0))
    grey = torch.full((3, *SIZE), 0.5)
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, generator, background=grey)
    drawn = (image[0] > 1.5 * image[1]) & (image[2] > 1.5 * image[1])
    expected = render_depth(example_mesh(), T, CAMERA, SIZE)[0, 0] > 0
    assert int((drawn & expected).sum()) / int((drawn | expected).sum()) > 0.95
    rows, columns = expected.nonzero().unbind(dim=1)
    inside = torch.stack([columns.min(), rows.min(), columns.max(), rows.max()])
    assert (box - inside).abs().max() < 1
    behind = eye(4)
    behind[2, 3] = -1.0
    with refused("no pixel"):
        synthesize_photograph(example_mesh(), behind, CAMERA, SIZE, torch.Generator())


@pytest.mark.slow
def test_demo_scenes_depend_on_the_seed_alone():
    first = demo_scene(1).image
    assert torch.equal(first, demo_scene(1).image)
    assert (first - synthetic.demo_scene().image).abs().mean() > 0.02


def test_painted_mesh_has_the_same_shape_and_a_red_front():
    plain = example_mesh()
    painted = example_mesh(painted=True)
    assert np.array_equal(plain.vertices, painted.vertices)
    red = painted.visual.face_colors[:, 0] > 190
    red &= painted.visual.face_colors[:, 1] < 60
    assert painted.triangles_center[red][:, 1].max() < painted.triangles_center[~red][:, 1].max()


@pytest.mark.slow
def test_demo_scenes_are_registered():
    registrar = Registrar(
        example_mesh(), pipeline=Pipeline().with_pose_prior("upright"), progress=False
    )
    for seed in range(5):
        scene = demo_scene(seed)
        result = registrar([scene.image], scene.box[None], scene.camera_matrix)[0]
        assert rotation_error(result.rotation, scene.truth[:3, :3]) < 2.5, seed
        assert result.reliable, seed
