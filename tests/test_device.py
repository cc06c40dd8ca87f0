"""Registration on a device gives the results of the CPU.

The device is simulated (``_support/pretended.py``), so no GPU is needed.
"""

import copy
from dataclasses import replace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.detectors import DETECTORS
from curvireg_torch.features import appearance
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import localize
from curvireg_torch.synthetic import example_mesh
from tests._support.pretended import PRETENDING, Pretended, pretended_gpu
from tests._support.scenes import CAMERA, scene, truck_bank

pytestmark = PRETENDING

VIEWS = cr.sample_views(azimuth_step=45, elevations=[10, 40])


@pytest.fixture(autouse=True)
def _single_picture_and_thread(monkeypatch):
    """As on a CPU: the rounding of convolutions depends on the numbers of pictures and threads."""
    monkeypatch.setattr(appearance, "CHUNK", 1)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def bank():
    return cr.ViewBank.build(example_mesh(), VIEWS, image_size=64, progress=False)


def test_pretended_gpu_refuses_what_a_gpu_refuses():
    with pretended_gpu() as device:
        x, here = torch.ones(2, 3, device=device), torch.ones(2, 3)
        for mix in (lambda: x + here, lambda: here[x[:, 0].long() - 1], lambda: torch.cat([x, here]), x.numpy):
            with pytest.raises((RuntimeError, TypeError), match="device"):
                mix()
        assert isinstance(x[torch.tensor([0])] + torch.tensor(1.0), Pretended)  # a GPU accepts these
        assert x.add_(1.0) is x
        assert x.cpu().tolist() == x.tolist() == [[2.0] * 3] * 2
        assert torch.zeros_like(x).device == torch.tensor([1.0], device=device).device == device


LAYERS = [
    cr.AnisotropicDiffusion(iterations=3),
    cr.ApparentRidges(),
    cr.AverageShadingGradient(),
    cr.DepthCurvilinearSaliency(),
    cr.EdgeBlur(),
    cr.HessianFrobeniusNorm(),
    cr.ImageCurvilinearSaliency(),
    cr.ImageGradient(),
    cr.LearnedCurvilinearSaliency(),
    cr.MultiScaleCurvilinearSaliency(),
    cr.MultiScaleFocusCurves(),
    cr.PrincipalCurvatureImage(),
]


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_layers_on_a_device(layer):
    def described(layer, image):
        out = layer(image)
        return cr.HOG()(out) if out.shape[1] == 2 else out

    image = torch.rand(2, 1, 48, 56, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = described(layer, image)
    with pretended_gpu() as device, torch.no_grad():
        out = described(copy.deepcopy(layer).to(device), image.to(device))
        assert out.device == device
        assert torch.equal(out.cpu(), expected)


@pytest.mark.parametrize("name", DETECTORS)
def test_detectors_on_a_device(name):
    image = torch.rand(1, 1, 40, 48, generator=torch.Generator().manual_seed(0))
    expected = DETECTORS[name](image)
    with pretended_gpu() as device:
        found = DETECTORS[name](image.to(device))
        assert torch.equal(found.points.cpu(), expected.points)


def test_rotation_from_viewpoint_mixes_numbers_and_device_tensors():
    azimuth = torch.tensor([10.0, 20.0])
    with pretended_gpu() as device:
        R = cr.rotation_from_viewpoint(azimuth.to(device), 30.0, 5.0)
        assert torch.equal(R.cpu(), cr.rotation_from_viewpoint(azimuth, 30.0, 5.0))
        assert cr.rotation_from_viewpoint(0.0, azimuth.to(device)).device == R.device == device


def test_build_on_a_device(bank):
    with pretended_gpu() as device:
        built = cr.ViewBank.build(example_mesh(), VIEWS, image_size=64, progress=False, device=device)
        assert built.device == device
        for name, tensor in bank.tensors.items():
            assert torch.equal(built.tensors[name].cpu(), tensor), name
        rendered = cr.ViewBank.build(
            example_mesh(), VIEWS, image_size=64, progress=False, device=device, renderer="torch"
        )
        assert (rendered.descriptors.cpu() - bank.descriptors).abs().mean() < 0.01


def assert_same(ours, expected):
    assert torch.equal(ours.rotation.cpu(), expected.rotation)
    assert torch.equal(ours.translation.cpu(), expected.translation)
    assert ours.score == expected.score
    assert ours.confidence == pytest.approx(expected.confidence, rel=1e-6)  # batches differ
    assert len(ours.hypotheses) == len(expected.hypotheses)


@pytest.mark.parametrize("preset", ["learned", "classical"])
def test_registrar_on_a_device(preset):
    """Photographs on either device; the box of one is corrected."""
    pipeline = replace(PRESETS[preset], bank=replace(PRESETS[preset].bank, image_size=64), hypotheses=2)
    bank = cr.ViewBank.build(example_mesh(), VIEWS, pipeline=pipeline, progress=False)
    image, box, _ = scene(0)
    wrong = box + 0.2 * (box[2:] - box[:2]).repeat(2) * torch.tensor([-0.9, 0.75, 0.1, 1.0])
    images, boxes = [image, (255 * image).round().byte()], torch.stack([box, wrong])
    expected = cr.Registrar(bank)(images, boxes, CAMERA)
    assert [one.corrected_box is not None for one in expected] == [False, True]
    with pretended_gpu() as device:
        results = cr.Registrar(bank, device=device)(
            [images[0].to(device), images[1]], boxes.to(device), CAMERA.to(device)
        )
        for result, one in zip(results, expected, strict=True):
            assert_same(result, one)
        assert torch.equal(results[1].corrected_box, expected[1].corrected_box)


def test_localize_on_a_device(bank):
    image, _, _ = scene(0)
    expected = localize(cr.Registrar(bank), [image], CAMERA)[0]
    with pretended_gpu() as device:
        found = localize(cr.Registrar(bank, device=device), [image.to(device)], CAMERA)[0]
        assert_same(found[0], expected[0])
        assert torch.equal(found[0].localization.box.cpu(), expected[0].localization.box)
        assert found[0].localization.presence == expected[0].localization.presence


def test_registrar_ignores_the_default_dtype():
    image, box, _ = scene(0)
    expected = cr.Registrar(truck_bank())([image], box[None], CAMERA)[0]
    torch.set_default_dtype(torch.float64)
    try:
        result = cr.Registrar(truck_bank())([image], box[None], CAMERA)[0]
    finally:
        torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(result.transform, expected.transform, atol=1e-6, rtol=0.0)
    assert result.score == pytest.approx(expected.score, abs=1e-6)
