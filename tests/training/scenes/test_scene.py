"""Generated scenes: the truth that comes with them is that of the picture."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import sample_views
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.settings import BankSettings
from curvireg_torch.training.scenes import GeneratedScenes
from curvireg_torch.training.scenes.camera_noise import simulate_camera
from curvireg_torch.training.scenes.materials import random_picture


@pytest.fixture(scope="module")
def scenes():
    return GeneratedScenes(200, seed=5)


def test_a_sample_depends_on_seed_and_index_alone(scenes):
    again = GeneratedScenes(10, seed=5)
    for i in (3, 0):
        for name, value in scenes[i].items():
            assert torch.equal(value, again[i][name]), name
    assert not torch.equal(scenes[3]["image"], GeneratedScenes(10, seed=6)[3]["image"])


def test_shapes_ranges_and_types(scenes):
    for i in range(6):
        sample = scenes[i]
        assert sample["image"].shape == (3, 128, 128)
        assert sample["image"].dtype == torch.float32
        assert sample["image"].min() >= 0
        assert sample["image"].max() <= 1
        assert sample["depth"].shape == sample["visible"].shape == (1, 128, 128)
        assert torch.linalg.det(sample["rotation"]) == pytest.approx(1.0, abs=1e-5)
        assert (sample["depth"] > 0).float().mean() > 0.003


def test_what_is_visible_is_the_object(scenes):
    """Visible pixels lie on the object's silhouette, or within a pixel of it."""
    for i in range(12):
        silhouette = torch.nn.functional.max_pool2d((scenes[i]["depth"] > 0).float(), 3, 1, 1) > 0
        assert (scenes[i]["visible"] & ~silhouette).float().sum() == 0


def test_depth_is_that_of_a_banks_view_of_the_same_pose():
    """Independent oracle: the bank's renderer, given rotation and distance; boxes are jittered, hence the tolerance."""
    scenes = GeneratedScenes(12, seed=8, upright=1.0)
    agree = []
    for i in range(12):
        sample = scenes[i]
        describe = ViewDescriber(scenes.shape(i).mesh(), BankSettings(image_size=128))
        depth = describe.depth(sample["rotation"][None], sample["distance"][None])[0]
        a, b = depth[0, 0] > 0, sample["depth"][0] > 0
        agree.append(float((a & b).sum() / (a | b).sum()))
        both = a & b
        if agree[-1] > 0.9:
            assert (depth[0, 0] - sample["depth"][0])[both].abs().median() < 0.05
    assert np.median(agree) > 0.8


def test_the_object_stands_out_of_the_picture():
    """Colours inside and outside differ more than two halves of the background do: the picture shows the mask."""
    scenes = GeneratedScenes(12, seed=9)
    edges = []
    for i in range(12):
        image, mask = scenes[i]["image"].mean(dim=0), scenes[i]["visible"][0].float()
        step = (mask[:, 1:] - mask[:, :-1]).abs() > 0
        change = (image[:, 1:] - image[:, :-1]).abs()
        if step.sum() > 20:
            edges.append(float(change[step].mean() / change[~step].mean()))
    assert np.median(edges) > 2.0


def test_own_meshes_take_the_objects_place():
    box = trimesh.creation.box((1, 2, 3))
    scenes = GeneratedScenes(4, meshes=[box], upright=0.0, image_size=64)
    assert np.allclose(
        np.sort(np.ptp(scenes.shape(0).vertices, axis=0)), np.array([1, 2, 3]) / np.linalg.norm([0.5, 1, 1.5])
    )
    assert scenes[2]["image"].shape == (3, 64, 64)


def test_upright_objects_are_seen_upright():
    up = torch.stack([GeneratedScenes(30, seed=2, upright=1.0)[i]["rotation"][:, 2] for i in range(8)])
    assert (up[:, 1] < -0.3).all()  # the model's z axis points up in the picture
    views = sample_views()
    assert (views.rotations[:, 1, 2] < 0).all()  # as in an upright bank


def test_errors():
    with pytest.raises(InvalidInputError, match="length"):
        GeneratedScenes(0)
    with pytest.raises(IndexError):
        GeneratedScenes(3)[3]


def test_a_camera_keeps_the_picture_recognisable():
    rng = np.random.default_rng(0)
    clean = np.zeros((64, 64, 3), np.float32)
    clean[16:48, 16:48] = 0.8
    for _ in range(10):
        picture = simulate_camera(clean, rng)
        assert picture.dtype == np.uint8
        assert picture.shape == clean.shape
        assert picture[24:40, 24:40].mean() > picture[:8].mean() + 40


def test_the_object_is_in_every_picture():
    """Also where the ground or clutter would hide it; and its pixels are its own, not the background's."""
    scenes = GeneratedScenes(400, seed=77_000_001, upright=1.0)
    for i in range(24):
        sample = scenes[i]
        assert sample["visible"].float().mean() > 0.08 * (sample["depth"] > 0).float().mean(), i


@pytest.mark.parametrize("seed", range(8))
def test_backgrounds_can_be_drawn_into(seed):
    """Of every kind: rays write their colours into the picture itself."""
    picture = random_picture(np.random.default_rng(seed), 16)
    picture.reshape(-1, 3)[:] = 0.5
    assert (picture == 0.5).all()
