"""Write the tables of docs/accuracy.md that say what confidences are worth.

    python scripts/confidence_table.py [RUN ...]

The tables of generated photographs are written from scripts/results/calibration.json. RUN are
folders that ``curvireg evaluate`` wrote: their results.jsonl have the confidences, their errors.csv
the errors. Their rows replace those of the same sets in scripts/results/confidence.json, and the
table is written from it.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from sklearn.metrics import roc_auc_score

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import DATASETS
from curvireg_torch.evaluation.compare import read_run
from scripts._shared import (
    REPOSITORY,
    RESULTS,
    RIGHT_DEG,
    Record,
    markdown_table,
    read_json,
    read_lines,
    run,
    stamp,
    update_page,
    write_json,
)

GENERATED = read_json(Path(__file__).with_name("tables.json"))["generated"]
"""By the name of their set in scripts/calibration: what photographs show."""


def main(folders: list[Path] = ()) -> None:
    page = REPOSITORY / "docs" / "accuracy.md"
    calibration = read_json(RESULTS / "calibration.json")
    update_page(page, "generated", generated_part(calibration))
    update_page(page, "withheld", table_of_withheld(calibration["held out"]["instance"]["sets"]))
    if folders:
        path = RESULTS / "confidence.json"
        stored = read_json(path)["sets"] if path.exists() else []
        rows = merged(stored, [measured(folder) for folder in folders])
        record = stamp() | {"sets": rows}
        write_json(path, record)
        update_page(page, "confidence", table(rows))


def merged(stored: Sequence[Record], rows: Sequence[Record]) -> list[Record]:
    """The stored rows, of which new ones of the same name take the place, then the other new
    ones."""
    return list({row["name"]: row for row in [*stored, *rows]}.values())


def measured(folder: Path) -> Record:
    """What the confidences of one run are worth; objects without a pose count as wrong, with
    confidence 0, and those whose true pose is unknown do not count."""
    results = {row["key"]: row for row in read_lines(folder / "results.jsonl")}
    evaluated = read_run(folder)
    scored = DATASETS[evaluated.dataset].scored.page_error
    errors = {
        key: row[scored] for key, row in evaluated.errors.items() if not math.isnan(row[scored])
    }
    if not errors:
        raise InvalidInputError("no object whose true pose is known; leave it out", subject=folder)
    found = [results[key] for key in errors]
    confidences = [result.get("confidence") or 0.0 for result in found]
    right = [error < RIGHT_DEG for error in errors.values()]
    trusted = [
        is_right for is_right, result in zip(right, found, strict=True) if result.get("reliable")
    ]
    return {
        "name": folder.name,
        "n": len(errors),
        "mean_confidence": fmean(confidences),
        "right": fmean(right),
        "reliable": len(trusted),
        "reliable_right": sum(trusted),
        "ambiguous": sum(result.get("ambiguous") is not None for result in found),
        "auc": roc_auc_score(right, confidences) if len(set(right)) == 2 else None,
    }


def generated_part(calibration: Record) -> str:
    """Markdown, of what calibrate.py recorded: all photographs in a sentence, then the table of the
    sets."""
    quality = calibration["held out"]["instance"]
    sentence = (
        "Fitted on {n} generated photographs, commit {commit}. On folds of other kinds of objects, "
        "mean confidence is {said:.2f}, right {right:.2f}; AUC {auc:.2f}; {reliable:.2f} are "
        "called reliable, {trusted:.3f} of these right. By kind of input:"
    )
    values = quality | {"commit": calibration["commit"], "trusted": quality["right if reliable"]}
    covered = (
        "Of {covariances} right and reliable answers, {50%:.2f} lie within the ellipsoid of 50 % "
        "that their covariances describe, and {90%:.2f} within that of 90 %; with {factor:.2f} "
        "times the variance, 0.90 would."
    )
    factor = quality["covariance_scale"] / calibration["constants"]["covariance_scale"]
    parts = [
        sentence.format(**values),
        table_of_generated(quality["sets"]),
        covered.format(covariances=quality["covariances"], factor=factor, **quality["within"]),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def table_of_generated(sets: Mapping[str, Record]) -> str:
    """Markdown, of the quality of confidences by set of generated photographs."""
    header = "photographs | N | mean confidence | right | reliable | wrong of these | AUC"
    cells = [header.split(" | ")]
    for name, photographs in GENERATED.items():
        one = sets[name]
        shares = [share(one[key]) for key in ("said", "right", "reliable")]
        wrong = one["reliable and wrong"]
        cells.append([photographs, one["n"], *shares, wrong, share(one["auc"])])
    return markdown_table(cells)


def table_of_withheld(sets: Mapping[str, Record]) -> str:
    """Markdown, of the same generated photographs with their cameras and without."""
    cells = [["set", "N", "within 5°: given, none", "within 15°", "median"]]
    for name in ("shapes", "packages"):
        both = (sets[name], sets[f"estimated_{name}"])
        row = [name, sets[name]["n"]]
        for key in ("within 5", "within 15"):
            row.append(", ".join(share(one[key]) for one in both))
        row.append(", ".join(f"{one['median']:.1f}°" for one in both))
        cells.append(row)
    return markdown_table(cells)


def table(rows: Sequence[Record]) -> str:
    """Markdown, of the quality of confidences by real set."""
    header = "set | N | mean confidence | right | reliable | of these right | ambiguous | AUC"
    cells = [header.split(" | ")]
    for row in rows:
        shares = [share(row[name]) for name in ("mean_confidence", "right")]
        counts = [row[name] for name in ("reliable", "reliable_right", "ambiguous")]
        cells.append([f"`{row['name']}`", row["n"], *shares, *counts, share(row["auc"])])
    return markdown_table(cells)


def share(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    run(main)
