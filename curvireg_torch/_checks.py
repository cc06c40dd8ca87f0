"""One check per contract. Each raises :class:`InvalidInputError` with what was expected and what came."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from .errors import InvalidInputError


def check_tensor(x: Tensor, name: str, shape: tuple[int | None, ...]) -> None:
    """``x`` is a floating tensor of ``shape``; ``None`` stands for any length."""
    if not isinstance(x, Tensor):
        raise InvalidInputError(f"{name}: expected a torch.Tensor, got {type(x).__name__}")
    if x.ndim != len(shape) or any(want is not None and want != got for want, got in zip(shape, x.shape, strict=True)):
        wanted = "(" + ", ".join("*" if n is None else str(n) for n in shape) + ")"
        raise InvalidInputError(f"{name}: expected shape {wanted}, got {tuple(x.shape)}")
    if not x.is_floating_point():
        raise InvalidInputError(
            f"{name}: expected a floating dtype, got {x.dtype}; convert with x.float() (images: divide by 255)"
        )


def check_last_axes(x: Tensor, name: str, shape: tuple[int | None, ...]) -> None:
    """``x`` is a floating tensor of shape (..., *shape)."""
    check_tensor(x, name, (None,) * (getattr(x, "ndim", 0) - len(shape)) + shape)


def check_image(x: Tensor, name: str = "image") -> None:
    """``x`` is a floating (B, 1, H, W) tensor with H, W >= 1."""
    check_tensor(x, name, (None, 1, None, None))
    if x.shape[-1] < 1 or x.shape[-2] < 1:
        raise InvalidInputError(f"{name}: expected at least one pixel, got {tuple(x.shape)}")


def check_colour_image(x: Tensor, name: str = "image") -> None:
    """``x`` is a floating (B, 1, H, W) or (B, 3, H, W) tensor with H, W >= 1."""
    check_tensor(x, name, (None, None, None, None))
    if x.shape[1] not in (1, 3):
        raise InvalidInputError(f"{name}: expected 1 (grey) or 3 (RGB) channels, got {x.shape[1]}")
    check_image(x[:, :1], name)


def check_field(x: Tensor, name: str = "field") -> None:
    """``x`` is a floating (B, 2, H, W) tensor: channel 0 = x, channel 1 = y."""
    check_tensor(x, name, (None, 2, None, None))


def check_mask(mask: Tensor, like: Tensor, name: str = "mask") -> None:
    """``mask`` is boolean, of the shape and on the device of ``like``."""
    if mask.dtype != torch.bool or mask.shape != like.shape:
        raise InvalidInputError(
            f"{name}: expected bool of shape {tuple(like.shape)}, got {mask.dtype} of shape {tuple(mask.shape)}"
        )
    check_same_device(mask, like, name)


def check_same_device(x: Tensor, like: Tensor, name: str) -> None:
    if x.device != like.device:
        raise InvalidInputError(f"{name}: expected device {like.device}, got {x.device}")


def check_option(value: str, options: Iterable[str], name: str) -> None:
    """``value`` is one of ``options``."""
    if value not in options:
        raise InvalidInputError(f"{name}: expected one of {', '.join(map(repr, options))}, got {value!r}")


def check_positive(value: float, name: str, *, zero_ok: bool = False) -> float:
    """``value``, a finite number > 0 (or >= 0). In a compiled graph it is a constant: one graph per value."""
    # torch.compile makes a float symbolic at its second value, and no kernel can be built of symbols. Taking the number
    # apart makes it look.
    value = math.ldexp(*math.frexp(value))
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero_ok):
        raise InvalidInputError(f"{name}: expected a finite number {'>=' if zero_ok else '>'} 0, got {value}")
    return value


def check_share(value: float, name: str) -> None:
    """``value`` is a share in (0, 1]."""
    if not 0 < value <= 1:
        raise InvalidInputError(f"{name}: expected 0 < {name} <= 1, got {value}")
