import copy

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import CAMERA, scene, truck_bank

VIEWS = cr.sample_views(azimuth_step=45, elevations=[10, 40])
MODULES = [cr.ApparentRidges, cr.AverageShadingGradient, cr.DepthCurvilinearSaliency, cr.EdgeBlur]
MODULES += [cr.HessianFrobeniusNorm, cr.ImageCurvilinearSaliency, cr.LearnedCurvilinearSaliency]
LAYERS = [
    cr.AnisotropicDiffusion(iterations=3),
    cr.MultiScaleFocusCurves(),
    *(make() for make in MODULES),
]


@pytest.mark.cuda
@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: type(layer).__name__)
def test_layers_on_a_gpu(layer):
    image = torch.rand(2, 1, 48, 56, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = layer(image)
        found = copy.deepcopy(layer).cuda()(image.cuda())
    assert found.is_cuda
    # fields have no sign
    error = torch.minimum((found.cpu() - expected).abs(), (found.cpu() + expected).abs())
    assert float((error > 1e-3 * expected.abs().max()).float().mean()) < 0.01


@pytest.mark.cuda
def test_bank_on_a_gpu():
    bank = cr.ViewBank.build(example_mesh(), VIEWS, image_size=64, progress=False)
    built = cr.ViewBank.build(example_mesh(), VIEWS, image_size=64, progress=False, device="cuda")
    assert built.device.type == "cuda"
    torch.testing.assert_close(built.descriptors.cpu(), bank.descriptors, atol=5e-3, rtol=0.0)


@pytest.mark.cuda
@pytest.mark.parametrize("detected", [False, True])
def test_registrar_on_a_gpu(detected):
    image, box, _ = scene(0)
    boxes = None if detected else box[None]
    expected = cr.Registrar(truck_bank())([image], boxes, CAMERA)[0]
    found = cr.Registrar(truck_bank(), device="cuda")([image.cuda()], boxes, CAMERA)[0]
    assert float(cr.rotation_error(found.rotation.cpu(), expected.rotation)) < 0.5
    assert found.score == pytest.approx(expected.score, abs=0.02)


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
