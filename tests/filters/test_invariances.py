"""What a change of the input does to the output: exactly nothing, a rotation, or a factor."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from curvireg_torch import filters
from curvireg_torch.descriptors import hog

from .layer_cases import LAYERS, Layer, photos

NOT_FIELDS = ("hog", "hog-hard", "diffusion", "diffusion-exponential", "blur", "blur-saliency")
FIELDS = [x for x in LAYERS if x.name not in NOT_FIELDS]
# Suppression takes the strict maximum on one side: which of two equal pixels stays depends on the side.
every_field = pytest.mark.parametrize("layer", [x for x in FIELDS if x.name != "ar"], ids=lambda x: x.name)
few = settings(max_examples=3, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def _input(layer: Layer, seed: int, size: int = 25) -> Tensor:
    return layer.inputs(1, size, seed=seed, dtype=torch.float64)


def _options(layer: Layer) -> dict[str, object]:
    """A camera that looks through the centre of the 25 px image with one focal length is as symmetric as the image."""
    camera = torch.tensor([[40.0, 0.0, 12.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    return layer.options | ({"camera_matrix": camera} if "camera_matrix" in layer.options else {})


def _close(a: Tensor, b: Tensor) -> bool:
    """Vectors equal up to sign; of each field 0.5 % may sit at a switch (a tie of scales, a threshold)."""
    scale = float(b.abs().max()) + 1e-12
    off = torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)) > 1e-7 * scale
    return float(off.float().mean()) <= 0.005


@every_field
@few
@given(seed=seeds)
def test_rotation_by_90_degrees_rotates_the_field(layer: Layer, seed: int) -> None:
    x, options = _input(layer, seed), _options(layer)
    turned = layer.function(torch.rot90(x, 1, (-2, -1)), **options)
    vx, vy = torch.rot90(layer.function(x, **options), 1, (-2, -1)).split(1, dim=1)
    assert _close(turned, torch.cat([vy, -vx], dim=1))


@every_field
@few
@given(seed=seeds)
def test_a_mirror_mirrors_the_field(layer: Layer, seed: int) -> None:
    x, options = _input(layer, seed), _options(layer)
    vx, vy = layer.function(x, **options).flip(-1).split(1, dim=1)
    assert _close(layer.function(x.flip(-1), **options), torch.cat([-vx, vy], dim=1))


@pytest.mark.parametrize("layer", [x for x in FIELDS if x.inputs is photos], ids=lambda x: x.name)
@few
@given(seed=seeds, offset=st.floats(-0.5, 0.5))
def test_an_intensity_offset_changes_nothing(layer: Layer, seed: int, offset: float) -> None:
    x = _input(layer, seed)
    assert _close(layer(x + offset), layer(x))


# Gradient-like fields grow with the contrast, saliency with its square, focus not at all. MCS over an edge-preserving
# smoothing has a kappa in grey levels, so it is invariant only if that scales too.
CONTRAST = {"ig": 1, "ics": 2, "mfc": 2, "mfc-alone": 0, "pci": 1, "mcs": 0, "mcs-bilateral": 0, "mcs-guided": 0}


@pytest.mark.parametrize("name", list(CONTRAST))
@few
@given(seed=seeds, factor=st.floats(0.25, 4.0))
def test_contrast_scales_by_its_power(name: str, seed: int, factor: float) -> None:
    layer = next(x for x in LAYERS if x.name == name)
    x = _input(layer, seed)
    scaled = {"kappa": 0.03 * factor} if name.startswith("mcs") else {}
    assert _close(layer.function(factor * x, **layer.options, **scaled), factor ** CONTRAST[name] * layer(x))


def test_mcs_with_a_fixed_kappa_is_not_invariant_to_contrast() -> None:
    x = photos(1, 25, dtype=torch.float64)
    assert not _close(filters.multiscale_curvilinear_saliency(0.25 * x), filters.multiscale_curvilinear_saliency(x))


@every_field
@few
@given(seed=seeds, dx=st.integers(1, 6), dy=st.integers(-6, -1))
def test_a_translation_moves_the_field(layer: Layer, seed: int, dx: int, dy: int) -> None:
    if "camera_matrix" in layer.options:
        return  # a perspective camera sees another surface
    x = _input(layer, seed)
    frame = 24
    if layer.inputs is photos:
        x = x - x[..., :1, :1]
        x = x * torch.hann_window(25, dtype=torch.float64).outer(torch.hann_window(25, dtype=torch.float64))
    wide = torch.nn.functional.pad(x, (frame,) * 4)
    field = layer(wide)
    moved = layer(torch.roll(wide, (dy, dx), (-2, -1)))
    assert _close(moved, torch.roll(field, (dy, dx), (-2, -1)))


@pytest.mark.parametrize("name", ["cs", "cs-paper", "asg", "hfn"])
@few
@given(seed=seeds, offset=st.floats(0.0, 50.0), factor=st.floats(0.1, 10.0))
def test_depth_offset_and_unit_change_nothing_with_unit_range(
    name: str, seed: int, offset: float, factor: float
) -> None:
    layer = next(x for x in LAYERS if x.name == name)
    z = _input(layer, seed)
    moved = torch.where(z > 0, factor * (z + offset), 0.0)
    assert _close(layer(moved), layer(z))


@few
@given(seed=seeds, factor=st.floats(0.1, 10.0))
def test_hog_ignores_sign_and_contrast(seed: int, factor: float) -> None:
    field = filters.image_gradient(photos(1, 32, seed=seed, dtype=torch.float64))
    signs = torch.where(torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(seed)) < 0.5, -1.0, 1.0)
    torch.testing.assert_close(hog(factor * signs * field), hog(field), rtol=1e-3, atol=1e-5)
