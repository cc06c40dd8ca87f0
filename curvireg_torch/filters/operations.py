"""What the layers share: safe arithmetic, blocks of a batch, missing pixels, derivatives,
suppression of non-maxima."""

import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregWarning, InvalidInputError
from ..utils.aliases import Fields, Size
from ..utils.checks import check_colour_image, check_positive, check_tensor
from ..utils.precision import exact_convolutions


def safe_eps(x: Tensor) -> float:
    """Smallest positive number of x's dtype whose power -1.5, the derivative of ``rsqrt``, is
    finite with a margin."""
    return math.pow(torch.finfo(x.dtype).tiny, 0.6)


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt(max(x, 0)) with gradient 0 instead of inf where x <= 0."""
    tiny: float = torch.finfo(x.dtype).tiny
    return x.clamp(min=tiny).sqrt() - math.sqrt(tiny)


def squared_length(x: Tensor, y: Tensor) -> Tensor:
    """x^2 + y^2 as a new tensor."""
    return (x * x).addcmul_(y, y)


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Disable autocast: a second derivative has no correct digit left in bfloat16."""
    device = x.device.type
    # meta has no autocast, and torch says so by an error
    if device == "meta" or not torch.is_autocast_enabled(device):
        return nullcontext()
    return torch.autocast(device, enabled=False)


def _without_tf32(x: Tensor) -> AbstractContextManager[object]:
    """Convolutions of a GPU with all 24 bits."""
    return exact_convolutions() if x.device.type == "cuda" else nullcontext()


