"""The paper's search between coherent views (its section "Registration of 2D images")."""

import torch
from torch import Tensor

from ..geometry import ViewSphere, rotation_from_viewpoint, viewpoint_from_rotation
from ..geometry.viewpoint import PAPER_RADIUS
from ..mesh import mesh_radius
from ..terms import QueryFeatures
from . import Ranking, ViewBank, ViewMatcher
from .bank import view_frame

BEST_VIEWS = 3  # "at least the highest three correspondences"
# |T_i^-1 T_(i+1) - Id|_F at which the search stops, translation in object radii (METHOD 6)
STOP_MOTION = 0.05
ANGLE_STEP = 5.0  # Degrees, of elevation, azimuth and in-plane rotation in the first round
DISTANCE_STEP = 0.05 / PAPER_RADIUS  # 5 cm, in object radii
# Steps of azimuth, elevation and in-plane rotation in degrees within which two views of the paper's
# grid are neighbours. Elevations run around the whole circle: 50 degrees apart, the last and the
# first of them 60
NEIGHBOUR_STEPS = (20.0, 60.0, 20.0)
MAX_ROUNDS = 8


def angles_near(angles: Tensor, reference: Tensor) -> Tensor:
    """(N, 3) azimuth, elevation, theta in degrees of the same views as ``angles`` (N, 3), as near
    ``reference`` (3,) as they can be: past a pole the elevation runs on."""
    over = 180.0 + angles * torch.tensor([1.0, -1.0, 1.0], dtype=angles.dtype)
    both = torch.stack([angles, over])
    both = reference + torch.remainder(both - reference + 180.0, 360.0) - 180.0
    nearer = (both - reference).abs().sum(dim=2).argmin(dim=0)
    return both[nearer, torch.arange(len(angles))]


def coherent_views(angles: Tensor, steps: tuple[float, float, float] = NEIGHBOUR_STEPS) -> Tensor:
    """(K,) bool: which of K views, the best one first, are connected with it by neighbours.

    Args:
        angles: (K, 3) azimuth, elevation, theta in degrees, from :func:`angles_near`.
        steps: between neighbours, at most.

    Example:
        >>> coherent_views(torch.tensor([[0.0, 0, 0], [20, 50, 0], [180, 0, 0]])).tolist()
        [True, True, False]
    """
    apart = (angles[:, None] - angles).abs()
    beside = (apart <= torch.tensor(steps, dtype=angles.dtype) + 0.1).all(dim=2)
    connected = beside[0]
    for _ in range(len(angles)):
        connected = beside[connected].any(dim=0)
    return connected


def divided(low: float, high: float, step: float) -> Tensor:
    """Numbers from ``low`` to ``high``, both among them, in equal steps of about ``step``."""
    steps = max(round((high - low) / step), int(high > low))
    return torch.linspace(low, high, steps + 1, dtype=torch.float64)


