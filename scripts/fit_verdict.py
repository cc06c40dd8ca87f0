"""Fits the constants of registration/verify.py and registration/confidence.py on rows of scripts/run_benchmark.py.

    python scripts/fit_verdict.py ROWS.jsonl ... [--out scripts/results/verdict.json]

Verdict: a softmax over the hypotheses of a photograph, linear in their evidence, that gives the right ones (within 30
degrees) most of the weight. Confidence: a logistic regression on what is known of the winner and its rival. Both are
fitted on all rows; what they are worth is measured on meshes left out in turn (five parts). Rows against a wrong mesh
(--wrong) teach the confidence alone, and together weigh a tenth: any other mesh is wrong whatever its pose, one of the
kind where its pose is.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from _record import between, table_lines
from check_verdict import RIGHT, auc, evidence_of, wrong_at
from scipy.optimize import minimize
from sklearn.linear_model import LogisticRegression

from curvireg_torch.registration.confidence import POSE_EVIDENCE, RELIABLE
from curvireg_torch.registration.verify import EVIDENCE, RANK_ALONE, WEIGHTS

PAGE = Path(__file__).parents[1] / "docs" / "accuracy.md"
BEGIN, END = "<!-- verdict:begin -->", "<!-- verdict:end -->"
PARTS = 5
WRONG = {"any": "another mesh", "kind": "another mesh of the object's kind"}
WRONG_SHARE = 0.1
"""Of the weight that the confidence is fitted with."""
PRIOR = WEIGHTS
"""The fit is drawn towards what is in use, by as much as a few photographs weigh."""


def table(row: dict[str, Any]) -> np.ndarray:
    """(H, 4) evidence of the hypotheses."""
    return np.array([[e[name] for name in EVIDENCE] for e in row["evidence"]])


def right(row: dict[str, Any]) -> np.ndarray:
    return (np.array(row["errors"]) < RIGHT) & (row.get("wrong") != "any")


def fit_verdict(rows: list[dict[str, Any]]) -> np.ndarray:
    prior = np.array(PRIOR)
    cases = [(table(r), right(r)) for r in rows if right(r).any() and not right(r).all()]

    def loss(w: np.ndarray) -> float:
        total = 2.0 * float((((w - prior) / prior) ** 2).sum())
        for X, good in cases:
            s = X @ w
            p = np.exp(s - s.max())
            total -= float(np.log(p[good].sum() / p.sum()))
        return total

    return minimize(loss, prior, method="L-BFGS-B", bounds=[(0.0, None)] * len(prior)).x


def in_use(row: dict[str, Any]) -> np.ndarray:
    """(H,) scores of the hypotheses by the constants in use; only "exact" photographs came with a camera."""
    return table(row) @ np.array(WEIGHTS if row["form"] == "exact" else RANK_ALONE)


def without(rows: list[dict[str, Any]]) -> dict[str, list[float]]:
    """Share of right winners, the constants in use, with all evidence and with each left out: mean and interval."""
    out = {}
    for name in ("", *EVIDENCE):
        weights = np.array(WEIGHTS) * [name != other for other in EVIDENCE]
        out[name or "nothing"] = share([bool(right(r)[np.argmax(table(r) @ weights)]) for r in rows], rows)
    return out


def features(rows: list[dict[str, Any]]) -> np.ndarray:
    """(n, F) of the winners by the constants in use."""
    out = []
    for row in rows:
        order = np.argsort(-in_use(row), kind="stable")
        out.append(evidence_of([row["evidence"][k] for k in order], with_camera=row["form"] == "exact"))
    return np.array(out)


def chosen(rows: list[dict[str, Any]]) -> np.ndarray:
    """(n,) bool: whether the winner by the constants in use is right."""
    return np.array([right(r)[np.argmax(in_use(r))] for r in rows])


def share(values: list[bool], rows: list[dict[str, Any]]) -> list[float]:
    """Mean and its 95 % interval by bootstrap over the rows' meshes."""
    index = {mesh: i for i, mesh in enumerate(sorted({r["mesh"] for r in rows}))}
    of = [index[r["mesh"]] for r in rows]
    right, all_of = np.bincount(of, weights=values), np.bincount(of)
    picks = np.random.default_rng(0).integers(len(index), size=(2000, len(index)))
    low, high = np.quantile(right[picks].sum(axis=1) / all_of[picks].sum(axis=1), [0.025, 0.975])
    return [float(np.mean(values)), float(low), float(high)]


