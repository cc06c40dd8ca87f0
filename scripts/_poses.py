"""The poses through which a registration goes, from the best view of the bank to its result."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from unittest.mock import patch

import torch
from torch import Tensor

from curvireg_torch.geometry import rotation_error
from curvireg_torch.registration import Registrar, Registration
from curvireg_torch.registration.contours.descent import ContourProblem, ContourState
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.poses import lift_to_poses

__all__ = ["PoseRecord", "recorded"]

_estimator, _search = (importlib.import_module(f"curvireg_torch.registration.{m}") for m in ("estimator", "search"))


@dataclass
class PoseRecord:
    """What :func:`recorded` saw, in order.

    Attributes:
        searches: of each search, the starts and all hypotheses after each round.
        fits: of each part of the contour fits, the (N, 4, 4) poses before it and after each round.
    """

    searches: list[list[Hypotheses]] = field(default_factory=list)
    fits: list[list[Tensor]] = field(default_factory=list)

    def path(self, registrar: Registrar, result: Registration, box: Tensor) -> list[tuple[str, Tensor]]:
        """("view", "search" or "contours", (4, 4) pose) from the best view to the result, without repetitions.

        Args:
            registrar, result: of one photograph, registered inside :func:`recorded` with a camera matrix.
            box: (4,) px, that was given.
        """
        T, K = result.projection
        fitted = self._before(T, len(self.fits))
        boxes = (box if result.corrected_box is None else result.corrected_box).double()[None]
        lifted = [lift_to_poses(registrar.describers, state, boxes, K[None]).T for state in self.searches[-1]]
        mine = int(rotation_error(lifted[-1][:, :3, :3], fitted[0][:3, :3]).argmin())
        searched = [("search", state[mine]) for state in lifted[1:]]
        steps = [("view", lifted[0][mine]), *searched, *(("contours", pose) for pose in fitted)]
        changes = [not torch.equal(a[1], b[1]) for a, b in pairwise(steps)]
        return [steps[0], *(step for step, changed in zip(steps[1:], changes, strict=True) if changed)]

    def _before(self, T: Tensor, end: int) -> list[Tensor]:
        """The poses from which the first ``end`` parts of the fits reached T, and T."""
        for k in reversed(range(end)):
            same = (self.fits[k][-1] == T).flatten(1).all(dim=1).nonzero()[:, 0].tolist()
            if same:
                rounds = [poses[same[0]] for poses in self.fits[k]]
                return [*self._before(rounds[0], k), *rounds[1:]]
        return [T]


@contextmanager
def recorded() -> Iterator[PoseRecord]:
    """Record the rounds of the searches and contour fits that run inside, of one photograph at a time."""
    record = PoseRecord()
    search, updated, descend = _search.search, _search._updated, ContourProblem.descend

    def recorded_search(describers, descriptors, starts, **options):  # type: ignore[no-untyped-def]
        record.searches.append([starts])
        return search(describers, descriptors, starts, **options)

    def recorded_update(*args):  # type: ignore[no-untyped-def]
        record.searches[-1].append(state := updated(*args))
        return state

    def recorded_descent(problem: ContourProblem, state: ContourState, reaches: tuple[float, ...]) -> ContourState:
        record.fits.append([state.T])
        for reach in reaches:
            state = descend(problem, state, (reach,))
            record.fits[-1].append(state.T)
        return state

    with (
        patch.object(_estimator, "search", recorded_search),
        patch.object(_search, "_updated", recorded_update),
        patch.object(ContourProblem, "descend", recorded_descent),
    ):
        yield record
