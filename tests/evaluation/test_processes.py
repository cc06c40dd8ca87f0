"""Several processes, and processes that die."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from curvireg_torch.data import BOPDataset
from curvireg_torch.evaluation import Benchmark, BOPBenchmark, Pascal3DBenchmark, Protocol, evaluate

REPOSITORY = Path(__file__).parents[2]


def start(*words, launcher=(sys.executable, "-m"), kill=None):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    if kill is not None:
        environment["CURVIREG_TEST_KILL"] = str(kill)
    return subprocess.run(
        [*launcher, "tests.evaluation.small", *map(str, words), "--quiet"],
        env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


def results(out):
    """Everything that was written, without timings."""
    summary = json.loads((out / "summary.json").read_text())
    del summary["seconds"]
    text = (out / "predictions.csv").read_text()
    with open(out / "predictions.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        del row[{"seconds", "time"}.intersection(row).pop()]
    return summary, rows, text.count("\n")


@pytest.mark.slow
def test_killed_and_started_again(pascal, tmp_path):
    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "whole", progress=False)
    words = ("pascal3d", pascal.root, "--out", tmp_path / "killed")
    for kill in (1, 3, 5):  # at its settings, at the second prediction, at predictions.csv
        assert start(*words, kill=kill).returncode == -signal.SIGKILL
        assert not (tmp_path / "killed" / "predictions.csv").exists()
    done = start(*words)
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "killed") == results(tmp_path / "whole")
    assert len(list((tmp_path / "killed" / "predictions").glob("*.json"))) == 6, "five objects and the settings"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pascal3d", "bop"])
def test_two_processes_do_the_same_as_one(request, tmp_path, kind):
    dataset = request.getfixturevalue(kind.removesuffix("3d"))
    if kind == "bop":
        alone: Benchmark = BOPBenchmark(BOPDataset(dataset.root), Protocol(pose="any"))
    else:
        alone = Pascal3DBenchmark(dataset, Protocol())
    evaluate(alone, tmp_path / "one", progress=False)
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
    two = start(kind, dataset.root, "--out", tmp_path / "two", launcher=torchrun)
    assert two.returncode == 0, two.stderr
    assert results(tmp_path / "two") == results(tmp_path / "one")
    assert two.stdout.count("protocol:") == 1, "one process reports"
