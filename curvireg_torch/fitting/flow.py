"""Points that move: corners of a picture with a known pose, found again in another by optical
flow."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from torch import Tensor

from ..rendering.contours import MeshContours
from .contour_problem import ContourProblem
from .edges import CROP_SIZE, EdgeCrops
from .least_squares import PointMatches, pixels
from .regions import colour_bins

FLOW_PATCH = 15  # Side of the patches of the optical flow in px
# Largest distance in px between a corner and where the flow back from its match ends
MAX_RETURN_ERROR = 1.5
RETURN_LEVELS = 1  # Levels of the pyramid of that flow, which starts at the corner


@dataclass(frozen=True)
class Frame:
    """The part of a frame around the object: its ``crops`` in three channels, their mean ``grey``
    (S, S) uint8, and the camera ``K`` (1, 3, 3) of these."""

    crops: EdgeCrops
    grey: np.ndarray
    K: Tensor
    contours: MeshContours

    @cached_property
    def bins(self) -> Tensor:
        """(S, S) histogram bins of the colours."""
        return colour_bins(self.crops.crops)

    @cached_property
    def problem(self) -> ContourProblem:
        """The fit of contours to the edges of the frame."""
        index = torch.zeros(1, dtype=torch.long)
        return ContourProblem(self.contours, self.crops.edges(1), index, self.K, CROP_SIZE)


@dataclass(frozen=True)
class Keyframe:
    """A ``grey`` picture (S, S) uint8 with a known pose ``T`` (1, 4, 4), and corners ``uv`` (P, 2)
    px, float32, at the points ``model`` (1, P, 3) of the surface."""

    grey: np.ndarray
    T: Tensor
    uv: np.ndarray
    model: Tensor


def track_points(keyframe: Keyframe, frame: Frame, T: Tensor, *, levels: int) -> PointMatches:
    """Corners of a keyframe in a new frame, searched where the pose ``T`` (1, 4, 4) projects them.
    Matches from which the flow does not lead back to the corner have weight 0. A pyramid of
    ``levels`` halvings lets the search reach further."""
    if len(keyframe.uv) == 0:
        return PointMatches(
            keyframe.model, torch.zeros(1, 0, 2).double(), torch.zeros(1, 0).double()
        )
    guess = pixels(keyframe.model, T, frame.K)[0].float().numpy()
    there, found = _optical_flow(keyframe.grey, frame.grey, keyframe.uv, guess, levels)
    back, returned = _optical_flow(frame.grey, keyframe.grey, there, keyframe.uv, RETURN_LEVELS)
    kept = found & returned & (np.linalg.norm(back - keyframe.uv, axis=1) < MAX_RETURN_ERROR)
    return PointMatches(
        keyframe.model,
        torch.from_numpy(there).double()[None],
        torch.from_numpy(kept).double()[None],
    )


def _optical_flow(
    before: np.ndarray, after: np.ndarray, points: np.ndarray, guess: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where points (P, 2) of one picture are in another, searched at ``guess`` (P, 2); and (P,)
    whether found."""
    window = (FLOW_PATCH, FLOW_PATCH)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(), winSize=window, maxLevel=levels, flags=flags
    )
    return there, found[:, 0] > 0
