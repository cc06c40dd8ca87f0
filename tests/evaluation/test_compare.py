"""Comparisons of two evaluations whose errors are known."""

import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from curvireg_torch.cli import main
from curvireg_torch.errors import MissingFileError
from curvireg_torch.evaluation import compare as module
from curvireg_torch.evaluation.compare import compare, in_words, read_run
from tests._support import refused
from tests._support.lists import written
from tests._support.miniature import write_json


def write_run(
    folder, errors, dataset="pascal3d", columns=("error_deg", "symmetric_error_deg"), **settings
):
    """Write a run with errors in degrees by key."""
    settings = {"dataset": dataset, "root": "set", "split": "val", "preset": "learned", **settings}
    summary = {"settings": settings, "protocol": "cad=annotated"}
    write_json(folder / "summary.json", summary)
    rows = [[key, "car", *([value] * len(columns))] for key, value in errors.items()]
    written(folder / "errors.csv", ",".join(("key", "group", *columns)), *rows)
    return folder


A = {"0": 5, "1": 12, "2": 40, "3": "inf", "4": 29.9, "5": 30, "6": 100, "7": 3, "only": 1}
B = {"0": 5, "1": 8, "2": 20, "3": 9, "4": 31, "5": 29, "6": 90, "7": 3, "new": 200}


@pytest.fixture
def runs(tmp_path):
    return write_run(tmp_path / "a", A), write_run(tmp_path / "b_2", B)


def test_pairs_are_counted_and_a_sign_test_is_made(runs):
    comparisons = {each.score: each for each in compare(*map(read_run, runs))}
    names = "acc_pi_6 acc_pi_18 symmetric_acc_pi_6 symmetric_acc_pi_18 med_err_deg"
    assert list(comparisons) == names.split()
    # below 30 degrees: A 0 1 4 7, B 0 1 2 3 5 7
    within = comparisons["acc_pi_6"]
    assert (within.n, within.a, within.b, within.difference) == (8, 0.5, 0.75, 0.25)
    assert (within.wins, within.losses) == (3, 1)
    assert within.p == pytest.approx(2 * binom.cdf(1, 4, 0.5))
    # Wilson, by hand
    z = 1.959964
    half = z * math.sqrt(0.25 / 8 + (z / 16) ** 2) / (1 + z * z / 8)
    assert within.a_interval == pytest.approx((0.5 - half, 0.5 + half), abs=1e-5)
    assert within.difference_interval[0] < 0.25 < within.difference_interval[1]
    # below 10 degrees: A 0 7, B 0 1 3 7
    assert (comparisons["acc_pi_18"].wins, comparisons["acc_pi_18"].losses) == (2, 0)
    assert comparisons["acc_pi_18"].p == 0.5
    median = comparisons["med_err_deg"]
    assert (median.a, median.b) == (np.median([5, 12, 40, np.inf, 29.9, 30, 100, 3]), 14.5)
    assert (median.wins, median.losses) == (5, 1)
    assert median.b_interval[0] <= 14.5 <= median.b_interval[1]


def test_a_run_equals_itself(runs):
    run = read_run(runs[0])
    for each in compare(run, run):
        assert (each.difference, each.wins, each.losses, each.p) == (0.0, 0, 0, 1.0)
        assert each.difference_interval == (0.0, 0.0)


def test_the_medians_of_two_runs_with_as_many_failures_as_poses_differ_by_nothing(tmp_path):
    errors = {str(k): "inf" if k < 5 else 5 for k in range(9)}
    median = compare(*(read_run(write_run(tmp_path / name, errors)) for name in "ab"))[-1]
    assert (median.a, median.difference, median.difference_interval) == (math.inf, 0.0, (0.0, 0.0))


def test_intervals_of_many_objects_are_narrow_and_hold_the_truth(tmp_path):
    """Of 1000 objects, about 600 and 700 are right: the standard error of the difference is
    0.02."""
    draw = np.random.default_rng(5)
    pair = []
    for share in (0.6, 0.7):
        errors = {str(k): 5.0 if draw.random() < share else 90.0 for k in range(1000)}
        run = write_run(tmp_path / str(share), errors, "web", ("error_deg",))
        pair.append(read_run(run))
    each = compare(*pair)[0]
    low, high = each.difference_interval
    assert 0.07 < high - low < 0.1
    assert low < each.difference < high
    assert each.p < 1e-4


