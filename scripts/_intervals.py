"""Intervals of shares and of differences, over what is independent in the real sets."""

from collections.abc import Callable, Hashable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from curvireg_torch.evaluation import Benchmark

RESAMPLES = 2000


def independent_units(objects: Benchmark) -> list[int]:
    """For each object of a set the number of the unit that it belongs to; units are independent, their members are not.

    PASCAL3D+: objects of one CAD. BOP: one object of a scene in one pose, however many lightings it was photographed
    under (the 80 instances of ``hope`` are 16 such views in five lightings each).
    """
    return _numbered([_unit(objects, k) for k in range(len(objects.items))])


def _unit(objects: Benchmark, k: int) -> Hashable:
    item = objects.items[k]
    known = objects.dataset.annotation(item.index)
    if "scene_id" not in known:
        return item.meshes
    pose = [round(float(v), 3) for v in (*known["rotation"].flatten(), *known["translation"])]
    return known["scene_id"], known["obj_id"], *pose


def _numbered(units: Sequence[Hashable]) -> list[int]:
    numbers = {unit: i for i, unit in enumerate(dict.fromkeys(units))}
    return [numbers[unit] for unit in units]


def interval(values: ArrayLike, units: Sequence[Hashable]) -> tuple[float, float, float]:
    """Mean of (N,) values, and its 95 % interval by bootstrap over units, all members of a unit drawn together.

    Args:
        values: shares (0 or 1 each) or paired differences of them.
        units: what each value belongs to; all different where values are independent.
    """
    values, number = np.asarray(values, float), _numbered(units)
    total, count = np.bincount(number, weights=values), np.bincount(number)
    picks = np.random.default_rng(0).integers(len(count), size=(RESAMPLES, len(count)))
    low, high = np.quantile(total[picks].sum(axis=1) / count[picks].sum(axis=1), [0.025, 0.975])
    return float(values.mean()), float(low), float(high)


def interval_of(units: Sequence[Hashable], measure: Callable[[np.ndarray], float | None]) -> tuple[float, float] | None:
    """95 % interval of ``measure(indices)`` by bootstrap over units; None of one unit, or where it is mostly undefined.

    Args:
        units: what each of the N answers belongs to.
        measure: of (M,) indices of answers, some of them several times; None where it is undefined.
    """
    number = np.array(_numbered(units))
    members = [np.flatnonzero(number == k) for k in range(number.max() + 1)]
    if len(members) < 2:
        return None
    rng = np.random.default_rng(0)
    picks = (rng.integers(len(members), size=len(members)) for _ in range(RESAMPLES))
    values = [v for pick in picks if (v := measure(np.concatenate([members[k] for k in pick]))) is not None]
    if len(values) <= RESAMPLES / 2:
        return None
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)
