"""From registered photographs to the constants of confidence and covariance, and what these are worth.

    python scripts/calibration/calibrate.py BENCHMARK --rows ROWS [--jobs 2] [--real DATA RUNS]

BENCHMARK is the folder of scripts/benchmark/make.py --count 2000. What is not in ROWS yet is registered first, as
scripts/benchmark/run.py does (stop and go on at will): every photograph to its own mesh or, of siblings, to that of
another object of the kind; and some to wrong meshes. Then the script writes

- curvireg_torch/registration/calibration.json, the constants,
- scripts/results/calibration.json, the same with what they are worth on objects that had no part in them,
- the tables of docs/accuracy.md.

Folds are of objects and kinds: an object, its copies and all others of its kind are in one fold. --real adds the real
sets in DATA, of which ``curvireg evaluate --out RUNS/NAME`` has written the predictions; nothing is fitted on them.
"""

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import chi2
from sklearn.linear_model import LogisticRegression

from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_error, symmetry_transforms, transform
from curvireg_torch.registration.confidence import (
    CONFIDENCE_FEATURES,
    RANKING_FEATURES,
    RELIABLE,
    LogisticModel,
    confidence_features,
)
from curvireg_torch.registration.rescoring import POSE_FEATURES, WEIGHTS, rescore
from scripts._shared import (
    REAL_SETS,
    REPOSITORY,
    benchmark,
    commit,
    independent_units,
    interval,
    interval_of,
    replace_between,
    table_lines,
    today,
    write_json,
)
from scripts.benchmark.run import register_benchmark

CONSTANTS = REPOSITORY / "curvireg_torch" / "registration" / "calibration.json"
RECORD = REPOSITORY / "scripts" / "results" / "calibration.json"
PAGE = REPOSITORY / "docs" / "accuracy.md"
BEGIN, END = "<!-- calibration:begin -->", "<!-- calibration:end -->"

PARTS: dict[str, tuple[str | None, int | None]] = {"right": (None, None), "any": ("any", 60), "kind": ("kind", 60)}
"""What is registered: --wrong and --limit of scripts/benchmark/run.py."""

FOLDS = 5
RIGHT = 30.0
"""Degrees of an answer that is right."""

WRONG_SHARE = 0.1
"""Of the weight that confidence is fitted with: as if one user in ten took a wrong mesh."""

RISK = 0.05
LEVELS = (0.5, 0.9, 0.95)
UNKNOWN = 0.5
"""Standard deviation of a direction that counts as unknown, in units of pi (turns) and of the distance (shifts)."""

COVERAGES = (1.0, 0.75, 0.5, 0.25)

Row = dict[str, Any]


def features_of(row: Row, *, with_appearance: bool = True) -> tuple[dict[str, float | None], float]:
    """Features of the best hypothesis of a row, and its error in degrees; also as if the pipeline had no appearance."""
    evidence = torch.tensor([[one[name] for name in POSE_FEATURES] for one in row["evidence"]], dtype=torch.float64)
    if not with_appearance:
        evidence[:, POSE_FEATURES.index("appearance")] = 0.0
    concentration = row["ranking"][RANKING_FEATURES.index("concentration")]
    features = confidence_features(evidence, rescore(evidence, with_camera=row["form"] == "exact"), concentration)
    return features, row["errors"][0]


def ranking_case(row: Row, *, with_appearance: bool = True) -> tuple[dict[str, float | None], float]:
    """Features of a row's ranking, and the error of its best view."""
    known = row["ranking"] if with_appearance else row["fast"]["ranking"]
    error = row["view_errors"][0] if with_appearance else row["fast"]["error"]
    return dict(zip(RANKING_FEATURES, known, strict=True)), error


Case = Callable[..., tuple[dict[str, float | None], float]]
MODELS: dict[str, tuple[Case, bool, str | None, tuple[str, ...]]] = {
    f"{stage}, {appearance}": (case, appearance == "appearance", form, names)
    for stage, case, form, names in (
        ("contours, camera", features_of, "exact", CONFIDENCE_FEATURES),
        ("contours, no camera", features_of, "sibling", CONFIDENCE_FEATURES),
        ("ranking", ranking_case, None, RANKING_FEATURES),
    )
    for appearance in ("appearance", "no appearance")
}
"""Of each model of confidence: what it is fitted on, with the appearance term or without, which form of photographs
(None: all), and its features."""


def group_of(row: Row) -> str:
    """What must be in one fold: objects of one kind, and the copies of an object without a kind."""
    return row["kind"] or row["like"]


