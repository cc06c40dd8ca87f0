"""scripts/speed: times of the pipeline, recall without a box, and the tables of the documentation."""

import json
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from curvireg_torch import Pipeline, Registrar, ViewMatcher
from curvireg_torch.pipeline import BankSettings, ViewPolicy
from scripts.speed import filters, load, paired, pipeline
from tests._support.pretended import PRETENDING, pretended_gpu
from tests._support.scenes import scene, truck_bank

for name in ("sklearn", "matplotlib"):
    pytest.importorskip(name, reason=f"{name} is not installed")
from scripts.speed import location  # noqa: E402

PIPELINE_RECORD = pipeline.RESULTS / "bench_pipeline.json"


def test_over_products_is_positive():
    image, box, _ = scene(0)
    assert pipeline.over_products(ViewMatcher(truck_bank()), [image], box[None]) > 0.0


@pytest.mark.parametrize("on_gpu", [False, pytest.param(True, marks=[*PRETENDING, pytest.mark.slow])])
def test_pipeline_times_are_of_the_device(on_gpu, monkeypatch):
    few = replace(Pipeline(), search=False, contours=False)  # tests/test_device.py covers these
    few = replace(few, views=ViewPolicy(directions=4, theta_step=180.0), bank=BankSettings(image_size=64))
    on = pretended_gpu() if on_gpu else nullcontext(torch.device("cpu"))
    used = []
    monkeypatch.setattr(pipeline, "seconds", lambda call, *_: pipeline.timed(call, 1)[0])
    monkeypatch.setattr(pipeline, "Registrar", lambda bank, **o: used.append(bank.device.type) or Registrar(bank, **o))
    with on as device:
        times = pipeline.pipeline_times(pipeline.dented_sphere(200), few, 1, str(device))
    assert set(times) == set(json.loads(PIPELINE_RECORD.read_text())["times"])
    assert all(value > 0.0 for value in times.values())
    assert used[-2:] == [device.type] * 2  # the earlier banks are read from disk


def test_paired_steps_keep_the_least_of_each_checkout(tmp_path, monkeypatch, capsys):
    """Megabytes rise with each call, seconds fall; the earlier checkout takes twice as long."""
    calls = []

    def measured(step, checkout, *others):
        calls.append((step, checkout.name, others[1].name))
        return {"seconds": (2.0 if checkout == tmp_path else 1.0) / len(calls), "megabytes": float(len(calls))}

    monkeypatch.setattr(paired, "measured", measured)
    monkeypatch.setattr(paired, "run", lambda *inputs: (inputs[2] / "case.json").write_text('{"faces": 9}'))
    out = tmp_path / "paired.json"
    words = ["--faces", "1", "9", "--megapixels", "0.3", "2", "--rounds", "2", "--out", str(out)]
    paired.main(["--against", str(tmp_path), *words])
    record = json.loads(out.read_text())
    assert [(case["faces"], case["megapixels"]) for case in record["cases"]] == [(9, 0.3), (9, 0.3), (9, 2.0)]
    assert calls[:2] == [("one", tmp_path.name, "before"), ("one", paired.ROOT.name, "now")]
    assert calls[2:4] == [("cold", tmp_path.name, "before"), ("cold", paired.ROOT.name, "now")]
    first = record["cases"][0]
    assert first["now"]["cold"] == {"seconds": 1.0 / 17, "megabytes": 4.0}
    assert first["before"]["cold"] == {"seconds": 2.0 / 16, "megabytes": 3.0}
    table = capsys.readouterr().out
    assert "| 9 | 0.3 | `cold` | 0.12 s, 3 MB | 0.06 s, 4 MB | 0.47 |" in table
    assert "| 9 | 0.3 | `follow` | - | 0.04 s, 15 MB | - |" in table  # the earlier checkout has no Follower


def row(number, *, right, preset="learned", linemod=False):
    """The right one of three proposals has the highest score; those without the object score lower."""
    overlaps = [0.6 if k == right else 0.1 for k in range(3)]
    evidence = [[9.0 if k == right else 6.0 + 0.01 * number, 0.7] for k in range(3)]
    absent = {"overlaps": [0.0] * 3, "evidence": [[5.0 + 0.1 * (number % 7), 0.6]] * 3}
    one = {"id": number, "pose": "upright", "form": "exact", "mesh": f"m{number}", "preset": preset}
    peer = {"linemod": {"overlaps": [0.1, 0.55, 0.0]}} if linemod else {}
    return {**one, "present": {"overlaps": overlaps, "evidence": evidence}, "absent": absent, **peer}


