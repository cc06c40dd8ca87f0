"""The scene generator: annotations agree with an independent rendering, and scenes depend on seed and number alone."""

import json
import sys

import numpy as np
import pytest
import torch

from curvireg_torch import load_mesh, render_depth
from curvireg_torch.data import BOPDataset
from scripts.benchmark import make
from scripts.calibration.calibrate import fit_logistic
from scripts.training.field_dataset import FieldDataset
from scripts.training.generated import GeneratedScenes


def generate(monkeypatch, out, *words):
    options = ["--count", "2", "--size", "120", "160", "--models", "9", "--out", out, *words]
    monkeypatch.setattr(sys, "argv", ["make.py", *map(str, options)])
    monkeypatch.setattr(make, "MIN_PIXELS", 40)
    make.main()
    return BOPDataset(out)


def silhouette(sample):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3], T[:3, 3] = sample["rotation"].double(), sample["translation"].double()
    mesh = load_mesh(sample["model_path"], unit="mm")
    return render_depth(mesh, T, sample["camera_matrix"].double(), tuple(sample["image"].shape[1:]))[0, 0] > 0


@pytest.mark.parametrize("kind", ["printed", "solids"])
def test_poses_and_boxes_agree_with_the_models(kind, monkeypatch, tmp_path):
    data = generate(monkeypatch, tmp_path / "one", "--kind", kind)
    assert len(data) == 2
    for sample in data:
        rows, columns = silhouette(sample).nonzero().unbind(dim=1)
        found = torch.stack([columns.min(), rows.min(), columns.max(), rows.max()])
        assert float((found - sample["box"]).abs().max()) <= 1
        assert sample["visib_fract"] >= 0.4
    again = generate(monkeypatch, tmp_path / "two", "--kind", kind)
    assert torch.equal(data[1]["image"], again[1]["image"])
    assert not torch.equal(data[0]["image"], data[1]["image"])


def test_shelves_are_seen_by_several_cameras(monkeypatch, tmp_path):
    words = ("--kind", "shelf", "--objects", "5", "7", "--cameras", "2", "--occlusion", "0.5")
    data = generate(monkeypatch, tmp_path, *words)
    assert {(s["scene_id"], s["image_id"]) for s in data} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert all(s["visib_fract"] >= 0.5 for s in data)
    cameras = json.loads((tmp_path / "test" / "000000" / "scene_camera.json").read_text())
    truths = json.loads((tmp_path / "test" / "000000" / "scene_gt.json").read_text())
    world = []  # the pose in the world is the same from both cameras
    for key in ("0", "1"):
        R, t = np.array(cameras[key]["cam_R_w2c"]).reshape(3, 3), np.array(cameras[key]["cam_t_w2c"])
        poses = {p["obj_id"]: R.T @ (np.array(p["cam_t_m2c"]) - t) for p in truths[key]}
        world.append(poses)
    both = set(world[0]) & set(world[1])
    assert len(both) >= 3
    for obj_id in both:
        np.testing.assert_allclose(world[0][obj_id], world[1][obj_id], atol=1e-3)
    for sample in list(data)[:3]:
        visible = silhouette(sample)
        x0, y0, x1, y1 = sample["box_visible"].int().tolist()
        assert bool(visible[y0 : y1 + 1, x0 : x1 + 1].any())


def test_sequences_move_in_small_steps(monkeypatch, tmp_path):
    data = generate(monkeypatch, tmp_path, "--kind", "printed", "--frames", "4", "--count", "1")
    R = torch.stack([s["rotation"] for s in data])
    cosine = 0.5 * ((R[1:] * R[:-1]).sum(dim=(1, 2)) - 1.0)
    degrees = torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))
    assert len(R) == 4
    assert 0.0 < float(degrees.max()) <= 5.01


def test_training_targets_are_the_view_at_the_true_pose():
    sample = FieldDataset(GeneratedScenes(10, seed=1))[1]
    descriptors = torch.nn.functional.normalize(sample["descriptors"].float(), dim=1)
    same, *others = (descriptors[1:] @ descriptors[0]).tolist()
    assert same > 0.9 > max(others)


def test_calibration_finds_the_weights_that_made_the_data():
    rng = np.random.default_rng(0)
    rows = []
    for k in range(4000):
        x = rng.normal(size=2)
        right = bool(rng.random() < 1 / (1 + np.exp(-(2.0 * x[0] - x[1] + 0.5))))
        rows.append({"features": {"a": x[0], "b": x[1]}, "right": right, "group": str(k % 50)})
    model, quality = fit_logistic(rows)
    assert model["weights"]["a"] == pytest.approx(2.0, abs=0.25)
    assert model["weights"]["b"] == pytest.approx(-1.0, abs=0.2)
    assert quality["said"] == pytest.approx(quality["right"], abs=0.02)
