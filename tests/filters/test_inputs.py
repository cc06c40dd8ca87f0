"""Photographs as input: colour becomes grey; missing pixels are filled and give zero."""

import math

import pytest
import torch
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch import filters
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.features import field_points, hog
from curvireg_torch.filters.operations import fill_missing, to_grey

from .layer_cases import LAYERS, colour_photos, photos

PHOTO_LAYERS = [layer for layer in LAYERS.values() if layer.inputs is photos]
every_photo_layer = pytest.mark.parametrize("layer", PHOTO_LAYERS, ids=lambda layer: layer.name)


def missing_value(layer):
    return 1000.0 if layer.name.startswith("blur") else 0.0


@every_photo_layer
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_photo_layers_fill_missing_pixels(layer, value):
    x = photos(2, 48, dtype=torch.float64)
    clean = layer(x.clone().requires_grad_()).detach()  # rounds as the other with gradients
    broken = x.clone()
    broken[0, 0, 5, 7] = value
    broken.requires_grad_()
    y = layer(broken)
    assert torch.isfinite(y).all()
    assert_close(y[1], clean[1], rtol=0.0, atol=0.0)
    if not layer.name.startswith("diffusion"):
        assert (y[0, :, 5, 7] == missing_value(layer)).all()
    # Beyond the reach of the kernels only normalisations by the maximum of the image can change.
    far = (y - clean)[0, :, 30:, 30:].abs()
    assert (far > 1e-6 * clean.abs().max()).float().mean() < 0.02
    y.square().sum().backward()
    assert broken.grad is not None
    assert torch.isfinite(broken.grad).all()
    assert float(broken.grad[0, 0, 5, 7]) == 0.0
    empty = layer(torch.full((1, 1, 12, 12), value))
    assert float(empty.min()) == float(empty.max()) == missing_value(layer)


def test_fill_missing_uses_the_surroundings():
    """On a ramp of 1 per px the error of the fill is at most the size of its pyramid cell."""
    ramp = torch.arange(64.0, dtype=torch.float64).expand(1, 1, 50, 64).contiguous()
    for size in (1, 3, 8):
        holes = torch.zeros_like(ramp, dtype=torch.bool)
        holes[..., 20 : 20 + size, 30 : 30 + size] = True
        filled = fill_missing(ramp.masked_fill(holes, math.nan))
        assert torch.equal(filled[~holes], ramp[~holes])
        assert (filled - ramp)[holes].abs().max() <= 2 * size
        gradient = filters.image_gradient(ramp.masked_fill(holes, math.nan))[..., 5:-5, 5:-5].norm(
            dim=1
        )
        assert gradient.max() < 2.5
    large = torch.zeros_like(ramp, dtype=torch.bool)
    large[..., :, 30:] = True  # outside of what is valid: the nearest pixel, as at the border
    filled = fill_missing(ramp.masked_fill(large, math.nan), large)
    assert (filled[..., 30:] == 29.0).all()


@pytest.mark.filterwarnings("ignore:There is a performance drop")
@every_photo_layer
@pytest.mark.parametrize("corner", [(0, 0), (5, 9)])
def test_a_padded_batch_gives_what_each_photograph_alone_gives(layer, corner):
    """Pixels beyond the photograph are outside, as its border is: no edge where it ends."""
    alone = photos(1, 40, dtype=torch.float64)
    other = photos(1, 64, seed=1, dtype=torch.float64)
    top, left = corner
    padded = torch.full_like(other, math.nan)
    padded[..., top : top + 40, left : left + 40] = alone
    found = layer(torch.cat([padded, other]))
    want = layer(alone)
    part = found[:1, :, top : top + 40, left : left + 40]
    assert_close(part, want, rtol=0.0, atol=1e-12 * float(want.abs().max()))
    assert_close(found[1:], layer(other))
    traced = torch.func.vmap(layer)(torch.cat([padded, other])[None])[0]
    assert_close(traced, found)


@pytest.mark.parametrize("unit", ["0 to 255", "normalised"])
@every_photo_layer
def test_images_in_another_unit_give_the_same_field_or_a_warning(layer, unit):
    image = photos(1, 32)
    scaled = 255.0 * image if unit == "0 to 255" else (image - 0.449) / 0.226
    if layer.name.startswith(("mcs", "diffusion")):
        with pytest.warns(CurviregWarning, match=r"image: expected grey levels in \[0, 1\], got"):
            layer(scaled)
        layer.function(255.0 * image, **{**layer.options, "kappa": 0.03 * 255.0})  # in its unit
        return
    field = layer(image)
    other = layer(scaled)
    factor = float((field * other).sum() / (field * field).sum())
    assert factor > 0.0
    assert_close(other, factor * field, rtol=1e-3, atol=1e-3 * float(other.abs().max()))


def test_the_learned_field_warns_of_images_in_another_unit():
    with pytest.warns(CurviregWarning, match="the network was trained on these"):
        cr.LearnedCurvilinearSaliency()(255.0 * photos(1, 32))


@every_photo_layer
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_penalties_are_finite_where_images_are_flat(layer, dtype):
    flat = torch.full((1, 1, 12, 12), 0.7, dtype=dtype)
    half = torch.where(torch.arange(12) >= 6, flat, 0.2)
    holes = torch.where(torch.arange(12) >= 9, math.nan, flat)
    for image in (0.0 * flat, flat, half, holes):
        x = image.clone().requires_grad_()
        y = layer(x)
        (slope,) = torch.autograd.grad(y.square().sum() + y.sum(), x, create_graph=True)
        assert torch.isfinite(slope).all()
        if slope.requires_grad:
            (curvature,) = torch.autograd.grad(slope.square().sum(), x)
            assert torch.isfinite(curvature).all()


@every_photo_layer
def test_photo_layers_convert_colour_to_grey(layer):
    colour = colour_photos(2, dtype=torch.float64)
    weights = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64).view(1, 3, 1, 1)
    assert_close(to_grey(colour), (weights * colour).sum(dim=1, keepdim=True))
    if layer.name.startswith("diffusion"):
        assert layer(colour).shape == colour.shape  # channels are independent
        assert_close(layer(colour)[:, 1:2], layer(colour[:, 1:2]))
    else:
        assert_close(layer(colour), layer(to_grey(colour)), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_hog_and_field_points_ignore_vectors_that_are_not_finite(value):
    field = filters.image_gradient(photos(2, 32))
    zero = field.clone()
    broken = field.clone()
    zero[0, :, 9, 12:15] = 0.0
    broken[0, :, 9, 12:15] = zero[0, :, 9, 12:15]
    broken[0, 1, 9, 12:15] = value
    assert_close(hog(broken), hog(zero), rtol=0.0, atol=0.0)
    assert torch.equal(field_points(broken), field_points(zero))
