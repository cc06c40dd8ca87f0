"""Write the three tables at the top of docs/accuracy.md from the records in scripts/results.

    python scripts/accuracy_tables.py             write the tables
    python scripts/accuracy_tables.py --check     exit 1 if the page differs from the records

Run it after any of the measurements that it shows was recorded again.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from scripts._shared import REPOSITORY, RESULTS, replace_between, right_share, table_lines

PAGE = REPOSITORY / "docs" / "accuracy.md"
BEGIN, END = "<!-- accuracy:begin -->", "<!-- accuracy:end -->"

Record = dict[str, Any]

SETS = {
    "benchmark, exact, upright": ("generated, exact mesh", "yes", "contours, exact, appearance"),
    "benchmark, sibling, upright": ("generated, similar mesh", "no", "contours, similar, appearance"),
    "pascal3d_mini": ("PASCAL3D+ (part), similar mesh", "no", "pascal3d_mini"),
    "hope": ("hope, exact mesh, in clutter (16 views x 5 lightings)", "yes", "hope"),
    "lm": ("LINEMOD (part), exact mesh", "yes", "lm"),
    "dino": ("dino, exact mesh", "yes", "dino"),
    "buddha": ("buddha, exact mesh", "yes", "buddha"),
}
"""For each set of hints.json: its name on the page, whether the camera is known, and its name in calibration.json."""

UPRIGHT = {
    "benchmark, exact, upright": ("generated, upright, exact mesh", "exact upright"),
    "benchmark, sibling, upright": ("generated, upright, similar mesh", "sibling upright"),
}
"""For each generated set of hints.json: its name on the page, and its shares in calibration.json."""


def record(name: str) -> Record:
    found: Record = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return found


def share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def measured(found: Record) -> str:
    return f"Measured on {found['date']}, commit {found['registered']}."


def right_answers(hints: Record, calibration: Record, evaluations: dict[str, Record]) -> list[list[str]]:
    """How often the first answer is right, without a hint and with one."""
    rows = [["photographs", "camera known", "N", "right", "right, azimuth known to 45°", "median error"]]
    for key, (name, camera, _) in SETS.items():
        hinted = share(hints["sets"][key].get("azimuth:45", [None])[0])
        if key in UPRIGHT:
            name, of_shares = UPRIGHT[key]
            found = calibration["shares"][of_shares]
            right, error = found["answer"][0], "-"
        else:
            found = evaluations[key]["summary"]
            right, error = right_share(found), f"{found['med_err_deg']:.1f}°"
        rows.append([name, camera, str(found["n"]), share(right), hinted, error])
    return rows


def trust(calibration: Record) -> list[list[str]]:
    """What confidence and answer sets are worth."""
    rows = [["photographs", "N", "called reliable", "right of them", "answer set holds the truth", "answers in it"]]
    confidences = calibration["held_out"] | calibration["real"]
    sets = calibration["answer_sets"] | calibration["real_answer_sets"]
    for name, _, key in SETS.values():
        found, answers = confidences[key], sets[key]
        counts = [str(found[k]) for k in ("n", "reliable", "reliable_and_right")]
        rows.append([name, *counts, share(answers["coverage"]), f"{answers['mean_size']:.1f}"])
    return rows


def precision(calibration: Record) -> list[list[str]]:
    """How exact right answers are."""
    head = ["photographs", "right", "best view, median", "rotation, median", "90 %", "translation, median", "90 %"]
    rows = [head]
    for pose, found in calibration["exactness"].items():
        degrees = [f"{found[key]:.2g}°" for key in ("best view", "rotation median", "rotation 90 %")]
        shifts = [f"{100 * found[key]:.2g} %" for key in ("translation median", "translation 90 %")]
        rows.append([f"generated, {pose}, exact mesh", str(found["n"]), *degrees, *shifts])
    return rows


def tables() -> str:
    """The three tables, each with its question and its records."""
    hints, calibration = record("hints"), record("calibration")
    evaluations = {
        path.stem.removeprefix("evaluation_"): json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(RESULTS.glob("evaluation_*.json"))
    }
    commits = ", ".join(sorted({found["commit"] for key, found in evaluations.items() if key in SETS}))
    parts = [
        (
            "How often is the first answer right?",
            right_answers(hints, calibration, evaluations),
            "Right: within 30°, up to symmetries. The hint is the true azimuth, moved at random by up to 45° "
            "([all hints](guides/pose-prior.md), with their own N and commits, some of them older). The median error of"
            f" PASCAL3D+ counts symmetries as errors. Measured on {calibration['date']}, commits "
            f"{calibration['registered']} (generated photographs), {commits} (the others).",
        ),
        (
            "How far can it be trusted?",
            trust(calibration),
            'Reliable: a confidence of at least 0.9. An answer set should hold the truth, or "none of them" where no '
            "answer is right, for 0.90 of the photographs. " + measured(calibration),
        ),
        (
            "How exact is it?",
            precision(calibration),
            "With a camera. Translation as a fraction of the distance. " + measured(calibration),
        ),
    ]
    return "\n".join("\n".join([f"## {title}", "", *table_lines(rows), "", note, ""]) for title, rows, note in parts)


def main(page: Path = PAGE) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if the page is out of date")
    check = parser.parse_args().check
    text = page.read_text(encoding="utf-8")
    expected = replace_between(text, BEGIN, END, "\n" + tables())
    if check:
        if expected != text:
            print(f"accuracy_tables: {page.name} is out of date; run scripts/accuracy_tables.py", file=sys.stderr)
        return int(expected != text)
    page.write_text(expected, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
