"""The learned field: a network that predicts the curvilinear saliency of depth from a
photograph."""

import hashlib
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ..errors import InvalidInputError, MissingFileError
from ..filters import operations as ops
from ..utils.checks import check_colour_image, check_tensor
from ..utils.files import write_tensors
from .backbone import OneDNNConv2d, assign_weights

WEIGHTS = Path(__file__).with_name("learned_field.safetensors")
# of WEIGHTS; other files are refused
SHA256 = "a32e00a1984fa8f54c49a9c0df33ae24538fac0193c3958a40b88a4eaf837892"
WORK_SIZE = 128  # px, shorter image side in training and inference
MAX_ASPECT = 8  # of the longer to the shorter side at which an image is still computed at WORK_SIZE


def doubled_angle(field: Tensor) -> Tensor:
    """Map vectors m (cos t, sin t) to sqrt(m) (cos 2t, sin 2t), (B, 2, H, W), so that v and -v
    become equal. Opposite vectors then add up instead of cancelling, which averaging and learning
    need.

    Example:
        >>> import torch
        >>> field = torch.tensor([0.0, 2.0]).view(1, 2, 1, 1)  # across an edge, sign free
        >>> doubled_angle(field).flatten().tolist() == doubled_angle(-field).flatten().tolist()
        True
    """
    check_tensor(field, "field", (None, 2, None, None))
    x, y = ops.at_least_float32(field).unbind(1)
    length = ops.safe_sqrt(x * x + y * y)
    scale = length.clamp(min=1e-12) ** -1.5
    return torch.stack([(x * x - y * y) * scale, 2.0 * x * y * scale], dim=1).to(field.dtype)


def halved_angle(doubled: Tensor) -> Tensor:
    """Inverse of :func:`doubled_angle` for lengths from 1e-12 to 1e18; each vector is in the half
    plane x >= 0.

    Example:
        >>> import torch
        >>> field = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1)
        >>> halved_angle(doubled_angle(field)).flatten().abs().tolist()
        [3.0, 0.0]
    """
    check_tensor(doubled, "doubled", (None, 2, None, None))
    c, s = ops.at_least_float32(doubled).unbind(1)
    length = ops.safe_sqrt(c * c + s * s)
    # With m = length^2 and cos 2t = c / length, compute the larger of m |cos t| and m |sin t|
    # without cancellation and the other from sin 2t = 2 sin t cos t.
    larger = ops.safe_sqrt(0.5 * length * (length + _absolute(c)))
    smaller = 0.5 * length * _absolute(s) / larger.clamp(min=ops.safe_eps(larger))
    x = torch.where(c >= 0, larger, smaller)
    y = torch.where(c >= 0, smaller, larger)
    return (length[:, None] * torch.stack([x, torch.where(s < 0, -y, y)], dim=1)).to(doubled.dtype)


def _absolute(x: Tensor) -> Tensor:
    """abs(x) with derivative 1 at 0, where that of torch is 0."""
    return torch.where(x < 0, -x, x)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        OneDNNConv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _conv(width, width),
            OneDNNConv2d(width, width, 3, 1, 1, bias=False),
            nn.BatchNorm2d(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.body(x))


