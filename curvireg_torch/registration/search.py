"""Coarse-to-fine search around views of rankings (the paper's section "Registration of 2D images"), batched."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error, rotation_from_axis_angle
from ..geometry.translation import pose_from_box
from ..matching import Ranking, ViewBank, ViewDescriber
from .hypotheses import Hypotheses
from .priors import BatchPriors
from .rescoring import similarities

__all__ = ["coherent_views", "search"]

TOLERANCE = 0.05
"""|T_i^-1 T_(i+1) - Id|_F at which the search stops, translation in object radii (METHOD 6)."""

REACH = 15.0
"""Largest rotation in degrees from the start: 1.5 times the spacing of a bank of 10 degrees."""

FIRST_STEP, FINEST_STEP = 5.0, 1.0
"""Degrees: half the spacing of the bank; finer steps move the contours of a crop by less than a pixel."""

ROUNDS, BRIEF = 8, 4
"""Largest number of rounds of seven poses each, and that of a brief search."""

FINALISTS, AFTER = 2, 1
"""Number of hypotheses of a photograph that are searched and fitted to the end, and rounds after which they are
selected."""


def coherent_views(rotations: Tensor, order: Tensor, *, count: int = 5, angle: float = REACH) -> Tensor:
    """(K,) views, at most the ``count`` first of ``order`` (N,), within ``angle`` degrees of the first."""
    best = order[:count]
    return best[rotation_error(rotations[best], rotations[best[:1]]) <= angle]


@torch.no_grad()
def search(
    describers: Sequence[ViewDescriber],
    descriptors: Tensor,
    starts: Hypotheses,
    *,
    bank: ViewBank | None = None,
    ranking: Ranking | None = None,
    boxes: Tensor | None = None,
    camera_matrices: Tensor | None = None,
    brief: bool = False,
    priors: BatchPriors | None = None,
) -> Hypotheses:
    """Search around hypotheses in ever smaller steps until each pose converges.

    The first round compares the coherent views of the bank (:func:`coherent_views`). Every further round takes the six
    rotations by +-step about the camera's axes around the best pose, and the pose where the parabolas through their
    scores peak; the step is halved where the best moves by less than half of it. With camera matrices, the distance is
    computed from the box twice, so that perspective is that of the photograph. The search stays within ``REACH``
    degrees of the start; the best ``FINALISTS`` of each photograph are searched to the end.

    Args:
        describers: of the bank's models.
        descriptors: (B, D) of the photographs' fields, computed by the describers.
        starts: hypotheses of those photographs.
        bank, ranking: that the starts come from; not needed for a brief search.
        boxes, camera_matrices: (B, 4) px and (B, 3, 3) of the photographs; both or none.
        priors: limits on the poses of the photographs; the starts lie within them.
        brief: before a contour fit: at most ``BRIEF`` rounds, without coherent views.

    Returns:
        The hypotheses with better ``rotation`` and ``distance``, and with their ``similarity`` in [0, 1].

    Raises:
        InvalidInputError: the search is not brief and lacks a bank or a ranking.
    """

    def scored(state: Hypotheses, candidates: Tensor) -> Tensor:
        """(H, C) normalised correlations of (H, C, 3, 3) candidates; -1 beyond ``REACH`` or outside the priors."""
        H, C = candidates.shape[:2]
        each = replace(state[torch.arange(H).repeat_interleave(C)], rotation=candidates.flatten(0, 1))
        outside = rotation_error(candidates, starts.rotation[active][:, None]) > REACH
        if priors is not None:
            outside |= ~priors.allow(state, candidates)
        return similarities(describers, descriptors, each).view(H, C).masked_fill(outside, -1.0)

    state = replace(starts, similarity=torch.full_like(starts.similarity, -1.0))
    if brief:
        candidates = starts.rotation[:, None]
    elif bank is None or ranking is None:
        raise InvalidInputError("search: needs bank and ranking, whose coherent views it compares first, or brief=True")
    else:
        candidates = _all_coherent(starts, bank, ranking)
    step = torch.full((len(starts),), FIRST_STEP, dtype=torch.float64)
    active = torch.arange(len(starts))
    for rounds in range(1 + (BRIEF if brief else ROUNDS)):
        if len(active) == 0:
            break
        before = state[active]
        scores = scored(before, candidates)
        now = _best(before, candidates, scores)
        if rounds:
            peak = _peak(before, scores, step[active])[:, None]
            now = _best(now, peak, scored(before, peak))
        if camera_matrices is not None and boxes is not None and rounds in (0, AFTER):
            filling = _box_filling_distances(describers, now, boxes, camera_matrices)
            now = replace(now, distance=torch.where(now.similarity > before.similarity, filling, before.distance))
        state = _updated(state, active, now)
        if rounds:
            still = rotation_error(before.rotation, now.rotation) < 0.5 * step[active]
            converged = still & (step[active] <= FINEST_STEP) & (_motion(describers, before, now) <= TOLERANCE)
            step[active] = torch.where(still, (step[active] / 2.0).clamp(min=FINEST_STEP), step[active])
            active = active[~converged]
        if rounds == AFTER:
            active = active[_among_best(state, FINALISTS)[active]]
        candidates = _six_rotations(step[active]) @ state.rotation[active][:, None]
    return state


def _best(state: Hypotheses, candidates: Tensor, scores: Tensor) -> Hypotheses:
    """The best of (H, C, 3, 3) candidates where it is better."""
    score, winner = scores.max(dim=1)
    chosen = candidates[torch.arange(len(state)), winner]
    better = score > state.similarity
    rotation = torch.where(better[:, None, None], chosen, state.rotation)
    return replace(state, rotation=rotation, similarity=torch.where(better, score, state.similarity))


def _six_rotations(step: Tensor) -> Tensor:
    """(H, 6, 3, 3) rotations by +step about x, y, z, then by -step."""
    axes = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    return rotation_from_axis_angle(axes * torch.deg2rad(step)[:, None, None])


def _peak(state: Hypotheses, scores: Tensor, step: Tensor) -> Tensor:
    """(H, 3, 3) rotations at the peaks of the parabolas through (H, 6) scores of :func:`_six_rotations`."""
    up, down = scores.split(3, dim=1)
    curvature = (up - 2.0 * state.similarity[:, None] + down).clamp(max=-1e-9)
    offset = (0.5 * (down - up) / curvature).clamp(-1.0, 1.0)
    offset = torch.where((up < 0) | (down < 0), torch.zeros_like(offset), offset)  # a rotation beyond REACH
    return rotation_from_axis_angle(offset * torch.deg2rad(step)[:, None]) @ state.rotation


def _among_best(state: Hypotheses, count: int) -> Tensor:
    """(H,) bool: whether a hypothesis is among the best ``count`` of its photograph."""
    order = state.similarity.argsort(descending=True, stable=True)
    same = state.image_index[order, None] == state.image_index[order]
    rank = same.tril(-1).sum(dim=1)
    return torch.zeros(len(state), dtype=torch.bool).index_put((order,), rank < count)


def _all_coherent(starts: Hypotheses, bank: ViewBank, ranking: Ranking) -> Tensor:
    """(H, C, 3, 3) coherent views of the hypotheses; the first is repeated where there are fewer."""
    rotations, model = bank.rotations.cpu().double(), bank.model.cpu()
    views = []
    for view, order in zip(starts.view.tolist(), ranking.order.cpu()[starts.image_index], strict=True):
        others = order[(order != view) & (model[order] == model[view])]
        near = others[rotation_error(rotations[others], rotations[view]) <= REACH]
        views.append(coherent_views(rotations, torch.cat([torch.tensor([view]), near])))
    most = max(map(len, views), default=1)
    padded = [torch.cat([v, v[:1].expand(most - len(v))]) for v in views]
    return rotations[torch.stack(padded)] if padded else rotations[:0, None]


def _box_filling_distances(
    describers: Sequence[ViewDescriber], state: Hypotheses, boxes: Tensor, cameras: Tensor
) -> Tensor:
    """(H,) distances at which the objects fill their boxes."""
    distance = state.distance.clone()
    for model, mine in state.by_model():
        describer, image = describers[model], state.image_index[mine]
        R, t = pose_from_box(describer.hull, state.rotation[mine], boxes[image], cameras[image])
        distance[mine] = torch.linalg.vector_norm(R @ describer.centre + t, dim=1)
    return distance


def _motion(describers: Sequence[ViewDescriber], a: Hypotheses, b: Hypotheses) -> Tensor:
    """(H,) size of the motion between two poses, compared with ``TOLERANCE``."""
    radii = torch.tensor([describer.radius for describer in describers], dtype=torch.float64)[a.model]
    rotation = torch.linalg.matrix_norm(a.rotation.mT @ b.rotation - torch.eye(3, dtype=torch.float64))
    motion: Tensor = rotation + (b.distance - a.distance).abs() / radii
    return motion


def _updated(state: Hypotheses, index: Tensor, part: Hypotheses) -> Hypotheses:
    """The state with ``part`` in place of the hypotheses ``index``."""
    changed = ("rotation", "distance", "similarity")
    return replace(state, **{name: getattr(state, name).index_copy(0, index, getattr(part, name)) for name in changed})
