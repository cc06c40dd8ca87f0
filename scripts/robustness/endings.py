"""End runs of a list at random moments: no row is lost or comes twice, and no process stays.

    python scripts/robustness/endings.py [--count 30] [--seed 0]

Each run of ``curvireg register --list``, with and without workers in turn, gets SIGKILL, SIGTERM,
SIGINT or SIGHUP at a random moment. Then no process of its session may be left, and whoever reads
its output must come to the end. The next run goes on in the same folder; one that comes to its end
must have each row once, in the order of the list and with the same poses as an undisturbed run, and
the next begins anew. The record is scripts/results/endings.json; exit code 1 if anything failed.
Linux.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from curvireg_torch import ViewBank, sample_views
from curvireg_torch.synthetic import demo_scene
from curvireg_torch.visualization.encoding import png, to_uint8
from scripts._shared import RESULTS, commit, today, write_json

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
PHOTOGRAPHS = 12
SECONDS_TO_END = 60.0  # after a signal, on a busy machine
SECONDS_OF_A_RUN = 600.0


def write_list(folder: Path) -> list[str]:
    """Write photographs, a small bank and their list; returns the words of the command."""
    scene = demo_scene(0)
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    ViewBank.build(scene.mesh, views, image_size=64, progress=False).save(
        folder / "mesh.safetensors"
    )
    rows = ["photo,x0,y0,x1,y1"]
    for seed in range(PHOTOGRAPHS):
        scene = demo_scene(seed)
        (folder / f"{seed}.png").write_bytes(png(to_uint8(scene.image)))
        rows.append(",".join([f"{seed}.png", *(f"{v:.1f}" for v in scene.box.tolist())]))
    (folder / "photos.csv").write_text("\n".join([*rows, ""]))
    words = ["register", "--list", folder / "photos.csv", folder / "mesh.safetensors"]
    return [*map(str, words), "--no-refine", "--quiet"]


def rows_of(out: Path) -> list[dict[str, Any]]:
    """The complete rows in a folder."""
    path = out / "results.jsonl"
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith(b"\n")]


def poses(out: Path) -> list[Any]:
    """Photograph and pose of each row of a run that came to its end."""
    return [(row["columns"]["photo"], row["rotation"]) for row in rows_of(out)]


def processes_of(session: int) -> list[str]:
    """Commands of the processes of a session that are running."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            state, *fields = (path / "stat").read_text().rpartition(")")[2].split()
            if int(fields[2]) == session and state != "Z":
                found.append((path / "cmdline").read_text().replace("\0", " ")[:120])
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            continue
    return found


def run(words: list[str], number: int | None, seconds: float) -> tuple[int, float, str]:
    """Run a command, which gets a signal after ``seconds`` if it has not ended; returns its code,
    its seconds, and what is wrong with its end."""
    begun = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "curvireg_torch", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        printed, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(number or signal.SIGKILL)
        try:
            printed, _ = process.communicate(timeout=SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            left = processes_of(process.pid)
            os.killpg(process.pid, signal.SIGKILL)
            return 0, time.monotonic() - begun, f"its pipe stays open: {left}"
    ended = time.monotonic()
    while (left := processes_of(process.pid)) and time.monotonic() < ended + SECONDS_TO_END:
        time.sleep(0.1)
    wrong = f"left behind: {left}" if left else ""
    if b"Traceback" in printed:
        wrong = printed.decode(errors="replace")[-2000:]
    return process.returncode, ended - begun, wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=30, help="signals (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)
    failures: list[str] = []
    tally = {"signals": 0, "ended_before": 0, "completed": 0}
    with tempfile.TemporaryDirectory() as folder:
        words = write_list(Path(folder))
        out = Path(folder, "undisturbed")
        code, seconds, wrong = run([*words, "--out", str(out)], None, SECONDS_OF_A_RUN)
        assert (code, wrong) == (0, ""), (code, wrong)
        expected = poses(out)
        took = {1: seconds, 2: seconds}
        count = 0
        out = Path(folder, "0")
        while tally["signals"] < arguments.count:
            jobs = 1 + count % 2
            number = SIGNALS[count // 2 % len(SIGNALS)]
            count += 1
            known = {row["key"] for row in rows_of(out)}
            moment = moments.uniform(0.0, took[jobs])
            command = [*words, "--jobs", str(jobs), "--out", str(out)]
            code, seconds, wrong = run(command, number, moment)
            label = f"{number.name} after {moment:.1f} s, --jobs {jobs}"
            keys = [row["key"] for row in rows_of(out)]
            lost = known - {*keys}
            if wrong or lost or len(keys) != len({*keys}):
                failures.append(f"{label}: code {code}, {len(lost)} rows lost; {wrong}")
            print(f"{label}: code {code}, {len(keys)} rows {wrong}", flush=True)
            if code == 0:
                tally["ended_before"] += 1
                took[jobs] = max(took[jobs], 1.5 * seconds)
            else:
                tally["signals"] += 1
            if code == 0 or tally["signals"] == arguments.count or len(keys) == PHOTOGRAPHS:
                code, _, wrong = run([*words, "--out", str(out)], None, SECONDS_OF_A_RUN)
                tally["completed"] += 1
                if (code, wrong) != (0, "") or poses(out) != expected:
                    failures.append(f"{label}, then to the end: code {code}; other rows; {wrong}")
                out = Path(folder, str(count))
    record = {"date": today(), "commit": commit(), **vars(arguments), **tally, "failures": failures}
    write_json(RESULTS / "endings.json", record)
    print(json.dumps(record, indent=2))
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
