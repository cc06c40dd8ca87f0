"""Lists and datasets by several processes, and by runs that are killed.

Blocks of photographs are then others than in one undisturbed process, which changes rounding.
"""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from curvireg_torch.cli import main
from tests._support.lists import box_of, lines, table, write_files, written

REPOSITORY = Path(__file__).parents[2]
PYTHON = (sys.executable, "-m")

pytestmark = pytest.mark.slow


def run(words, **variables):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(
        [*PYTHON, "tests._support.small", *map(str, words)],
        env={**environment, **{name: str(value) for name, value in variables.items()}},
        cwd=REPOSITORY, capture_output=True, text=True, timeout=600,
    )  # fmt: skip


def evaluation(out):
    """Everything that an evaluation wrote, without times."""
    summary = json.loads((out / "summary.json").read_text())
    del summary["seconds"]
    rows = table(out, "predictions.csv")
    for row in rows:
        del row[{"seconds", "time"}.intersection(row).pop()]
    return summary, rows


def list_results(out):
    """Everything that a list wrote, without times."""
    rows = [
        {k: v for k, v in row.items() if k not in ("seconds", "revision")} for row in lines(out)
    ]
    return rows, table(out), (out / "index.html").read_text()


def agrees(value, other):
    """Whether two results are the same up to rounding: numbers, also as texts of a table."""
    if isinstance(value, dict):
        return [*value] == [*other] and all(agrees(value[key], other[key]) for key in value)
    if isinstance(value, list | tuple):
        return len(value) == len(other) and all(map(agrees, value, other))
    if value == other:
        return True
    if isinstance(value, str):
        try:
            numbers = [[float(word) for word in text.split()] for text in (value, other)]
        except ValueError:
            return False
        return agrees(*numbers)
    return isinstance(value, float) and math.isclose(value, other, rel_tol=1e-4, abs_tol=1e-6)


@pytest.fixture(params=["bop", "list"])
def case(request, tmp_path):
    """The words of a command without ``--out``, and a function that reads what it wrote."""
    if request.param != "list":
        root = request.getfixturevalue("bop").root
        (root / "test_targets_bop19.json").unlink()  # three objects with a box instead of one
        return ["evaluate", "bop", root], evaluation
    write_files(tmp_path)
    rows = [
        [f"photos/{seed}.png", *box_of(seed), mesh]
        for seed in range(3)
        for mesh in ("truck.ply", "other.ply")
    ]
    rows.append(["none.png", "", "", "", "", "truck.ply"])
    (tmp_path / "other.ply").write_bytes((tmp_path / "truck.ply").read_bytes())
    path = written(tmp_path / "list.csv", "photo,x0,y0,x1,y1,mesh", *rows)
    return ["register", "--list", path], list_results


@pytest.fixture
def expected(case, tmp_path):
    words, read = case
    assert main([*map(str, words), "--out", str(tmp_path / "one"), "--quiet"]) == 0
    return read(tmp_path / "one")


def test_killed_runs_continue(case, expected, tmp_path):
    words, read = case
    out = tmp_path / "killed"
    for write in (2, 2, 1):
        assert run([*words, "--out", out], CURVIREG_TEST_KILL=write).returncode == -signal.SIGKILL
        assert not (out / "summary.json").exists()
        assert not (out / "results.csv").exists()
    assert not (out / "results.jsonl").read_bytes().endswith(b"\n"), "a line was cut short"
    done = run([*words, "--out", out])
    assert done.returncode == 0, done.stderr
    assert agrees(read(out), expected)


def test_two_processes_give_the_same_results(case, expected, tmp_path):
    words, read = case
    out = tmp_path / "two"
    done = run([*words, "--jobs", "2", "--out", out])
    assert done.returncode == 0, done.stderr
    assert agrees(read(out), expected)
    assert done.stdout.count(f"see {out}") == 1, "one process reports"


@pytest.mark.parametrize("case", ["list"], indirect=True)
def test_rows_are_in_the_order_of_the_list_after_a_worker_was_killed(case, expected, tmp_path):
    """Its photographs are registered last."""
    words, read = case
    out = tmp_path / "lost"
    marker = tmp_path / "killed"
    done = run([*words, "--jobs", "2", "--out", out], CURVIREG_TEST_KILL_WORKER=marker)
    assert (done.returncode, marker.exists()) == (0, True), done.stderr
    assert agrees(read(out), expected)


@pytest.mark.parametrize(
    ("photos", "code"), [(["0.png", "1.png"], 3), (["none.png", "missing.png"], 2)]
)
def test_strict_ends_with_its_code_for_several_processes_too(tmp_path, photos, code):
    """Nothing is calibrated here, so that no result is reliable."""
    write_files(tmp_path)
    files = [tmp_path / "photos" / name for name in photos]
    files.append(tmp_path / "truck.safetensors")
    done = run(["register", *files, "--strict", "--jobs", "2", "--out", tmp_path / "out"])
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
    assert (tmp_path / "out" / "results.csv").is_file()
