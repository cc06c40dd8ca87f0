"""Fits of confidences to measured rows, and how well they tell what is right."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logsumexp
from sklearn.metrics import roc_auc_score

from curvireg_torch.registration.confidence import (
    DOUBT_FEATURES,
    EVIDENCE_FEATURES,
    RELIABLE,
    LogisticModel,
)
from curvireg_torch.registration.doubts import MIRROR_DOUBT
from curvireg_torch.utils.arrays import Array
from scripts._shared import RIGHT_DEG, Record
from scripts.calibration.sets import SETS

FOLDS = 5
RESOLUTIONS = np.arange(0.5, 1.55, 0.1).round(2).tolist()
"""Those that are tried. Scores of two poses that look the same differ by up to 0.5."""


def folds_of(rows: Sequence[Record]) -> Array:
    """(n,) fold of each row; groups are assigned so that folds have about equal sizes."""
    groups, member, counts = np.unique(
        [row["group"] for row in rows], return_inverse=True, return_counts=True
    )
    fold = np.zeros(len(groups), int)
    size = np.zeros(FOLDS)
    for k in np.argsort(-counts, kind="stable"):
        fold[k] = size.argmin()
        size[fold[k]] += counts[k]
    return fold[member]


def fit_logistic(rows: Sequence[Record], weight: Array, signs: Mapping[str, float]) -> Record:
    """Weights and bias of the probability that a row is ``right``.

    The standardised weights have a unit Gaussian prior, and the sign in ``signs``, if there is one.
    """
    names = list(rows[0]["features"])
    X = np.array([[row["features"][name] or 0.0 for name in names] for row in rows])
    y = np.array([row["right"] for row in rows])
    mean = X.mean(axis=0)
    spread = X.std(axis=0)
    spread[spread < 1e-6] = np.inf  # a constant feature gets weight 0
    Z = (X - mean) / spread

    def loss(p: Array) -> tuple[float, Array]:
        w = p[:-1]
        logit = Z @ w + p[-1]
        losses = np.logaddexp(0.0, logit) - y * logit
        value = weight @ losses + 0.5 * (w @ w)
        slope = weight * (expit(logit) - y)
        return value, np.append(Z.T @ slope + w, slope.sum())

    ranges = {1.0: (0.0, None), -1.0: (None, 0.0)}
    free = (None, None)
    bounds = [ranges.get(signs.get(name), free) for name in names]
    start = np.zeros(len(names) + 1)
    found = minimize(loss, start, jac=True, bounds=[*bounds, free], method="L-BFGS-B").x
    w = found[:-1] / spread
    bias = float(found[-1] - w @ mean)
    weights = dict(zip(names, w.round(4).tolist(), strict=True))
    return {"weights": weights, "bias": round(bias, 4), "n": len(y)}


def fit_level(rows: Sequence[Record], weight: Array, constants: Record) -> Record:
    """The model of ``constants`` with a scale and a level of its logit, so that the confidence of
    the first hypothesis, its share included, is right: two numbers, which few photographs
    determine. Slope and resolution of the shares stay."""
    logit = np.array([row_logit(row, constants) for row in rows])
    share = np.array([first_share(row, constants) for row in rows])
    first = np.array([row["first"] for row in rows])

    def loss(p: Array) -> float:
        scale, level = p
        confidence = np.clip(expit(scale * logit + level) * share, 1e-9, 1.0 - 1e-9)
        said = np.where(first, confidence, 1.0 - confidence)
        return -weight @ np.log(said)

    scale, level = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    weights = {name: round(float(scale) * value, 4) for name, value in constants["weights"].items()}
    bias = round(float(scale * constants["bias"] + level), 4)
    return constants | {"weights": weights, "bias": bias, "n": len(rows)}


def row_logit(row: Record, constants: Record) -> float:
    """Logit of the probability that any hypothesis of a row is right."""
    features = row["features"]
    terms = [weight * (features[name] or 0.0) for name, weight in constants["weights"].items()]
    return constants["bias"] + sum(terms)


def fit_shares(rows: Sequence[Record], weight: Array, *, ties: bool) -> Record:
    """Slope and resolution of :func:`curvireg_torch.registration.confidence.shares`, where some
    pose is right and some are not; without ``ties`` the resolution is 0."""
    decided = [k for k, row in enumerate(rows) if row["right"] and max(row["errors"]) >= RIGHT_DEG]

    def filled(name: str, value: float) -> Array:
        columns = zip_longest(*(rows[k][name] for k in decided), fillvalue=value)
        return np.array([*columns], ndmin=2).T.copy()

    scores = filled("scores", -np.inf)
    behind = scores.max(axis=1, keepdims=True) - scores
    right = filled("errors", np.inf) < RIGHT_DEG

    def loss(slope: float, resolution: float) -> float:
        logits = -slope * np.maximum(0.0, behind - resolution)
        of_right = np.where(right, logits, -np.inf)
        losses = logsumexp(logits, axis=1) - logsumexp(of_right, axis=1)
        return weight[decided] @ losses + 0.05 * slope**2

    found = []
    for resolution in RESOLUTIONS if ties else (0.0,):
        best = minimize_scalar(loss, args=(resolution,), bounds=(0.01, 10.0), method="bounded")
        found.append((best.fun, round(float(best.x), 4), resolution))
    _, slope, resolution = min(found)
    return {"slope": slope, "resolution": resolution}


def first_probability(row: Record, constants: Record) -> float:
    """Confidence of a row."""
    any_right = LogisticModel(constants["weights"], constants["bias"])(row["features"])
    doubt = MIRROR_DOUBT if row.get("mirror") else 1.0
    return doubt * any_right * first_share(row, constants)


def first_share(row: Record, constants: Record) -> float:
    """Share of the first hypothesis in the probability that any is right."""
    scores = np.array(row["scores"])
    logits = -constants["slope"] * np.maximum(0.0, scores.max() - scores - constants["resolution"])
    return np.exp(logits[0] - logsumexp(logits))


def quality_of(p: Array, right: Array, weight: Array) -> Record:
    """How well probabilities (n,) tell the right answers (n,) bool."""
    sure = p >= RELIABLE

    def mean(values: Array, chosen: Any = slice(None)) -> float:
        return np.average(values[chosen], weights=weight[chosen])

    both = len(np.unique(right)) == 2
    return {
        "n": len(p),
        "right": mean(right),
        "said": mean(p),
        "reliable": mean(sure),
        "auc": roc_auc_score(right, p, sample_weight=weight) if both else None,
        "right if reliable": mean(right, sure) if sure.any() else None,
        "reliable and wrong": int((sure & ~right).sum()),
    }


def errors_within(errors: Array) -> Record:
    """Fractions of errors (n,) in degrees within 5 and 15, and their median."""
    within = {f"within {limit}": (errors < limit).mean() for limit in (5, 15)}
    return within | {"median": np.median(errors)}


def weights_of(sets: Array) -> Array:
    """(n,) weights of rows by their sets, with which these have their assumed shares of all
    photographs."""
    weight = np.ones(len(sets))
    assumed = {name: SETS[name].share for name in np.unique(sets) if SETS[name].share}
    ordinary = (~np.isin(sets, list(assumed))).sum()
    factor = ordinary / (1.0 - sum(assumed.values()))
    for name, share in assumed.items():
        weight[sets == name] = factor * share / (sets == name).sum()
    return weight


def fit_registrations(rows: list[Record], *, exact: bool) -> tuple[Record, Record]:
    """Constants of a model of registrations, and their quality on held-out folds, in all and by
    set."""
    for row in rows:
        is_present = not SETS[row["set"]].absent
        row["right"] = is_present and min(row["errors"]) < RIGHT_DEG
        row["first"] = is_present and row["errors"][0] < RIGHT_DEG
    sets = np.array([row["set"] for row in rows])
    weight = weights_of(sets)
    signs = dict.fromkeys(EVIDENCE_FEATURES, 1.0) | dict.fromkeys(DOUBT_FEATURES, -1.0)

    def fit(train: Array) -> Record:
        # what fits, but is less probable than the mirror image, tells nothing of what fits
        train = train & ~is_mirrored
        some = [rows[k] for k in np.flatnonzero(train)]
        fitted = fit_logistic(some, weight[train], signs)
        fitted |= fit_shares(some, weight[train], ties=exact)
        return fit_level(some, weight[train], fitted)

    is_mirrored = np.array([row.get("mirror", False) for row in rows])
    fold = folds_of(rows)
    p = np.zeros(len(rows))
    for k in range(FOLDS):
        constants = fit(fold != k)
        for held_out in np.flatnonzero(fold == k):
            p[held_out] = first_probability(rows[held_out], constants)
    first = np.array([row["first"] for row in rows])
    quality = quality_of(p, first, weight)
    by_set = {name: sets == name for name in dict.fromkeys(sets.tolist())}
    by_set["grey"] = np.array([row["grey"] for row in rows])
    by_set["with colours"] = ~by_set["grey"]
    errors = np.array([row["errors"][0] for row in rows])
    quality["sets"] = {}
    for name, own in by_set.items():
        if own.any():
            of_set = quality_of(p[own], first[own], weight[own])
            quality["sets"][name] = of_set | errors_within(errors[own])
    return fit(np.full(len(rows), True)), quality
