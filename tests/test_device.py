import copy

import pytest
import torch
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import Follower
from curvireg_torch.synthetic import example_mesh
from tests._support import CAMERA, bank_of, scene, truck_bank

VIEWS = cr.sample_views(azimuth_step=45, elevations=[10, 40])
MODULES = [cr.ApparentRidges, cr.AverageShadingGradient, cr.DepthCurvilinearSaliency, cr.EdgeBlur]
MODULES += [cr.HessianFrobeniusNorm, cr.ImageCurvilinearSaliency, cr.LearnedCurvilinearSaliency]
MODULES += [cr.ImageGradient, cr.MultiScaleCurvilinearSaliency]
LAYERS = [
    cr.AnisotropicDiffusion(iterations=3),
    cr.MultiScaleFocusCurves(),
    torch.nn.Sequential(cr.ImageGradient(), cr.HOG(grid=4)),
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
    assert (error > 1e-3 * expected.abs().max()).float().mean() < 0.01


@pytest.mark.cuda
def test_bank_on_a_gpu():
    bank = bank_of(example_mesh(), VIEWS, image_size=64)
    built = bank_of(example_mesh(), VIEWS, image_size=64, device="cuda")
    assert built.device.type == "cuda"
    # pixels on the outline may differ: a z-buffer there, rays here
    descriptors = built.descriptors.cpu().float()
    expected = bank.descriptors.float()
    differs = (descriptors - expected).abs() > 5e-3
    assert differs.float().mean() < 0.01
    assert torch.cosine_similarity(descriptors, expected).min() > 0.999


@pytest.mark.cuda
@pytest.mark.parametrize("detected", [False, True])
def test_registrar_on_a_gpu(detected):
    image, box, _ = scene(0)
    boxes = None if detected else box[None]
    expected = cr.Registrar(truck_bank())([image], boxes, CAMERA)[0]
    found = cr.Registrar(truck_bank(), device="cuda")([image.cuda()], boxes, CAMERA)[0]
    assert cr.rotation_error(found.rotation.cpu(), expected.rotation) < 0.5
    assert found.score == pytest.approx(expected.score, abs=0.02)


@pytest.mark.cuda
@pytest.mark.parametrize("preset", ["classical", "paper"])
def test_presets_on_a_gpu(preset):
    """Nearly equal views may change places: their scores are compared, and that a pose is found."""
    image, box, _ = scene(0)
    bank = bank_of(truck_bank().mesh, pipeline=PRESETS[preset])
    registrar = cr.Registrar(bank, device="cuda")
    found = registrar([image.cuda()], box[None], CAMERA)[0]
    expected = cr.ViewMatcher(bank)(image[None], box[None]).scores
    assert_close(found.ranking.scores.cpu(), expected, atol=0.05, rtol=0.0)
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1.0, abs=1e-4)


def test_registrar_and_follower_ignore_the_default_dtype():
    image, box, truth = scene(0)
    expected = cr.Registrar(truck_bank())([image], box[None], CAMERA)[0]
    torch.set_default_dtype(torch.float64)
    try:
        registrar = cr.Registrar(truck_bank())
        result = registrar([image], box[None], CAMERA)[0]
        follow = Follower(registrar, CAMERA)
        follow.start(image, truth)
        followed = follow(image)
    finally:
        torch.set_default_dtype(torch.float32)
    assert_close(result.transform, expected.transform, atol=1e-6, rtol=0.0)
    assert result.score == pytest.approx(expected.score, abs=1e-6)
    assert cr.rotation_error(followed.rotation, truth[:3, :3]) < 4.0
