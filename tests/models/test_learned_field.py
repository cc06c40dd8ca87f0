"""The learned field as a layer."""

import math

import pytest
import torch
from safetensors.torch import save_file

from curvireg_torch.errors import InvalidInputError, MissingFileError
from curvireg_torch.models import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle, halved_angle
from curvireg_torch.models.backbone import Backbone
from curvireg_torch.models.learned_field import SHA256, WEIGHTS


@pytest.fixture(scope="module")
def field():
    return LearnedCurvilinearSaliency()


def alike(one, other):
    """Up to the sign, which may change where the direction is vertical."""
    return torch.minimum((one - other).abs().amax(dim=1), (one + other).abs().amax(dim=1)).max() < 1e-3


def test_doubled_angles_have_no_sign_and_are_undone():
    t = torch.linspace(-3, 3, 25, dtype=torch.float64)
    m = torch.linspace(0.1, 4, 25, dtype=torch.float64)
    vectors = torch.stack([m * t.cos(), m * t.sin()])[None, :, :, None]
    code = doubled_angle(vectors)
    assert torch.allclose(code, doubled_angle(-vectors))
    assert torch.allclose(code[0, :, :, 0], m.sqrt() * torch.stack([(2 * t).cos(), (2 * t).sin()]))
    back = halved_angle(code)
    assert torch.allclose(back, torch.where(vectors[:, :1] < 0, -vectors, vectors), atol=1e-9)


def test_halved_angle_has_finite_gradients_everywhere():
    code = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]]).T[None, :, :, None].requires_grad_()
    halved_angle(code).square().sum().backward()
    assert code.grad.isfinite().all()
    small = torch.randn(1, 2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(halved_angle, (small,))


def test_size_of_network_and_file():
    assert sum(p.numel() for p in FieldNetwork().parameters()) <= 2_000_000
    assert WEIGHTS.stat().st_size <= 8_000_000
    assert len(SHA256) == 64


@pytest.mark.parametrize("make", [LearnedCurvilinearSaliency, Backbone])
def test_making_a_network_leaves_the_random_generator_alone(make):
    before = torch.get_rng_state()
    made = make()
    assert torch.equal(torch.get_rng_state(), before)
    assert {p.device.type for p in made.parameters()} == {"cpu"}


@pytest.mark.parametrize("shape", [(1, 1, 128, 128), (2, 3, 256, 256), (1, 3, 60, 90), (1, 1, 1, 1)])
def test_shapes(field, shape):
    x = torch.rand(shape)
    out = field(x)
    assert out.shape == (shape[0], 2, *shape[2:])
    assert out.isfinite().all()
    assert out.dtype == torch.float32
    mask = field.mask(x)
    assert mask.shape == (shape[0], 1, *shape[2:])
    assert mask.min() >= 0
    assert mask.max() <= 1


def test_images_of_a_batch_do_not_mix(field):
    x = torch.rand(3, 3, 128, 128)
    assert alike(field(x)[1:2], field(x[1:2]))


def test_float16_and_float64_images_keep_their_dtype(field):
    x = torch.rand(1, 3, 64, 64)
    assert alike(field(x.double()).float(), field(x))
    assert field(x.half()).dtype == torch.float16


def test_gradients_reach_the_image(field):
    x = torch.rand(1, 3, 64, 64, requires_grad=True)
    field(x).square().sum().backward()
    assert x.grad.abs().sum() > 0
    assert x.grad.isfinite().all()


def test_it_stays_in_evaluation_mode_after_loading(field):
    assert not field.training


def test_it_exports(field):
    x = torch.rand(1, 3, 128, 128)
    exported = torch.export.export(field, (x,)).module()
    assert alike(exported(x), field(x))


@pytest.mark.slow
def test_it_compiles_whole(field):
    torch._dynamo.reset()
    x = torch.rand(1, 3, 128, 128)
    assert alike(torch.compile(field, fullgraph=True)(x), field(x))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e3])
def test_doubled_angles_are_undone_in_every_dtype(dtype, size):
    t = torch.linspace(-3.1, 3.1, 63, dtype=torch.float64)
    vectors = (size * torch.stack([t.cos(), t.sin()])[None, :, :, None]).to(dtype)
    back = halved_angle(doubled_angle(vectors))
    assert back.dtype == doubled_angle(vectors).dtype == dtype
    off = torch.minimum((back - vectors).abs(), (back + vectors).abs()).amax(dim=1)
    # float16 has no more than 4 bits of 1e-6 itself.
    precision = 0.5 if (dtype, size) == (torch.float16, 1e-6) else 16 * torch.finfo(dtype).eps
    assert off.max() < precision * size


def test_saved_weights_come_back(field, tmp_path):
    field.save(tmp_path / "own.safetensors")
    again = LearnedCurvilinearSaliency(weights=tmp_path / "own.safetensors")
    x = torch.rand(1, 3, 128, 128)
    assert torch.equal(again(x), field(x))


def test_errors(field, tmp_path):
    with pytest.raises(InvalidInputError, match="channels"):
        field(torch.rand(1, 2, 32, 32))
    with pytest.raises(InvalidInputError, match="floating"):
        field(torch.zeros(1, 3, 32, 32, dtype=torch.uint8))
    with pytest.raises(MissingFileError, match="does not exist"):
        LearnedCurvilinearSaliency(weights=tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"not weights")
    with pytest.raises(InvalidInputError, match="not a safetensors file"):
        LearnedCurvilinearSaliency(weights=tmp_path / "bad.safetensors")
    save_file({"a": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(InvalidInputError, match="FieldNetwork"):
        LearnedCurvilinearSaliency(weights=tmp_path / "other.safetensors")


def test_damaged_packaged_weights_are_refused(tmp_path, monkeypatch):
    content = bytearray(WEIGHTS.read_bytes())
    content[-1] ^= 1
    (tmp_path / "damaged.safetensors").write_bytes(content)
    monkeypatch.setattr("curvireg_torch.models.learned_field.WEIGHTS", tmp_path / "damaged.safetensors")
    with pytest.raises(InvalidInputError, match="install curvireg_torch again"):
        LearnedCurvilinearSaliency()


def test_a_square_on_a_plain_ground_gives_its_outline(field):
    """The field is strong at the border of a bright square in the middle and points across it."""
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


def test_black_and_white_lie_two_either_side_of_nought():
    """As in training: the first layer is handed 4 (x - 1/2)."""
    network, handed = FieldNetwork((8, 8, 8, 8)).eval(), []
    network.down[0].register_forward_pre_hook(lambda _module, inputs: handed.append(inputs[0]))
    picture = torch.linspace(0, 1, 3 * 32 * 32).view(1, 3, 32, 32)
    network(picture)
    assert torch.allclose(handed[0], torch.linspace(-2, 2, 3 * 32 * 32).view(1, 3, 32, 32), atol=1e-6)
