"""Feed broken files to every reader: each must end in a result or in one of our errors, within time and memory limits.

    python scripts/robustness/fuzz.py                                  the 100,000 inputs of the record
    python scripts/robustness/fuzz.py --inputs 1000 --out fuzz.json    a shorter run with its own record

Batches run in separate processes, so that a stuck or killed batch does not stop the run. The report is written after
each batch, and an interrupted run can be resumed. ``scripts/results/fuzz.json`` is the record, and SECURITY.md has its
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from curvireg_torch.errors import CurviregError
from curvireg_torch.geometry import camera_matrix, crop_images, pose_from_box, square_boxes
from curvireg_torch.geometry.crops import check_boxes
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.terms import crop_regions, jittered_boxes
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page
from scripts.robustness.fuzz_inputs import INPUTS

RESULT = RESULTS / "fuzz.json"
DOCUMENT = REPOSITORY / "SECURITY.md"
FRACTIONS = {"images": 0.3, "meshes": 0.35, "mat": 0.1, "tables": 0.1, "banks": 0.05, "boxes": 0.05, "cameras": 0.05}
BATCH = 5000
SECONDS = 20.0  # for one input
MEGABYTES = 3000  # for a process, libraries included

VALUES = st.floats(width=32) | st.sampled_from([-0.5, 0.0, 1e-30, 63.5, 47.5, 1e9, -1e9, 1e30, float("nan")])
FOUR = st.lists(VALUES, min_size=4, max_size=4)
PLAUSIBLE = st.tuples(st.floats(-5, 60), st.floats(-5, 45), st.floats(0.01, 200), st.floats(0.01, 200))
BOXES = FOUR | PLAUSIBLE.map(lambda b: [b[0], b[1], b[0] + b[2], b[1] + b[3]])
IMAGE = torch.linspace(0, 1, 3 * 48 * 64).view(3, 48, 64)


def check_box(values: list[float], sides: tuple[int, int], margin: float) -> None:
    box, image = torch.tensor([values]), IMAGE[:, : sides[0], : sides[1]]
    crops, A = crop_images([image], box, size=16, margin=abs(margin) % 4)
    assert bool(crops.isfinite().all())
    assert bool(A.isfinite().all())
    assert bool((crops >= -1e-3).all() and (crops <= 1.001).all())
    regions = crop_regions([image], jittered_boxes(box, 0.1), size=16, margin=0.1)
    assert bool(regions.isfinite().all())
    square_boxes(box, 0.1)


def check_camera(values: list[float], box: list[float]) -> None:
    K = camera_matrix(*values, dtype=torch.float64)
    corners = extreme_points(trimesh.creation.box((0.1, 0.2, 0.3)))
    boxes = torch.tensor(box, dtype=torch.float64)
    check_boxes(boxes[None], [(48, 64)])
    R, t = pose_from_box(corners, torch.eye(3, dtype=torch.float64), boxes, K)
    assert bool(R.isfinite().all() and t.isfinite().all())
    assert bool(
        pose_from_box(corners, torch.eye(3, dtype=torch.float64), boxes, K, allocentric=False)[1].isfinite().all()
    )


EXAMPLES: dict[str, tuple[Callable[..., None], Any]] = {
    "boxes": (check_box, st.tuples(BOXES, st.tuples(st.integers(1, 48), st.integers(1, 64)), VALUES)),
    "cameras": (check_camera, st.tuples(FOUR, BOXES)),
}
"""Checks of numbers instead of files; hypothesis finds the numbers."""


def run_examples(kind: str, number: int, count: int) -> int:
    """Run up to ``count`` examples of ``EXAMPLES[kind]`` with seed ``number``; returns how many hypothesis found."""
    check, strategy = EXAMPLES[kind]
    tried = 0

    @seed(number)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(strategy)
    def examples(values: tuple[Any, ...]) -> None:
        nonlocal tried
        tried += 1
        try:
            check(*values)
        except CurviregError:
            return

    examples()
    return tried


def attack(kind: str, number: int, folder: Path) -> str:
    """Read input ``number`` of ``kind``; returns "result" or the name of our error, and raises anything else."""
    try:
        INPUTS[kind](np.random.default_rng([number, list(INPUTS).index(kind)]), folder)
    except CurviregError as error:
        text = str(error)
        assert text, "an error without a message"
        assert len(text.splitlines()) == 1, f"a message of several lines: {text!r}"
        return type(error).__name__
    return "result"


def worker(kind: str, start: int, count: int, folder: Path) -> None:
    """Process inputs ``start`` to ``start + count``; prints a JSON line before each input and one for the batch."""
    warnings.simplefilter("ignore")
    outcomes: Counter[str] = Counter()
    failures, slowest = [], 0.0
    for number in [start] if kind in EXAMPLES else range(start, start + count):
        print(json.dumps({"at": number}), flush=True)
        begin = time.perf_counter()
        try:
            if kind in EXAMPLES:
                count = run_examples(kind, start, count)
                outcomes["result or our error"] = count
            else:
                outcomes[attack(kind, number, folder)] += 1
        except Exception:
            outcomes["failure"] += 1
            failures.append(f"{kind} {number}: {traceback.format_exc(limit=-4)}")
        slowest = max(slowest, time.perf_counter() - begin)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    slowest = slowest / count if kind in EXAMPLES else slowest
    report = {"tried": count, "outcomes": outcomes, "slowest": slowest, "failures": failures, "peak_mb": peak}
    print(json.dumps(report), flush=True)


def run(kind: str, start: int, count: int) -> dict[str, Any]:
    """Run one batch in a process; if the process dies, the report names the input that killed it."""
    command = [sys.executable, "-m", "scripts.robustness.fuzz", "--worker", kind, str(start), str(count)]
    limit = 60.0 + 0.1 * count + SECONDS
    options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "cwd": REPOSITORY}
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run([*command, folder], timeout=limit, **options)
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
    parser.add_argument("--kinds", nargs="+", choices=FRACTIONS, default=list(FRACTIONS))
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
        total = report["kinds"].setdefault(kind, fresh)
        while (remaining := round(arguments.inputs * FRACTIONS[kind]) - total["tried"]) > 0:
            begin = time.perf_counter()
            batch = run(kind, total["tried"], min(BATCH, remaining))
            total["tried"] += batch["tried"]
            total["seconds"] = round(total["seconds"] + time.perf_counter() - begin, 1)
            total["outcomes"] = dict(Counter(total["outcomes"]) + Counter(batch["outcomes"]))
            total["slowest_s"] = round(max(total["slowest_s"], batch["slowest"]), 3)
            total["peak_mb"] = round(max(total["peak_mb"], batch["peak_mb"]), 1)
            total["failures"] += batch["failures"]
            total |= {"date": today(), "commit": here}
            report["inputs"] = sum(k["tried"] for k in report["kinds"].values())
            report["failures"] = sum(len(k["failures"]) for k in report["kinds"].values())
            temporary = arguments.out.with_suffix(".tmp")
            temporary.write_text(json.dumps(report, indent=1) + "\n")
            os.replace(temporary, arguments.out)
        print(f"{kind}: {json.dumps({**total, 'failures': len(total['failures'])})}")
    if arguments.out == RESULT:
        update_page(DOCUMENT, "fuzz", table(report))
    return 1 if report["failures"] else 0


def table(report: dict[str, Any]) -> str:
    rows = [["of", "inputs", "s", "slowest, s", "peak, MB", "failures", "day, commit"]]
    for kind, total in report["kinds"].items():
        times = [f"{total['seconds']:.0f}", f"{total['slowest_s']:.1f}", f"{total['peak_mb']:.0f}"]
        rows.append(
            [kind, f"{total['tried']:,}", *times, str(len(total["failures"])), f"{total['date']}, {total['commit']}"]
        )
    return "\n".join([*table_lines(rows), ""])


if __name__ == "__main__":
    sys.exit(main())
