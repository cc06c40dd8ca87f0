"""Write the table of docs/accuracy.md that says what confidences are worth.

    python scripts/confidence_table.py RUN ...

RUN are folders that ``curvireg evaluate`` wrote: their results.jsonl have the confidences, their
errors.csv the errors. The table goes into docs/accuracy.md, its values into
scripts/results/confidence.json.
"""

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sklearn.metrics import roc_auc_score

from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json

RIGHT = 30.0  # degrees
ERROR_COLUMNS = ("rotation", "symmetric_error_deg")  # of BOP sets and of PASCAL3D+
HEADER = (
    "set",
    "N",
    "mean confidence",
    "right",
    "reliable",
    "of these right",
    "ambiguous",
    "AUC",
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", nargs="+", type=Path, help="folder of curvireg evaluate")
    options = parser.parse_args()
    rows = [measured(run) for run in options.run]
    record = {"date": today(), "commit": commit(), "sets": rows}
    write_json(RESULTS / "confidence.json", record)
    update_page(REPOSITORY / "docs" / "accuracy.md", "confidence", table(rows))


def measured(run: Path) -> dict[str, Any]:
    """What the confidences of one run are worth; objects without a pose count as wrong, with
    confidence 0."""
    lines = (run / "results.jsonl").read_text(encoding="utf-8").splitlines()
    results = {row["key"]: row for row in map(json.loads, lines)}
    with (run / "errors.csv").open(encoding="utf-8", newline="") as file:
        errors = list(csv.DictReader(file))
    column = next(name for name in ERROR_COLUMNS if name in errors[0])
    confidences = []
    right = []
    reliable = []
    ambiguous = 0
    for row in errors:
        result = results[row["key"]]
        confidences.append(result.get("confidence") or 0.0)
        right.append(bool(row[column]) and float(row[column]) < RIGHT)
        reliable.append(bool(result.get("reliable")))
        ambiguous += result.get("ambiguous") is not None
    trusted = [
        is_right for is_right, is_reliable in zip(right, reliable, strict=True) if is_reliable
    ]
    return {
        "name": run.name,
        "n": len(errors),
        "mean_confidence": sum(confidences) / len(errors),
        "right": sum(right) / len(errors),
        "reliable": len(trusted),
        "reliable_right": sum(trusted),
        "ambiguous": ambiguous,
        "auc": float(roc_auc_score(right, confidences)) if len(set(right)) == 2 else None,
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    cells = [list(HEADER)]
    for row in rows:
        auc = "" if row["auc"] is None else f"{row['auc']:.2f}"
        shares = [f"{row[name]:.2f}" for name in ("mean_confidence", "right")]
        counts = [str(row[name]) for name in ("reliable", "reliable_right", "ambiguous")]
        cells.append([f"`{row['name']}`", str(row["n"]), *shares, *counts, auc])
    return "\n".join(table_lines(cells)) + "\n"


if __name__ == "__main__":
    main()
