"""Uniformly distributed rotations."""

import numpy as np
import torch

from curvireg_torch.geometry import rotation_error
from curvireg_torch.training.scenes import GeneratedScenes
from curvireg_torch.training.scenes.rotations import random_rotation


def haar(count, rng):
    """Independent oracle: columns by Gram-Schmidt of normal vectors, right-handed."""
    a, b = rng.normal(size=(2, count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b -= (a * b).sum(axis=1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return np.stack([a, b, np.cross(a, b)], axis=2)


def test_random_rotation_is_uniform():
    """The mean is 0, angles have the density (1 - cos t) / pi, and every probe has a rotation nearby."""
    rng = np.random.default_rng(0)
    rotations = np.stack([random_rotation(rng) for _ in range(8000)])
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(rotations), 1.0)
    assert np.abs(rotations.mean(axis=0)).max() < 0.03  # five standard errors of sqrt(1 / 3 / 8000)
    probes = torch.from_numpy(haar(1000, rng))
    cosine = (torch.einsum("pij,nij->pn", probes, torch.from_numpy(rotations)) - 1.0) / 2.0
    near = torch.rad2deg(torch.acos(cosine.max(dim=1).values.clamp(-1, 1)))
    assert near.max() < 15.0
    angles = np.sort(torch.acos(cosine[0].clamp(-1, 1)).numpy())
    expected = (angles - np.sin(angles)) / np.pi
    assert np.abs(expected - np.linspace(0, 1, len(angles))).max() < 0.02  # Kolmogorov-Smirnov, p = 0.003


def test_generated_scenes_have_uniform_orientations():
    """Neither the identity nor the quarter with R00 < 0 that LAPACK's QR decomposition gives."""
    scenes = GeneratedScenes(40, seed=3, upright=0.0, image_size=16)
    rotations = torch.stack([scenes[i]["rotation"] for i in range(40)])
    assert all(((rotations[:, k, k] < 0).float().mean() - 0.5).abs() < 0.3 for k in range(3))
    assert rotation_error(rotations[:, None], rotations[None]).median() > 90.0
