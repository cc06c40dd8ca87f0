"""Coarse-to-fine search around views of rankings (the paper's section "Registration of 2D images"), all at once."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..geometry import rotation_error, rotation_from_axis_angle
from ..geometry.translation import place_view
from ..matching import Ranking, ViewBank, ViewDescriber
from .hypotheses import Hypotheses
from .verify import similarities

__all__ = ["coherent_views", "search"]

TOLERANCE = 0.05
"""|T_i^-1 T_(i+1) - Id|_F at which the search stops, translation in object radii (METHOD 6)."""

REACH = 15.0
"""Degrees: half as far again as the neighbours in a bank of 10 degrees, which were found worse."""

FIRST_STEP, FINEST_STEP = 5.0, 1.0
"""Degrees: half the spacing of the bank; finer steps move the contours of a crop by less than a pixel."""

ROUNDS = 12
"""At most."""

FINALISTS, AFTER = 2, 2
"""So many hypotheses of a photograph are searched to the end; the others stop after so many rounds."""


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
    bank: ViewBank,
    ranking: Ranking,
    boxes: Tensor | None = None,
    camera_matrices: Tensor | None = None,
) -> Hypotheses:
    """Search around hypotheses in ever smaller steps until each pose stops moving.

    The first round compares the coherent views of the bank themselves (:func:`coherent_views`). Every further round
    takes the 26 turns by +-step about the camera's axes around the best pose; the step halves whenever nothing is
    better. With camera matrices, the distance follows in closed form from the box after every round, so that
    perspective is that of the photograph. The search keeps within ``REACH`` degrees of the hypothesis. All hypotheses
    of all photographs step together; the best ``FINALISTS`` of each photograph go on to the end.

    Args:
        describers: of the bank's models.
        descriptors: (B, D) of the photographs' fields, as the describers make them.
        starts: hypotheses of those photographs.
        bank, ranking: where they come from.
        boxes, camera_matrices: (B, 4) px and (B, 3, 3) of the photographs; both or none.

    Returns:
        The same hypotheses with better rotation and distance, and ``score``: the normalised correlation in [0, 1].
    """
    order, near = ranking.order.cpu(), bank.rotations.cpu().double()
    candidates = [
        near[_coherent_with(int(view), order[int(b)], near, bank.model.cpu())]
        for b, view in zip(starts.photograph, starts.view, strict=True)
    ]
    state = replace(starts, score=torch.full_like(starts.score, -1.0))
    step = torch.full((len(starts),), FIRST_STEP, dtype=torch.float64)
    active = torch.arange(len(starts))
    for rounds in range(ROUNDS):
        if len(active) == 0:
            break
        before = state[active]
        owner = torch.repeat_interleave(torch.arange(len(before)), torch.tensor([len(c) for c in candidates]))
        turned = replace(before[owner], rotation=torch.cat(candidates))
        scores = similarities(describers, descriptors, turned).split([len(c) for c in candidates])
        winners = torch.stack([s.argmax() for s in scores])
        best = torch.stack([s[w] for s, w in zip(scores, winners, strict=True)])
        improved = best > before.score
        chosen = torch.stack([c[w] for c, w in zip(candidates, winners, strict=True)])
        now = replace(
            before,
            rotation=torch.where(improved[:, None, None], chosen, before.rotation),
            score=torch.where(improved, best, before.score),
        )
        if camera_matrices is not None and boxes is not None:
            now = replace(
                now, distance=torch.where(improved, _placed(describers, now, boxes, camera_matrices), now.distance)
            )
        state = _put(state, active, now)
        fine = (step[active] <= FINEST_STEP) & (_moved(describers, before, now) <= TOLERANCE)
        if rounds:
            step[active] = torch.where(improved, step[active], (step[active] / 2.0).clamp(min=FINEST_STEP))
            active = active[~fine]
        if rounds + 1 == AFTER:
            active = active[_among_best(state, FINALISTS)[active]]
        anchors = starts.rotation[active]
        candidates = [
            _around(state.rotation[i], float(step[i]), anchor)
            for i, anchor in zip(active.tolist(), anchors, strict=True)
        ]
    return state


def _among_best(state: Hypotheses, count: int) -> Tensor:
    """(H,) bool: whether a hypothesis is among the best ``count`` of its photograph."""
    order = state.score.argsort(descending=True, stable=True)
    same = state.photograph[order, None] == state.photograph[order]
    place = same.tril(-1).sum(dim=1)
    return torch.zeros(len(state), dtype=torch.bool).index_put((order,), place < count)


def _coherent_with(view: int, order: Tensor, rotations: Tensor, model: Tensor) -> Tensor:
    """The coherent views of the ranking that begins with ``view``."""
    rest = order[(order != view) & (model[order] == model[view])]
    near = rest[rotation_error(rotations[rest], rotations[view]) <= REACH]
    return coherent_views(rotations, torch.cat([torch.tensor([view]), near]))


def _around(rotation: Tensor, step: float, anchor: Tensor) -> Tensor:
    """(K, 3, 3): 3 x 3 tilts by +-step, each with 3 turns in the image plane, less the pose itself."""
    s = torch.tensor([0.0, -step, step], dtype=torch.float64).deg2rad()
    o = torch.zeros(1, dtype=torch.float64)
    tilts = rotation_from_axis_angle(torch.cartesian_prod(s, s, o))
    turns = rotation_from_axis_angle(torch.cartesian_prod(o, o, s))
    candidates = (turns[None] @ tilts[:, None]).flatten(0, 1)[1:] @ rotation
    return candidates[rotation_error(candidates, anchor) <= REACH]


def _placed(describers: Sequence[ViewDescriber], state: Hypotheses, boxes: Tensor, cameras: Tensor) -> Tensor:
    """(H,) distances at which the objects fill their boxes."""
    distance = state.distance.clone()
    for model in state.model.unique().tolist():
        mine = state.model == model
        describe, photograph = describers[model], state.photograph[mine]
        R, t = place_view(describe.hull, state.rotation[mine], boxes[photograph], cameras[photograph])
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
