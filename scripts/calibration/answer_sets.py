"""Constants of answer sets: probabilities of the rivals, and the threshold of split-conformal calibration."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp

from curvireg_torch.registration.answer_set import LEVEL, AnswerSet, answer_set
from curvireg_torch.registration.rescoring import POSE_FEATURES, rescore
from scripts.calibration.quality import RIGHT, Row


def evidence_of(row: Row, *, with_appearance: bool) -> torch.Tensor:
    """(H, 4) ``POSE_FEATURES`` of the hypotheses, optionally without the appearance term."""
    evidence = torch.tensor([[one[name] for name in POSE_FEATURES] for one in row["evidence"]], dtype=torch.float64)
    if not with_appearance:
        evidence[:, POSE_FEATURES.index("appearance")] = 0.0
    return evidence


def unrefined(row: Row, *, with_appearance: bool) -> Row:
    """The result without search and contour fit."""
    found: Row = row["unrefined"]["appearance" if with_appearance else "no appearance"]
    return found


def answer_case(row: Row, name: str) -> tuple[torch.Tensor, np.ndarray]:
    """Scores of a row's hypotheses (H,), and which answers are right (H + 1,), the last being "none of them"."""
    with_appearance = not name.endswith("no appearance")
    row = row if name.startswith("contours") else unrefined(row, with_appearance=with_appearance)
    evidence = evidence_of(row, with_appearance=with_appearance)
    right = np.array(row["errors"]) < RIGHT
    return rescore(evidence, exact=name.startswith("contours, exact")), np.append(right, not right.any())


def fit_answers(cases: Sequence[tuple[torch.Tensor, np.ndarray]]) -> dict[str, float]:
    """Slope and level of "none of them" of :func:`answer_set`, where the first answer is wrong."""
    wrong = [(np.append(s[1:] - s[1:].max(), 0.0), right[1:]) for s, right in cases if not right[0] and len(s) > 1]

    def loss(p: np.ndarray) -> float:
        logits = [(np.exp(p[0]) * scores + p[1] * (np.arange(len(scores)) == len(scores) - 1)) for scores, _ in wrong]
        likelihood = (logsumexp(x) - logsumexp(x[right]) for x, (_, right) in zip(logits, wrong, strict=True))
        return 0.05 * float((p**2).sum()) + sum(map(float, likelihood))

    found = minimize(loss, np.zeros(2), method="L-BFGS-B").x
    return {"slope": round(float(np.exp(found[0])), 4), "none": round(float(found[1]), 4)}


def probability_before(answers: AnswerSet, right: np.ndarray) -> float:
    """Sum of the probabilities of the answers that enter the set before the first right one."""
    return next(before for answer, before in answers.candidates if right[answer])


def fit_answer_sets(rows: Sequence[Row], name: str, sure: np.ndarray, fold: np.ndarray) -> tuple[Row, Row]:
    """Constants of the answer set by split-conformal calibration, and their quality on held-out folds.

    Args:
        rows: photographs with their own mesh or a similar one.
        name: of the confidence model.
        sure, fold: (n,) held-out confidences of the rows and their folds.
    """
    cases = [answer_case(row, name) for row in rows]

    def answers(k: int, constants: dict[str, float]) -> AnswerSet:
        return answer_set(float(sure[k]), cases[k][0], constants)

    def fit(train: np.ndarray) -> dict[str, float]:
        constants = fit_answers([cases[k] for k in train])
        before = [probability_before(answers(k, constants | {"threshold": 1.0}), cases[k][1]) for k in train]
        quantile = min(1.0, math.ceil((len(train) + 1) * LEVEL) / len(train))
        threshold = math.nextafter(float(np.quantile(before, quantile, method="higher")), math.inf)
        return constants | {"threshold": math.ceil(threshold * 1e4) / 1e4}

    held_out: list[tuple[bool, int, bool]] = []
    for k in np.unique(fold):
        constants = fit(np.flatnonzero(fold != k))
        for i in np.flatnonzero(fold == k):
            chosen, right = answers(i, constants), cases[i][1]
            covered = bool(right[list(chosen.members)].any()) or bool(chosen.holds_none and right[-1])
            held_out.append((covered, len(chosen.members) + chosen.holds_none, chosen.holds_none))
    covered, size, none = (float(np.mean(values)) for values in zip(*held_out, strict=True))
    quality = {"n": len(rows), "coverage": covered, "mean_size": size, "none": none}
    return fit(np.arange(len(rows))), quality
