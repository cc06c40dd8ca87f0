"""What every detector returns, and the steps that several of them share."""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from ..descriptors.points import field_points, strongest_points
from ..filters.inputs import fill_missing, grey, may_lack_pixels, missing
from ..filters.numerics import at_least_float32, safe_sqrt
from ..utils.checks import check_colour_image

Function = TypeVar("Function", bound=Callable[..., "Detection"])


class Detection(NamedTuple):
    """A detector's answer."""

    response: Tensor
    """(B, 1, H, W) float32 or float64 >= 0, in the detector's own unit."""

    points: Tensor
    """(B, 1, H, W) bool feature points, at most the share of the pixels that was asked for (ties aside)."""

    def coordinates(self) -> list[Tensor]:
        """Per image the (N, 2) pixel coordinates x, y of its points, strongest first.

        Example:
            >>> response = torch.tensor([[0.0, 1.0], [2.0, 0.0]])[None, None]
            >>> Detection(response, response > 0).coordinates()[0].tolist()
            [[0, 1], [1, 0]]
        """
        result = []
        for response, points in zip(self.response[:, 0], self.points[:, 0], strict=True):
            y, x = points.nonzero(as_tuple=True)
            order = torch.argsort(response[y, x], descending=True, stable=True)
            result.append(torch.stack([x, y], dim=1)[order])
        return result


def detector(function: Function) -> Function:
    """A detector on photographs by the rule of :mod:`curvireg_torch.filters.inputs`: it sees grey levels, all finite.

    (B, 3, H, W) is RGB and becomes grey; half types compute in float32; NaN and infinite pixels are filled from around
    them, and nothing is detected there.
    """

    @functools.wraps(function)
    def on_photograph(image: Tensor, **options: float) -> Detection:
        check_colour_image(image)
        x = grey(at_least_float32(image))
        if not may_lack_pixels(x):
            return function(x, **options)
        holes = missing(x)
        response, points = function(fill_missing(x, holes), **options)
        return Detection(torch.where(holes, 0.0, response), points & ~holes)

    return cast(Function, on_photograph)


def from_field(field: Tensor, share: float) -> Detection:
    """Length of a vector field, and its maxima across the field's direction."""
    response = safe_sqrt(field.square().sum(dim=1, keepdim=True))
    return Detection(response, field_points(field, share=share))


def from_peaks(response: Tensor, share: float) -> Detection:
    """A response map, and those of its pixels that no pixel of their 3 x 3 neighbourhood exceeds."""
    response = response.clamp(min=0.0)
    peaks = response == F.max_pool2d(response, 3, stride=1, padding=1)
    return Detection(response, strongest_points(response, peaks & (response > 0), share))


def grey_bytes(image: Tensor) -> list[Tensor]:
    """Each image as (H, W) uint8 in memory that OpenCV can read."""
    return list((image.detach().float().clamp(0.0, 1.0) * 255.0).round().byte().cpu()[:, 0])
