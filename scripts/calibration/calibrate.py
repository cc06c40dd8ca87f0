"""Fit the constants of confidence and covariance on registered photographs, and measure their quality.

    python scripts/calibration/calibrate.py BENCHMARK --rows ROWS [--jobs 2 | --registered] [--real DATA RUNS]

BENCHMARK is the folder of scripts/benchmark/make.py --count 2000. Photographs that are not in ROWS yet are registered
first, as by scripts/benchmark/run.py (an interrupted run can be resumed): each to its object's mesh or, for siblings,
to that of another object of the kind, and some to wrong meshes; --registered does with the rows that there are. Then
the script writes

- curvireg_torch/registration/calibration.json, the constants,
- scripts/results/calibration.json, the constants with their quality on held-out objects,
- the tables of docs/accuracy.md.

Folds are by object and kind: an object, its copies and all others of its kind are in one fold. --real adds the real
sets in DATA, with the predictions that ``curvireg evaluate --out RUNS/NAME`` wrote; nothing is fitted on them.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import chi2
from sklearn.linear_model import LogisticRegression

from curvireg_torch.registration.confidence import (
    CONFIDENCE_FEATURES,
    RANKING_FEATURES,
    RELIABLE,
    LogisticModel,
    confidence_features,
    model_name,
)
from curvireg_torch.registration.rescoring import POSE_FEATURES, WEIGHTS, rescore
from scripts._shared import REPOSITORY, commit, today, update_page, write_json
from scripts.benchmark.run import register_benchmark
from scripts.calibration.answer_sets import evidence_of, fit_answer_sets, unrefined
from scripts.calibration.quality import (
    LEVELS,
    REAL_SETS,
    RIGHT,
    Row,
    count_inside,
    exactness,
    group_of,
    page,
    quality_by_subset,
    radii,
    real_set,
    squared_distance,
    success_rates,
)

CONSTANTS = REPOSITORY / "curvireg_torch" / "registration" / "calibration.json"
RECORD = REPOSITORY / "scripts" / "results" / "calibration.json"
PAGE = REPOSITORY / "docs" / "accuracy.md"

PARTS: dict[str, tuple[str | None, int | None]] = {"right": (None, None), "any": ("any", 60), "kind": ("kind", 60)}
"""Sets of photographs, with the options --wrong and --limit of scripts/benchmark/run.py."""

FOLDS = 5
WRONG_FRACTION = 0.1
"""Weight of the wrong meshes in the fit of confidence, as if one photograph in ten came with a wrong mesh."""


def features_of(row: Row, *, with_appearance: bool = True) -> tuple[dict[str, float | None], float]:
    """Features of the best hypothesis of a row, optionally without the appearance term, and its error in degrees."""
    evidence = evidence_of(row, with_appearance=with_appearance)
    concentration = row["ranking"][RANKING_FEATURES.index("concentration")]
    features = confidence_features(evidence, rescore(evidence, exact=row["form"] == "exact"), concentration)
    return features, row["errors"][0]


def ranking_case(row: Row, *, with_appearance: bool = True) -> tuple[dict[str, float | None], float]:
    """Features of a row's ranking, and the error of its best view in degrees."""
    found = unrefined(row, with_appearance=with_appearance)
    return dict(zip(RANKING_FEATURES, found["ranking"], strict=True)), found["errors"][0]


Case = Callable[..., tuple[dict[str, float | None], float]]
FORMS = {"exact": "exact", "similar": "sibling"}
"""Kinds of meshes, and the form of the benchmark's photographs that are registered to them."""

MODELS: dict[str, tuple[Case, bool, str, tuple[str, ...]]] = {
    model_name(stage, exact=kind == "exact", with_appearance=with_appearance): (case, with_appearance, form, names)
    for stage, case, names in (
        ("contours", features_of, CONFIDENCE_FEATURES),
        ("ranking", ranking_case, RANKING_FEATURES),
    )
    for kind, form in FORMS.items()
    for with_appearance in (True, False)
}
"""Of each confidence model: the function that gives its cases, whether the appearance term is used, the form of the
photographs, and its features."""


