"""Coarse-to-fine search around views of rankings (the paper's section "Registration of 2D images"), all at once."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error, rotation_from_axis_angle
from ..geometry.translation import pose_from_box
from ..matching import Ranking, ViewBank, ViewDescriber
from .hypotheses import Hypotheses
from .rescoring import similarities

__all__ = ["coherent_views", "search"]

TOLERANCE = 0.05
"""|T_i^-1 T_(i+1) - Id|_F at which the search stops, translation in object radii (METHOD 6)."""

REACH = 15.0
"""Degrees: half as far again as the neighbours in a bank of 10 degrees, which were found worse."""

FIRST_STEP, FINEST_STEP = 5.0, 1.0
"""Degrees: half the spacing of the bank; finer steps move the contours of a crop by less than a pixel."""

ROUNDS, BRIEF = 8, 4
"""At most, of seven poses each; of a brief search."""

FINALISTS, AFTER = 2, 2
"""So many hypotheses of a photograph are followed to the end, by search and by contours; the others are searched
for so many rounds."""


def coherent_views(rotations: Tensor, order: Tensor, *, count: int = 5, angle: float = REACH) -> Tensor:
    """The best ``count`` views, less those farther than ``angle`` degrees from the first.

    Args:
        rotations: (N, 3, 3).
        order: (N,) view indices, best first.

    Returns:
        (K,) view indices, 1 <= K <= count.
    """
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
) -> Hypotheses:
    """Search around hypotheses in ever smaller steps until each pose stops moving.

    First the coherent views of the bank themselves are compared (:func:`coherent_views`). Every round then takes the
    six turns by +-step about the camera's axes around the best pose, and the pose where the parabolas through their
    scores peak; the step halves where the best moves by less than half of it. With camera matrices, the distance
    follows in closed form from the box twice on the way, so that perspective is that of the photograph. The search
    keeps within ``REACH`` degrees of the hypothesis. All hypotheses of all photographs step together; the best
    ``FINALISTS`` of each photograph go on to the end.

    Args:
        describers: of the bank's models.
        descriptors: (B, D) of the photographs' fields, as the describers make them.
        starts: hypotheses of those photographs.
        bank, ranking: where they come from; not needed for a brief search.
        boxes, camera_matrices: (B, 4) px and (B, 3, 3) of the photographs; both or none.
        brief: for contours to go on from: ``BRIEF`` rounds at most, from the hypotheses' own views, no coherent ones.

    Returns:
        The same hypotheses with better rotation and distance, and ``score``: the normalised correlation in [0, 1].

    Raises:
        InvalidInputError: neither brief nor with bank and ranking.
    """
    state = replace(starts, score=torch.full_like(starts.score, -1.0))
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
        scores = _scores(describers, descriptors, before, candidates, starts.rotation[active])
        now = _best(before, candidates, scores)
        if rounds:
            peak = _peak(before, scores, step[active])[:, None]
            now = _best(now, peak, _scores(describers, descriptors, before, peak, starts.rotation[active]))
        if camera_matrices is not None and boxes is not None and rounds in (0, AFTER):
            filling = _placed(describers, now, boxes, camera_matrices)
            now = replace(now, distance=torch.where(now.score > before.score, filling, before.distance))
        state = _put(state, active, now)
        if rounds:
            still = rotation_error(before.rotation, now.rotation) < 0.5 * step[active]
            finished = still & (step[active] <= FINEST_STEP) & (_moved(describers, before, now) <= TOLERANCE)
            step[active] = torch.where(still, (step[active] / 2.0).clamp(min=FINEST_STEP), step[active])
            active = active[~finished]
        if rounds == AFTER:
            active = active[_among_best(state, FINALISTS)[active]]
        candidates = _axes(step[active]) @ state.rotation[active][:, None]
    return state


def _scores(
    describers: Sequence[ViewDescriber], descriptors: Tensor, state: Hypotheses, candidates: Tensor, anchors: Tensor
) -> Tensor:
    """(H, C) normalised correlations of (H, C, 3, 3) candidates; -1 beyond the reach of the (H, 3, 3) anchors."""
    H, C = candidates.shape[:2]
    each = replace(state[torch.arange(H).repeat_interleave(C)], rotation=candidates.flatten(0, 1))
    scores = similarities(describers, descriptors, each).view(H, C)
    return scores.masked_fill(rotation_error(candidates, anchors[:, None]) > REACH, -1.0)


def _best(state: Hypotheses, candidates: Tensor, scores: Tensor) -> Hypotheses:
    """The best of (H, C, 3, 3) candidates where it is better."""
    score, winner = scores.max(dim=1)
    chosen = candidates[torch.arange(len(state)), winner]
    better = score > state.score
    rotation = torch.where(better[:, None, None], chosen, state.rotation)
    return replace(state, rotation=rotation, score=torch.where(better, score, state.score))


def _axes(step: Tensor) -> Tensor:
    """(H, 6, 3, 3) turns by +step about x, y, z, then by -step."""
    turns = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    return rotation_from_axis_angle(turns * torch.deg2rad(step)[:, None, None])


def _peak(state: Hypotheses, scores: Tensor, step: Tensor) -> Tensor:
    """(H, 3, 3) poses at the peaks of the parabolas through (H, 6) scores of :func:`_axes`, a step away at most."""
    up, down = scores.split(3, dim=1)
    bend = (up - 2.0 * state.score[:, None] + down).clamp(max=-1e-9)
    offset = (0.5 * (down - up) / bend).clamp(-1.0, 1.0)
    offset = torch.where((up < 0) | (down < 0), torch.zeros_like(offset), offset)  # one of them lies out of reach
    turned: Tensor = rotation_from_axis_angle(offset * torch.deg2rad(step)[:, None]) @ state.rotation
    return turned


def _among_best(state: Hypotheses, count: int) -> Tensor:
    """(H,) bool: whether a hypothesis is among the best ``count`` of its photograph."""
    order = state.score.argsort(descending=True, stable=True)
    same = state.photograph[order, None] == state.photograph[order]
    place = same.tril(-1).sum(dim=1)
    return torch.zeros(len(state), dtype=torch.bool).index_put((order,), place < count)


def _all_coherent(starts: Hypotheses, bank: ViewBank, ranking: Ranking) -> Tensor:
    """(H, C, 3, 3) coherent views around the hypotheses, the first again where there are fewer."""
    rotations, model = bank.rotations.cpu().double(), bank.model.cpu()
    views = []
    for view, order in zip(starts.view.tolist(), ranking.order.cpu()[starts.photograph], strict=True):
        rest = order[(order != view) & (model[order] == model[view])]
        near = rest[rotation_error(rotations[rest], rotations[view]) <= REACH]
        views.append(coherent_views(rotations, torch.cat([torch.tensor([view]), near])))
    most = max(map(len, views), default=1)
    same = [torch.cat([v, v[:1].expand(most - len(v))]) for v in views]
    return rotations[torch.stack(same)] if same else rotations[:0, None]


def _placed(describers: Sequence[ViewDescriber], state: Hypotheses, boxes: Tensor, cameras: Tensor) -> Tensor:
    """(H,) distances at which the objects fill their boxes."""
    distance = state.distance.clone()
    for model in state.model.unique().tolist():
        mine = state.model == model
        describe, photograph = describers[model], state.photograph[mine]
        R, t = pose_from_box(describe.hull, state.rotation[mine], boxes[photograph], cameras[photograph])
        distance[mine] = torch.linalg.vector_norm(R @ describe.centre + t, dim=1)
    return distance


def _moved(describers: Sequence[ViewDescriber], a: Hypotheses, b: Hypotheses) -> Tensor:
    radii = torch.tensor([describe.radius for describe in describers], dtype=torch.float64)[a.model]
    turn = torch.linalg.matrix_norm(a.rotation.mT @ b.rotation - torch.eye(3, dtype=torch.float64))
    moved: Tensor = turn + (b.distance - a.distance).abs() / radii
    return moved


def _put(state: Hypotheses, index: Tensor, part: Hypotheses) -> Hypotheses:
    return replace(
        state,
        rotation=state.rotation.index_copy(0, index, part.rotation),
        distance=state.distance.index_copy(0, index, part.distance),
        score=state.score.index_copy(0, index, part.score),
    )