def test_resamples_are_drawn_in_parts_whose_size_changes_nothing(runs, monkeypatch):
    pair = list(map(read_run, runs))
    expected = compare(*pair)
    for at_once in (1, 8 * 7):
        monkeypatch.setattr(module, "DRAWN_AT_ONCE", at_once)
        assert compare(*pair) == expected
    monkeypatch.undo()
    errors = {str(k): {"error_deg": k, "symmetric_error_deg": k} for k in range(1000)}
    many = replace(pair[0], errors=errors)
    tracemalloc.start()
    compare(many, many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * module.RESAMPLES * len(errors)  # bytes: less than all resamples hold


def test_average_recalls_of_bop_are_compared_by_object(tmp_path):
    columns = ("rotation", "add", "mssd", "mspd")
    first = write_run(tmp_path / "a", {"0": 0.26, "1": 0.04, "2": "inf"}, "bop", columns)
    second = write_run(tmp_path / "b", {"0": 0.21, "1": 0.04, "2": 0.6}, "bop", columns)
    found = {each.score: each for each in compare(read_run(first), read_run(second))}
    names = "acc_15_deg acc_30_deg add_recall_0.1d mssd_ar mspd_ar med_err_deg"
    assert list(found) == names.split()
    recall = found["mssd_ar"]  # thresholds 0.05 to 0.5
    assert (recall.a, recall.b) == pytest.approx(((0.5 + 1.0) / 3, (0.6 + 1.0) / 3))
    assert (recall.wins, recall.losses) == (1, 0)


def test_objects_of_unknown_pose_do_not_count(tmp_path):
    first, second = (
        read_run(write_run(tmp_path / name, errors, "web", ("error_deg",)))
        for name, errors in (("a", {"0": 5, "1": ""}), ("b", {"0": "", "1": 5}))
    )
    assert {each.n for each in compare(first, first)} == {1}
    for each in compare(first, second):
        assert (each.n, math.isnan(each.a)) == (0, True)


def test_keys_are_those_of_the_results(tmp_path):
    run = read_run(write_run(tmp_path, {"'-cup/0": 5, "'=cup/0": 5, "'tis/0": 5}))
    assert list(run.errors) == ["-cup/0", "=cup/0", "'tis/0"]


def test_the_command_prints_rows_for_tables(runs, capsys):
    assert main(["compare", *map(str, runs)]) == 0
    printed = capsys.readouterr().out
    assert "8 objects in both; 1 only in A and 1 only in B do not count" in printed
    assert "acc_pi_6: A 0.500 [0.215, 0.785]   B 0.750 [0.409, 0.929]   B - A +0.250 [" in printed
    assert "B wins 3, loses 1, p 0.62" in printed
    assert "| a | 8 | 0.500 [0.215, 0.785] | 0.250 [" in printed
    assert "b\\_2 & 8 & 0.750 [0.409, 0.929] & 0.500 [" in printed
    assert printed.count(" \\\\\n") == 3
    write_run(runs[0], A, pipeline={"bins": 9, "box_jitter": 0.1})
    write_run(runs[1], B, models="models_cad", pipeline={"bins": 9, "box_jitter": 0.0})
    assert main(["compare", *map(str, runs)]) == 0
    printed = capsys.readouterr().out
    first, second, *_ = printed.splitlines()
    how = "preset learned, cad=annotated"
    assert first.endswith(f"a: {how}, pipeline.box_jitter=0.1")
    assert second.endswith(f"b_2: {how}, models=models_cad, pipeline.box_jitter=0.0")
    pair = [read_run(run) for run in runs]
    assert printed == in_words(*pair, compare(*pair))
    assert main(["compare", *map(str, runs), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["comparisons"][0]["wins"] == 3


def test_runs_that_cannot_be_compared_are_refused(runs, tmp_path):
    first = read_run(runs[0])
    for name, other in {"root": "other", "split": "test", "dataset": "web"}.items():
        other = read_run(write_run(tmp_path / name, A, **{name: other}))
        with refused(f"the {name} of one run is .*; give two runs of the same"):
            compare(first, other)
    with refused("no object in common"):
        compare(first, read_run(write_run(tmp_path / "none", {"x": 1})))
    with refused("no column symmetric_error_deg"):
        compare(first, read_run(write_run(tmp_path / "short", A, columns=("error_deg",))))
    with refused(r"summary\.json: no such file", MissingFileError):
        read_run(tmp_path)
    (runs[0] / "errors.csv").write_text("key,group,error_deg\n0,car,many\n")
    with refused(r"errors\.csv: damaged"):
        read_run(runs[0])
    (runs[0] / "errors.csv").unlink()
    with refused(r"errors\.csv: no such file.*curvireg evaluate", MissingFileError):
        read_run(runs[0])
    (runs[0] / "summary.json").write_text("{}")
    with refused("not of an evaluation"):
        read_run(runs[0])
