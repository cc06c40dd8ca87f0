"""Generated scenes and their ground truth."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.training.scenes import GeneratedScenes
from curvireg_torch.training.scenes.materials import random_picture
from curvireg_torch.training.scenes.scene import simulate_camera


@pytest.fixture(scope="module")
def scenes():
    return GeneratedScenes(200, seed=5)


def test_generated_scenes_depend_on_seed_and_index(scenes):
    again = GeneratedScenes(10, seed=5)
    for i in (3, 0):
        assert all(torch.equal(value, again[i][name]) for name, value in scenes[i].items())
    assert not torch.equal(scenes[3]["image"], GeneratedScenes(10, seed=6)[3]["image"])


def test_generated_scenes_have_the_stated_shapes_and_ranges(scenes):
    """Visible pixels are within the silhouette, up to one pixel."""
    for i in range(12):
        sample = scenes[i]
        assert (sample["image"].shape, sample["image"].dtype) == ((3, 128, 128), torch.float32)
        assert ((sample["image"] >= 0) & (sample["image"] <= 1)).all()
        assert sample["depth"].shape == sample["visible"].shape == (1, 128, 128)
        assert torch.linalg.det(sample["rotation"]) == pytest.approx(1.0, abs=1e-5)
        assert (sample["depth"] > 0).float().mean() > 0.003
        silhouette = torch.nn.functional.max_pool2d((sample["depth"] > 0).float(), 3, 1, 1) > 0
        assert not (sample["visible"] & ~silhouette).any()


def test_depth_matches_the_view_of_a_bank():
    """Independent oracle: the bank's renderer at the same rotation and distance; the box is jittered."""
    scenes = GeneratedScenes(12, seed=8, upright=1.0)
    agree = []
    for i in range(12):
        sample = scenes[i]
        describe = ViewDescriber(scenes.shape(i).mesh(), BankSettings(image_size=128))
        depth = describe.depth(sample["rotation"][None], sample["distance"][None])[0]
        a, b = depth[0, 0] > 0, sample["depth"][0] > 0
        agree.append(float((a & b).sum() / (a | b).sum()))
        if agree[-1] > 0.9:
            assert (depth[0, 0] - sample["depth"][0])[a & b].abs().median() < 0.05
    assert np.median(agree) > 0.8


def test_image_has_edges_at_the_border_of_the_mask():
    """Colours change more across the mask's border than elsewhere."""
    scenes = GeneratedScenes(12, seed=9)
    edges = []
    for i in range(12):
        image, mask = scenes[i]["image"].mean(dim=0), scenes[i]["visible"][0].float()
        step = (mask[:, 1:] - mask[:, :-1]).abs() > 0
        change = (image[:, 1:] - image[:, :-1]).abs()
        if step.sum() > 20:
            edges.append(float(change[step].mean() / change[~step].mean()))
    assert np.median(edges) > 2.0


def test_generated_scenes_of_given_meshes():
    scenes = GeneratedScenes(4, meshes=[trimesh.creation.box((1, 2, 3))], upright=0.0, image_size=64)
    extents = np.sort(np.ptp(scenes.shape(0).vertices, axis=0))
    assert np.allclose(extents, np.array([1, 2, 3]) / np.linalg.norm([0.5, 1, 1.5]))
    assert scenes[2]["image"].shape == (3, 64, 64)


def test_upright_objects_have_z_up_in_the_image():
    up = torch.stack([GeneratedScenes(30, seed=2, upright=1.0)[i]["rotation"][:, 2] for i in range(8)])
    assert (up[:, 1] < -0.3).all()  # the model's z axis points up in the picture, as in an upright bank
    assert (sample_views().rotations[:, 1, 2] < 0).all()


def test_generated_scenes_reject_bad_lengths_and_indices():
    with pytest.raises(InvalidInputError, match="length"):
        GeneratedScenes(0)
    with pytest.raises(IndexError):
        GeneratedScenes(3)[3]


def test_simulate_camera_keeps_bright_areas_bright():
    rng = np.random.default_rng(0)
    clean = np.zeros((64, 64, 3), np.float32)
    clean[16:48, 16:48] = 0.8
    for _ in range(10):
        picture = simulate_camera(clean, rng)
        assert (picture.dtype, picture.shape) == (np.uint8, clean.shape)
        assert picture[24:40, 24:40].mean() > picture[:8].mean() + 40


def test_object_is_visible_in_every_scene():
    """Also if ground or clutter would hide it."""
    scenes = GeneratedScenes(400, seed=77_000_001, upright=1.0)
    for i in range(24):
        sample = scenes[i]
        assert sample["visible"].float().mean() > 0.08 * (sample["depth"] > 0).float().mean(), i


@pytest.mark.parametrize("seed", range(8))
def test_random_picture_is_writable(seed):
    """For every kind of background, because rendering writes into it."""
    picture = random_picture(np.random.default_rng(seed), 16)
    picture.reshape(-1, 3)[:] = 0.5
    assert (picture == 0.5).all()
