"""Coarse-to-fine search around views of rankings (the paper's section "Registration of 2D images"), batched."""

from dataclasses import replace

import torch
from torch import Tensor

from ..geometry import rotation_error, rotation_from_axis_angle
from ..matching import ViewDescriber
from .poses import Poses, similarities

STOP_MOTION = 0.05  # |T_i^-1 T_(i+1) - Id|_F at which the search stops (METHOD 6)
SEARCH_ANGLE = 15.0  # Largest rotation in degrees from the start: 1.5 times the spacing of a bank of 10 degrees
# Degrees: half the spacing of the bank; finer steps move the contours of a crop by less than a pixel
FIRST_STEP, FINEST_STEP = 5.0, 1.0
MAX_ROUNDS = 8  # Largest number of rounds of six poses each


@torch.no_grad()
def search(describer: ViewDescriber, descriptor: Tensor, starts: Poses) -> Tensor:
    """Return (H, 3, 3) allocentric rotations whose views match a photograph's ``descriptor`` (1, D) best, near the
    starts. Every round takes the six rotations by +-step about the camera's axes around the best pose; the step is
    halved where none of them is better, and the search ends where the pose stops moving at the finest step."""
    axes = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])

    def scores_of(poses: Poses) -> Tensor:
        return similarities(describer.descriptors(poses.rotation, poses.distance), descriptor)

    best, score = starts.rotation, scores_of(starts)
    step = torch.full((len(starts),), FIRST_STEP, dtype=torch.float64)
    active = torch.arange(len(starts))
    for _ in range(MAX_ROUNDS):
        if len(active) == 0:
            break
        turns = rotation_from_axis_angle(axes * torch.deg2rad(step[active])[:, None, None])
        candidates = turns @ best[active, None]
        each = replace(starts[active.repeat_interleave(6)], rotation=candidates.flatten(0, 1))
        scores = scores_of(each)
        far = rotation_error(candidates, starts.rotation[active, None]).flatten() > SEARCH_ANGLE
        value, winner = scores.masked_fill(far, -1.0).view(-1, 6).max(dim=1)
        better = value > score[active]
        moved = torch.where(better[:, None, None], candidates[torch.arange(len(active)), winner], best[active])
        motion = torch.linalg.matrix_norm(best[active].mT @ moved - torch.eye(3, dtype=torch.float64))
        best, score = best.index_copy(0, active, moved), score.index_copy(0, active, value.maximum(score[active]))
        done = ~better & (step[active] <= FINEST_STEP) & (motion <= STOP_MOTION)
        step[active] = torch.where(better, step[active], (step[active] / 2.0).clamp(min=FINEST_STEP))
        active = active[~done]
    return best