def motion(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> float:
    """E = |T^-1 T' - Id|_F of two poses with rotations (3, 3) and the object's centre at distances
    () in radii on the optical axis."""
    R, distance = first
    S, other = second
    turned = R.T @ S - torch.eye(3, dtype=torch.float64)
    along = other - distance
    return float((turned.square().sum() + along.square()).sqrt())


@torch.no_grad()
def search(
    matcher: ViewMatcher, query: QueryFeatures, ranking: Ranking, *, least_coherent: int = 1
) -> tuple[Tensor, Tensor]:
    """Return the rotation (3, 3) and the distance () in model units, float64, of the view that
    matches one photograph best, between the least and the greatest angles and distances of the
    coherent ones of its three best views.

    Every round compares all views of a grid, :data:`ANGLE_STEP` and :data:`DISTANCE_STEP` wide at
    first and half as wide in each further round (the paper does not say how they go on), between
    the coherent views of the round before. The search ends where the best pose moves by
    :data:`STOP_MOTION` or less. An orthographic camera does not see the distance: views that differ
    in nothing else count as one, and that of the best view stays.

    Mostly the best view has no coherent one among the three, and nothing is searched ("at least the
    highest three"). ``least_coherent`` = 2 takes views down the ranking until one is coherent with
    it (docs/paper.md has the effect).
    """
    bank = matcher.bank
    frame, rotations, angles = _views_in_frame(bank)
    perspective = bank.settings.camera == "perspective"
    order = ranking.order[0].cpu()
    if ranking.allowed is not None:
        order = order[ranking.allowed[0].cpu()[order]]
    distances = bank.views.distance.cpu().double()
    steps = NEIGHBOUR_STEPS
    width = ANGLE_STEP
    farther = DISTANCE_STEP
    pose = rotations[order[0]], distances[order[0]]
    for _ in range(MAX_ROUNDS):
        best, chosen = _coherent(
            rotations, angles, order, steps, least=least_coherent, with_distance=perspective
        )
        away = distances[best]
        low = chosen.amin(dim=0).tolist()
        high = chosen.amax(dim=0).tolist()
        axes = [divided(a, b, width) for a, b in zip(low, high, strict=True)]
        axes.append(
            divided(float(away.min()), float(away.max()), farther) if perspective else pose[1][None]
        )
        *columns, distances = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
        angles = torch.stack(columns, dim=1)
        rotations = rotation_from_viewpoint(*columns)
        order = _ranked(matcher, query, columns, distances)
        found = rotations[order[0]], distances[order[0]]
        moved = motion(pose, found)
        pose = found
        if moved <= STOP_MOTION:
            break
        steps = (width, width, width)
        width = width / 2.0
        farther = farther / 2.0
    return pose[0] @ frame, pose[1] * mesh_radius(bank.mesh)


def _views_in_frame(bank: ViewBank) -> tuple[Tensor, Tensor, Tensor]:
    """The frame (3, 3) in which angles of a bank's views are; their rotations (N, 3, 3) in it, and
    azimuths, elevations and thetas (N, 3) in degrees, float64."""
    frame = view_frame(bank.mesh, bank.pipeline.views)
    rotations = bank.rotations.cpu().double() @ frame.T
    return frame, rotations, torch.stack(viewpoint_from_rotation(rotations), dim=1)


def _ranked(
    matcher: ViewMatcher, query: QueryFeatures, columns: list[Tensor], distances: Tensor
) -> Tensor:
    """(N,) the order of views of azimuths, elevations and thetas, the best one first."""
    frame = view_frame(matcher.bank.mesh, matcher.bank.pipeline.views)
    azimuth, elevation, theta = (column.float() for column in columns)
    views = ViewSphere(azimuth, elevation, theta, distances.float()).in_frame(frame)
    return matcher.compare_views(query, views).argsort(descending=True, stable=True).cpu()


def _coherent(
    rotations: Tensor,
    angles: Tensor,
    order: Tensor,
    steps: tuple[float, float, float],
    *,
    least: int,
    with_distance: bool,
) -> tuple[Tensor, Tensor]:
    """(K,) the views of ``order`` that are coherent with the first, of its best three, or of more
    until there are ``least``, and their (K, 3) angles."""
    count = BEST_VIEWS
    while True:
        best = order[:count] if with_distance else different_views(rotations, order, count)
        near = angles_near(angles[best], angles[best[0]])
        coherent = coherent_views(near, steps)
        if int(coherent.sum()) >= least or len(best) < count:
            return best[coherent], near[coherent]
        count += 1


def coherent_of(bank: ViewBank, ranking: Ranking) -> Tensor:
    """(K,) the views between which :func:`search` begins, for one photograph."""
    _, rotations, angles = _views_in_frame(bank)
    perspective = bank.settings.camera == "perspective"
    order = ranking.order[0].cpu()
    views, _ = _coherent(
        rotations, angles, order, NEIGHBOUR_STEPS, least=1, with_distance=perspective
    )
    return views


@torch.no_grad()
def refine(matcher: ViewMatcher, query: QueryFeatures, view: int) -> Tensor:
    """(3, 3) float64 the best of nine views: one of the bank, and those :data:`ANGLE_STEP` beside
    it in azimuth and elevation."""
    bank = matcher.bank
    frame, _, angles = _views_in_frame(bank)
    azimuth, elevation, theta = angles[view]
    steps = torch.tensor([-ANGLE_STEP, 0.0, ANGLE_STEP], dtype=torch.float64)
    axes = (azimuth + steps, elevation + steps, theta[None])
    columns = [axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij")]
    distances = bank.views.distance[view].cpu().double().expand(len(columns[0]))
    best = _ranked(matcher, query, columns, distances)[0]
    return rotation_from_viewpoint(*columns)[best] @ frame


def different_views(rotations: Tensor, order: Tensor, count: int) -> Tensor:
    """(K,) the first ``count`` views of ``order`` (N,) whose rotations (N, 3, 3) differ; fewer if
    there are no more."""
    chosen: list[int] = []
    for view in order.tolist():
        if all(float((rotations[view] - rotations[other]).abs().max()) > 1e-4 for other in chosen):
            chosen.append(view)
        if len(chosen) == count:
            break
    return torch.tensor(chosen, dtype=torch.long)
