"""Throws broken files at every reader: each must end in a result or in one of our errors, in time and memory.

    python scripts/robustness/fuzz.py                                  the 100,000 inputs of the record
    python scripts/robustness/fuzz.py --inputs 1000 --out fuzz.json    some, beside it

Batches run in processes of their own, which a stuck or killed one takes along with nothing else; the report is written
after each, and another run continues from it. ``scripts/results/fuzz.json`` is the record, and SECURITY.md has its
table. Exit code 1 if anything failed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from scripts._shared import REPOSITORY, commit, replace_between, today

RESULT = REPOSITORY / "scripts" / "results" / "fuzz.json"
DOCUMENT = REPOSITORY / "SECURITY.md"
BEGIN, END = "<!-- fuzz:begin -->", "<!-- fuzz:end -->"
SHARES = {"images": 0.3, "meshes": 0.35, "mat": 0.1, "tables": 0.1, "banks": 0.05, "boxes": 0.05, "cameras": 0.05}
BATCH = 5000
SECONDS = 20.0  # for one input
MEGABYTES = 3000  # for a process, libraries included


def worker(kind: str, start: int, count: int, folder: Path) -> None:
    """Inputs ``start`` to ``start + count``; prints a line of JSON for each that is done and one for the batch."""
    warnings.simplefilter("ignore")
    from scripts.robustness.fuzz_inputs import DATASETS, attack

    if kind in ("boxes", "cameras"):
        print(json.dumps({"at": start}), flush=True)
        begin, failure = time.perf_counter(), None
        try:
            count = DATASETS[kind](start, count)
        except Exception:
            failure = traceback.format_exc(limit=-3)
        say = {
            "tried": count,
            "outcomes": {"result or our error": count},
            "slowest": (time.perf_counter() - begin) / count,
        }
        print(json.dumps({**say, "failures": [failure] if failure else [], "peak_mb": peak()}), flush=True)
        return
    outcomes: Counter[str] = Counter()
    failures, slowest = [], 0.0
    for number in range(start, start + count):
        print(json.dumps({"at": number}), flush=True)
        begin = time.perf_counter()
        try:
            outcomes[attack(kind, number, folder)] += 1
        except Exception:
            outcomes["failure"] += 1
            failures.append(f"{kind} {number}: {traceback.format_exc(limit=-4)}")
        slowest = max(slowest, time.perf_counter() - begin)
    report = {"tried": count, "outcomes": outcomes, "slowest": slowest, "failures": failures, "peak_mb": peak()}
    print(json.dumps(report), flush=True)


def peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(kind: str, start: int, count: int) -> dict[str, Any]:
    """One batch in a process of its own; where that dies, what it did before and which input it was."""
    command = [sys.executable, "-m", "scripts.robustness.fuzz", "--worker", kind, str(start), str(count)]
    limit = 60.0 + 0.1 * count + SECONDS
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                [*command, folder], capture_output=True, text=True, timeout=limit, errors="replace", cwd=REPOSITORY
            )
            output, died = done.stdout, f"exit code {done.returncode}: {done.stderr[-800:]}"
        except subprocess.TimeoutExpired as error:
            output, died = (error.stdout or b"").decode(errors="replace"), f"not done in {limit:g} s"
    lines = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    if lines and "tried" in lines[-1]:
        report: dict[str, Any] = lines[-1]
        if report["slowest"] > SECONDS:
            report["failures"].append(f"{kind} {start}+: an input took {report['slowest']:.1f} s")
        if report["peak_mb"] > MEGABYTES:
            report["failures"].append(f"{kind} {start}+: {report['peak_mb']:.0f} MB")
        return report
    at = lines[-1]["at"] if lines else start
    return {
        "tried": at - start + 1, "outcomes": {"killed": 1, "unknown": at - start}, "slowest": 0.0, "peak_mb": 0.0,
        "failures": [f"{kind} {at}: {died}"],
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--kinds", nargs="+", choices=SHARES, default=list(SHARES))
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        kind, start, count, folder = arguments.worker
        worker(kind, int(start), int(count), Path(folder))
        return 0
    here = commit()
    report: dict[str, Any] = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"kinds": {}}
    for kind in arguments.kinds:
        fresh = {"tried": 0, "seconds": 0.0, "outcomes": {}, "slowest_s": 0.0, "peak_mb": 0.0, "failures": []}
        own = report["kinds"].setdefault(kind, fresh)
        while own["tried"] < round(arguments.inputs * SHARES[kind]):
            begin = time.perf_counter()
            batch = run(kind, own["tried"], min(BATCH, round(arguments.inputs * SHARES[kind]) - own["tried"]))
            own["tried"] += batch["tried"]
            own["seconds"] = round(own["seconds"] + time.perf_counter() - begin, 1)
            own["outcomes"] = dict(Counter(own["outcomes"]) + Counter(batch["outcomes"]))
            own["slowest_s"] = round(max(own["slowest_s"], batch["slowest"]), 3)
            own["peak_mb"] = round(max(own["peak_mb"], batch["peak_mb"]), 1)
            own["failures"] += batch["failures"]
            own |= {"date": today(), "commit": here}
            report["inputs"] = sum(k["tried"] for k in report["kinds"].values())
            report["failures"] = sum(len(k["failures"]) for k in report["kinds"].values())
            temporary = arguments.out.with_suffix(".tmp")
            temporary.write_text(json.dumps(report, indent=1) + "\n")
            os.replace(temporary, arguments.out)
        print(f"{kind}: {own['tried']} inputs, {own['seconds']} s, slowest {own['slowest_s']} s, "
              f"{own['peak_mb']} MB, {len(own['failures'])} failures; {own['outcomes']}")  # fmt: skip
    if arguments.out == RESULT:
        text = DOCUMENT.read_text(encoding="utf-8")
        DOCUMENT.write_text(replace_between(text, BEGIN, END, table(report)), encoding="utf-8")
    return 1 if report["failures"] else 0


def table(report: dict[str, Any]) -> str:
    rows = [
        f"| {kind} | {own['tried']:,} | {own['seconds']:.0f} | {own['slowest_s']:.1f} | {own['peak_mb']:.0f} "
        f"| {len(own['failures'])} | {own['date']}, {own['commit']} |"
        for kind, own in report["kinds"].items()
    ]
    head = ["| of | inputs | s | slowest, s | peak, MB | failures | day, commit |", f"|{' --- |' * 7}"]
    return "\n".join([*head, *rows, ""])


if __name__ == "__main__":
    sys.exit(main())
