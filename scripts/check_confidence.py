"""What confidence is worth on real photographs: calibration, error versus coverage, right mesh versus wrong mesh.

    python scripts/check_confidence.py DATA [--out scripts/results/confidence.json]

DATA as for compare_similarities.py. Each object is ranked against its own mesh and against wrong ones: those of the
other BOP objects, or one CAD of each of three other classes. An answer is right if the best view is within 30 degrees
of the truth, symmetries taken into account (no refinement).
"""

import argparse
import json
from pathlib import Path

import torch
from compare_similarities import SETS, shots

import curvireg_torch as cr
from curvireg_torch.pipeline import DEFAULT, preset_named
from curvireg_torch.registration import RELIABLE, ranking_evidence
from curvireg_torch.registration.confidence import probability

COVERAGES = (1.0, 0.75, 0.5, 0.25, 0.1)
WRONG_CLASSES = 3


@torch.no_grad()
def collect(data: Path) -> list[dict]:
    """One row per ranking."""
    rows: list[dict] = []
    for kind in ("upright", "any"):
        groups = [(n, *g) for n in SETS if SETS[n] == kind for g in shots(data, n, {"annotated": 0.0})]
        folders = sorted({path.parent for _, _, path, _ in groups})
        queries = {}
        for _, bank, path, group in groups:
            matcher = cr.ViewMatcher(bank, pipeline=preset_named(DEFAULT))
            queries[path] = [matcher.query([s.image], s.boxes["annotated"][None]) for s in group]
            for name, _, other, members in groups:
                if other not in queries and other != path:
                    queries[other] = [matcher.query([s.image], s.boxes["annotated"][None]) for s in members]
                place = folders.index(path.parent) - folders.index(other.parent)
                first = min(p for _, _, p, _ in groups if p.parent == path.parent)
                if kind == "upright" and other != path and (path != first or place % len(folders) > WRONG_CLASSES):
                    continue
                if kind == "upright" and other != path and place == 0:
                    continue
                for shot, query in zip(members, queries[other], strict=True):
                    ranking = matcher.rank(query)
                    best = int(ranking.order[0, 0])
                    error = None
                    if other == path:
                        view = bank.rotations[best : best + 1].double()
                        error = float(shot.errors(view, shot.boxes["annotated"])[0])
                    rows.append(
                        {
                            "set": name,
                            "mesh": f"{path.parent.name}/{path.stem}",
                            "error": error,
                            "evidence": ranking_evidence(ranking, bank.rotations)[0].tolist(),
                        }
                    )
            print(kind, path.stem, len(rows), flush=True)
    return rows


def auc(higher: torch.Tensor, lower: torch.Tensor) -> float | None:
    """Share of pairs in which the first is larger; ties count half."""
    if not len(higher) or not len(lower):
        return None
    difference = higher[:, None] - lower[None]
    return float(((difference > 0).double() + 0.5 * (difference == 0).double()).mean())


def confidences(rows: list[dict]) -> torch.Tensor:
    return probability(torch.tensor([r["evidence"] for r in rows], dtype=torch.float64))


def judge(rows: list[dict]) -> dict:
    own, others = ([r for r in rows if (r["error"] is None) == wrong] for wrong in (False, True))
    p, wrong_mesh = confidences(own), confidences(others)
    right = torch.tensor([r["error"] < 30 for r in own])
    bins = (p * 5).long().clamp(max=4)
    diagram = [
        {
            "confidence": float(p[bins == b].mean()),
            "right": float(right[bins == b].double().mean()),
            "n": int((bins == b).sum()),
        }
        for b in range(5)
        if bool((bins == b).any())
    ]
    order = p.argsort(descending=True, stable=True)
    return {
        "n": len(own),
        "right": float(right.double().mean()),
        "mean_confidence": float(p.mean()),
        "ece": sum(abs(b["confidence"] - b["right"]) * b["n"] for b in diagram) / len(own),
        "diagram": diagram,
        "error_at_coverage": {
            str(c): float((~right[order[: max(1, round(c * len(own)))]]).double().mean()) for c in COVERAGES
        },
        "auc_right_answer": auc(p[right], p[~right]),
        "auc_right_mesh": auc(p, wrong_mesh),
        "auc_right_mesh_right_answer": auc(p[right], wrong_mesh),
        "reliable": {
            "share": float((p >= RELIABLE).double().mean()),
            "right": float(right[p >= RELIABLE].double().mean()) if bool((p >= RELIABLE).any()) else None,
            "wrong_mesh_share": float((wrong_mesh >= RELIABLE).double().mean()),
        },
        "wrong_mesh_n": len(wrong_mesh),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--rows", type=Path, help="keep the collected rows in this file, or read them from it")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "confidence.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.rows and arguments.rows.exists():
        rows = json.loads(arguments.rows.read_text())
    else:
        rows = collect(arguments.data)
        if arguments.rows:
            arguments.rows.write_text(json.dumps(rows))
    result = {name: judge([r for r in rows if r["set"] == name]) for name in SETS} | {"all": judge(rows)}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
