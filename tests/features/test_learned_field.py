"""The learned field: the layer contract, its weights, and its output on a simple image."""

import math
from unittest.mock import Mock

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch import filters
from curvireg_torch.errors import MissingFileError
from curvireg_torch.features import LearnedCurvilinearSaliency, doubled_angle, halved_angle
from curvireg_torch.features.backbone import Backbone, describe
from curvireg_torch.features.learned_field import FieldNetwork, save_weights
from tests._support import double, refused, seeded, uniform

from .._support.layer_contract import LayerCase, LayerContract
from .._support.quick import slow_after
from ..filters.layer_cases import colour_photos, equal_up_to_sign, photos


@pytest.fixture(scope="module")
def field():
    return LearnedCurvilinearSaliency()


class TestLearnedField(LayerContract):
    network = LearnedCurvilinearSaliency()
    cases = (
        LayerCase("grey", network, photos, constant_gives_zero=False),
        LayerCase("colour", network, colour_photos, constant_gives_zero=False),
    )
    test_gradcheck = test_function_transforms = None  # the network computes in float32

    def test_batched_equals_one_by_one(self, case):
        x = case.inputs(3, 48)
        assert equal_up_to_sign(case(x), torch.cat([case(image[None]) for image in x]), atol=1e-3)


@pytest.mark.parametrize("make", [LearnedCurvilinearSaliency, Backbone])
def test_networks_do_not_advance_the_random_generator(make):
    before = torch.get_rng_state()
    network = make()
    assert torch.equal(torch.get_rng_state(), before)
    assert {p.device.type for p in network.parameters()} == {"cpu"}
    assert not network.training


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e3])
def test_halved_angle_inverts_doubled_angle_in_every_dtype(dtype, size):
    t = torch.linspace(-3.1, 3.1, 63, dtype=torch.float64)
    vectors = (size * torch.stack([t.cos(), t.sin()])[None, :, :, None]).to(dtype)
    restored = halved_angle(doubled_angle(vectors))
    assert restored.dtype == doubled_angle(vectors).dtype == dtype
    off = torch.minimum((restored - vectors).abs(), (restored + vectors).abs()).amax(dim=1)
    # 1e-6 in float16 has only 4 bits.
    precision = 0.5 if (dtype, size) == (torch.float16, 1e-6) else 16 * torch.finfo(dtype).eps
    assert off.max() < precision * size


