"""Mutation test: change the package in one small place, run the tests of that place, see whether one of them notices.

    python scripts/mutate.py metrics geometry --sample 30     # go on where the last run stopped
    python scripts/mutate.py metrics --sample 30 --again      # survivors once more, after new tests
    python scripts/mutate.py metrics --list                   # what would be changed
    python scripts/mutate.py --table                          # the counts into CONTRIBUTING.md

One mutant (``mutants.py``) at a time, in a temporary copy; the first failing test kills it. Tests of a module: those of
the folder of its package (of a module beside the packages: files that have its name or import it), and its doctests;
not those marked slow or data. They run once as they are, under coverage; a mutant then meets those that run its line,
the quickest first, half a minute of them at most. The sample is drawn by a hash of the mutant and the seed, it stays
where the code does.

``scripts/results/mutation.json``: how many of a package's mutants were sampled and killed, and every survivor. A
``reason`` written there beside a survivor is kept: why no test can or need tell it from the original.
``mutation_by_hand.json`` beside it lists mutants that were placed by hand where gaps were suspected.
"""

import argparse
import hashlib
import importlib
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from coverage import Coverage, CoverageData
from mutants import Mutant, mutants_of
from scipy.stats import binomtest

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "scripts" / "results" / "mutation.json"
BY_HAND = RESULT.with_name("mutation_by_hand.json")
TABLE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- mutants:begin -->", "<!-- mutants:end -->"
PACKAGE = "curvireg_torch"
PRELOADED = ("torch", "numpy", "scipy.spatial", "kornia", "cv2", "trimesh", "sklearn.covariance", "skimage.feature")
PRELOADED += ("pytest",)
TOGETHER = {"terms": "matching", "matching": "terms", "commands": "cli"}  # what is tested with another
WALL_LIMIT_S = 400.0
ENOUGH_S = 30.0  # of tests for one mutant
LOG, SEEN, TIMES = "log.txt", "seen.db", "times.json"


def sample(mutants: Iterable[Mutant], count: int, seed: int) -> list[Mutant]:
    """``count`` of them (0: all), the choice of each depending on its own text alone; in the files' order."""

    def rank(mutant: Mutant) -> bytes:
        return hashlib.sha1(f"{seed} {mutant.key.rsplit(' in ', 1)[0]}".encode()).digest()

    chosen = sorted(mutants, key=rank)[: count or None]
    return sorted(chosen, key=lambda m: (m.path, m.start, m.text))


def snapshot(folder: Path) -> None:
    """What tests need of the repository as it is now."""
    for name in (PACKAGE, "tests", "scripts", "docs", "datasets"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, folder / name)


def files_of(copy: Path, package: str) -> list[str]:
    """Sources of a package or of a module."""
    folder = copy / PACKAGE / package
    paths = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
    return [p.relative_to(copy).as_posix() for p in paths if p.name != "__init__.py"]


def tests_of(copy: Path, path: str) -> list[str]:
    """Test files of a source."""
    parts = Path(path).with_suffix("").parts[1:]
    home, stem = copy.joinpath("tests", *parts[:-1]), parts[-1].strip("_")
    everywhere = sorted((copy / "tests").rglob("test_*.py"))
    module = rf"{PACKAGE}\.{re.escape('.'.join(parts))}\b"
    if len(parts) > 1:
        homes = {home, copy / "tests" / TOGETHER.get(parts[0], parts[0])}
        near = [p for p in everywhere if homes & set(p.parents)]
        module += rf"|{PACKAGE}\.{re.escape('.'.join(parts[:-1]))} import [^\n]*\b{parts[-1]}\b"
    else:
        module += rf"|{PACKAGE}\.{TOGETHER.get(stem, stem)}\b"
        near = [p for p in everywhere if p.parent == home and (stem in p.stem or re.search(module, p.read_text()))]
    near = near or [p for p in everywhere if re.search(module, p.read_text())]
    return [p.relative_to(copy).as_posix() for p in near]


class Times:
    """A plugin of pytest: seconds of CPU of each test function, all its cases and their fixtures together."""

    def __init__(self) -> None:
        self.seconds = defaultdict[str, float](float)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.seconds[nodeid.split("[")[0]] -= time.process_time()

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self.seconds[nodeid.split("[")[0]] += time.process_time()