def folds_of(rows: Sequence[Row]) -> np.ndarray:
    """(n,) fold of each row; groups are assigned so that folds have about equal sizes."""
    groups, counts = np.unique([group_of(row) for row in rows], return_counts=True)
    size, fold = [0] * FOLDS, {}
    for k in np.argsort(-counts, kind="stable"):
        fold[groups[k]] = int(np.argmin(size))
        size[fold[groups[k]]] += int(counts[k])
    return np.array([fold[group_of(row)] for row in rows])


def is_right(row: Row, error: float) -> bool:
    """Registration to an arbitrary wrong mesh is always wrong; to one of the object's kind only if the pose is."""
    return error < RIGHT and row["wrong"] != "any"


def fit_logistic(X: np.ndarray, y: np.ndarray, weight: np.ndarray, names: Sequence[str]) -> LogisticModel:
    """Logistic regression of features (n, F) with a unit Gaussian prior on the standardised weights."""
    mean, spread = X.mean(axis=0), X.std(axis=0)
    spread[spread < 1e-6] = np.inf  # a constant feature gets weight 0
    model = LogisticRegression(max_iter=2000).fit((X - mean) / spread, y, sample_weight=weight)
    w = model.coef_[0] / spread
    weights = {name: round(float(value), 4) for name, value in zip(names, w, strict=True)}
    return LogisticModel(weights, round(float(model.intercept_[0] - w @ mean), 4))


def fit_transfer(exact: LogisticModel, X: np.ndarray, y: np.ndarray) -> LogisticModel:
    """Adapt a model of exact meshes to similar meshes, by a factor on its weights and a new bias.

    Siblings carry too little information to fit weights on them alone.
    """
    logit = X @ np.array(list(exact.weights.values()))
    slope = fit_logistic(logit[:, None], y, np.ones(len(y)), ["logit"])
    factor = max(0.0, slope.weights["logit"])
    return LogisticModel({name: round(factor * w, 4) for name, w in exact.weights.items()}, slope.bias)


def fit_confidence(rows: Sequence[Row], name: str) -> tuple[LogisticModel, list[Row], np.ndarray, np.ndarray]:
    """The model, its rows, their confidences by models of the other folds, and whether they are right."""
    case, with_appearance, form, names = MODELS[name]
    rows = [row for row in rows if row["form"] in (form, "exact")]
    cases = [case(row, with_appearance=with_appearance) for row in rows]
    X = np.array([[features[n] or 0.0 for n in names] for features, _ in cases])
    y = np.array([is_right(row, error) for row, (_, error) in zip(rows, cases, strict=True)])
    wrong, fold = np.array([bool(row["wrong"]) for row in rows]), folds_of(rows)
    trains, evaluated = (np.array([row["form"] == f for row in rows]) for f in ("exact", form))
    weight = np.ones(len(rows))
    if wrong.any():
        weight[wrong] = WRONG_FRACTION / (1.0 - WRONG_FRACTION) * (~wrong & trains).sum() / wrong.sum()

    def fit(train: np.ndarray) -> LogisticModel:
        used = train & trains
        model = fit_logistic(X[used], y[used], weight[used], names)
        if form == "exact":
            return model
        return fit_transfer(model, X[train & evaluated], y[train & evaluated])

    confidence = np.zeros(len(rows))
    for k in range(FOLDS):
        model = fit(fold != k)
        for i in np.flatnonzero(fold == k):
            confidence[i] = model(cases[i][0])
    chosen = [row for row, e in zip(rows, evaluated, strict=True) if e]
    return fit(np.full(len(rows), True)), chosen, confidence[evaluated], y[evaluated]


