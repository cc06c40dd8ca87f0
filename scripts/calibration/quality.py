"""Quality of confidences and covariances: statistics with bootstrap intervals, the real sets, and the tables."""

import math
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from curvireg_torch.evaluation import DATASETS, Benchmark, Protocol
from curvireg_torch.evaluation.store import ResultStore
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_error, symmetry_transforms, transform
from curvireg_torch.registration.confidence import RELIABLE
from scripts._shared import table_lines

REAL_SETS = {"pascal3d_mini": "upright", "hope": "any", "lm": "any", "dino": "any", "buddha": "any"}
"""Real datasets, each with the pose prior of its protocol."""
RESAMPLES = 2000
RIGHT = 30.0
"""A pose is right if its rotation error is below this many degrees."""

RISK = 0.05
LEVELS = (0.5, 0.9, 0.95)
UNKNOWN = 0.5
"""A direction counts as unknown above this standard deviation, in units of pi (rotation) or distance (translation)."""

COVERAGES = (1.0, 0.75, 0.5, 0.25)

Row = dict[str, Any]


def open_real_set(data: Path, name: str) -> Benchmark:
    """Open one of the real sets: PASCAL3D+ sets in ``data`` (pixels counted from 0), the others in ``data/bop``."""
    is_pascal = name.startswith("pascal")
    spec = DATASETS["pascal3d" if is_pascal else "bop"]
    dataset = spec.open(data / name, pixel_origin=0) if is_pascal else spec.open(data / "bop" / name)
    return spec.scored(dataset, Protocol(pose=REAL_SETS[name]))


def independent_units(objects: Benchmark) -> list[int]:
    """Number of the independent unit of each object of a set.

    PASCAL3D+: all objects of one CAD are a unit. BOP: one object of a scene in one pose is a unit under all its
    lightings (the 80 instances of ``hope`` are 16 such views in five lightings each).
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
    """Mean of (N,) values with its 95 % interval by bootstrap over units.

    Args:
        values: 0 or 1 each, or paired differences of such values.
        units: unit of each value. All members of a unit are drawn together.
    """
    values, number = np.asarray(values, float), _numbered(units)
    total, count = np.bincount(number, weights=values), np.bincount(number)
    picks = np.random.default_rng(0).integers(len(count), size=(RESAMPLES, len(count)))
    low, high = np.quantile(total[picks].sum(axis=1) / count[picks].sum(axis=1), [0.025, 0.975])
    return float(values.mean()), float(low), float(high)


def interval_of(units: Sequence[Hashable], measure: Callable[[np.ndarray], float | None]) -> tuple[float, float] | None:
    """95 % interval of ``measure(indices)`` by bootstrap over units.

    Args:
        units: unit of each of the N values.
        measure: statistic of (M,) indices, which may repeat; None where it is undefined.

    Returns:
        The interval, or None if there is only one unit or the measure is undefined in half of the resamples.
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


