"""Time ``curvireg demo`` on an idle machine and beside busy loops, in this checkout and in another one, alternately.

    git worktree add ../before 9b0fb33
    python scripts/speed/load.py --against ../before       # writes scripts/results/load.json and the table of the docs

Every run has a process of its own and finds its bank in the cache. ``passive`` is the other checkout with
``OMP_WAIT_POLICY=PASSIVE``, with which torch's threads sleep while they wait for each other. Only on a machine that
does nothing else are the times beside no busy loop those of an idle one.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from scripts._shared import REPOSITORY, RESULTS, commit, run_process, table_lines, today, update_page, write_json

RESULT = RESULTS / "load.json"
PAGE = REPOSITORY / "docs" / "performance.md"
PASSIVE = {"OMP_WAIT_POLICY": "PASSIVE"}
Times = dict[str, list[float]]


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """``count`` processes that compute without end."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def run_demo(checkout: Path, folder: Path, environment: dict[str, str]) -> dict[str, float]:
    """Seconds of the whole command and of the registration in it, both as a clock shows them, and processor seconds."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_", "MKL_"))}
    paths = {"PYTHONPATH": str(checkout), "CURVIREG_CACHE": str(folder / "cache")}
    words = ["-m", "curvireg_torch", "demo", "--quiet", "--out", str(folder / "out")]
    seconds, usage, _ = run_process(words, folder, {**inherited, **paths, **environment})
    registration = json.loads((folder / "out" / "result.json").read_text())["seconds"]["register"]
    return {"command": seconds, "registration": registration, "processor": usage.ru_utime + usage.ru_stime}


def measured(
    variants: dict[str, tuple[Path, dict[str, str]]], loads: Sequence[int], rounds: int
) -> list[dict[str, Any]]:
    """For each number of busy loops, the times of every variant, which take turns."""
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folders = {name: Path(temporary, name) for name in variants}
        for name, (checkout, environment) in variants.items():
            folders[name].mkdir()
            run_demo(checkout, folders[name], environment)  # builds the bank
        for load in loads:
            times: dict[str, Times] = {name: {} for name in variants}
            with busy_loops(load):
                for _ in range(rounds):
                    for name, (checkout, environment) in variants.items():
                        for kind, value in run_demo(checkout, folders[name], environment).items():
                            times[name].setdefault(kind, []).append(round(value, 2))
            rows.append({"busy_loops": load, "seconds": times})
            print(json.dumps(rows[-1]), flush=True)
    return rows


def table(record: dict[str, Any]) -> str:
    """Median, and the longest, seconds of the command and of the registration in it."""
    names = list(record["rows"][0]["seconds"])
    rows = [["busy loops", *(f"{kind}, {name}" for kind in ("command", "registration") for name in names)]]
    for row in record["rows"]:
        cells = [row["seconds"][name][kind] for kind in ("command", "registration") for name in names]
        rows.append([str(row["busy_loops"]), *(f"{statistics.median(cell):.1f} ({max(cell):.1f})" for cell in cells)])
    commits = ", ".join(f"{name} {value}" for name, value in record["commits"].items())
    runs = f"{record['rounds']} runs each, {record['cores']} cores, {record['date']}; {commits}."
    return "\n".join([*table_lines(rows), "", runs, ""])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, required=True, metavar="CHECKOUT", help="another checkout")
    parser.add_argument("--loads", type=int, nargs="+", default=[0, 1, 4], metavar="N", help="numbers of busy loops")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args(arguments)
    before = options.against.resolve()
    variants = {"before": (before, {}), "passive": (before, PASSIVE), "now": (REPOSITORY, {})}
    record = {
        "date": today(),
        "commits": {"before": commit(before), "now": commit()},
        "cores": os.cpu_count(),
        "rounds": options.rounds,
        "rows": measured(variants, options.loads, options.rounds),
    }
    write_json(options.out, record)
    print(table(record))
    if options.out == RESULT:
        update_page(PAGE, "load", table(record))


if __name__ == "__main__":
    main()