def fit_covariance(rows: Sequence[Row], sure: np.ndarray) -> tuple[Row, Row]:
    """Constants of the covariance from the reliable results, right or wrong, and their cross-validated quality."""
    reliable = [row for row, p in zip(rows, sure, strict=True) if p >= RELIABLE and row.get("covariance")]
    # Multiplied by the scale in use, these are distances under the unscaled covariance.
    raw = np.array([r["scale"] * squared_distance(r["pose_error"], r["covariance"], r["distance"]) for r in reliable])

    def fit(index: np.ndarray) -> Row:
        """The scale is such that the 90 % ellipsoid has a Gaussian's radius: few wrong answers are among them."""
        scale = round(radii(raw[index])["0.9"] / float(chi2.ppf(0.9, 6)), 3)
        return {"scale": scale, "squared_radius": radii(raw[index] / scale)}

    fold, inside = folds_of(reliable), dict.fromkeys((f"{level:g}" for level in LEVELS), 0)
    for k in range(FOLDS):
        constants = fit(np.flatnonzero(fold != k))
        for level, count in count_inside(raw[fold == k] / constants["scale"], constants["squared_radius"]).items():
            inside[level] += count
    return fit(np.arange(len(reliable))), {"n": len(reliable), "inside": inside}


def fit_rescoring(rows: Sequence[Row]) -> list[float]:
    """Rescoring weights that maximise the softmax of right hypotheses, with a prior around the weights in use."""
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


def calibrate(rows: Sequence[Row]) -> tuple[Row, Row]:
    """Constants, and their quality on held-out folds."""
    constants: Row = {"confidence": {}, "answer_set": {}, "covariance": {}}
    held_out: dict[str, Row] = {}
    answer_sets: dict[str, Row] = {}
    covariance_held_out: Row = {}
    for name in MODELS:
        model, used, sure, right = fit_confidence(rows, name)
        constants["confidence"][name] = {"weights": dict(model.weights), "bias": model.bias, "n": len(used)}
        held_out |= quality_by_subset(used, sure, right, name)
        own = np.flatnonzero([not row["wrong"] for row in used])
        own_rows, fold = [used[k] for k in own], folds_of(used)[own]
        constants["answer_set"][name], answer_sets[name] = fit_answer_sets(own_rows, name, sure[own], fold)
        if name == "contours, exact, appearance":
            constants["covariance"], covariance_held_out = fit_covariance(used, sure)
    quality = {"held_out": held_out, "answer_sets": answer_sets, "covariance_held_out": covariance_held_out}
    return constants, quality


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("benchmark", type=Path)
    parser.add_argument("--rows", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--registered", action="store_true", help="register no further photographs")
    parser.add_argument("--real", type=Path, nargs=2, metavar=("DATA", "RUNS"))
    arguments = parser.parse_args()
    rows: list[Row] = []
    for part, (wrong, limit) in PARTS.items():
        path = arguments.rows / f"{part}.jsonl"
        if arguments.registered:
            rows += map(json.loads, path.read_text(encoding="utf-8").splitlines())
            continue
        rows += register_benchmark(arguments.benchmark, path, wrong=wrong, limit=limit, jobs=arguments.jobs)
    rows = [row for row in rows if "errors" in row]
    constants, held_out = calibrate(rows)
    registered = ", ".join(sorted({row["commit"] for row in rows}))
    record = {"date": today(), "commit": commit(), "registered": registered, "n": len(rows), **constants, **held_out}
    write_json(CONSTANTS, constants)
    record |= {"shares": success_rates(rows), "exactness": exactness(rows)}
    record |= {"verdict": {"used": list(WEIGHTS), "fitted": fit_rescoring(rows)}}
    if arguments.real:
        record["real"] = {name: real_set(*arguments.real, name, constants["covariance"]) for name in REAL_SETS}
        summaries = {name: (arguments.real[1] / name / "summary.json").read_text() for name in REAL_SETS}
        record["real_answer_sets"] = {name: json.loads(text)["answer_set"] for name, text in summaries.items()}
    write_json(RECORD, record)
    update_page(PAGE, "calibration", page(record))
    print(page(record))


if __name__ == "__main__":
    main()