@pytest.mark.parametrize("vector", [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.6, -0.8)])
def test_halved_angle_has_gradients_along_the_axes(vector):
    x = double(vector).view(1, 2, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(halved_angle, x)
    assert torch.autograd.gradgradcheck(halved_angle, x)


def test_what_training_uses_refuses_wrong_input():
    network = FieldNetwork((4, 4, 8, 8))
    for function, x, message in (
        (doubled_angle, torch.ones(1, 3, 4, 4), r"field: expected shape \(\*, 2"),
        (halved_angle, torch.ones(1, 2, 4, 4, dtype=torch.long), "doubled: expected a floating"),
        (network, torch.ones(1, 1, 32, 32), r"image: expected shape \(\*, 3"),
        (network, torch.ones(1, 3, 32, 40), "multiples of 16 px"),
    ):
        with refused(message):
            function(x)


def test_learned_field_loads_other_weights_and_rejects_bad_ones(tmp_path):
    torch.manual_seed(0)
    network = FieldNetwork()
    x = torch.rand(4, 3, 128, 128)
    with torch.no_grad():
        network(x)  # statistics that batch normalisation divides by
        network.eval()
        save_weights(network, tmp_path / "weights.safetensors")
        loaded = LearnedCurvilinearSaliency(weights=tmp_path / "weights.safetensors")
        out = F.interpolate(network(x), scale_factor=2.0, mode="bilinear")
    assert not any(isinstance(layer, torch.nn.BatchNorm2d) for layer in loaded.modules())
    assert all(p.requires_grad for p in loaded.parameters())
    with refused("folded"):
        save_weights(loaded.network, tmp_path / "folded.safetensors")
    # stored as halves
    assert_close(loaded.mask(x), out[:, 2:].sigmoid(), atol=2e-3, rtol=0)
    assert_close(doubled_angle(loaded(x)), out[:, :2], atol=2e-3, rtol=0)
    missing, corrupt, other = (
        tmp_path / f"{name}.safetensors" for name in ("missing", "corrupt", "other")
    )
    corrupt.write_bytes(b"not weights")
    save_file({"a": torch.zeros(2)}, other)
    with refused("does not exist", MissingFileError):
        LearnedCurvilinearSaliency(weights=missing)
    for path, message in ((corrupt, "not a safetensors file"), (other, "FieldNetwork")):
        with refused(message):
            LearnedCurvilinearSaliency(weights=path)


def test_learned_field_of_a_square_is_its_outline(field):
    x = torch.full((1, 3, 128, 128), 0.3)
    x[:, :, 24:104, 24:104] = 0.8
    out = field(x)[0]
    length = out.norm(dim=0)
    left = out[:, 40:88, 20:29]
    assert length[40:88, 20:29].mean() > 3 * length[40:88, 50:80].mean()
    strong = left.norm(dim=0) > 0.3 * length.max()
    angle = torch.atan2(left[1], left[0])[strong]
    assert strong.any()
    assert angle.abs().median() < math.radians(20)
    mask = field.mask(x)[0, 0]
    assert mask[40:88, 40:88].mean() > 0.8
    assert mask[:8].mean() < 0.2


@pytest.mark.parametrize(
    ("dtype", "channels"),
    slow_after(2, [(torch.float16, 3), (torch.float64, 1), (torch.bfloat16, 3)]),
)
def test_learned_field_with_weights_of_another_dtype(field, dtype, channels):
    x = torch.rand(2, channels, 60, 100, generator=seeded(0))
    converted = LearnedCurvilinearSaliency().to(dtype)
    assert {p.dtype for p in converted.parameters()} == {dtype}
    precision = 0.05 if dtype is not torch.float64 else 1e-5
    for image in (x, x.to(dtype)):
        out, mask = converted.field_and_mask(image)
        assert out.dtype == mask.dtype == image.dtype
        assert_close(mask.float(), field.mask(x), atol=precision, rtol=0)
        assert_close(
            doubled_angle(out).float(), doubled_angle(field(x)), atol=precision, rtol=0
        )  # vectors have no sign


def test_learned_field_of_double_weights_reads_double_images():
    converted = LearnedCurvilinearSaliency().double()
    x = uniform(1, 3, 60, 60)
    assert not torch.equal(converted(x), converted(x.float().double()))


def test_learned_field_under_autocast(field):
    x = torch.rand(1, 3, 64, 64, generator=seeded(0))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = field(x)
    assert out.dtype == torch.float32
    assert_close(doubled_angle(out), doubled_angle(field(x)), atol=0.05, rtol=0)


@pytest.mark.parametrize("shape", [(2, 600), (600, 2), (1, 1), (1, 5000)])
def test_learned_field_does_not_enlarge_slivers(shape):
    field = LearnedCurvilinearSaliency()
    field.network.forward = Mock(
        side_effect=lambda x: x.new_zeros(len(x), 3, x.shape[2] // 2, x.shape[3] // 2)
    )
    assert field(torch.rand(1, 3, *shape)).shape == (1, 2, *shape)
    assert field.network.forward.call_args.args[0][0, 0].numel() <= 8 * 128 * 128


def test_fields_fill_missing_pixels():
    generator = seeded(0)
    image = torch.rand(1, 3, 64, 64, generator=generator)
    lost = image.clone()
    lost[0, :, 30:34, 30:34], lost[0, 2, 5, 5] = math.nan, math.inf
    where = filters.operations.missing_mask(lost).any(dim=1, keepdim=True)
    learned = cr.LearnedCurvilinearSaliency()
    field = learned(lost)
    assert field.isfinite().all()
    assert not field.masked_select(where).any()
    assert field.masked_select(~where).any()
    assert learned.mask(lost).isfinite().all()
    appearance_scores = describe(torch.cat([image, lost]), Backbone())
    assert appearance_scores.isfinite().all()
    assert 0.5 < (appearance_scores[0].float() * appearance_scores[1].float()).sum() < 0.9999
