"""Contour fits on the device of the contours: those that several photographs need at the same time
are one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from ..rendering.contours import MeshContours
from ..utils.company import by_key, compute_together
from .contour_fit import fit_to_edges, short_fit
from .details import ContourDetails, compared, contour_details
from .edges import EdgeCrops
from .measured_fit import ContourFit, contour_evidence, contour_support


@dataclass(frozen=True)
class FitRequest:
    """Poses in the crops of one photograph, whose contours are fitted or measured.

    Attributes:
        contours: of the mesh.
        crops: of the boxes, on any device.
        K, T, image_index: (N, 3, 3) cameras, (N, 4, 4) poses and (N,) crops, on the CPU.
        options: of the fit; tensors have a row for each pose.
    """

    contours: MeshContours
    crops: EdgeCrops
    K: Tensor
    T: Tensor
    image_index: Tensor
    options: Mapping[str, Any]

    @property
    def key(self) -> tuple[Any, ...]:
        """What requests have in common that are computed together."""
        mask = self.crops.mask
        shapes = (self.crops.crops.shape[1:], None if mask is None else mask.probability.shape[1:])
        options = [
            (name, type(value) if isinstance(value, Tensor) else value)
            for name, value in sorted(self.options.items())
        ]
        return (id(self.contours), *shapes, *options)

    def arguments(self) -> tuple[Any, ...]:
        """Contours, crops, cameras, poses and crop indices, on the device of the contours."""
        device = self.contours.device
        tensors = [x.to(device) for x in (self.K, self.T, self.image_index)]
        return (self.contours, self.crops.to(device), *tensors)

    def options_on_device(self) -> dict[str, Any]:
        """The options, on the device of the contours."""
        device = self.contours.device
        return {
            name: value.to(device) if isinstance(value, Tensor) else value
            for name, value in self.options.items()
        }

    @staticmethod
    def joined(requests: Sequence["FitRequest"]) -> "FitRequest":
        """Requests of one key as one."""
        first = requests[0]
        if len(requests) == 1:
            return first
        crops = [request.crops.to(first.contours.device) for request in requests]
        counts = [len(cut.crops) for cut in crops]
        before = [sum(counts[:k]) for k in range(len(counts))]
        index = [
            request.image_index + shift for request, shift in zip(requests, before, strict=True)
        ]
        options = {
            name: torch.cat([request.options[name] for request in requests])
            if isinstance(value, Tensor)
            else value
            for name, value in first.options.items()
        }
        K = torch.cat([request.K for request in requests])
        T = torch.cat([request.T for request in requests])
        return FitRequest(first.contours, EdgeCrops.cat(crops), K, T, torch.cat(index), options)


Tensors = tuple[Tensor, ...]


def _computed(
    requests: Sequence[FitRequest], function: Callable[[FitRequest], Tensors]
) -> list[Tensors]:
    """What ``function`` computes for the poses of requests, on the CPU; those of one key are
    joined."""

    def together(some: Sequence[FitRequest]) -> list[Tensors]:
        joined = FitRequest.joined(some)
        # on a CPU many small steps take a tenth less time in it
        with torch.inference_mode(joined.contours.device.type == "cpu"):
            measured = [x.cpu() for x in function(joined)]
        found = [x.clone() for x in measured]  # tensors like any other
        counts = [len(request.T) for request in some]
        return list(zip(*(x.split(counts) for x in found), strict=True))

    return by_key(requests, lambda request: request.key, together)


def fit_together(
    contours: MeshContours,
    crops: EdgeCrops,
    K: Tensor,
    T: Tensor,
    image_index: Tensor,
    **options: Any,
) -> ContourFit:
    """:func:`.fit_to_edges`, on the device of the contours; the result is on the CPU."""
    return ContourFit(
        *compute_together(_fits, FitRequest(contours, crops, K, T, image_index, options))
    )


def _fits(requests: Sequence[FitRequest]) -> list[Tensors]:
    def fitted(request: FitRequest) -> Tensors:
        fit = fit_to_edges(*request.arguments(), **request.options_on_device())
        return tuple(getattr(fit, field.name) for field in fields(ContourFit))

    return _computed(requests, fitted)


def short_fit_together(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`.short_fit`, on the device of the contours; the result is on the CPU."""
    T, support = compute_together(_short_fits, FitRequest(contours, crops, K, T, image_index, {}))
    return T, support


def _short_fits(requests: Sequence[FitRequest]) -> list[Tensors]:
    return _computed(requests, lambda request: short_fit(*request.arguments()))


def support_together(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> Tensor:
    """:func:`.contour_support`, on the device of the contours; the result is on the CPU."""
    return compute_together(_supports, FitRequest(contours, crops, K, T, image_index, {}))[0]


def _supports(requests: Sequence[FitRequest]) -> list[Tensors]:
    return _computed(requests, lambda request: (contour_support(*request.arguments()),))


def evidence_together(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> Tensor:
    """:func:`.contour_evidence`, on the device of the contours; the result is on the CPU."""
    return compute_together(_evidence, FitRequest(contours, crops, K, T, image_index, {}))[0]


def _evidence(requests: Sequence[FitRequest]) -> list[Tensors]:
    return _computed(requests, lambda request: (contour_evidence(*request.arguments()),))


def details_together(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`.compare_details`, with contours on their device; the result is on the CPU."""
    request = FitRequest(contours, crops, K, T, image_index, {})
    return compared(ContourDetails(*compute_together(_details, request)))


def _details(requests: Sequence[FitRequest]) -> list[Tensors]:
    def measured(request: FitRequest) -> Tensors:
        details = contour_details(*request.arguments())
        return tuple(getattr(details, field.name) for field in fields(ContourDetails))

    return _computed(requests, measured)
