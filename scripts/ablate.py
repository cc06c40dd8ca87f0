"""The ablation table of docs/accuracy.md: one change to a preset each row, all sets.

    python scripts/ablate.py DATA --out results/ablation [--rows NAME ...]     measure what is not measured yet
    python scripts/ablate.py --table                                           write the table again, measure nothing

DATA holds pascal3d_mini (PASCAL3D+ layout, pixels counted from 0) and bop/dino, bop/hope, bop/lm, bop/buddha.
Predictions go to --out, one folder per row and set; stop it and run it again. Numbers are kept in
scripts/results/ablation.json: for each row and set N, the shares of objects within 30 and 15 degrees (symmetries of the
objects taken into account), the median error, 95 % intervals by bootstrap over what is independent (CADs of PASCAL3D+,
views of BOP sets with all their lightings), the same of the objects that are seen whole, and against the first row the
difference within 30 degrees with its interval over paired resamples.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from _intervals import independent_units, interval
from _record import REPOSITORY, SETS, benchmark, between, commit, today

from curvireg_torch.evaluation import evaluate
from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.metrics import median_error
from curvireg_torch.pipeline import PRESETS, Pipeline

KEPT = REPOSITORY / "scripts" / "results" / "ablation.json"
PAGE = REPOSITORY / "docs" / "accuracy.md"
BEGIN, END = "<!-- ablation:begin -->", "<!-- ablation:end -->"


_learned, _classical = PRESETS["learned"], PRESETS["classical"]


def _ranked(pipeline: Pipeline) -> Pipeline:
    """Nothing behind the ranking."""
    return replace(pipeline, search=False, contours=False)


def _without(pipeline: Pipeline, name: str) -> Pipeline:
    return replace(pipeline, terms=tuple(term for term in pipeline.terms if term.name != name))


ROWS: dict[str, Pipeline] = {
    "learned": _learned,
    "without S_look": _without(_learned, "appearance"),
    "one hypothesis": replace(_learned, hypotheses=1),
    "without contours": replace(_learned, contours=False),
    "ranking alone": _ranked(_learned),
    "ranking, without S_look": _ranked(_without(_learned, "appearance")),
    "ranking, without S_rep": _ranked(_without(_learned, "repeatability")),
    "ranking, without S_box": _ranked(_without(_learned, "box")),
    "ranking, without slack": _ranked(replace(_learned, box_jitter=0.0)),
    "classical": _classical,
    "classical ranking": _ranked(_classical),
    "gradient instead of MFC": _ranked(replace(_classical, field="gradient")),
    "MCS instead of MFC": _ranked(replace(_classical, field="saliency")),
    "paper": _ranked(PRESETS["paper"]),
}
"""Name -> pipeline; differences are taken against the first."""


def measure(row: str, name: str, data: Path, out: Path) -> dict[str, Any]:
    """Errors of all objects, in the order of the dataset."""
    folder = out / row.replace(" ", "_").replace(",", "") / name
    objects = benchmark(data, name)
    summary = evaluate(objects, folder, preset=ROWS[row])
    assert summary is not None
    store = PredictionStore(folder / "predictions")
    rows = [(item, store.read(item.key)) for item in objects.items]
    kept = [(item, prediction) for item, prediction in rows if "skipped" not in prediction]
    items, predictions = [item for item, _ in kept], [prediction for _, prediction in kept]
    return {
        "errors": [round(float(e), 3) for e in objects.rotation_errors(items, predictions)],
        "whole": [objects.easy(item) for item in items],
        "units": [
            unit for unit, (_, row) in zip(independent_units(objects), rows, strict=True) if "skipped" not in row
        ],
        "add_recall_0.1d": summary.get("add_recall_0.1d"),
        "plain_acc_30": summary.get("acc_pi_6"),
        "date": today(),
        "commit": commit(REPOSITORY),
    }


def cells(name: str, kept: dict[str, Any], base: dict[str, Any]) -> list[str]:
    errors, whole = torch.tensor(kept["errors"]), torch.tensor(kept["whole"])
    right, before = (errors < 30).float(), (torch.tensor(base["errors"]) < 30).float()
    mean, low, high = interval(right, kept["units"])
    difference, worst, best = interval(right - before, kept["units"])
    return [
        name,
        f"{len(errors)} ({len(set(kept['units']))})",
        f"{mean:.3f} ({low:.2f} to {high:.2f})",
        "" if kept is base else f"{difference:+.3f} ({worst:+.2f} to {best:+.2f})",
        f"{float((errors < 15).float().mean()):.3f}",
        f"{median_error(errors):.1f}°",
        f"{float((errors[whole] < 30).float().mean()):.3f} ({int(whole.sum())})",
    ]


def table(results: dict[str, Any]) -> str:
    head = ["row", "N (independent)", "within 30°", "against the first", "15°", "median", "seen whole: 30° (N)"]
    parts = []
    for name in SETS:
        rows = {row: results[row][name] for row in ROWS if name in results.get(row, {})}
        if not rows:
            continue
        base = next(iter(rows.values()))
        lines = [head, ["---"] * len(head), *(cells(row, kept, base) for row, kept in rows.items())]
        parts.append(f"**{name}**\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n")
    return "\n".join(parts)


def write_table() -> None:
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(between(text, BEGIN, END, table(json.loads(KEPT.read_text()))), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", metavar="DATA")
    parser.add_argument("--out", type=Path, default=Path("results/ablation"), metavar="DIR")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="NAME")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS), metavar="NAME")
    parser.add_argument("--table", action="store_true", help="only write the table again")
    arguments = parser.parse_args()
    if not arguments.table:
        if arguments.data is None:
            parser.error("DATA is needed to measure")
        for row in arguments.rows:
            for name in arguments.sets:
                kept = measure(row, name, arguments.data, arguments.out)
                results = json.loads(KEPT.read_text()) if KEPT.exists() else {}
                results.setdefault(row, {})[name] = kept
                KEPT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    write_table()


if __name__ == "__main__":
    main()