def page(result: dict[str, Any]) -> str:
    """Tables of docs/accuracy.md."""
    held = result["confidence"]["held_out"]
    known = {t: v for t, v in held["precision_at"].items() if v[0] is not None}
    head = ["photographs", "N", "best view", "after search, contours and verdict", "among five hypotheses"]
    keys = ("best_view", "winner", "among_hypotheses")
    shares = [
        [name, str(s["n"]), *("{:.2f} ({:.2f} to {:.2f})".format(*s[k]) for k in keys)]
        for name, s in result["shares"].items()
    ]
    mesh = "".join(
        f" Of right meshes against {WRONG[which]} ({v['n']} photographs): {v['auc']:.2f}; of these wrong meshes"
        f" {v['believed']} are believed, {v['right_of_them']} of them with a pose within 30 degrees."
        for which, v in result["confidence"].get("right_mesh", {}).items()
    )
    return "\n".join(
        [
            *table_lines([head, *shares]),
            "",
            *table_lines(
                [
                    ["exact photographs, verdict without", *result["verdict"]["without"]],
                    ["right", *(f"{v[0]:.3f}" for v in result["verdict"]["without"].values())],
                ]
            ),
            "",
            f"Confidence, meshes left out in turn: AUC of right answers {held['auc_right_answer']:.2f}.{mesh}",
            "",
            *table_lines(
                [
                    ["coverage", *held["risk_at_coverage"]],
                    ["share that is wrong", *(f"{v:.2f}" for v in held["risk_at_coverage"].values())],
                ]
            ),
            "",
            *table_lines(
                [
                    ["confidence of at least", *known],
                    ["right", *(f"{v[0]:.2f}" for v in known.values())],
                    ["of all", *(f"{v[1]:.2f}" for v in known.values())],
                ]
            ),
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "verdict.json")
    arguments = parser.parse_args()
    everything = [json.loads(line) for path in arguments.rows for line in path.read_text().splitlines()]
    everything = [r for r in everything if "errors" in r]
    rows, wrong = ([r for r in everything if bool(r["wrong"]) == kind] for kind in (False, True))
    meshes = sorted({r["mesh"] for r in everything})
    part = np.array([meshes.index(r["mesh"]) % PARTS for r in rows + wrong])
    weight = np.ones(len(part))
    weight[len(rows) :] = WRONG_SHARE / (1.0 - WRONG_SHARE) * len(rows) / max(1, len(wrong))
    sure = np.zeros(len(part))
    X, truth = features(rows + wrong), chosen(rows + wrong)
    for k in range(PARTS):
        train, test = np.flatnonzero(part != k), np.flatnonzero(part == k)
        model = LogisticRegression(C=1.0, max_iter=1000).fit(X[train], truth[train], sample_weight=weight[train])
        sure[test] = model.predict_proba(X[test])[:, 1]
    whole = LogisticRegression(C=1.0, max_iter=1000).fit(X, truth, sample_weight=weight)
    p, y = sure[: len(rows)], truth[: len(rows)]
    result: dict[str, Any] = {
        "n": len(rows),
        "shares": {
            f"{form} {pose}": {
                "n": len(some),
                "best_view": share([r["view_errors"][0] < RIGHT for r in some], some),
                "winner": share(chosen(some).tolist(), some),
                "among_hypotheses": share([bool(right(r).any()) for r in some], some),
            }
            for form in ("exact", "sibling")
            for pose in ("upright", "free")
            if (some := [r for r in rows if r["form"] == form and r["pose"] == pose])
        },
        "verdict": {
            "evidence": list(EVIDENCE),
            "used": list(WEIGHTS),
            "fitted_with_camera": [round(float(v), 2) for v in fit_verdict([r for r in rows if r["form"] == "exact"])],
            "without": without([r for r in rows if r["form"] == "exact"]),
            "winner_right": float(y.mean()),
            "best_view_right": float(np.mean([r["view_errors"][0] < RIGHT for r in rows])),
        },
        "confidence": {
            "evidence": list(POSE_EVIDENCE),
            "weights": [round(float(v), 3) for v in whole.coef_[0]],
            "bias": round(float(whole.intercept_[0]), 3),
            "held_out": {
                "auc_right_answer": auc(p[y], p[~y]),
                "risk_at_coverage": wrong_at(p, y),
                "precision_at": {
                    f"{t:g}": [float(y[p >= t].mean()) if (p >= t).any() else None, float((p >= t).mean())]
                    for t in (0.5, 0.6, 0.7, 0.8, 0.9)
                },
            },
        },
    }
    same = [any((r["form"], r["pose"]) == (w["form"], w["pose"]) for w in wrong) for r in rows]
    for which in sorted({r["wrong"] for r in wrong}):
        here = np.array([r.get("wrong") == which for r in rows + wrong])
        believed = here & (sure >= RELIABLE)
        result["confidence"].setdefault("right_mesh", {})[which] = {
            "auc": auc(p[same], sure[here]),
            "n": int(here.sum()),
            "believed": int(believed.sum()),
            "right_of_them": int((np.array([min(r["errors"][:1]) < RIGHT for r in rows + wrong]) & believed).sum()),
        }
    arguments.out.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result, indent=2))
    if arguments.out.parent == PAGE.parents[1] / "scripts" / "results":
        text = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(between(text, BEGIN, END, page(result)), encoding="utf-8")


if __name__ == "__main__":
    main()
