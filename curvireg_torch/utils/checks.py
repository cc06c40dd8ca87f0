"""Checks of arguments, one per contract, shared by all layers, so that all accept the same.

Each raises :class:`InvalidInputError` (pixels: :class:`ImageError`) with expected and actual value.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import ImageError, InvalidInputError
from .likes import BoxesLike, CameraLike

MAX_ROTATION_DEVIATION = 1e-2  # poses in files are rounded, and half precision rounds to 5e-4
MAX_PIXEL_ASPECT = 1.1  # largest ratio of the focal lengths at which pixels count as square


def type_and_shape(value: object) -> str:
    """What was passed instead of the expected tensor, for an error message."""
    return (
        f"{value.dtype} of shape {tuple(value.shape)}"
        if isinstance(value, Tensor | np.ndarray)
        else type(value).__name__
    )


def check_tensor(x: Tensor, name: str, shape: tuple[int | None, ...]) -> None:
    """``x`` is a floating tensor of ``shape``; ``None`` stands for any length."""
    if not isinstance(x, Tensor):
        raise InvalidInputError(f"{name}: expected a torch.Tensor, got {type(x).__name__}")
    if x.ndim != len(shape) or any(
        n is not None and n != size for n, size in zip(shape, x.shape, strict=True)
    ):
        expected = ", ".join("*" if n is None else str(n) for n in shape)
        raise InvalidInputError(f"{name}: expected shape ({expected}), got {tuple(x.shape)}")
    if not x.is_floating_point():
        raise InvalidInputError(
            f"{name}: expected a floating dtype, got {x.dtype}; convert with x.float() (images: "
            f"divide by 255)"
        )
    _check_dense(x, name)


def _check_dense(x: Tensor, name: str) -> None:
    """``x`` has a layout and a dtype with which torch computes."""
    is_float8 = x.is_floating_point() and x.element_size() == 1
    if is_float8 or x.layout != torch.strided:
        raise InvalidInputError(
            f"{name}: expected a dense tensor that is not float8, got {x.layout} of {x.dtype}; "
            f"convert with to_dense() or float()"
        )


def check_last_axes(x: Tensor, name: str, shape: tuple[int | None, ...]) -> None:
    """``x`` is a floating tensor of shape (..., *shape)."""
    check_tensor(x, name, (None,) * (getattr(x, "ndim", 0) - len(shape)) + shape)


def check_image(x: Tensor, name: str = "image") -> None:
    """``x`` is a floating (B, 1, H, W) tensor with H, W >= 1."""
    check_tensor(x, name, (None, 1, None, None))
    if 0 in x.shape[2:]:
        raise InvalidInputError(f"{name}: expected at least one pixel, got {tuple(x.shape)}")


def check_colour_image(x: Tensor) -> None:
    """``x`` is a floating (B, 1, H, W) or (B, 3, H, W) tensor with H, W >= 1."""
    check_tensor(x, "image", (None, None, None, None))
    if x.shape[1] not in (1, 3):
        raise InvalidInputError(f"image: expected 1 (grey) or 3 (RGB) channels, got {x.shape[1]}")
    check_image(x[:, :1])


def check_photograph(x: Any, name: str = "images") -> None:
    """``x`` is a (C, H, W) tensor, C = 1 (grey) or 3 (RGB), with at least one pixel, floating or
    uint8."""
    if not isinstance(x, Tensor) or x.ndim != 3 or x.shape[0] not in (1, 3) or 0 in x.shape:
        expected = "1 (grey) or 3 (RGB) channels in shape (C, H, W), arrays (H, W, C)"
        raise InvalidInputError(f"{name}: expected {expected}, got {type_and_shape(x)}")
    if x.dtype != torch.uint8 and not x.is_floating_point():
        raise InvalidInputError(f"{name}: expected uint8, or floating in [0, 1], got {x.dtype}")


def check_pixels(x: Tensor, where: str) -> None:
    """The pixels of floating ``x`` are finite and in [0, 1] within 0.001; ``where`` names them, as
    "of the box"."""
    low, high = (float(value) for value in x.detach().aminmax()) if x.numel() else (0.0, 0.0)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ImageError(f"NaN or inf in the pixels {where}; repair the image, or use another")
    if high > 1.0 + 1e-3 or low < -1e-3:
        raise ImageError(
            f"pixels outside [0, 1] {where}; divide floating images by 255, or pass uint8"
        )


def check_same_device(x: Tensor, like: Tensor, name: str) -> None:
    if x.device != like.device:
        raise InvalidInputError(f"{name}: expected device {like.device}, got {x.device}")


def check_device(name: torch.device | str, option: str = "device") -> None:
    """``name`` is a device on which torch computes on this machine."""
    try:
        torch.zeros(1, device=name).item()
    # builds of torch without CUDA raise the second, a dtype the third
    except (RuntimeError, AssertionError, TypeError) as error:
        usable = ", ".join(["cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))])
        message = f"torch cannot use {str(name)!r} on this machine; choose from {usable}"
        raise InvalidInputError(f"{option}: {message}") from error


def check_option(value: str, options: Iterable[str], name: str) -> None:
    """``value`` is one of ``options``."""
    if value not in options:
        raise InvalidInputError(
            f"{name}: expected one of {', '.join(map(repr, options))}, got {value!r}"
        )


def check_number(value: Any, name: str) -> float:
    """Return ``value`` if it is a finite number. In a compiled graph it is a constant: one graph
    per value."""
    try:
        if isinstance(value, bool | str):
            raise TypeError
        # torch.compile makes a float symbolic at its second value; splitting it forces the value,
        # which kernels need.
        number = math.ldexp(*math.frexp(value))
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(
            f"{name}: expected a number, got {type(value).__name__} {value!r:.40}"
        ) from error
    if not math.isfinite(number):
        raise InvalidInputError(f"{name}: expected a finite number, got {number}")
    return number


def check_positive(value: Any, name: str, *, zero_ok: bool = False) -> float:
    """Return ``value`` if it is a finite number > 0 (or >= 0); otherwise as
    :func:`check_number`."""
    number = check_number(value, name)
    if number < 0 or (number == 0 and not zero_ok):
        raise InvalidInputError(
            f"{name}: expected a finite number {'>=' if zero_ok else '>'} 0, got {number}"
        )
    return number


def check_fraction(value: Any, name: str) -> float:
    """Return ``value`` if it is a fraction in (0, 1]."""
    number = check_number(value, name)
    if not 0 < number <= 1:
        raise InvalidInputError(f"{name}: expected 0 < {name} <= 1, got {number}")
    return number


def check_probability(value: Any, name: str) -> float:
    """Return a number in [0, 1], or refuse it."""
    number = check_number(value, name)
    if not 0.0 <= number <= 1.0:
        raise InvalidInputError(f"{name}: expected a probability from 0 to 1, got {value!r}")
    return number


def check_integer(value: Any, name: str, *, least: int = 1) -> int:
    """Return ``value`` if it is an integer >= ``least``; 2.0 and True are none."""
    if (
        isinstance(value, bool)
        or not hasattr(type(value), "__index__")
        or isinstance(value, Tensor)
        or value < least
    ):
        raise InvalidInputError(f"{name}: expected an integer >= {least}, got {value!r:.40}")
    return int(value)


def check_finite(x: Tensor, name: str) -> None:
    """``x`` has no NaN and no inf."""
    if not x.isfinite().all():
        raise InvalidInputError(f"{name}: expected finite entries, got NaN or inf")


def check_rotation(R: Tensor, name: str) -> None:
    """``R`` is floating (..., 3, 3), rotations within ``MAX_ROTATION_DEVIATION`` or not finite
    (missing estimates)."""
    check_last_axes(R, name, (3, 3))
    bad = int(_is_no_rotation(R).sum())
    if bad:
        raise InvalidInputError(
            f"{name}: expected rotations (orthonormal, determinant +1), got {bad} that are not"
        )


def check_pose(T: Tensor, name: str) -> None:
    """``T`` is floating (..., 4, 4) and finite, each a rigid transform [[R, t], [0, 0, 0, 1]]."""
    check_last_axes(T, name, (4, 4))
    check_finite(T, name)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=T.dtype, device=T.device)
    off = (T[..., 3, :] - last).abs().amax(-1) > 1e-6  # inverting a pose may leave this
    bad = int((off | _is_no_rotation(T[..., :3, :3])).sum())
    if bad:
        raise InvalidInputError(
            f"{name}: expected rigid transforms [[R, t], [0, 0, 0, 1]], R orthonormal with "
            f"determinant +1, got {bad} that are not; remove scale and reflection"
        )


def check_symmetries(symmetries: Tensor) -> None:
    """``symmetries`` is floating (S, 3, 3) or (S, 4, 4), S >= 1, of finite rotations or rigid
    transforms."""
    if (
        getattr(symmetries, "ndim", 0) != 3
        or symmetries.shape[1:] not in ((3, 3), (4, 4))
        or not len(symmetries)
    ):
        raise InvalidInputError(
            f"symmetries: expected shape (S, 4, 4) or (S, 3, 3) with S >= 1, got "
            f"{type_and_shape(symmetries)}"
        )
    (check_pose if symmetries.shape[1] == 4 else check_rotation)(symmetries, "symmetries")
    check_finite(symmetries, "symmetries")


def _is_no_rotation(R: Tensor) -> Tensor:
    """(...) bool: whether a (..., 3, 3) matrix is finite and not a rotation within
    ``MAX_ROTATION_DEVIATION``."""
    R = R.detach().to(torch.promote_types(R.dtype, torch.float32))
    a, b, c = R.unbind(-2)
    # Rows a and b of unit length at right angles and c = a x b: orthonormal with determinant +1.
    products = torch.stack([(a * a).sum(-1) - 1.0, (b * b).sum(-1) - 1.0, (a * b).sum(-1)], -1)
    off = (
        torch.cat([products, c - torch.linalg.cross(a, b)], -1).abs().amax(-1)
        > MAX_ROTATION_DEVIATION
    )
    return off & R.isfinite().all(-1).all(-1)


def check_camera_matrix(K: Tensor, name: str = "camera matrix") -> None:
    """``K`` is floating (..., 3, 3): finite [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy
    > 0."""
    if not isinstance(K, Tensor) or tuple(K.shape[-2:]) != (3, 3) or not K.is_floating_point():
        raise InvalidInputError(f"{name}: expected floating (..., 3, 3), got {type_and_shape(K)}")
    check_finite(K, name)
    if not ((K[..., 0, 0] > 0).all() and (K[..., 1, 1] > 0).all()):
        raise InvalidInputError(
            f"{name}: expected focal lengths FX, FY > 0 (in pixels); check their order FX FY CX CY"
        )
    last = torch.tensor([0.0, 0.0, 1.0], dtype=K.dtype, device=K.device)
    if not ((K[..., 2, :] == last).all() and (K[..., 1, 0] == 0).all()):
        raise InvalidInputError(f"{name}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if not (K[..., 0, 1].abs() <= 1e-6 * K[..., 0, 0]).all():  # rounding may leave this
        raise InvalidInputError(f"{name}: expected no skew, K[0, 1] = 0; rectify the image")


def check_square_pixels(K: Tensor, name: str = "camera matrix") -> None:
    """The focal lengths of valid (..., 3, 3) cameras are at most 10 % apart: views are rendered
    with square pixels."""
    for camera in K.reshape(-1, 3, 3).tolist():
        (fx, _, cx), (_, fy, cy), _ = camera
        if not are_nearly_equal(fx, fy):
            advice = "resize the image's width by FY / FX, and FX, CX and the box with it"
            if are_nearly_equal(cx, cy):
                advice = (
                    f"if the order was CX CY FX FY, swap the halves: {cx:g} {cy:g} {fx:g} {fy:g}"
                )
            raise InvalidInputError(
                f"{name}: expected square pixels, FX and FY at most 10 % apart, got {fx:g} and "
                f"{fy:g}; {advice}"
            )


def are_nearly_equal(a: float, b: float) -> bool:
    """Whether two lengths > 0 are at most 10 % apart, as the focal lengths of square pixels."""
    return a > 0 and b > 0 and 1.0 / MAX_PIXEL_ASPECT <= a / b <= MAX_PIXEL_ASPECT


def as_tensor(values: Any, name: str) -> Any:
    """An array, of any strides and byte order, as a tensor, copied where torch cannot share it;
    all else as it is. Refuses arrays and tensors with which torch cannot compute."""
    x = values
    if isinstance(values, np.ndarray):
        try:
            # torch warns of read-only arrays
            native = np.require(values, values.dtype.newbyteorder("="), ["C", "W", "E"])
            x = torch.from_numpy(native)
        except TypeError as error:
            raise InvalidInputError(
                f"{name}: expected numbers of a dtype of torch, got {type_and_shape(values)}"
            ) from error
    if isinstance(x, Tensor):
        _check_dense(x, name)
    return x


def as_numbers(values: Any, name: str, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor, an array, or nested lists of these as a floating tensor of at least ``dtype``."""
    values = as_tensor(values, name)
    try:
        if isinstance(values, list | tuple):
            plain = all(
                isinstance(value, int | float) and not isinstance(value, bool) for value in values
            )
            if plain:
                x = torch.tensor(values, dtype=dtype)
            else:
                x = torch.stack([as_numbers(value, name, dtype=dtype) for value in values])
        else:
            # as_tensor would move a tensor to the default device
            x = values if isinstance(values, Tensor) else torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        reason = str(error).partition("\n")[0]
        raise InvalidInputError(
            f"{name}: expected numbers, got {type(values).__name__} ({reason})"
        ) from error
    if x.is_complex() or x.dtype == torch.bool:
        raise InvalidInputError(f"{name}: expected numbers, got {x.dtype}")
    return x.to(torch.promote_types(x.dtype, dtype) if x.is_floating_point() else dtype)


def check_numbers(values: Any, name: str, count: int | None = None) -> Tensor:
    """Return ``count`` finite numbers, or at least one, of a list, range, array or tensor as (N,)
    float64."""
    numbers = as_numbers(
        list(values) if isinstance(values, range) else values, name, dtype=torch.float64
    ).flatten()
    if len(numbers) != (count or max(1, len(numbers))) or not numbers.isfinite().all():
        raise InvalidInputError(
            f"{name}: expected {count or 'at least one'} finite numbers, got {values!r:.80}"
        )
    return numbers.double()


def as_boxes(boxes: BoxesLike, count: int) -> Tensor:
    """A tensor, an array or lists as (count, 4) boxes, at least float32; values are checked with
    the images."""
    x = as_numbers(boxes, "boxes")
    x = x.view(0, 4) if count == 0 and x.numel() == 0 else x
    if tuple(x.shape) != (count, 4):
        raise InvalidInputError(
            f"boxes: expected shape ({count}, 4), one for each image, got {tuple(x.shape)}"
        )
    return x


def as_camera_matrices(matrices: CameraLike, count: int) -> Tensor:
    """One matrix for all, or one for each, as (count, 3, 3) float64; values are not checked."""
    K = as_numbers(matrices, "camera_matrices", dtype=torch.float64)
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), (1,), (count,)):
        raise InvalidInputError(
            f"camera_matrices: expected (3, 3) or ({count}, 3, 3), got {tuple(K.shape)}"
        )
    return K.expand(count, 3, 3)
