"""Photographs of dino in the order of their angles: a real sequence with steps of about 10 degrees."""

import pytest
import torch
from scripts.speed.follow import LARGEST_GAP, chains

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, read_image
from curvireg_torch.geometry import rotation_error
from curvireg_torch.registration import Follower
from tests._support.real_data import real_data

pytestmark = pytest.mark.data


def test_follower_keeps_dino_over_steps_of_ten_degrees():
    dataset = BOPDataset(real_data("bop/dino"))
    samples = [dataset.annotation(k) for k in range(len(dataset))]
    order = max(chains(torch.stack([s["rotation"] for s in samples]).double(), LARGEST_GAP), key=len)
    mesh = cr.load_mesh(samples[0]["model_path"], unit="mm")
    bank = cr.ViewBank.build(mesh, cr.sample_views(azimuth_step=90, elevations=[0]), progress=False)
    follow = Follower(cr.Registrar(bank), samples[order[0]]["camera_matrix"])
    first, *others = (samples[k] for k in order)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = first["rotation"], first["translation"]
    follow.start(read_image(first["image_path"]), pose)
    assert len(others) >= 2
    for sample in others:
        result = follow(read_image(sample["image_path"]))
        assert float(rotation_error(result.rotation, sample["rotation"].double())) < 5.0
        t = sample["translation"].double()
        assert float((result.translation - t).norm() / t.norm()) < 0.05