class FieldNetwork(nn.Module):
    """A small U-Net with additive skips, which predicts a field and the object's mask.

    Args:
        widths: channels at strides 2, 4, 8 and 16.

    Shape:
        Input (B, 3, H, W) in [0, 1], H and W multiples of 16; output (B, 3, H/2, W/2): channels 0
        and 1 are the field by :func:`doubled_angle`, channel 2 the logit of the mask.

    Example:
        >>> FieldNetwork((4, 4, 8, 8))(torch.rand(1, 3, 64, 48)).shape
        torch.Size([1, 3, 32, 24])
    """

    def __init__(self, widths: tuple[int, int, int, int] = (24, 48, 96, 160)) -> None:
        super().__init__()
        a, b, c, d = widths
        self.down = nn.ModuleList(
            [
                nn.Sequential(_conv(3, a, 2), _conv(a, a)),
                nn.Sequential(_conv(a, b, 2), _Residual(b)),
                nn.Sequential(_conv(b, c, 2), _Residual(c), _Residual(c)),
                nn.Sequential(_conv(c, d, 2), _Residual(d), _Residual(d)),
            ]
        )
        self.across = nn.ModuleList([OneDNNConv2d(i, o, 1) for i, o in ((d, c), (c, b), (b, a))])
        self.up = nn.ModuleList([_conv(c, c), _conv(b, b), _conv(a, a)])
        self.head = OneDNNConv2d(a, 3, 3, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        check_tensor(image, "image", (None, 3, None, None))
        if any(side % 16 or side == 0 for side in image.shape[2:]):
            raise InvalidInputError(
                f"image: expected sides that are multiples of 16 px, got {tuple(image.shape)}"
            )
        x = 4.0 * (image - 0.5)
        levels = []
        for block in self.down:
            x = block(x)
            levels.append(x)
        for across, up, skip in zip(self.across, self.up, levels[2::-1], strict=True):
            x = up(F.interpolate(across(x), scale_factor=2.0, mode="nearest") + skip)
        out: Tensor = self.head(x)
        return out


def _without_batch_norm(network: nn.Module) -> None:
    """Fold every batch normalisation of a network in evaluation into the convolution before it,
    which saves a sixth of the network's time."""
    for name, child in network.named_children():
        _without_batch_norm(child)
        if isinstance(child, nn.Sequential):
            layers: list[nn.Module] = []
            for layer in child:
                before = layers[-1] if layers else None
                if isinstance(layer, nn.BatchNorm2d) and isinstance(before, nn.Conv2d):
                    layers[-1] = fuse_conv_bn_eval(before, layer).requires_grad_(
                        before.weight.requires_grad
                    )
                else:
                    layers.append(layer)
            setattr(network, name, nn.Sequential(*layers))


class LearnedCurvilinearSaliency(nn.Module):
    """Curvilinear saliency of an object's depth, predicted from its photograph.

    The output of a :class:`FieldNetwork` trained on generated scenes only (see
    ``docs/learned.md``): contours of the object and its parts without texture and background. It
    replaces :class:`MultiScaleFocusCurves` for crops around one object; it is not a general edge
    detector. Its ``network`` has no batch normalisation, which is part of the convolutions: to
    train on, use a ``FieldNetwork``.

    Args:
        weights: safetensors file of another training; None is the packaged file.

    Shape:
        Input (B, 1 or 3, H, W) in [0, 1], RGB if 3; output (B, 2, H, W) without unit, x >= 0.
        Computed at a shorter side of ``WORK_SIZE`` px. Missing pixels (NaN or infinite) give 0.
        Differentiable. The output has the dtype of the input; the network computes in that of its
        weights, which ``.half()`` and ``.bfloat16()`` convert.

    Raises:
        InvalidInputError: wrong shape or dtype, or a file whose weights do not fit this network.
        MissingFileError: the file does not exist.

    Example:
        >>> LearnedCurvilinearSaliency()(torch.rand(2, 3, 64, 64)).shape
        torch.Size([2, 2, 64, 64])
    """

    colour = True
    """The field uses colour: :class:`ViewMatcher` does not convert photographs to grey for it."""

    def __init__(self, *, weights: Path | str | None = None) -> None:
        super().__init__()
        self.weights = None if weights is None else str(weights)
        path = Path(weights or WEIGHTS)
        # random initial values would advance the global random generator
        with torch.device("meta"):
            self.network = FieldNetwork()
        try:
            assign_weights(self.network, _read_weights(path, packaged=weights is None))
        except RuntimeError as error:  # other names or shapes
            raise InvalidInputError(
                f"weights: {path} does not hold the weights of FieldNetwork"
            ) from error
        _without_batch_norm(self.network)
        self.eval()

    def forward(self, image: Tensor) -> Tensor:
        return self.field_and_mask(image)[0]

    def mask(self, image: Tensor) -> Tensor:
        """(B, 1, H, W) probability that a pixel belongs to the central object, including its
        occluded parts."""
        return self.field_and_mask(image)[1]

    def field_and_mask(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Both, from one pass of the network."""
        output = self._network_output(image)
        field = halved_angle(output[:, :2]).to(image.dtype)
        mask = output[:, 2:].sigmoid().to(image.dtype)
        if ops.may_have_missing(image):
            field = field.masked_fill(ops.missing_mask(image).any(dim=1, keepdim=True), 0.0)
        return field, mask

    def _network_output(self, image: Tensor) -> Tensor:
        check_colour_image(image)
        H, W = image.shape[-2:]
        zoom = WORK_SIZE / max(min(H, W), max(H, W) / MAX_ASPECT)
        size = [max(1, round(side * zoom / 16)) * 16 for side in (H, W)]
        weight = self.network.head.weight
        # Resized in float32 at least: on a CPU, torch has no antialiasing of half types.
        x = ops.fill_missing(image.to(ops.at_least_float32(weight[:0]).dtype)).expand(-1, 3, -1, -1)
        ops.warn_of_range(x, "the network was trained on these")
        if size != [H, W]:
            x = F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=True)
        x = self.network(x.to(weight.dtype).contiguous(memory_format=torch.channels_last))
        x = ops.at_least_float32(x).contiguous()
        # without antialiasing, the number of threads would change the rounding
        return F.interpolate(x, (H, W), mode="bilinear", align_corners=False, antialias=True)

    def extra_repr(self) -> str:
        return f"weights={self.weights!r}"


def save_weights(network: FieldNetwork, path: Path) -> None:
    """Write half-precision safetensors atomically. The network is one that was trained, not that of
    the layer."""
    if not any(isinstance(layer, nn.BatchNorm2d) for layer in network.modules()):
        raise InvalidInputError(
            "network: its batch normalisation is folded; save the FieldNetwork that was trained"
        )
    state = network.state_dict()
    write_tensors(path, {k: v.half() if v.is_floating_point() else v for k, v in state.items()})


def _read_weights(path: Path, *, packaged: bool) -> dict[str, Tensor]:
    if not path.is_file():
        raise MissingFileError(
            f"weights: {path} does not exist; train it with scripts/training/train_learned_field.py"
        )
    content = path.read_bytes()
    if packaged and hashlib.sha256(content).hexdigest() != SHA256:
        raise InvalidInputError(f"weights: {path} is damaged; install curvireg_torch again")
    try:
        weights = load(content)
    except SafetensorError as error:
        raise InvalidInputError(f"weights: {path} is not a safetensors file ({error})") from error
    return {k: v.float() if v.is_floating_point() else v for k, v in weights.items()}