def format_interval(value: float | None, bounds: Sequence[float] | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" + ("" if bounds is None else f" ({bounds[0]:.2f} to {bounds[1]:.2f})")


def auc(confidence: np.ndarray, right: np.ndarray) -> float | None:
    """Fraction of pairs in which the right result has the higher confidence, ties counting half; None without pairs."""
    difference = confidence[right][:, None] - confidence[~right][None]
    return float((difference > 0).mean() + 0.5 * (difference == 0).mean()) if difference.size else None


def cumulative_risk(confidence: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(n,) fraction of wrong results among the k + 1 most confident ones."""
    order = np.argsort(-confidence, kind="stable")
    return np.cumsum(~right[order]) / np.arange(1, len(right) + 1)


def coverage_at_risk(confidence: np.ndarray, right: np.ndarray, risk: float) -> float:
    """Largest fraction of results, the most confident first, of which no more than ``risk`` are wrong."""
    good = np.flatnonzero(cumulative_risk(confidence, right) <= risk)
    return float(good.max() + 1) / len(right) if len(good) else 0.0


def group_of(row: Row) -> str:
    """Group that must be in one fold: objects of one kind, or the copies of an object without a kind."""
    return row["kind"] or row["like"]


def quality(sure: np.ndarray, right: np.ndarray, units: Sequence[Any]) -> Row:
    """Quality of confidences, with counts and intervals over units."""
    risk, reliable = cumulative_risk(sure, right), sure >= RELIABLE
    return {
        "n": len(sure),
        "units": len({str(unit) for unit in units}),
        "right": int(right.sum()),
        "mean": float(sure.mean()),
        "auc": auc(sure, right),
        "auc_interval": interval_of(units, lambda i: auc(sure[i], right[i])),
        "coverage_at_risk": coverage_at_risk(sure, right, RISK),
        "coverage_interval": interval_of(units, lambda i: coverage_at_risk(sure[i], right[i], RISK)),
        "risk_at_coverage": {
            f"{c:g}": [round(float(risk[k - 1]) * k), k] for c in COVERAGES if (k := max(1, round(c * len(sure))))
        },
        "reliable": int(reliable.sum()),
        "reliable_and_right": int(right[reliable].sum()),
    }


def squared_distance(error: Sequence[float], covariance: Sequence[Sequence[float]], distance: float) -> float:
    """e^T C^-1 e over the known directions; see ``UNKNOWN``."""
    wide = np.array([math.pi] * 3 + [distance] * 3)
    value, axes = np.linalg.eigh(np.array(covariance) / wide[:, None] / wide)
    known = value < UNKNOWN**2
    return float((((axes.T @ (np.array(error) / wide)) ** 2 / value)[known]).sum())


def radii(squares: np.ndarray) -> dict[str, float]:
    """Squared radii of the ellipsoids that contain ``LEVELS`` of the squared distances (conformal quantiles)."""
    rank = [min(len(squares) - 1, math.ceil(level * (len(squares) + 1)) - 1) for level in LEVELS]
    return {f"{level:g}": round(float(np.sort(squares)[k]), 4) for level, k in zip(LEVELS, rank, strict=True)}


def count_inside(squares: np.ndarray, radius: dict[str, float]) -> dict[str, int]:
    """Number of squared distances within each ellipsoid."""
    return {level: int((squares <= r).sum()) for level, r in radius.items()}


def success_rates(rows: Sequence[Row]) -> dict[str, Row]:
    """Fraction of right results by form and pose, with intervals over groups."""
    out = {}
    for form in ("exact", "sibling"):
        for pose in ("upright", "free"):
            some = [r for r in rows if not r["wrong"] and (r["form"], r["pose"]) == (form, pose)]
            if some:
                units = [group_of(row) for row in some]
                found = {
                    "best view": [r["view_errors"][0] < RIGHT for r in some],
                    "answer": [r["errors"][0] < RIGHT for r in some],
                    "answer within 5 degrees": [r["errors"][0] < 5.0 for r in some],
                    "among the hypotheses": [min(r["errors"]) < RIGHT for r in some],
                }
                out[f"{form} {pose}"] = {"n": len(some)} | {k: list(interval(v, units)) for k, v in found.items()}
    return out


def exactness(rows: Sequence[Row]) -> dict[str, Row]:
    """Errors of right answers with the exact mesh, by pose: degrees, and fractions of the distance."""
    out = {}
    for pose in ("upright", "free"):
        some = [r for r in rows if (r["form"], r["pose"], r["wrong"]) == ("exact", pose, None) and "pose_error" in r]
        if some := [r for r in some if r["errors"][0] < RIGHT]:
            errors = [r["errors"][0] for r in some]
            shifts = [float(np.linalg.norm(r["pose_error"][3:])) / r["distance"] for r in some]
            out[pose] = {
                "n": len(some),
                "best view": float(np.median([r["view_errors"][0] for r in some])),
                "rotation median": float(np.median(errors)),
                "rotation 90 %": float(np.quantile(errors, 0.9)),
                "translation median": float(np.median(shifts)),
                "translation 90 %": float(np.quantile(shifts, 0.9)),
            }
    return out


def real_set(data: Path, runs: Path, name: str, covariance: Row) -> Row:
    """Quality of the stored predictions for a real set."""
    objects, store = open_real_set(data, name), ResultStore(runs / name)
    items = objects.selection(None)
    rows = [store.read(item.key) for item in items]
    right = (objects.rotation_errors(items, rows) < RIGHT).numpy()
    sure = np.array([row.get("confidence", 0.0) for row in rows])
    found = quality(sure, right, independent_units(objects))
    squares = []
    for item, row in zip(items, rows, strict=True):
        if row.get("covariance") is not None:
            sample = objects.dataset.annotation(item.index)
            poses = transform(sample["rotation"].double(), sample["translation"].double())
            poses = poses @ symmetry_transforms(sample["model_info"]).double()
            R, t = (torch.tensor(row[k], dtype=torch.float64) for k in ("rotation", "translation"))
            near = poses[rotation_error(poses[:, :3, :3], R).argmin()]
            error = torch.cat([axis_angle_from_rotation(near[:3, :3] @ R.T), near[:3, 3] - t])
            squares.append(squared_distance(error.tolist(), row["covariance"], float(t.norm())))
    inside = count_inside(np.array(squares), covariance["squared_radius"])
    return {**found, "covariance": {"n": len(squares), "inside": inside}}


def quality_by_subset(rows: Sequence[Row], sure: np.ndarray, right: np.ndarray, name: str) -> dict[str, Row]:
    """Quality of a model on all photographs, in clutter, and for wrong meshes."""
    correct = np.array([not row["wrong"] for row in rows])
    out = {name: quality(sure[correct], right[correct], [group_of(r) for r, c in zip(rows, correct, strict=True) if c])}
    if name.startswith("contours, exact"):
        crowd = correct & np.array([row["clutter"] >= 3 for row in rows])
        units = [group_of(r) for r, c in zip(rows, crowd, strict=True) if c]
        out[f"{name}, in clutter"] = quality(sure[crowd], right[crowd], units)
        for which in ("any", "kind"):
            wrong = np.array([row["wrong"] == which for row in rows])
            if wrong.any():
                units = [group_of(r) for r, w in zip(rows, wrong, strict=True) if w]
                out[f"{name}, {'wrong' if which == 'any' else 'similar'} mesh"] = quality(
                    sure[wrong], right[wrong], units
                )
    return out


def page(record: Row) -> str:
    """Tables of docs/accuracy.md."""
    head = ["photographs", "N (independent)", "right", "AUC", f"coverage at {RISK:.0%} risk"]
    head += [f"wrong of the surest {c:.0%}" for c in COVERAGES[1:]] + ["reliable", "right of them"]
    lines = [head]
    for name, found in {**record["held_out"], **record.get("real", {})}.items():
        wrong = (found["risk_at_coverage"][f"{c:g}"] for c in COVERAGES[1:])
        lines.append(
            [
                name,
                f"{found['n']} ({found['units']})",
                str(found["right"]),
                format_interval(found["auc"], found["auc_interval"]),
                format_interval(found["coverage_at_risk"], found["coverage_interval"]),
                *(f"{k} of {n}" for k, n in wrong),
                str(found["reliable"]),
                str(found["reliable_and_right"]),
            ]
        )
    ellipsoid = [["reliable answers with a covariance", "N", *(f"in the {level:.0%} ellipsoid" for level in LEVELS)]]
    sets = {"benchmark, held out": record["covariance_held_out"]}
    sets |= {name: found["covariance"] for name, found in record.get("real", {}).items() if found["covariance"]["n"]}
    ellipsoid += [
        [name, str(found["n"]), *(f"{k} ({k / found['n']:.2f})" for k in found["inside"].values())]
        for name, found in sets.items()
    ]
    measures = list(next(iter(record["shares"].values())))[1:]
    right = [["benchmark", "N", *measures]]
    right += [
        [name, str(found["n"]), *(format_interval(found[m][0], found[m][1:]) for m in measures)]
        for name, found in record["shares"].items()
    ]
    where = (
        f"`python scripts/calibration/calibrate.py`, {record['date']}; registered by commit {record['registered']}, "
    )
    where += f"fitted by {record['commit']}."
    answers = [["answer sets", "N", "hold the truth", "mean number of answers", 'hold "none of them"']]
    answers += [
        [name, str(found["n"]), *(f"{found[m]:.2f}" for m in ("coverage", "mean_size", "none"))]
        for name, found in {**record["answer_sets"], **record.get("real_answer_sets", {})}.items()
    ]
    tables = (table_lines(rows) for rows in (right, lines, answers, ellipsoid))
    return "\n".join([*(line for table in tables for line in [*table, ""]), where, ""])
