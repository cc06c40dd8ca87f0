"""End runs of a list at random moments: no row is lost or comes twice, and no process stays.

    python scripts/robustness/endings.py [--count 30] [--seed 0]

Each run of ``curvireg register --list``, with and without workers, gets SIGKILL, SIGTERM, SIGINT or
SIGHUP at a random moment before its first row is on disk, between two rows, or after the last one.
Runs of the last two kinds are forked from this process, which has imported all modules and computed
nothing: on a busy machine, to import them takes longer than the rows.
Then no process of its session may be left, and whoever reads its output must come to the end. The
next run goes on in the same folder; once all rows are there, one that is not disturbed must have
each row once, in the order of the list and with the poses of an undisturbed run, and the next
begins anew. The record is scripts/results/endings.json; exit code 1 if anything failed. Linux.
"""

import argparse
import itertools
import json
import os
import random
import select
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import curvireg_torch.cli.register
import curvireg_torch.jobs.lists
import curvireg_torch.jobs.opening  # noqa: F401
from curvireg_torch import ViewBank, sample_views
from curvireg_torch.__main__ import main as command_line
from curvireg_torch.synthetic import demo_scene
from curvireg_torch.visualization.encoding import png, to_uint8
from scripts._shared import RESULTS, commit, today, write_json

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
PHASES = ("before", "between", "after")  # rows
PHOTOGRAPHS = 12
SECONDS_TO_END = 300.0  # after a signal, on a busy machine
ROUNDING = 1e-5  # of rotations in blocks of other sizes


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


def agree(out: Path, other: Path) -> bool:
    """Whether two finished runs have the same photographs in the same order, and the same poses."""
    rows = rows_of(out)
    others = rows_of(other)
    names = [[row["columns"]["photo"] for row in some] for some in (rows, others)]
    if names[0] != names[1]:
        return False
    values = [
        [v for row in some for line in row["rotation"] for v in line] for some in (rows, others)
    ]
    return all(abs(a - b) < ROUNDING for a, b in zip(*values, strict=True))


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


class Moment(NamedTuple):
    """When a run gets its signal: so many seconds after its folder has so many rows."""

    rows: int
    seconds: float


