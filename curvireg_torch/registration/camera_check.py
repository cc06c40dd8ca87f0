"""Whether a photograph agrees with the focal length that was given for it.

Perspective shows the focal length of a photograph of a known object. Where it does so clearly, a
given one that differs belongs to another picture: one of another size, cropped, stretched, or taken
with another lens or zoom. The pose is then wrong, though its contours lie on edges.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..fitting.contour_problem import ContourProblem
from ..fitting.edges import EdgeCrops
from ..fitting.focal_length import FocalPrior, fit_focal_length, focal_information, scaled_cameras
from ..fitting.measured_fit import FULL_SIZE_RADII
from ..rendering.contours import MeshContours
from .block import Block
from .focal import FULL_RADII, HALF_RADII, REPORTED_VARIANCE
from .hypotheses import Hypotheses
from .result import Registration
from .target import Target

CLEAR_DEVIATION = 0.15
"""Standard deviation of log f up to which a photograph determines its focal length."""

CONTRADICTION = 3.0
"""Standard deviations from which a given focal length is named."""

NOTICED_STEP = 0.02
"""First step of log f from which a focal length is fitted: with the right camera most first steps
are smaller, and a fit takes ten times as long as a step."""

WITHIN_REACH = 2.0
"""Multiple of the clear deviation up to which, at the fitted pose, a focal length is worth a fit: a
fit lowers the deviation, but in none of 40 reliable answers with right and wrong cameras to a
third."""

LARGEST_CHANGE = 2.0
WIDE = 2.0
"""Largest change of log f, and deviation of a prior that does not matter."""


def with_checked_cameras(
    target: Target,
    block: Block,
    crops: EdgeCrops,
    best: Hypotheses,
    results: Sequence[Registration],
) -> list[Registration]:
    """Results of photographs, whose ``best`` poses are one in each, with a warning where one is
    reliable and the photograph contradicts the focal length of its camera."""
    found = list(results)
    checked = torch.tensor(
        [
            place
            for place, (result, item) in enumerate(zip(results, block.photographs, strict=True))
            if result.reliable and item.camera_source != "estimated"
        ],
        dtype=torch.long,
    )
    if not len(checked):
        return found
    some = best[checked]
    given = some.cameras, some.T, some.photograph
    gaps, deviations = focal_gaps(target.describer.contours, crops, *given)
    for place, camera, gap, deviation in zip(
        checked.tolist(), some.cameras, gaps, deviations, strict=True
    ):
        text = focal_contradiction(
            float(camera[0, 0]),
            float(gap),
            float(deviation),
            given_deviation=block.photographs[place].focal_deviation,
        )
        if text is not None:
            result = found[place]
            found[place] = replace(result, warnings=(*result.warnings, text))
    return found


def focal_gaps(
    contours: MeshContours, crops: EdgeCrops, cameras: Tensor, T: Tensor, crop_index: Tensor
) -> tuple[Tensor, Tensor]:
    """How far photographs contradict the focal lengths of fitted poses.

    Args:
        contours: of the mesh.
        crops: of the photographs.
        cameras: (N, 3, 3) in px of the photographs, N > 0.
        T: (N, 4, 4) poses, fitted with these cameras.
        crop_index: (N,) the crop of each pose.

    Returns:
        (N,) by how much the log of the focal length that a photograph shows exceeds that of its
        camera, and (N,) its standard deviation, infinite where nobody looked further, as the first
        step is small, or the photograph shows too little of the focal length.
    """
    gap = torch.zeros(len(T), dtype=torch.float64)
    deviation = torch.full_like(gap, torch.inf)
    problem = ContourProblem.of(contours, crops, cameras, crop_index)
    first, _ = focal_information(problem, problem.state(T), FULL_SIZE_RADII[0])
    expected = (REPORTED_VARIANCE * first.variance).sqrt()
    is_worth_it = (first.step.abs() > NOTICED_STEP) & (expected < WITHIN_REACH * CLEAR_DEVIATION)
    noticed = is_worth_it.nonzero()[:, 0]
    if not len(noticed):
        return gap, deviation
    given = cameras[noticed]
    index = crop_index[noticed]
    half = ContourProblem.of(contours, crops, given, index, factor=2)
    coarse = fit_focal_length(half, T[noticed], _no_prior(given), HALF_RADII)
    cameras = scaled_cameras(given, coarse.log_zoom)
    full = ContourProblem.of(contours, crops, cameras, index)
    fine = fit_focal_length(full, coarse.state.T, _no_prior(cameras), FULL_RADII)
    information, _ = focal_information(fine.problem, fine.state, FULL_SIZE_RADII[-1])
    found = (REPORTED_VARIANCE * information.variance).sqrt()
    gap = gap.index_copy(0, noticed, coarse.log_zoom + fine.log_zoom)
    return gap, deviation.index_copy(0, noticed, found)


def _no_prior(cameras: Tensor) -> FocalPrior:
    nothing = torch.zeros(len(cameras), dtype=torch.float64)
    return FocalPrior(nothing, WIDE, nothing - LARGEST_CHANGE, nothing + LARGEST_CHANGE)


def focal_contradiction(
    focal: float, gap: float, deviation: float, *, given_deviation: float = 0.0
) -> str | None:
    """What is wrong with a camera with the ``focal`` length in px, known up to
    ``given_deviation``, if the photograph shows one whose log is larger by ``gap``, with a standard
    ``deviation``; None if they agree, or if it is not clear.

    Example:
        >>> focal_contradiction(550.0, 0.7, 0.05)[:56]
        'the photograph shows a focal length of about 1108 px, no'
        >>> focal_contradiction(550.0, 0.1, 0.05) is None
        True
    """
    if deviation >= CLEAR_DEVIATION:
        return None
    if abs(gap) <= CONTRADICTION * (deviation**2 + given_deviation**2) ** 0.5:
        return None
    shown = focal * torch.tensor(gap).exp().item()
    return (
        f"the photograph shows a focal length of about {shown:.0f} px, not the camera's "
        f"{focal:.0f} px: the camera is of a picture of another size, or this one was cropped, "
        f"stretched or zoomed; give its own camera, or none"
    )
