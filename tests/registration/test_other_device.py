from dataclasses import replace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.rendering.visibility import FaceTests
from curvireg_torch.rendering.zbuffer import DeviceRenderer
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.terms import Appearance
from tests._support import CAMERA, exact_registrar, learned_registrar, scene

VIEWS = cr.sample_views(azimuth_step=45, elevations=[0, 30])
AGREES = 0.05  # degrees


@pytest.fixture
def elsewhere():
    """A device whose tensors do not mix with those of the CPU."""
    support = pytest.importorskip("tests._support.other_device", exc_type=AttributeError)
    with support.other_device() as device, torch.no_grad():
        yield device


def photographs(count):
    scenes = [scene(seed) for seed in range(count)]
    return [image for image, _, _ in scenes], torch.stack([box for _, box, _ in scenes])


def check_agreement(results, expected):
    for result, other in zip(results, expected, strict=True):
        assert result.ok
        assert cr.rotation_error(result.rotation, other.rotation) < AGREES
        assert result.confidence == pytest.approx(other.confidence, abs=0.01)


@pytest.mark.slow
def test_a_registration_is_computed_on_one_device(elsewhere):
    images, boxes = photographs(2)
    expected = learned_registrar()(images, boxes, CAMERA)
    registrar = exact_registrar(learned_registrar().bank.to(elsewhere))
    check_agreement(registrar(images, boxes, CAMERA), expected)


@pytest.mark.slow
def test_a_bank_of_another_device_has_the_same_views(elsewhere):
    appearance = replace(Appearance(), exhaustive_limit=4, top=3)
    terms = tuple(
        appearance if isinstance(term, Appearance) else term for term in cr.Pipeline().terms
    )
    pipeline = replace(cr.Pipeline(), terms=terms)
    options = {"pipeline": pipeline, "image_size": 96, "progress": False}
    bank = cr.ViewBank.build(example_mesh(), VIEWS, **options)
    other = cr.ViewBank.build(example_mesh(), VIEWS, device=elsewhere, **options)
    every = slice(None)
    differs = (other.points_at(every).cpu() != bank.points_at(every)).float().mean()
    assert float(differs) < 1e-3
    differs = (other.silhouettes_at(every).cpu() != bank.silhouettes_at(every)).float().mean()
    assert float(differs) < 1e-3
    torch.testing.assert_close(other.boxes.cpu(), bank.boxes)
    error = (other.descriptors.cpu() - bank.descriptors).abs()
    assert (error > 5e-3).float().mean() < 1e-3  # a pixel of an edge more or less
    images, boxes = photographs(1)
    found = cr.Registrar(other)(images, boxes, CAMERA)
    check_agreement(found, cr.Registrar(bank)(images, boxes, CAMERA))


@pytest.mark.slow
def test_photographs_in_a_block_have_the_poses_that_they_have_alone(monkeypatch):
    """The backend of devices, on the CPU."""
    images, boxes = photographs(3)
    expected = learned_registrar()(images, boxes, CAMERA)
    registrar = exact_registrar(learned_registrar().bank)
    describer = registrar.describer
    monkeypatch.setattr("curvireg_torch.rendering.contours._visibility", FaceTests)
    describer.__dict__["contours"] = MeshContours(describer.view_mesh)
    describer.view_renderer = DeviceRenderer(example_mesh(), "cpu")
    together = registrar(images, boxes, CAMERA)
    check_agreement(together, expected)
    alone = [registrar(images[k : k + 1], boxes[k : k + 1], CAMERA)[0] for k in range(3)]
    check_agreement(alone, together)