def at_least_float32(x: Tensor) -> Tensor:
    """Convert float16 and bfloat16 to float32, since squared derivatives exceed their range."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def image_maximum(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """(B, 1, 1, 1) maximum of each image, whose values are >= 0, where ``mask`` is False."""
    x = x if mask is None else torch.where(mask, 0.0, x)
    return x.amax(dim=(1, 2, 3), keepdim=True)


def is_host_readable(x: Tensor) -> bool:
    """Whether Python can read the values of x at no cost: a CPU tensor, not compiled, not in a
    ``torch.func`` call."""
    if torch.compiler.is_compiling() or x.device.type != "cpu":
        return False
    # torch has no public test for this
    return not torch._C._functorch.is_functorch_wrapped_tensor(x)


def check_scalar(value: float | Tensor, name: str, *, zero_ok: bool = False) -> float | Tensor:
    """Return a positive option, a number or a scalar tensor, whose value is checked where it is
    readable."""
    if not isinstance(value, Tensor):
        return check_positive(value, name, zero_ok=zero_ok)
    check_tensor(value, name, ())
    if is_host_readable(value):
        check_positive(float(value.detach()), name, zero_ok=zero_ok)
    return at_least_float32(value)


def check_sigmas(sigmas: Sequence[float], name: str) -> list[float]:
    """Return at least one standard deviation, each > 0."""
    if not hasattr(sigmas, "__len__") or len(sigmas) == 0:
        raise InvalidInputError(
            f"{name}: expected a sequence of at least one sigma, got {sigmas!r:.40}"
        )
    return [check_positive(sigma, name) for sigma in sigmas]


# channels of a result: several tensors (B, 1, H, W), or one tensor that holds them all
Planes = tuple[Tensor, ...]
BLOCK_PIXELS = 2**18  # that a layer gets at once, so that intermediate results stay in the cache


def apply_in_blocks(layer: Callable[..., Planes], *tensors: Tensor) -> Tensor:
    """``stack_channels(*layer(*tensors))`` of a layer that treats images independently, in blocks
    on a CPU."""
    x = tensors[0]
    if torch.compiler.is_compiling() or x.device.type != "cpu" or x.numel() <= BLOCK_PIXELS:
        return stack_channels(*layer(*tensors))
    size = max(1, BLOCK_PIXELS // x.shape[1:].numel())
    parts = zip(*(tensor.split(size) for tensor in tensors), strict=True)
    return torch.cat([stack_channels(*layer(*part)) for part in parts])


def stack_channels(*planes: Tensor) -> Tensor:
    """(B, C, H, W) from C tensors (B, 1, H, W)."""
    if len(planes) == 1:
        return planes[0]
    # A compiled concatenation of single channels is laid out channels-last and then transposed.
    return torch.stack([plane.squeeze(1) for plane in planes], dim=1)


USUAL_RANGE = (-0.01, 1.01)  # of grey levels; resized images overshoot a little
# holes of up to 2^5 px are filled from their surroundings, the middle of larger ones with the mean
MAX_HOLE_LEVELS = 5


def apply_to_photograph(
    layer: Callable[[Tensor, Tensor | None], Planes], image: Tensor, *, missing_value: float = 0.0
) -> Tensor:
    """Apply ``layer`` to grey levels and the mask of missing pixels, None without any; these are
    filled from their surroundings and give ``missing_value``."""
    check_colour_image(image)

    def on_photographs(x: Tensor) -> Planes:
        if not may_have_missing(x):
            return layer(x, None)
        mask = missing_mask(x)
        planes = layer(fill_missing(x, mask), mask)
        return tuple(torch.where(mask, missing_value, plane) for plane in planes)

    return apply_in_blocks(on_photographs, to_grey(at_least_float32(image))).to(image.dtype)


def to_grey(image: Tensor) -> Tensor:
    """(B, 1, H, W) grey levels of (B, 3, H, W) RGB, 0.299 R + 0.587 G + 0.114 B; a grey image is
    returned unchanged."""
    if image.shape[1] == 1:
        return image
    from kornia.color import rgb_to_grayscale  # here, because its import takes 0.3 s

    grey: Tensor = rgb_to_grayscale(image)
    return grey


def may_have_missing(x: Tensor) -> bool:
    """False if all of x is known to be finite, at the cost of one sum; always True while
    tracing."""
    return not is_host_readable(x) or not math.isfinite(float(x.detach().sum()))


def missing_mask(x: Tensor) -> Tensor:
    """True where x is NaN or infinite."""
    return ~(x.abs() < math.inf)


def fill_missing(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Fill missing pixels of (B, C, H, W), by default those not finite: outside of the valid
    pixels' bounding box, as in a padded batch, with the nearest pixel of the box, as at the border
    of an image; inside with the mean of the smallest pyramid cell that has a valid pixel. An image
    without any becomes 0."""
    if mask is None:
        if not may_have_missing(x):
            return x
        mask = missing_mask(x)
    x = replicate_box(x, mask)
    mask = replicate_box(mask, mask)
    # whole cells at all levels: sizes that are rounded would need a compiled graph each
    side = 2**MAX_HOLE_LEVELS
    # torch cannot compile -n % side
    right, below = ((n + side - 1) // side * side - n for n in (x.shape[-1], x.shape[-2]))
    whole = (0, right, 0, below)
    sums = [F.pad(torch.where(mask, 0.0, x), whole)]
    weights = [F.pad((~mask).to(x.dtype), whole)]
    for _ in range(MAX_HOLE_LEVELS):
        sums.append(F.avg_pool2d(sums[-1], 2))
        weights.append(F.avg_pool2d(weights[-1], 2))
    tiny = torch.finfo(x.dtype).tiny
    fill = sums[-1].sum(dim=(2, 3), keepdim=True) / weights[-1].sum(dim=(2, 3), keepdim=True).clamp(
        min=tiny
    )
    for total, weight in zip(sums[:0:-1], weights[:0:-1], strict=True):
        fill = torch.where(weight > 0, total / weight.clamp(min=tiny), fill)
        fill = F.interpolate(fill, scale_factor=2.0, mode="nearest")
    return torch.where(mask, fill[..., : x.shape[-2], : x.shape[-1]], x)


def replicate_box(x: Tensor, missing: Tensor | None) -> Tensor:
    """``x`` with the pixels outside of the bounding box of those that are valid replaced by the
    nearest ones in it, as at the border of an image; ``x`` itself without a mask."""
    if missing is None:
        return x
    for dim in (-2, -1):
        x = x.gather(dim, nearest_in_box(missing, dim).expand_as(x))
    return x


def nearest_in_box(missing: Tensor, dim: int) -> Tensor:
    """(B, C, H, 1) or (B, C, 1, W) index along ``dim``, -2 or -1, of the nearest row or column of
    the bounding box of valid pixels."""
    last = missing.shape[dim] - 1
    index = torch.arange(last + 1, device=missing.device)
    index = index[:, None] if dim == -2 else index
    seen = ~missing.all(dim=-3 - dim, keepdim=True)
    low = torch.where(seen, index, last).amin(dim=dim, keepdim=True)
    high = torch.where(seen, index, 0).amax(dim=dim, keepdim=True)
    return torch.minimum(torch.maximum(index, low), high)


def warn_of_range(image: Tensor, reason: str) -> None:
    """Warn of an image beyond ``USUAL_RANGE`` whose values are readable; ``reason`` ends a
    sentence: why it matters."""
    if not is_host_readable(image) or image.numel() == 0:
        return
    low, high = (float(level) for level in image.detach().aminmax())
    if low < USUAL_RANGE[0] or high > USUAL_RANGE[1]:
        message = (
            f"expected grey levels in [0, 1], got {low:.3g} to {high:.3g}, and {reason}; divide by "
            f"255 or undo the normalisation"
        )
        warnings.warn(CurviregWarning(message, subject="image"), stacklevel=5)


def zero_nonfinite_vectors(field: Tensor) -> Tensor:
    """(B, 2, H, W) with vectors that have a NaN or infinite component replaced by zero."""
    if not may_have_missing(field):
        return field
    return torch.where(missing_mask(field).any(dim=1, keepdim=True), 0.0, field)


MAX_TENSOR_RADIUS = 16  # px, of the kernel of a sigma that is a tensor: a traced graph reserves it
# px, below which a kernel is a single 1 in every dtype and has derivative 0
MIN_SIGMA = 1e-3


def gaussian_smooth(x: Tensor, sigma: float | Tensor) -> Tensor:
    """Separable Gaussian smoothing of (B, C, H, W) with replicated borders; NaN spreads.

    Args:
        sigma: standard deviation in px, >= 0; 0 returns ``x``. A scalar tensor is differentiable.
            The kernel is cut at ceil(4 sigma) px, for a tensor at 16 px at most. Traced tensors are
            clamped to 0.001 px, not checked.

    Example:
        >>> import torch
        >>> gaussian_smooth(torch.ones(1, 1, 8, 8), 1.5).amin() > 0.999
        tensor(True)
    """
    return smooth(at_least_float32(x), check_scalar(sigma, "sigma", zero_ok=True), margin=0).to(
        x.dtype
    )


def smooth(x: Tensor, sigma: float | Tensor, *, margin: int = 1, linear: bool = False) -> Tensor:
    """:func:`gaussian_smooth` of an image enlarged by ``margin`` px on each side, as finite
    differences need it: ``linear`` by the slope at the borders, else by replicating them."""
    readable = not x.is_meta and (not isinstance(sigma, Tensor) or is_host_readable(sigma))
    if linear or prefers_shifts(x, sigma) or not readable:
        weights = _gaussian_kernel(sigma, x)
        pad = _extrapolate_pad if linear else replicate_pad
        return _weighted_shifts(pad(x, len(weights) // 2 + margin), weights)
    from kornia.filters import gaussian_blur2d  # here, because its import takes 0.3 s

    radius = _kernel_radius(sigma)
    x = replicate_pad(x, margin)
    if radius == 0:
        return x
    both: Any = (sigma, sigma)
    if isinstance(sigma, Tensor):
        both = sigma.to(x.dtype).clamp(min=MIN_SIGMA).expand(1, 2)
    # kornia makes its kernel on the default device
    with full_precision(x), _without_tf32(x), x.device:
        blurred: Tensor = gaussian_blur2d(x, 2 * radius + 1, both, "replicate")
    return blurred


def prefers_shifts(*inputs: Tensor | float) -> bool:
    """Whether sums of shifted images take the place of kornia's Gaussian: in graphs, where they
    fuse with what surrounds them, and on a CPU where gradients are wanted, since those of
    convolutions of a single channel are slow (docs/kornia.md has the times)."""
    if torch.compiler.is_compiling():
        return True
    wanted = [x for x in inputs if isinstance(x, Tensor) and x.requires_grad]
    return torch.is_grad_enabled() and any(x.device.type == "cpu" for x in wanted)


def _weighted_shifts(x: Tensor, weights: Sequence[float] | Tensor) -> Tensor:
    """The separable correlation of ``x`` with ``weights``, where it lies in ``x``."""
    if len(weights) == 1:
        return x
    for dim in (-1, -2):
        padded = x
        length = x.shape[dim] - len(weights) + 1
        x = padded.narrow(dim, 0, length) * weights[0]
        for i in range(1, len(weights)):
            part = padded.narrow(dim, i, length)
            x = (
                x.addcmul_(part, weights[i])
                if isinstance(weights, Tensor)
                else x.add_(part, alpha=weights[i])
            )
    return x


def _kernel_radius(sigma: float | Tensor) -> int:
    """Of a kernel in px; that of a tensor that cannot be read is the largest."""
    if not isinstance(sigma, Tensor):
        return math.ceil(4.0 * sigma) if sigma >= MIN_SIGMA else 0
    if not is_host_readable(sigma):
        return MAX_TENSOR_RADIUS
    return min(max(math.ceil(4.0 * float(sigma.detach())), 1), MAX_TENSOR_RADIUS)


def _gaussian_kernel(sigma: float | Tensor, like: Tensor) -> Sequence[float] | Tensor:
    """Weights of a kernel of odd length: floats for a float, a tensor for a tensor."""
    radius = _kernel_radius(sigma)
    if not isinstance(sigma, Tensor):
        kernel = [
            math.exp(-0.5 * (i / sigma) ** 2) if i else 1.0 for i in range(-radius, radius + 1)
        ]
        total = sum(kernel)
        return [weight / total for weight in kernel]
    sigma = sigma.to(like.dtype).clamp(min=MIN_SIGMA)
    offsets = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2) * (offsets.abs() <= torch.ceil(4.0 * sigma))
    return weights / weights.sum()


def replicate_pad(x: Tensor, radius: int) -> Tensor:
    """Pad (B, C, H, W) by ``radius`` px on all sides with the nearest border pixel."""
    return F.pad(x, (radius, radius, radius, radius), mode="replicate") if radius else x


def _extrapolate_pad(x: Tensor, radius: int) -> Tensor:
    """Pad (B, C, H, W) by ``radius`` px on all sides with the slope at the border, so that planes
    stay planes."""
    steps = torch.arange(1, radius + 1, device=x.device, dtype=x.dtype)
    for dim in (-1, -2):
        n = x.shape[dim]
        k = steps if dim == -1 else steps[:, None]
        first = x.narrow(dim, 0, 1)
        last = x.narrow(dim, n - 1, 1)
        # The indices are clamped because an image one pixel wide has no slope.
        fall = first - x.narrow(dim, min(1, n - 1), 1)
        rise = last - x.narrow(dim, max(n - 2, 0), 1)
        x = torch.cat([first + fall * k.flip(0), x, last + rise * k], dim=dim)
    return x


def central_gradient(p: Tensor) -> tuple[Tensor, Tensor]:
    """(p_x, p_y) per px by central differences; the result is 1 px smaller than p on each side.
    kornia's take several times as long (docs/kornia.md)."""
    return _half_difference(p[..., 1:-1, 2:], p[..., 1:-1, :-2]), _half_difference(
        p[..., 2:, 1:-1], p[..., :-2, 1:-1]
    )


def central_derivatives(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(p_x, p_y, p_xx, p_yy, p_xy) per px and px^2; each is 1 px smaller than p on each side."""
    x = p[..., 1:-1, 1:-1]
    slope = _half_difference(p[..., 2:], p[..., :-2])
    xx = (p[..., 1:-1, 2:] + p[..., 1:-1, :-2]).sub_(x, alpha=2)
    yy = (p[..., 2:, 1:-1] + p[..., :-2, 1:-1]).sub_(x, alpha=2)
    xy = _half_difference(slope[..., 2:, :], slope[..., :-2, :])
    return slope[..., 1:-1, :], _half_difference(p[..., 2:, 1:-1], p[..., :-2, 1:-1]), xx, yy, xy


def _half_difference(after: Tensor, before: Tensor) -> Tensor:
    return torch.sub(after, before).mul_(0.5)


def is_directional_maximum(length: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """True where ``length`` is a maximum along (x, y), rounded to 45 degrees as in Canny; all (B,
    1, H, W)."""
    H, W = length.shape[-2:]
    p = F.pad(length, (1, 1, 1, 1))

    def shifted(dx: int, dy: int) -> Tensor:
        return p[..., 1 + dy : 1 + dy + H, 1 + dx : 1 + dx + W]

    tan = 0.41421356  # tan 22.5 degrees
    horizontal = y.abs() <= tan * x.abs()
    vertical = x.abs() <= tan * y.abs()
    diagonal = ~(horizontal | vertical)
    falling = diagonal & (x * y > 0)  # y points down: equal signs run from top left to bottom right
    result = torch.zeros_like(horizontal)
    for selected, dx, dy in (
        (horizontal, 1, 0),
        (vertical, 0, 1),
        (falling, 1, 1),
        (diagonal & ~falling, 1, -1),
    ):
        # Strict on one side only, so that a plateau two pixels wide yields exactly one point.
        result = result | (selected & (length > shifted(dx, dy)) & (length >= shifted(-dx, -dy)))
    return result


def resized(image: Tensor, size: Size, *, mode: str = "bilinear") -> Tensor:
    """(C, h, w) float32 in about [0, 1] of a photograph (C, H, W), floating in [0, 1] or uint8."""
    if tuple(image.shape[-2:]) == size and image.is_floating_point():
        return image.float()
    options: Fields = {
        "size": size,
        "mode": mode,
        "antialias": True,
        "align_corners": False,
    }
    # One channel at a time to save memory: photographs are large.
    small = torch.cat(
        [F.interpolate(channel[None, None].float(), **options)[0] for channel in image]
    )
    return small / 255.0 if image.dtype == torch.uint8 else small
