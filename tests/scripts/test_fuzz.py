"""A short run of scripts/robustness/fuzz.py: every input ends in a result or in one of our errors."""

import json
import sys

import pytest

from curvireg_torch.errors import ImageError
from tests._support.scripts import imported

COUNTS = {"images": 150, "meshes": 100, "mat": 150, "tables": 20, "banks": 20, "boxes": 60, "cameras": 60}


@pytest.fixture
def fuzz():
    with imported("scripts.robustness.fuzz") as script, imported("scripts.robustness.fuzz_inputs") as inputs:
        yield script, inputs


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", COUNTS)
def test_no_input_escapes(fuzz, tmp_path, capsys, kind):
    script, inputs = fuzz
    assert set(COUNTS) == set(inputs.DATASETS) == set(script.SHARES)
    script.worker(kind, 10_000_000, COUNTS[kind], tmp_path)  # not those of the long run
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert report["failures"] == []
    assert report["tried"] >= COUNTS[kind] // 2  # hypothesis may find no more
    if kind not in ("boxes", "cameras", "tables"):
        assert {"result"} < set(report["outcomes"])  # faults that matter, and faults that do not


@pytest.mark.filterwarnings("ignore")
def test_a_foreign_error_and_a_message_of_two_lines_are_failures(fuzz, tmp_path, capsys, monkeypatch):
    script, inputs = fuzz
    raised = [ImageError("two\nlines"), ImageError("one line"), KeyError("foreign")]

    def attack(*_):
        raise raised.pop()

    monkeypatch.setitem(inputs.DATASETS, "mat", attack)
    script.worker("mat", 0, 3, tmp_path)
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert report["outcomes"] == {"failure": 2, "ImageError": 1}
    assert "KeyError" in report["failures"][0]
    assert "several lines" in report["failures"][1]


def test_the_report_continues_and_names_what_killed_a_process(fuzz, tmp_path, monkeypatch):
    script, _ = fuzz
    out, batches = tmp_path / "fuzz.json", []

    class Done:
        returncode, stderr = -11, "Segmentation fault"

    def process(command, **_):
        batches.append(command[command.index("--worker") + 1 :][:3])
        done = Done()
        done.stdout = '{"at": 3}\n{"at": 4}\n'
        if len(batches) > 1:
            done.stdout = '{"tried": 6, "outcomes": {"result": 6}, "slowest": 0.1, "peak_mb": 9, "failures": []}\n'
        return done

    monkeypatch.setattr(script.subprocess, "run", process)
    monkeypatch.setattr(script, "commit", lambda *_, **__: "abc1234")  # which runs git
    monkeypatch.setattr(script, "SHARES", {"mat": 1.0})
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "--inputs", "11", "--out", str(out)])
    assert script.main() == 1
    assert batches == [["mat", "0", "11"], ["mat", "5", "6"]]
    report = json.loads(out.read_text())
    assert report["inputs"] == 11
    assert report["failures"] == 1
    assert "mat 4: exit code -11" in report["kinds"]["mat"]["failures"][0]
    assert script.main() == 1  # nothing is left to do
    assert len(batches) == 2


def test_the_long_run_found_nothing_and_stands_in_security(fuzz):
    script, _ = fuzz
    report = json.loads(script.RESULT.read_text())
    assert report["inputs"] >= 100_000
    assert set(report["kinds"]) == set(script.SHARES)
    assert report["failures"] == 0
    text = script.DOCUMENT.read_text()
    assert script.replace_between(text, script.BEGIN, script.END, script.table(report)) == text