@dataclass
class Course:
    """What ran in the tests of a package: test functions by line of each file, and their seconds."""

    lines: dict[str, dict[int, list[str]]]
    seconds: dict[str, float]

    def tests(self, mutant: Mutant) -> list[str]:
        """Functions that run the mutant's line, the quickest first; those that run its file, if that is at import."""
        lines = self.lines.get(mutant.path, {})
        at = max((line for line in lines if line <= mutant.line), default=0)
        names = {name for name in lines.get(at, []) if name} or {n for some in lines.values() for n in some if n}
        ids = {"{}.py::{}".format(*name.replace(".", "/").rsplit("/", 1)) for name in names}
        chosen = sorted(ids & self.seconds.keys(), key=lambda name: self.seconds[name])
        total = accumulate(self.seconds[name] for name in chosen)
        return [name for name, so_far in zip(chosen, total, strict=True) if so_far < ENOUGH_S]


def watched(copy: Path, tests: list[str]) -> Course:
    """The course of tests that pass."""
    if run_tests(copy, tests, cpu_s=None, watch=True)[0] != "survived":
        raise SystemExit(f"the tests fail by themselves:\n{(copy / LOG).read_text()}")
    data = CoverageData(str(copy / SEEN))
    data.read()
    lines = {Path(p).relative_to(copy).as_posix(): data.contexts_by_lineno(p) for p in data.measured_files()}
    for stale in (copy / PACKAGE).rglob("__pycache__"):
        shutil.rmtree(stale)
    return Course(lines, json.loads((copy / TIMES).read_text()))


def run_tests(copy: Path, tests: list[str], *, cpu_s: int | None, watch: bool = False) -> tuple[str, float]:
    """``survived``, ``killed`` or ``timeout``, and the seconds, of a forked process that runs tests in the copy."""
    start = time.monotonic()
    log = copy / LOG
    child = os.fork()
    if child == 0:  # torch and the like are imported already; the package is not
        os.setsid()
        os.chdir(copy)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        if cpu_s is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(copy))
        os.environ["PYTHONPATH"] = str(copy)
        import pytest

        seen = Coverage(data_file=str(copy / SEEN), include=[str(copy / PACKAGE / "*")], config_file=False)
        seen.set_option("run:dynamic_context", "test_function")
        code, times = 3, Times()
        if watch:
            seen.start()
        try:
            words = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow and not data"]
            code = pytest.main([*words, *tests], plugins=[times])
            if watch:
                seen.stop()
                seen.save()
                (copy / TIMES).write_text(json.dumps(times.seconds))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(code))
    while (status := os.waitpid(child, os.WNOHANG))[0] == 0:
        if cpu_s is not None and time.monotonic() - start > WALL_LIMIT_S:
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.02)
    seconds = time.monotonic() - start
    if os.WIFSIGNALED(status[1]):
        return "timeout", seconds
    code = os.WEXITSTATUS(status[1])
    if code not in (0, 1, 2, 5):  # 5: no tests
        raise SystemExit(f"pytest ended with {code}:\n{log.read_text()[-2000:]}")
    return ("survived" if code in (0, 5) else "killed"), seconds


def judged(copy: Path, mutants: list[Mutant]) -> Iterator[tuple[Mutant, str, float]]:
    """Each mutant with its outcome and the seconds."""
    files = sorted({path for mutant in mutants for path in tests_of(copy, mutant.path)})
    sources = sorted({mutant.path for mutant in mutants})
    course = watched(copy, [*files, *sources]) if mutants else Course({}, {})
    for mutant in mutants:
        tests, target = course.tests(mutant), copy / mutant.path
        source = target.read_bytes()
        target.write_bytes(mutant.apply(source))
        try:
            limit = int(3.0 * sum(course.seconds[name] for name in tests) + 20.0)
            outcome, seconds = run_tests(copy, [*tests, mutant.path], cpu_s=limit)
        finally:
            target.write_bytes(source)
        yield mutant, outcome, seconds


def stored() -> dict[str, Any]:
    return json.loads(RESULT.read_text()) if RESULT.exists() else {}