class Process:
    """A run of the command in a session of its own: a new process, or a fork of this one."""

    def __init__(self, words: list[str], *, is_forked: bool) -> None:
        self.output, writer = os.pipe()
        self.code: int | None = None
        if is_forked:
            self.pid = os.fork()
            if not self.pid:
                _become(words, writer)
        else:
            command = [sys.executable, "-m", "curvireg_torch", *words]
            streams = [(os.POSIX_SPAWN_DUP2, writer, stream) for stream in (1, 2)]
            self.pid = os.posix_spawn(
                sys.executable, command, os.environ, file_actions=streams, setsid=True
            )
        os.close(writer)

    def poll(self) -> int | None:
        """The code, if the process has ended."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if pid else None
        return self.code

    def read_to_end(self, seconds: float) -> bytes | None:
        """All that it and its workers print; None if they do not end within so many seconds."""
        end = time.monotonic() + seconds
        printed = b""
        while select.select([self.output], [], [], max(end - time.monotonic(), 0.0))[0]:
            some = os.read(self.output, 65536)
            if not some:
                os.close(self.output)
                return printed
            printed += some
        return None


def _become(words: list[str], writer: int) -> NoReturn:
    """Be ``python -m curvireg_torch``."""
    code = 70
    try:
        os.setsid()
        os.dup2(writer, 1)
        os.dup2(writer, 2)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
        sys.argv = ["curvireg", *words]
        code = command_line()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # of the command: it is printed, as Python would
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


class Ended(NamedTuple):
    """A run: its code, the phase in which it got its signal, if it did, and what was wrong with its
    end; the seconds until its first row, its last one, and its end."""

    code: int
    phase: str
    wrong: str
    seconds: tuple[float, float, float]


def run(
    words: list[str],
    out: Path,
    number: int = 0,
    moment: Moment | None = None,
    *,
    is_forked: bool = True,
) -> Ended:
    """Run a command, which gets a signal at a moment, if it has not ended before."""
    known = len(rows_of(out))
    path = out / "results.jsonl"
    begun = time.monotonic()
    process = Process([*words, "--out", str(out)], is_forked=is_forked)
    first = last = reached = 0.0
    phase = ""
    while process.poll() is None:
        now = time.monotonic()
        count = path.read_bytes().count(b"\n") if path.exists() else 0
        if count > known and not first:
            first = now - begun
        if count == PHOTOGRAPHS and not last:
            last = now - begun
        if moment is not None and count >= moment.rows and not reached:
            reached = now
        if moment is not None and reached and now >= reached + moment.seconds:
            os.kill(process.pid, number)
            phase = "before" if count == known else "after" if count == PHOTOGRAPHS else "between"
            break
        time.sleep(0.005)
    printed = process.read_to_end(SECONDS_TO_END)
    if printed is None:
        left = processes_of(process.pid)
        os.killpg(process.pid, signal.SIGKILL)
        return Ended(-1, phase, f"its pipe stays open: {left}", (first, last, 0.0))
    ended = time.monotonic()
    while (left := processes_of(process.pid)) and time.monotonic() < ended + SECONDS_TO_END:
        time.sleep(0.1)
    wrong = f"left behind: {left}" if left else ""
    if b"Traceback" in printed:
        wrong = printed.decode(errors="replace")[-2000:]
    while process.poll() is None:
        time.sleep(0.01)
    return Ended(process.code or 0, phase, wrong, (first, last, ended - begun))


def moment_in(
    phase: str, known: int, took: tuple[float, float, float, float], chance: random.Random
) -> Moment:
    """A random moment of a run that begins with so many rows; ``took`` are the seconds until the
    first row of a new process, and, of a fork, until its first row, its last one and its end."""
    begin, first, last, end = took
    if phase == "before":
        return Moment(0, chance.uniform(0.0, begin))
    if phase == "after":
        return Moment(PHOTOGRAPHS, chance.uniform(0.0, end - last))
    row = (last - first) / PHOTOGRAPHS
    return Moment(chance.randint(known + 1, PHOTOGRAPHS - 1), chance.uniform(0.0, row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=30, help="signals (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    arguments = parser.parse_args()
    # a shell's jobs in the background ignore these
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    chance = random.Random(arguments.seed)
    kinds = list(itertools.product(PHASES, SIGNALS, (1, 2)))
    chance.shuffle(kinds)
    failures: list[str] = []
    phases: Counter[str] = Counter()
    completed = 0
    with tempfile.TemporaryDirectory() as folder:
        with ProcessPoolExecutor(1, get_context("spawn")) as executor:
            words = executor.submit(write_list, Path(folder)).result()
        commands = {jobs: [*words, "--jobs", str(jobs)] for jobs in (1, 2)}
        undisturbed = {jobs: Path(folder, f"undisturbed-{jobs}") for jobs in (1, 2)}
        begin, _, _ = run(words, Path(folder, "new"), is_forked=False).seconds
        took = {}
        for jobs, command in commands.items():
            done = run(command, undisturbed[jobs])
            assert (done.code, done.wrong) == (0, ""), done
            took[jobs] = (begin, *done.seconds)
        assert agree(undisturbed[2], undisturbed[1]), "other rows by workers"
        out = Path(folder, "0")
        for count, (phase, number, jobs) in enumerate(itertools.cycle(kinds)):
            known = {row["key"] for row in rows_of(out)}
            moment = moment_in(phase, len(known), took[jobs], chance)
            done = run(commands[jobs], out, number, moment, is_forked=phase != "before")
            reached = done.phase if done.code else "ended before"
            label = f"{number.name} {reached}, --jobs {jobs}"
            keys = [row["key"] for row in rows_of(out)]
            lost = known - {*keys}
            if done.wrong or lost or len(keys) != len({*keys}):
                failures.append(f"{label}: code {done.code}, {len(lost)} rows lost; {done.wrong}")
            print(f"{label}: code {done.code}, {len(keys)} rows {done.wrong}", flush=True)
            phases[reached] += 1
            signals = sum(phases[name] for name in PHASES)
            if len(keys) >= PHOTOGRAPHS - 1 or signals == arguments.count:
                done = run(words, out)
                completed += 1
                if (done.code, done.wrong) != (0, "") or not agree(out, undisturbed[1]):
                    failures.append(f"{label}, then to the end: {done}; other rows?")
                out = Path(folder, str(count + 1))
            if signals == arguments.count:
                break
    tally = {"signals": signals, **phases, "completed": completed, "failures": failures}
    record = {"date": today(), "commit": commit(), **vars(arguments), **tally}
    write_json(RESULTS / "endings.json", record)
    print(json.dumps(record, indent=2))
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
