"""The result of a detector, and the steps that several detectors share."""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from ..features.points import field_points, strongest_points
from ..filters.inputs import fill_missing, may_have_missing, missing_mask, to_grey
from ..filters.numerics import at_least_float32, full_precision, safe_sqrt
from ..utils.checks import check_colour_image

Function = TypeVar("Function", bound=Callable[..., "Detection"])


class Detection(NamedTuple):
    """Response map and feature points of a detector."""

    response: Tensor
    """(B, 1, H, W) float32 or float64 >= 0, in a unit that depends on the detector."""

    points: Tensor
    """(B, 1, H, W) bool feature points, at most the requested fraction of the pixels except for ties."""

    def coordinates(self) -> list[Tensor]:
        """Pixel coordinates x, y of the points of each image, (N, 2), strongest first.

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
    """Decorator that lets a detector on finite grey levels accept any photograph.

    RGB becomes grey, half types compute in float32, and missing pixels are filled and have no detections.
    """

    @functools.wraps(function)
    def on_photograph(image: Tensor, **options: float) -> Detection:
        check_colour_image(image)
        x = to_grey(at_least_float32(image))
        with full_precision(x):
            if not may_have_missing(x):
                return function(x, **options)
            mask = missing_mask(x)
            response, points = function(fill_missing(x, mask), **options)
        return Detection(torch.where(mask, 0.0, response), points & ~mask)

    return cast(Function, on_photograph)


def detection_from_field(field: Tensor, fraction: float) -> Detection:
    """Length of a vector field, and its maxima across the direction of the field."""
    response = safe_sqrt(field.square().sum(dim=1, keepdim=True))
    return Detection(response, field_points(field, fraction=fraction))


def detection_from_peaks(response: Tensor, fraction: float) -> Detection:
    """The positive part of a response map, and its maxima over 3 x 3 px."""
    response = response.clamp(min=0.0)
    peaks = response == F.max_pool2d(response, 3, stride=1, padding=1)
    return Detection(response, strongest_points(response, peaks & (response > 0), fraction))


def to_uint8_images(image: Tensor) -> list[Tensor]:
    """Each image as (H, W) uint8 in CPU memory, as OpenCV needs it."""
    return list((image.detach().float().clamp(0.0, 1.0) * 255.0).round().byte().cpu()[:, 0])
