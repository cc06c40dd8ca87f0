"""Pairs of views that the shape of a mesh does not tell apart."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..geometry import uniform_views, viewpoint_from_rotation
from ..geometry.conversions import axis_angle_from_rotation, rotation_from_axis_angle
from ..geometry.viewpoint import angles_between, up_rotation
from ..matching import ViewDescriber
from ..registration import Registrar
from ..utils.aliases import Fields, Progress
from .photographs import UPRIGHT

LOOKED_AT = 48  # Directions from which the mesh is looked at
RIVAL_ANGLE = 30.0  # Degrees beyond which a look-alike is another answer
# Views of the bank that are tried for each direction, beside its half turns about the mesh's axes
CANDIDATES = 3
TURNED = 2  # Candidates that are turned to come nearer
# Degrees that a photograph resolves: poses look alike that differ by no more than a pose from
# itself, turned so far
RESOLUTION = 3.0
HALF_TURNS = torch.diag_embed(2.0 * torch.eye(3).double() - 1.0)  # about the mesh's axes
STEEP = 60.0  # Degrees of elevation from which azimuth and roll can hardly be told apart
# A print tells two views apart if in more than a fraction of their cells of so many pixels colours
# differ by so much, of 1
PRINT_FRACTION = 0.03
CELL = 8
COLOUR_DIFFERENCE = 0.15
# Degrees from which a rotation between two views is half a turn, and cosines of the angle between
# its axis and the upward one that make it one about that axis, or about a level one
HALF_TURN = 150.0
ALONG = 0.9
ACROSS = 0.4
STEPS = (6.0, 2.0)  # Degrees by which a candidate is turned to come nearer


@dataclass(frozen=True)
class LookAlike:
    """Two views of a mesh.

    Attributes:
        rotation, rival: (3, 3) float64 model -> camera.
        angle: degrees between them, up to the mesh's symmetries.
        similarity: normalised correlation of their descriptors.
        resolved: that of the first view and itself, turned by what a photograph resolves.
        print_differs: fraction of their area in which their colours differ; None without colours.
        hint: the option of a pose prior that tells them apart.
    """

    rotation: Tensor
    rival: Tensor
    angle: float
    similarity: float
    resolved: float
    print_differs: float | None = None
    hint: str = ""

    @property
    def is_alike(self) -> bool:
        """Whether a photograph of the first view does not tell the two apart."""
        return self.similarity >= self.resolved

    @property
    def print_tells(self) -> bool:
        """Whether the mesh's print tells the two views apart."""
        return self.print_differs is not None and self.print_differs > PRINT_FRACTION

    def to_dict(self) -> Fields:
        return {
            "view": _angles_of(self.rotation),
            "rival": _angles_of(self.rival),
            "angle_deg": self.angle,
            "similarity": self.similarity,
            "resolved": self.resolved,
            "alike": self.is_alike,
            "print_differs": self.print_differs,
            "hint": self.hint,
        }


def _angles_of(rotation: Tensor) -> dict[str, float]:
    angles = map(float, viewpoint_from_rotation(rotation))
    return dict(zip(("azimuth", "elevation", "theta"), angles, strict=True))


@torch.no_grad()
def look_alikes(registrar: Registrar, report: Progress = lambda *_: None) -> tuple[LookAlike, ...]:
    """The most similar view beyond 30 degrees of each of 48 directions, spread evenly over the
    sphere; of an upright object, of those from which one looks at it.

    Candidates are views of the bank, and half turns about the axes of the mesh; the best are turned
    until they are most similar. Descriptors are those by which poses are compared with photographs.
    Symmetries of a mesh without colours do not count.

    Args:
        registrar: of the mesh.
        report: called with "look-alikes", directions done and in all.
    """
    bank = registrar.bank
    describer = registrar.describer
    symmetries = None if bank.mesh.has_colours else registrar.symmetries_of(exact=True)
    directions = uniform_views(LOOKED_AT).rotations.double()
    up = up_rotation(bank.mesh.up).double()
    if registrar.pipeline.views.pose == "upright":
        elevation = viewpoint_from_rotation(directions @ up.mT)[1]
        directions = directions[(elevation >= UPRIGHT[0]) & (elevation <= UPRIGHT[1])]
    distance = bank.distances.median().double().cpu()
    descriptors = _described(describer, directions, distance)
    resolved = _resolved(describer, directions, distance, descriptors)
    views = bank.rotations.double().cpu()
    coarse = F.normalize(bank.descriptors, dim=1)
    matched = _described(describer.with_settings(bank.settings), directions, distance)
    similarity = (matched @ coarse.T).cpu()
    pairs = []
    for row, direction in enumerate(directions):
        report("look-alikes", row, len(directions))
        angle = _angle(views, direction, symmetries)
        scores = similarity[row].masked_fill(angle <= RIVAL_ANGLE + sum(STEPS), -torch.inf)
        best = scores.topk(min(CANDIDATES, len(scores))).indices
        half_turns = direction @ HALF_TURNS
        candidates = torch.cat([views[best[scores[best].isfinite()]], half_turns])
        candidates = candidates[
            _angle(candidates, direction, symmetries) > RIVAL_ANGLE + sum(STEPS)
        ]
        if not len(candidates):
            continue
        rival, score = _nearest(describer, candidates, distance, descriptors[row])
        pairs.append(
            LookAlike(
                direction,
                rival,
                float(_angle(rival[None], direction, symmetries)),
                score,
                resolved[row],
                print_difference(describer, direction, rival, distance),
                _hint(direction, rival, up),
            )
        )
    report("look-alikes", len(directions), len(directions))
    return tuple(sorted(pairs, key=lambda pair: pair.resolved - pair.similarity))