def folds_of(rows: Sequence[Row]) -> np.ndarray:
    """(n,) fold of each row; groups are dealt out so that folds are of about one size."""
    groups, counts = np.unique([group_of(row) for row in rows], return_counts=True)
    size, fold = [0] * FOLDS, {}
    for k in np.argsort(-counts, kind="stable"):
        fold[groups[k]] = int(np.argmin(size))
        size[fold[groups[k]]] += int(counts[k])
    return np.array([fold[group_of(row)] for row in rows])


def is_right(row: Row, error: float) -> bool:
    """Any other mesh is wrong whatever its pose; one of the object's kind where its pose is."""
    return error < RIGHT and row["wrong"] != "any"


def fitted(X: np.ndarray, y: np.ndarray, weight: np.ndarray, names: Sequence[str]) -> LogisticModel:
    """Logistic regression of features (n, F), drawn towards 0 by as much as one unit of each standardised weight."""
    mean, spread = X.mean(axis=0), X.std(axis=0)
    spread[spread < 1e-6] = np.inf  # a feature that is always the same says nothing
    model = LogisticRegression(max_iter=2000).fit((X - mean) / spread, y, sample_weight=weight)
    w = model.coef_[0] / spread
    weights = {name: round(float(value), 4) for name, value in zip(names, w, strict=True)}
    return LogisticModel(weights, round(float(model.intercept_[0] - w @ mean), 4))


def transferred(own: LogisticModel, X: np.ndarray, y: np.ndarray) -> LogisticModel:
    """A model of the object's own mesh, for another object's: how much its logit is worth there, and a bias.

    Among siblings hardly anything tells right from wrong, and weights of their own would be those of chance.
    """
    logit = X @ np.array(list(own.weights.values()))
    slope = fitted(logit[:, None], y, np.ones(len(y)), ["logit"])
    factor = max(0.0, slope.weights["logit"])
    return LogisticModel({name: round(factor * w, 4) for name, w in own.weights.items()}, slope.bias)


def fit_confidence(rows: Sequence[Row], name: str) -> tuple[LogisticModel, list[Row], np.ndarray, np.ndarray]:
    """The model, its rows, what they get from models that other folds made, and whether they are right."""
    case, with_appearance, form, names = MODELS[name]
    teaching = "exact" if form == "sibling" else form
    rows = [row for row in rows if form is None or row["form"] in (form, teaching)]
    cases = [case(row, with_appearance=with_appearance) for row in rows]
    X = np.array([[features[n] or 0.0 for n in names] for features, _ in cases])
    y = np.array([is_right(row, error) for row, (_, error) in zip(rows, cases, strict=True)])
    wrong, fold = np.array([bool(row["wrong"]) for row in rows]), folds_of(rows)
    teaches, asked = (np.array([want in (None, row["form"]) for row in rows]) for want in (teaching, form))
    weight = np.ones(len(rows))
    if wrong.any():
        weight[wrong] = WRONG_SHARE / (1.0 - WRONG_SHARE) * (~wrong & teaches).sum() / wrong.sum()

    def fit(train: np.ndarray) -> LogisticModel:
        some = train & teaches
        own = fitted(X[some], y[some], weight[some], names)
        return own if form == teaching else transferred(own, X[train & asked], y[train & asked])

    sure = np.zeros(len(rows))
    for k in range(FOLDS):
        model = fit(fold != k)
        for i in np.flatnonzero(fold == k):
            sure[i] = model(cases[i][0])
    used = [row for row, a in zip(rows, asked, strict=True) if a]
    return fit(np.full(len(rows), True)), used, sure[asked], y[asked]


def auc(sure: np.ndarray, right: np.ndarray) -> float | None:
    """Share of pairs in which the right answer is the surer one, ties counting half; None without pairs."""
    above = sure[right][:, None] - sure[~right][None]
    return float((above > 0).mean() + 0.5 * (above == 0).mean()) if above.size else None


