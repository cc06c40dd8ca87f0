"""Effect of a change of the input on the output: none, a rotation, or a factor."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from .._support.layer_contract import LayerCase
from .layer_cases import LAYERS

FIELDS = [x for x in LAYERS.values() if x.name.partition("-")[0] not in ("hog", "diffusion", "blur")]
# Suppression is strict on one side only, so which of two equal pixels remains depends on the side.
every_field = pytest.mark.parametrize("layer", [x for x in FIELDS if x.name != "ar"], ids=lambda x: x.name)
few = settings(max_examples=3, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def _input(layer: LayerCase, seed: int, size: int = 25) -> Tensor:
    return layer.inputs(1, size, seed=seed, dtype=torch.float64)


def _options(layer: LayerCase) -> dict[str, object]:
    """The options, with a camera centred on the 25 px image, which is as symmetric as the image."""
    camera = torch.tensor([[40.0, 0.0, 12.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    return {**layer.options, **({"camera_matrix": camera} if "camera_matrix" in layer.options else {})}


def _close(a: Tensor, b: Tensor) -> bool:
    """Equality up to sign, except for 0.5 % of the vectors at a switch (tied scales, a threshold)."""
    scale = float(b.abs().max()) + 1e-12
    off = torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)) > 1e-7 * scale
    return float(off.float().mean()) <= 0.005


@every_field
@few
@given(seed=seeds)
def test_fields_rotate_and_mirror_with_the_image(layer: LayerCase, seed: int) -> None:
    x, options = _input(layer, seed), _options(layer)
    field = layer.function(x, **options)
    vx, vy = torch.rot90(field, 1, (-2, -1)).split(1, dim=1)
    assert _close(layer.function(torch.rot90(x, 1, (-2, -1)), **options), torch.cat([vy, -vx], dim=1))
    vx, vy = field.flip(-1).split(1, dim=1)
    assert _close(layer.function(x.flip(-1), **options), torch.cat([-vx, vy], dim=1))


# A gradient is proportional to contrast, saliency to its square; focus is invariant. MCS is invariant if kappa, which
# is in grey levels, is scaled too.
CONTRAST = {"ig": 1, "ics": 2, "mfc": 2, "mfc-alone": 0, "pci": 1, "mcs": 0}


@pytest.mark.parametrize("name", list(CONTRAST))
@few
@given(seed=seeds, factor=st.floats(0.25, 4.0))
def test_photo_fields_scale_with_a_power_of_contrast(name: str, seed: int, factor: float) -> None:
    layer = LAYERS[name]
    x = _input(layer, seed)
    scaled = {"kappa": 0.03 * factor} if name.startswith("mcs") else {}
    assert _close(layer.function(factor * x, **layer.options, **scaled), factor ** CONTRAST[name] * layer(x))


@pytest.mark.parametrize("name", ["cs", "cs-paper", "asg", "hfn"])
@few
@given(seed=seeds, offset=st.floats(0.0, 50.0), factor=st.floats(0.1, 10.0))
def test_depth_fields_with_unit_range_are_invariant_to_offset_and_unit(
    name: str, seed: int, offset: float, factor: float
) -> None:
    layer = LAYERS[name]
    z = _input(layer, seed)
    moved = torch.where(z > 0, factor * (z + offset), 0.0)
    assert _close(layer(moved), layer(z))
