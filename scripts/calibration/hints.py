"""How much a hint about the azimuth helps: write the table of docs/guides/pose-prior.md.

    python scripts/calibration/hints.py ROWS RUNS

ROWS holds the rows of scripts/benchmark/run.py: right.jsonl without a hint, and hint_90.jsonl, hint_45.jsonl and
hint_30.jsonl with ``--hint azimuth:90`` and so on. RUNS holds folders none, azimuth:90, azimuth:45 and azimuth:30, each
with what ``curvireg evaluate --out RUNS/HINT/SET`` wrote. Photographs that are missing in one of the files are left
out; a hint that was not measured has "-". A set that is measured again gets a new line; the others keep theirs, with
their commits. Without right.jsonl or hint_*.jsonl, ROWS is not looked at.
"""

import argparse
import json
from pathlib import Path

from scripts._shared import REPOSITORY, RESULTS, commit, right_share, table_lines, today, update_page, write_json
from scripts.calibration.quality import REAL_SETS, RIGHT, Row, format_interval, group_of, interval

RECORD = RESULTS / "hints.json"

HINTS = {"none": "right", "azimuth:90": "hint_90", "azimuth:45": "hint_45", "azimuth:30": "hint_30"}
"""Hints, and the files of their rows."""


def benchmark_rates(rows: dict[str, dict[int, Row]]) -> dict[str, Row]:
    """Fractions of right answers with their intervals for each form, from rows by hint and photograph."""
    common = sorted(set.intersection(*(set(found) for found in rows.values())))
    out: dict[str, Row] = {}
    for form in ("exact", "sibling"):
        ids = [i for i in common if rows["none"][i]["form"] == form]
        units = [group_of(rows["none"][i]) for i in ids]
        if not ids:
            continue
        rates = {hint: interval([found[i]["errors"][0] < RIGHT for i in ids], units) for hint, found in rows.items()}
        out[f"benchmark, {form}, upright"] = {"n": len(ids), **rates}
    return out


def real_rates(runs: Path) -> dict[str, Row]:
    """Fractions of right answers on the real sets, up to symmetries."""
    out: dict[str, Row] = {}
    for name in REAL_SETS:
        files = {hint: runs / hint / name / "summary.json" for hint in HINTS}
        summaries = {hint: json.loads(file.read_text()) for hint, file in files.items() if file.is_file()}
        rates = {hint: [right_share(found)] for hint, found in summaries.items()}
        if "none" in summaries:
            out[name] = {"n": summaries["none"]["n"], **rates}
    return out


def with_commit(found: Row, recorded: Row | None) -> Row:
    """The numbers with the commit of today; digit for digit the recorded ones, they were not measured again."""
    found = json.loads(json.dumps(found))  # tuples become lists
    if recorded is not None and recorded == {**found, "commit": recorded["commit"]}:
        return recorded
    return {**found, "commit": commit()}


def page(record: Row) -> str:
    """The table, one line for each set."""
    lines = [["within 30 degrees", "N", "no hint", "90 degrees", "45 degrees", "30 degrees", "commit"]]
    for name, found in record["sets"].items():
        known = (found.get(hint, [None]) for hint in HINTS)
        rates = (format_interval(rate[0], rate[1:] or None) for rate in known)
        lines.append([name, str(found["n"]), *rates, found["commit"]])
    where = "`python scripts/calibration/hints.py`; each line was measured at its commit."
    return "\n".join([*table_lines(lines), "", where, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path)
    parser.add_argument("runs", type=Path)
    arguments = parser.parse_args()
    rows = {}
    for hint, name in HINTS.items():
        if not (arguments.rows / f"{name}.jsonl").is_file():
            continue
        found = [json.loads(line) for line in (arguments.rows / f"{name}.jsonl").read_text().splitlines()]
        rows[hint] = {row["id"]: row for row in found if "errors" in row}
    sets = {**(benchmark_rates(rows) if "none" in rows and len(rows) > 1 else {}), **real_rates(arguments.runs)}
    earlier = json.loads(RECORD.read_text(encoding="utf-8"))["sets"] if RECORD.is_file() else {}
    sets = {name: with_commit(found, earlier.get(name)) for name, found in sets.items()}
    record = {"date": today(), "commit": commit(), "sets": {**earlier, **sets}}
    write_json(RECORD, record)
    update_page(REPOSITORY / "docs" / "guides" / "pose-prior.md", "hints", page(record))
    print(page(record))


if __name__ == "__main__":
    main()
