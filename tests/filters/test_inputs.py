"""The one rule for photographs: colour becomes grey, missing pixels are filled and give nothing."""

import math

import pytest
import torch
from kornia.color import rgb_to_grayscale

from curvireg_torch import filters
from curvireg_torch.descriptors import field_points, hog
from curvireg_torch.filters.inputs import fill_missing
from curvireg_torch.filters.inputs import to_grey as grey

from .layer_cases import LAYERS, Layer, photos

PHOTO_LAYERS = [x for x in LAYERS if x.inputs is photos]
SMOOTHINGS = ("diffusion", "diffusion-exponential")
every_photo_layer = pytest.mark.parametrize("layer", PHOTO_LAYERS, ids=lambda x: x.name)


@every_photo_layer
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_missing_pixel_is_filled_and_gives_nothing(layer: Layer, value: float) -> None:
    x = photos(2, 48, dtype=torch.float64)
    clean = layer(x)
    broken = x.clone()
    broken[0, 0, 5, 7] = value
    broken.requires_grad_()
    y = layer(broken)
    assert torch.isfinite(y).all()
    torch.testing.assert_close(y[1], clean[1], rtol=0.0, atol=0.0)
    nothing = {"blur": 1000.0, "blur-saliency": 1000.0}.get(layer.name, 0.0)
    if layer.name not in SMOOTHINGS:
        assert bool((y[0, :, 5, 7] == nothing).all())
    # Beyond the kernels' reach nothing changed but what the image's largest saliency is the unit of.
    far = (y - clean)[0, :, 30:, 30:].abs()
    assert float((far > 1e-6 * clean.abs().max()).float().mean()) < 0.02
    y.square().sum().backward()
    assert broken.grad is not None
    assert torch.isfinite(broken.grad).all()
    assert float(broken.grad[0, 0, 5, 7]) == 0.0


@every_photo_layer
def test_nothing_but_missing_pixels(layer: Layer) -> None:
    y = layer(torch.full((1, 1, 12, 12), math.nan))
    assert torch.isfinite(y).all()
    assert float(y.min()) == float(y.max()) == {"blur": 1000.0, "blur-saliency": 1000.0}.get(layer.name, 0.0)


def test_holes_are_filled_from_around_them() -> None:
    """On a ramp of 1 per px the fill is as wrong as its square is wide, and the gradient sees no edge at its rim."""
    ramp = torch.arange(64.0, dtype=torch.float64).expand(1, 1, 50, 64).contiguous()
    for size in (1, 3, 8):
        holes = torch.zeros_like(ramp, dtype=torch.bool)
        holes[..., 20 : 20 + size, 30 : 30 + size] = True
        filled = fill_missing(ramp.masked_fill(holes, math.nan), holes)
        assert torch.equal(filled[~holes], ramp[~holes])
        assert float((filled - ramp)[holes].abs().max()) <= 2 * size
        gradient = filters.image_gradient(ramp.masked_fill(holes, math.nan))[..., 5:-5, 5:-5].norm(dim=1)
        assert float(gradient.max()) < 2.5
    large = torch.zeros_like(ramp, dtype=torch.bool)
    large[..., :, 2:] = True  # farther than the pyramid reaches: the mean of what is left
    filled = fill_missing(ramp.masked_fill(large, math.nan), large)
    assert float(filled[..., -1].max()) == pytest.approx(0.5)


def test_smoothings_come_out_filled() -> None:
    x = photos(1, 32, dtype=torch.float64)
    broken = x.clone()
    broken[0, 0, 16, 10:13] = math.nan
    for smoothing in (
        lambda x: filters.anisotropic_diffusion(x, iterations=5),
        lambda x: filters.bilateral_smooth(x, sigma=1.5),
        lambda x: filters.guided_smooth(x, sigma=1.5),
    ):
        y = smoothing(broken)
        assert torch.isfinite(y).all()
        assert float((y - smoothing(x)).abs().max()) < float(x.max() - x.min())


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_missing_pixels_under_vmap() -> None:
    x = photos(3, 24, dtype=torch.float64)
    x[1, 0, 4, 5] = math.nan
    want = filters.image_gradient(x)
    torch.testing.assert_close(torch.func.vmap(filters.image_gradient)(x[:, None])[:, 0], want)


@every_photo_layer
def test_colour_becomes_kornias_grey(layer: Layer) -> None:
    colour = torch.stack([photos(2, 24, seed=i, dtype=torch.float64)[:, 0] for i in range(3)], dim=1)
    assert colour.shape == (2, 3, 24, 24)
    torch.testing.assert_close(grey(colour), rgb_to_grayscale(colour))
    if layer.name in SMOOTHINGS:
        assert layer(colour).shape == colour.shape  # channels by themselves
        torch.testing.assert_close(layer(colour)[:, 1:2], layer(colour[:, 1:2]))
    else:
        torch.testing.assert_close(layer(colour), layer(grey(colour)), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_vectors_that_are_not_finite_count_as_zero(value: float) -> None:
    field = filters.image_gradient(photos(2, 32))
    zero, broken = field.clone(), field.clone()
    zero[0, :, 9, 12:15] = 0.0
    broken[0, :, 9, 12:15] = zero[0, :, 9, 12:15]
    broken[0, 1, 9, 12:15] = value
    torch.testing.assert_close(hog(broken), hog(zero), rtol=0.0, atol=0.0)
    assert torch.equal(field_points(broken), field_points(zero))


def test_holes_of_up_to_32_px_are_filled_from_around_them() -> None:
    """A hole that leaves one row and column of its 32 px square free is filled from that row and column, 0 like all
    that is near; a hole that leaves one row and column of a 64 px square free is filled with the mean in its middle."""
    for side, expected in ((31, 0.0), (63, None)):
        image = torch.zeros(1, 1, 256, 256, dtype=torch.float64)
        image[..., 192:, :] = 1.0
        holes = torch.zeros_like(image, dtype=torch.bool)
        holes[..., 64 : 64 + side, 64 : 64 + side] = True
        mean = float(image[~holes].mean())
        filled = fill_missing(image.masked_fill(holes, math.nan), holes)
        assert float(filled[0, 0, 70, 70]) == pytest.approx(mean if expected is None else expected, abs=1e-3)
