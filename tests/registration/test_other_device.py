import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.rendering.visibility import FaceTests
from curvireg_torch.rendering.zbuffer import DeviceRenderer
from curvireg_torch.synthetic import example_mesh
from tests._support import (
    CAMERA,
    answer_to,
    bank_around,
    check_agreement,
    exact_registrar,
    first_scenes,
    learned_registrar,
)


@pytest.fixture
def elsewhere():
    """A device whose tensors do not mix with those of the CPU."""
    support = pytest.importorskip("tests._support.other_device", exc_type=AttributeError)
    with support.other_device() as device, torch.no_grad():
        yield device


def check_all(results, expected):
    for result, other in zip(results, expected, strict=True):
        check_agreement(result, other)


@pytest.mark.slow
def test_a_registration_is_computed_on_one_device(elsewhere):
    images, boxes, _ = first_scenes(2)
    expected = learned_registrar()(images, boxes, CAMERA)
    registrar = exact_registrar(learned_registrar().bank.to(elsewhere))
    check_all(registrar(images, boxes, CAMERA), expected)


@pytest.mark.slow
def test_a_bank_of_another_device_has_the_same_views(elsewhere):
    pipeline = cr.Pipeline().with_term("appearance", exhaustive_limit=4, top=3)
    bank, other = (
        bank_around(example_mesh(), 45, [0, 30], pipeline=pipeline, device=device)
        for device in ("cpu", elsewhere)
    )
    for name in ("points_at", "silhouettes_at"):
        here, there = (getattr(each, name)(slice(None)).cpu() for each in (bank, other))
        assert float((here != there).float().mean()) < 1e-3
    torch.testing.assert_close(other.boxes.cpu(), bank.boxes)
    error = (other.descriptors.cpu() - bank.descriptors).abs()
    assert (error > 5e-3).float().mean() < 1e-3  # a pixel of an edge more or less
    images, boxes, _ = first_scenes(1)
    found = cr.Registrar(other)(images, boxes, CAMERA)
    check_all(found, cr.Registrar(bank)(images, boxes, CAMERA))


@pytest.mark.slow
def test_photographs_in_a_block_have_the_poses_that_they_have_alone(monkeypatch):
    """The backend of devices, on the CPU."""
    images, boxes, _ = first_scenes(3)
    expected = learned_registrar()(images, boxes, CAMERA)
    registrar = exact_registrar(learned_registrar().bank)
    describer = registrar.describer
    monkeypatch.setattr("curvireg_torch.rendering.contours._visibility", FaceTests)
    describer.__dict__["contours"] = MeshContours(describer.view_mesh)
    describer.view_renderer = DeviceRenderer(example_mesh(), "cpu")
    together = registrar(images, boxes, CAMERA)
    check_all(together, expected)
    check_all([answer_to(seed, registrar) for seed in range(3)], together)