def test_location_record_of_known_rows():
    rows = [row(k, right=k % 2, linemod=k < 4) for k in range(12)] + [row(20, right=2, preset="fast")]
    record, drawn = location.record_of(rows)
    learned, fast = record["sets"]
    assert (learned["set"], learned["preset"], learned["n"]) == ("exact upright", "learned", 12)
    assert [learned[f"recall_{k}"] for k in (1, 5, 20)] == [0.5, 1.0, 1.0]
    assert learned["surest"] == 1.0, "the right proposal scores highest"
    assert (learned["linemod_n"], learned["linemod"]["recall_1"], learned["linemod"]["recall_5"]) == (4, 0.0, 1.0)
    assert (fast["n"], fast["recall_1"], fast["recall_5"], fast["linemod"]) == (1, 0.0, 1.0, None)
    assert set(record["presence"]) == {"learned"}, "presence is fitted for some presets only"
    fitted = record["presence"]["learned"]
    assert fitted["weights"][0] > 0
    assert fitted["forms"]["exact"]["photographs"] == {"n": 24, "true": 12, "auc": 1.0}
    assert fitted["forms"]["exact"]["places"] == {"n": 72, "true": 12, "auc": 1.0}
    assert [len(axes.lines) for axes in location.draw(drawn).axes] == [2, 2], "a curve and the diagonal"


def test_pages_have_the_recorded_tables():
    page = (pipeline.REPOSITORY / "docs" / "performance.md").read_text(encoding="utf-8")
    table = pipeline.pipeline_table(json.loads(PIPELINE_RECORD.read_text()))
    assert f"<!-- pipeline:begin -->\n{table}<!-- pipeline:end -->" in page
    table = location.table(json.loads(location.RECORD.read_text(encoding="utf-8")))
    assert f"<!-- location:begin -->\n{table}<!-- location:end -->" in location.PAGE.read_text(encoding="utf-8")


def test_filters_script_compares_equal_functions(tmp_path):
    out, page = tmp_path / "filters.json", tmp_path / "page.md"
    filters.main(["--batch", "1", "--size", "48", "--repetitions", "1", "--no-compile", "--out", str(out)])
    record = json.loads(out.read_text(encoding="utf-8"))
    assert set(record["blocks"]) == set(filters.BLOCKS)
    assert all(row["max_difference"] < 1e-5 for row in record["blocks"].values())
    assert set(record["layers"]) == set(filters.LAYERS)
    assert all(row["near_contour"] > 0.7 for row in record["mcs_smoothing"].values())
    page.write_text("<!-- layers:begin -->\nold\n<!-- layers:end -->\n", encoding="utf-8")
    filters.write_tables(record, page)
    text = page.read_text(encoding="utf-8")
    assert "old" not in text
    assert all(f"| {name} |" in text for name in (*filters.BLOCKS, *filters.LAYERS))


def test_load_runs_the_variants_alternately_beside_busy_loops(tmp_path, monkeypatch, capsys):
    started, running, runs = [], [], []

    class Loop:
        def __init__(self, words):
            started.append(words)
            running.append(self)

        def kill(self):
            running.remove(self)

        def wait(self):
            assert self not in running

    def run_demo(checkout, folder, environment):
        runs.append((checkout.name, folder.name, bool(environment), len(running)))
        return {"command": float(len(runs)), "registration": 0.5, "processor": 2.0}

    monkeypatch.setattr(load, "run_demo", run_demo)
    monkeypatch.setattr(load.subprocess, "Popen", Loop)
    monkeypatch.setattr(load, "commit", lambda *_: "abc")
    out = tmp_path / "load.json"
    load.main(["--against", str(tmp_path), "--loads", "0", "3", "--rounds", "2", "--out", str(out)])
    before, here = tmp_path.name, load.REPOSITORY.name
    turn = [(before, "before", False), (before, "passive", True), (here, "now", False)]
    assert runs == [(*each, loops) for loops, rounds in ((0, 3), (3, 2)) for each in turn * rounds]
    assert (len(started), running) == (3, [])
    rows = json.loads(out.read_text())["rows"]
    assert rows[1]["seconds"]["passive"]["command"] == [11.0, 14.0]
    assert "| 3 | 11.5 (13.0) | 12.5 (14.0) | 13.5 (15.0) | 0.5 (0.5) |" in capsys.readouterr().out