def store(package: str, mutants: int, chosen: list[Mutant], outcomes: dict[str, str]) -> dict[str, Any]:
    """Writes a package's row, keeping what others wrote meanwhile; returns it without its lists."""
    result = stored()
    reasons = {s["key"]: s["reason"] for s in result.get(package, {}).get("survivors", [])}
    alive = [m for m in chosen if outcomes.get(m.key) == "survived"]
    n = len(outcomes)
    row = {"mutants": mutants, "sampled": n, "killed": n - len(alive)}
    survivors = [{"key": m.key, "line": m.line, "reason": reasons.get(m.key, "")} for m in alive]
    result[package] = {**row, "survivors": survivors, "outcomes": outcomes}
    RESULT.write_text(json.dumps(dict(sorted(result.items())), indent=1, ensure_ascii=False) + "\n")
    return row


def share(killed: int, sampled: int) -> str:
    """The 95 % interval (Wilson's) of the share of all mutants that the tests notice, from a sample of them."""
    if sampled == 0:
        return "unknown"
    found = binomtest(killed, sampled).proportion_ci(method="wilson")
    return f"{100 * found.low:.0f} to {100 * found.high:.0f} %"


def table() -> str:
    """Markdown of what is stored: the counts, then the survivors, then what was placed by hand."""
    rows = [
        f"| {package} | {row['killed']} of {row['sampled']} tried, of {row['mutants']} possible | "
        f"{share(row['killed'], row['sampled'])} |"
        for package, row in stored().items()
    ]
    lines = ["| package | noticed | share of all, 95 % interval |", "| --- | --- | --- |", *rows, ""]
    for row in stored().values():
        for s in row["survivors"]:
            path, change = s["key"].split(" ", 1)
            before, after = change.rsplit(" #", 1)[0].split(": ", 1)[1].split(" -> ", 1)
            lines.append(f"- {path}, `{before}` to `{after}`: {s['reason'] or 'no test yet'}")
    by_hand = json.loads(BY_HAND.read_text())
    lines += ["", f"Placed by hand where gaps were suspected (`scripts/results/{BY_HAND.name}`): the tests notice"]
    lines += [
        f"{by_hand['killed']} of {by_hand['placed']}. This is no sample, and says nothing of the others.",
        "",
    ]
    lines += [f"- {s['file']}, `{s['before']}` to `{s['after']}`: {s['reason']}" for s in by_hand["survivors"]]
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("packages", nargs="*", help="metrics, geometry, cli, ...")
    parser.add_argument("--sample", type=int, default=30, help="mutants of each package; 0: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="files whose path holds this; the rest of the sample stays as it is")
    parser.add_argument("--again", action="store_true", help="run known survivors once more")
    parser.add_argument("--list", action="store_true", help="print the sample and run nothing")
    parser.add_argument("--table", action="store_true", help="write what is stored into CONTRIBUTING.md")
    options = parser.parse_args()
    if options.table:
        text = TABLE.read_text(encoding="utf-8")
        head, tail = text.split(BEGIN)[0], text.split(END)[1]
        TABLE.write_text(f"{head}{BEGIN}\n{table()}{END}{tail}", encoding="utf-8")
        return
    if not options.list:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        for name in PRELOADED:
            importlib.import_module(name)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy = Path(folder)
        snapshot(copy)
        for package in options.packages:
            sources = {path: (copy / path).read_bytes() for path in files_of(copy, package)}
            every = [m for path, source in sources.items() for m in mutants_of(path, source)]
            chosen = sample(every, options.sample, options.seed)
            changes = {m: f"{m.path}:{m.line} {m.kind}: {' -> '.join(m.diff(sources[m.path]))}" for m in chosen}
            if options.list:
                print(*changes.values(), sep="\n")
                continue
            old = stored().get(package, {}).get("outcomes", {})
            outcomes = {m.key: old[m.key] for m in chosen if m.key in old}
            wanted = (None, "survived") if options.again else (None,)
            open_ = [m for m in chosen if options.only in m.path and old.get(m.key) in wanted]
            for mutant, outcome, seconds in judged(copy, open_):
                outcomes[mutant.key] = outcome
                print(f"{outcome:8} {seconds:5.1f} s {changes[mutant]}", flush=True)
                store(package, len(every), chosen, outcomes)
            print(package, store(package, len(every), chosen, outcomes), flush=True)


if __name__ == "__main__":
    main()