def confused_sides(pairs: Sequence[LookAlike], up: str) -> str:
    """Which sides most of the pairs confuse, in words: half a turn about the axis that points
    ``up`` is front and back, one about a level axis is top and bottom."""
    axis = up_rotation(up).double()[2]
    kinds = Counter[str]()
    for pair in pairs:
        turn = axis_angle_from_rotation(pair.rotation.mT @ pair.rival)
        steepness = abs(float(F.normalize(turn, dim=0) @ axis))
        half = float(torch.rad2deg(turn.norm())) > HALF_TURN
        upright = half and steepness > ALONG
        level = half and steepness < ACROSS
        kinds["front and back" if upright else "top and bottom" if level else "several sides"] += 1
    return kinds.most_common(1)[0][0]


def _hint(rotation: Tensor, rival: Tensor, up: Tensor) -> str:
    """The option of a pose prior by which two views differ most, each within the range that it
    has; ``up`` (3, 3) turns the mesh's upward axis to z."""
    first, second = (viewpoint_from_rotation(each @ up.mT) for each in (rotation, rival))
    elevations = float(first[1]), float(second[1])
    if abs(elevations[0] - elevations[1]) > RIVAL_ANGLE:
        return "--elevation"
    if max(map(abs, elevations)) > STEEP:  # azimuth and roll are one turn there
        return "--near"
    turn = abs((float(first[0] - second[0]) + 180.0) % 360.0 - 180.0)
    return "--azimuth" if turn > RIVAL_ANGLE else "--theta"


def print_difference(
    describer: ViewDescriber, rotation: Tensor, rival: Tensor, distance: Tensor
) -> float | None:
    """See :attr:`LookAlike.print_differs`: cells of a few pixels are compared, as the two views
    hardly coincide better."""
    if not describer.draws_colours:
        return None
    pictures = describer.shaded(torch.stack([rotation, rival]), distance.expand(2))[:, 1:]
    cells = F.avg_pool2d(pictures, CELL)
    seen = (cells < 1.0).any(dim=1).any(dim=0)
    difference = (cells[0] - cells[1]).abs().amax(dim=0)
    return float((difference[seen] > COLOUR_DIFFERENCE).double().mean())


def _angle(rotations: Tensor, rotation: Tensor, symmetries: Tensor | None) -> Tensor:
    """(N,) degrees between rotations (N, 3, 3) and one (3, 3), up to symmetries (S, 4, 4)."""
    return angles_between(rotations, rotation[None], symmetries)[:, 0]


def _described(describer: ViewDescriber, rotations: Tensor, distance: Tensor) -> Tensor:
    """(N, D) descriptors of unit length."""
    return F.normalize(describer.descriptors(rotations, distance.expand(len(rotations))), dim=1)


def _turns(degrees: float) -> Tensor:
    """(6, 3, 3) turns about the three axes, in both directions."""
    axes = torch.eye(3, dtype=torch.float64)
    vectors = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)) * torch.cat([axes, -axes])
    return rotation_from_axis_angle(vectors)


def _resolved(
    describer: ViewDescriber, rotations: Tensor, distance: Tensor, descriptors: Tensor
) -> list[float]:
    """Of each rotation the mean similarity with itself, turned about the axes by what a photograph
    resolves."""
    turned = _turns(RESOLUTION) @ rotations[:, None]
    similar = _described(describer, turned.flatten(0, 1), distance).view(len(rotations), 6, -1)
    values: list[float] = (similar * descriptors[:, None]).sum(dim=2).mean(dim=1).tolist()
    return values


def _nearest(
    describer: ViewDescriber, candidates: Tensor, distance: Tensor, descriptor: Tensor
) -> tuple[Tensor, float]:
    """The candidate (3, 3) of (K, 3, 3) that comes nearest to a descriptor (D,) when turned, and
    its similarity."""
    unturned = _described(describer, candidates, distance) @ descriptor
    candidates = candidates[unturned.topk(min(TURNED, len(candidates))).indices.cpu()]
    still = torch.eye(3, dtype=torch.float64)[None]
    for degrees in STEPS:
        turns = torch.cat([still, _turns(degrees)])
        around = turns @ candidates[:, None]
        similarity = (_described(describer, around.flatten(0, 1), distance) @ descriptor).view(
            len(candidates), -1
        )
        best = similarity.argmax(dim=1).cpu()
        candidates = around[torch.arange(len(candidates)), best]
        highest = similarity.amax(dim=1)
    winner = int(highest.argmax())
    return candidates[winner], float(highest[winner])