def risks(sure: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(n,) share that is wrong among the k + 1 surest."""
    order = np.argsort(-sure, kind="stable")
    return np.cumsum(~right[order]) / np.arange(1, len(right) + 1)


def coverage_at_risk(sure: np.ndarray, right: np.ndarray) -> float:
    """Largest share of answers, the surest first, of which no more than ``RISK`` are wrong."""
    good = np.flatnonzero(risks(sure, right) <= RISK)
    return float(good.max() + 1) / len(right) if len(good) else 0.0


def worth(sure: np.ndarray, right: np.ndarray, units: Sequence[Any]) -> Row:
    """What confidences are worth, with counts and intervals over units."""
    risk, believed = risks(sure, right), sure >= RELIABLE
    return {
        "n": len(sure),
        "units": len({str(unit) for unit in units}),
        "right": int(right.sum()),
        "mean": float(sure.mean()),
        "auc": auc(sure, right),
        "auc_interval": interval_of(units, lambda i: auc(sure[i], right[i])),
        "coverage_at_risk": coverage_at_risk(sure, right),
        "coverage_interval": interval_of(units, lambda i: coverage_at_risk(sure[i], right[i])),
        "risk_at_coverage": {
            f"{c:g}": [round(float(risk[k - 1]) * k), k] for c in COVERAGES if (k := max(1, round(c * len(sure))))
        },
        "reliable": int(believed.sum()),
        "reliable_and_right": int(right[believed].sum()),
    }


def squared_distance(error: Sequence[float], covariance: Sequence[Sequence[float]], distance: float) -> float:
    """e^T C^-1 e along the directions that are known; the others have a deviation of pi or of the distance."""
    wide = np.array([math.pi] * 3 + [distance] * 3)
    value, axes = np.linalg.eigh(np.array(covariance) / wide[:, None] / wide)
    known = value < UNKNOWN**2
    return float((((axes.T @ (np.array(error) / wide)) ** 2 / value)[known]).sum())


def radii(squares: np.ndarray) -> dict[str, float]:
    """Squared radii of the ellipsoids that hold LEVELS of these squared distances (the conformal quantiles)."""
    rank = [min(len(squares) - 1, math.ceil(level * (len(squares) + 1)) - 1) for level in LEVELS]
    return {f"{level:g}": round(float(np.sort(squares)[k]), 4) for level, k in zip(LEVELS, rank, strict=True)}


def held(squares: np.ndarray, radius: dict[str, float]) -> dict[str, int]:
    """How many squared distances lie within each ellipsoid."""
    return {level: int((squares <= r).sum()) for level, r in radius.items()}


def fit_covariance(rows: Sequence[Row], sure: np.ndarray) -> tuple[Row, Row]:
    """Constants of the covariance from the believed answers, wrong ones among them, and their worth by folds."""
    believed = [row for row, p in zip(rows, sure, strict=True) if p >= RELIABLE and row.get("covariance")]
    # Of the covariance before it was scaled.
    raw = np.array([r["scale"] * squared_distance(r["pose_error"], r["covariance"], r["distance"]) for r in believed])

    def fit(index: np.ndarray) -> Row:
        """The ellipsoid of 95 % has a Gaussian's radius."""
        scale = round(radii(raw[index])["0.95"] / float(chi2.ppf(0.95, 6)), 3)
        return {"scale": scale, "squared_radius": radii(raw[index] / scale)}

    fold, inside = folds_of(believed), dict.fromkeys((f"{level:g}" for level in LEVELS), 0)
    for k in range(FOLDS):
        constants = fit(np.flatnonzero(fold != k))
        for level, count in held(raw[fold == k] / constants["scale"], constants["squared_radius"]).items():
            inside[level] += count
    return fit(np.arange(len(believed))), {"n": len(believed), "inside": inside}


def fit_verdict(rows: Sequence[Row]) -> list[float]:
    """Weights of the verdict by which right hypotheses have most of a softmax, drawn towards those in use."""
    cases = [
        (np.array([[one[name] for name in POSE_FEATURES] for one in row["evidence"]]), np.array(row["errors"]) < RIGHT)
        for row in rows
        if row["form"] == "exact" and not row["wrong"]
    ]
    cases = [(X, right) for X, right in cases if right.any() and not right.all()]
    prior = np.array(WEIGHTS)

    def loss(w: np.ndarray) -> float:
        return 2.0 * float((((w - prior) / prior) ** 2).sum()) + sum(
            float(logsumexp(X @ w) - logsumexp((X @ w)[right])) for X, right in cases
        )

    found = minimize(loss, prior, method="L-BFGS-B", bounds=[(0.0, None)] * len(prior))
    return [round(float(w), 2) for w in found.x]


def shares(rows: Sequence[Row]) -> dict[str, Row]:
    """How many answers are right, by form and pose, with intervals over groups."""
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


def real_set(data: Path, runs: Path, name: str, covariance: Row) -> Row:
    """What predictions for a real set say of themselves, and what is true."""
    judge, store = benchmark(data, name), PredictionStore(runs / name / "predictions")
    items = judge.selection(None)
    rows = [store.read(item.key) for item in items]
    right = (judge.rotation_errors(items, rows) < RIGHT).numpy()
    sure = np.array([row.get("confidence", 0.0) for row in rows])
    found = worth(sure, right, independent_units(judge))
    squares = []
    for item, row in zip(items, rows, strict=True):
        if row.get("covariance") is not None:
            sample = judge.dataset.annotation(item.index)
            poses = transform(sample["rotation"].double(), sample["translation"].double())
            poses = poses @ symmetry_transforms(sample["model_info"]).double()
            R, t = (torch.tensor(row[k], dtype=torch.float64) for k in ("rotation", "translation"))
            near = poses[rotation_error(poses[:, :3, :3], R).argmin()]
            error = torch.cat([axis_angle_from_rotation(near[:3, :3] @ R.T), near[:3, 3] - t])
            squares.append(squared_distance(error.tolist(), row["covariance"], float(t.norm())))
    inside = held(np.array(squares), covariance["squared_radius"])
    return {**found, "covariance": {"n": len(squares), "inside": inside}}


def shown(value: float | None, bounds: Sequence[float] | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" + ("" if bounds is None else f" ({bounds[0]:.2f} to {bounds[1]:.2f})")


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
                shown(found["auc"], found["auc_interval"]),
                shown(found["coverage_at_risk"], found["coverage_interval"]),
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
        [name, str(found["n"]), *(shown(found[m][0], found[m][1:]) for m in measures)]
        for name, found in record["shares"].items()
    ]
    where = f"`python scripts/calibration/calibrate.py`, {record['date']}, commit {record['commit']}."
    tables = (table_lines(rows) for rows in (right, lines, ellipsoid))
    return "\n".join([*(line for table in tables for line in [*table, ""]), where, ""])


def slices(rows: Sequence[Row], sure: np.ndarray, right: np.ndarray, name: str) -> dict[str, Row]:
    """What a model is worth, by pose and clutter, and against wrong meshes."""
    own = np.array([not row["wrong"] for row in rows])
    out = {name: worth(sure[own], right[own], [group_of(r) for r, o in zip(rows, own, strict=True) if o])}
    if name.startswith("contours, camera"):
        crowd = own & np.array([row["clutter"] >= 3 for row in rows])
        units = [group_of(r) for r, c in zip(rows, crowd, strict=True) if c]
        out[f"{name}, in clutter"] = worth(sure[crowd], right[crowd], units)
        for which in ("any", "kind"):
            wrong = np.array([row["wrong"] == which for row in rows])
            if wrong.any():
                units = [group_of(r) for r, w in zip(rows, wrong, strict=True) if w]
                out[f"{name}, {'wrong' if which == 'any' else 'similar'} mesh"] = worth(
                    sure[wrong], right[wrong], units
                )
    return out


def calibrate(rows: Sequence[Row]) -> tuple[Row, Row]:
    """Constants, and what they are worth on folds that had no part in them."""
    constants: Row = {"confidence": {}, "covariance": {}}
    held_out: dict[str, Row] = {}
    covariance_held_out: Row = {}
    for name in MODELS:
        model, used, sure, right = fit_confidence(rows, name)
        constants["confidence"][name] = {"weights": dict(model.weights), "bias": model.bias, "n": len(used)}
        held_out |= slices(used, sure, right, name)
        if name == "contours, camera, appearance":
            constants["covariance"], covariance_held_out = fit_covariance(used, sure)
    return constants, {"held_out": held_out, "covariance_held_out": covariance_held_out}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmark", type=Path)
    parser.add_argument("--rows", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--real", type=Path, nargs=2, metavar=("DATA", "RUNS"))
    arguments = parser.parse_args()
    rows: list[Row] = []
    for part, (wrong, limit) in PARTS.items():
        path = arguments.rows / f"{part}.jsonl"
        rows += register_benchmark(arguments.benchmark, path, wrong=wrong, limit=limit, jobs=arguments.jobs)
    rows = [row for row in rows if "errors" in row]
    constants, worthy = calibrate(rows)
    write_json(CONSTANTS, constants)
    record = {"date": today(), "commit": commit(), "n": len(rows), **constants, **worthy}
    record |= {"shares": shares(rows), "verdict": {"used": list(WEIGHTS), "fitted": fit_verdict(rows)}}
    if arguments.real:
        record["real"] = {name: real_set(*arguments.real, name, constants["covariance"]) for name in REAL_SETS}
    write_json(RECORD, record)
    PAGE.write_text(replace_between(PAGE.read_text(encoding="utf-8"), BEGIN, END, page(record)), encoding="utf-8")
    print(page(record))


if __name__ == "__main__":
    main()
