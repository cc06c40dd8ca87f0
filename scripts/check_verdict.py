"""How far the confidence of registered poses can be believed on real photographs: a table of docs/method.md.

    python scripts/check_verdict.py DATA EVALUATED

DATA holds pascal3d_mini and bop/{hope,lm,dino}, EVALUATED what `curvireg evaluate --out EVALUATED/NAME` left of each.
Confidence is computed again from the kept evidence, by the constants in use. An answer is right within 30 degrees, up
to the object's symmetries.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _record import REPOSITORY, SETS, benchmark, between, commit, table_lines, today, write_json

from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.registration.confidence import RELIABLE, pose_confidence, pose_evidence
from curvireg_torch.registration.verify import EVIDENCE, verdict

RECORD = REPOSITORY / "scripts" / "results" / "check_verdict.json"
PAGE = REPOSITORY / "docs" / "method.md"
MARKERS = "<!-- believed:begin -->", "<!-- believed:end -->"
COVERAGES = (1.0, 0.75, 0.5, 0.25)
RIGHT = 30.0


def evidence_of(known: list[dict[str, float]], *, with_camera: bool) -> list[float]:
    """What the confidence rests on, from the evidence of the winner and, behind it, of its rivals."""
    evidence = torch.tensor([[one[name] for name in EVIDENCE] for one in known], dtype=torch.float64)
    score = verdict(evidence, with_camera=with_camera)
    lead = float(score[0] - score[1:].max()) if len(score) > 1 else float("inf")
    best = known[0]
    return pose_evidence(best["similarity"], lead, with_camera=with_camera, support=best["support"])


def confidence_of(row: dict[str, Any], *, with_camera: bool) -> float:
    """Of a kept prediction; 0 of one that failed."""
    if "evidence" not in row:
        return 0.0
    known = [row["evidence"], *(rival["evidence"] for rival in row.get("rivals", []))]
    return pose_confidence(evidence_of(known, with_camera=with_camera))


def auc(higher: np.ndarray, lower: np.ndarray) -> float | None:
    """Share of pairs in which the first is larger, ties counting half; None without pairs."""
    above = higher[:, None] - lower[None]
    return float((above > 0).mean() + 0.5 * (above == 0).mean()) if above.size else None


def wrong_at(sure: np.ndarray, right: np.ndarray) -> dict[str, float]:
    """Share that is wrong among the most confident, by coverage."""
    order = np.argsort(-sure, kind="stable")
    return {f"{c:g}": float(1.0 - right[order[: max(1, round(c * len(sure)))]].mean()) for c in COVERAGES}


def judged(sure: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """What the confidences are worth."""
    believed = sure >= RELIABLE
    return {
        "n": len(sure),
        "right": float(right.mean()),
        "mean": float(sure.mean()),
        "auc": auc(sure[right], sure[~right]),
        "wrong_at": wrong_at(sure, right),
        "reliable": float(believed.mean()),
        "right_of_them": float(right[believed].mean()) if believed.any() else None,
    }


def table(record: dict[str, Any]) -> str:
    head = ["set", "N", "right", "mean confidence", "AUC right answer"]
    head += [f"wrong at coverage {c:g}" if c == 1 else f"{c:g}" for c in COVERAGES] + ["reliable", "right of them"]
    rows = [head]
    for name, found in record["sets"].items():
        numbers = [found["right"], found["mean"], found["auc"], *found["wrong_at"].values()]
        numbers += [found["reliable"], found["right_of_them"]]
        rows.append([name, str(found["n"]), *("-" if x is None else f"{x:.2f}" for x in numbers)])
    return "\n".join([*table_lines(rows), "", f"{record['date']}, commit {record['commit']}.", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("evaluated", type=Path, metavar="EVALUATED")
    arguments = parser.parse_args()
    sets: dict[str, Any] = {}
    every: list[tuple[np.ndarray, np.ndarray]] = []
    for name in SETS:
        judge, store = benchmark(arguments.data, name), PredictionStore(arguments.evaluated / name / "predictions")
        items = judge.selection(None)
        rows = [store.read(item.key) for item in items]
        right = (judge.rotation_errors(items, rows) < RIGHT).numpy()
        sure = np.array(
            [confidence_of(r, with_camera=i.camera_matrix is not None) for r, i in zip(rows, items, strict=True)]
        )
        sets[name] = judged(sure, right)
        every.append((sure, right))
    sets["all"] = judged(*(np.concatenate(part) for part in zip(*every, strict=True)))
    record = {"commit": commit(REPOSITORY), "date": today(), "sets": sets}
    write_json(RECORD, record)
    PAGE.write_text(between(PAGE.read_text(encoding="utf-8"), *MARKERS, table(record)), encoding="utf-8")


if __name__ == "__main__":
    main()
