"""scripts/robustness: short runs of the fuzzer, the soak test and the worst cases, and their records."""

import json
import subprocess
import sys

import pytest

from curvireg_torch.errors import ImageError
from scripts.robustness import bad_calls, bad_files, bad_inputs, fuzz, soak, worst_cases
from tests._support.scripts import ROOT

COUNTS = {"images": 150, "meshes": 100, "mat": 150, "tables": 20, "banks": 20, "boxes": 60, "cameras": 60}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", COUNTS)
def test_fuzz_worker_finds_no_failure(tmp_path, capsys, kind):
    assert set(COUNTS) == {*fuzz.INPUTS, *fuzz.EXAMPLES} == set(fuzz.FRACTIONS)
    fuzz.worker(kind, 10_000_000, COUNTS[kind], tmp_path)  # other inputs than those of the long run
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert report["failures"] == []
    assert report["tried"] >= COUNTS[kind] // 2  # hypothesis may find fewer examples
    if kind not in ("boxes", "cameras", "tables"):
        assert {"result"} < set(report["outcomes"])  # some faults matter, some do not


@pytest.mark.filterwarnings("ignore")
def test_fuzz_worker_reports_foreign_errors_and_long_messages(tmp_path, capsys, monkeypatch):
    raised = [ImageError("two\nlines"), ImageError("one line"), KeyError("foreign")]

    def attack(*_):
        raise raised.pop()

    monkeypatch.setitem(fuzz.INPUTS, "mat", attack)
    fuzz.worker("mat", 0, 3, tmp_path)
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert report["outcomes"] == {"failure": 2, "ImageError": 1}
    assert "KeyError" in report["failures"][0]
    assert "several lines" in report["failures"][1]


def test_fuzz_resumes_and_names_the_input_that_killed_a_process(tmp_path, monkeypatch):
    out, batches = tmp_path / "fuzz.json", []

    def process(command, **_):
        batches.append(command[command.index("--worker") + 1 :][:3])
        output = '{"at": 3}\n{"at": 4}\n'
        if len(batches) > 1:
            output = '{"tried": 6, "outcomes": {"result": 6}, "slowest": 0.1, "peak_mb": 9, "failures": []}\n'
        return subprocess.CompletedProcess(command, -11, output, "Segmentation fault")

    monkeypatch.setattr(fuzz.subprocess, "run", process)
    monkeypatch.setattr(fuzz, "commit", lambda: "abc1234")  # which runs git
    monkeypatch.setattr(fuzz, "FRACTIONS", {"mat": 1.0})
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "--inputs", "11", "--out", str(out)])
    assert fuzz.main() == 1
    assert batches == [["mat", "0", "11"], ["mat", "5", "6"]]
    report = json.loads(out.read_text())
    assert (report["inputs"], report["failures"]) == (11, 1)
    assert "mat 4: exit code -11" in report["kinds"]["mat"]["failures"][0]
    assert fuzz.main() == 1
    assert len(batches) == 2, "nothing is left to do"


def test_fuzz_record_has_no_failure():
    report = json.loads(fuzz.RESULT.read_text())
    assert report["inputs"] >= 100_000
    assert set(report["kinds"]) == set(fuzz.FRACTIONS)
    assert report["failures"] == 0


@pytest.mark.parametrize(("module", "name"), [(fuzz, "fuzz"), (worst_cases, "worst cases")])
def test_security_page_has_the_recorded_table(module, name):
    table = module.table(json.loads(module.RESULT.read_text()))
    assert f"<!-- {name}:begin -->\n{table}<!-- {name}:end -->" in module.DOCUMENT.read_text()


def test_soak_growth_is_detected():
    def course(rss, files, threads):
        return [
            {"rss_mb": 500 + rss * i + 300 * (i > 10), "files": 9 + int(files * i), "threads": 2 + int(threads * i)}
            for i in range(100)
        ]

    assert soak.is_flat(soak.growth(course(0.0, 0.0, 0.0)), 20.0), "the first quarter does not count"
    assert soak.growth(course(1.0, 0.0, 0.0))["rss_mb"] == pytest.approx(50.0)
    for leak in ((1.0, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)):
        assert not soak.is_flat(soak.growth(course(*leak)), 20.0)
    before = soak.resources()
    with open(__file__, "rb"):
        assert soak.resources()["files"] == before["files"] + 1


@pytest.mark.slow
def test_soak_of_two_processes_with_one_cache(tmp_path):
    out = tmp_path / "soak.json"
    # --allow: so few registrations only warm up.
    words = ["--count", "40", "--processes", "2", "--reopen", "5", "--allow", "100", "--out", out]
    command = [sys.executable, "-m", "scripts.robustness.soak", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(out.read_text())
    assert result["flat"] is True
    assert [len(process["course"]) for process in result["processes"]] == [40, 40]


def test_worst_case_is_read_or_refused(monkeypatch, capsys, tmp_path):
    limit = worst_cases.limits.MAX_MAT_UNPACKED_BYTES
    for unpacked, outcome in ((50_000, "read"), (limit + 10_000, "refused: ")):
        monkeypatch.setattr(worst_cases.limits, "MAX_MAT_UNPACKED_BYTES", unpacked)
        worst_cases.CASES["mat"].make(tmp_path / "a.mat")
        worst_cases.worker("mat", tmp_path / "a.mat")
        found = json.loads(capsys.readouterr().out)
        assert found["outcome"].startswith(outcome)
        assert found["megabytes"] > 50
        assert found["seconds"] > 0


def test_worst_cases_record_is_within_its_limits():
    record = json.loads(worst_cases.RESULT.read_text())
    assert all(worst_cases.within(name, found) for name, found in record.items())
    found = {"outcome": "read", "seconds": 1.0, "megabytes": 500.0}
    for change in ({"seconds": 1e4}, {"megabytes": 1e6}, {"outcome": "died: killed"}):
        assert not worst_cases.within("mat", {**found, **change})


@pytest.fixture(scope="module")
def bad_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    bad_files.write_files(folder)
    return folder


GROUPS = [*dict.fromkeys(group for group, _ in bad_inputs.read_cases())]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("group", GROUPS)
def test_answers_to_bad_command_lines_are_clear(group, bad_folder, tmp_path, monkeypatch):
    """Every fourth case of a group; the record has all."""
    if "view" in group:
        pytest.importorskip("nicegui")
    monkeypatch.chdir(bad_folder)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    cases = [text for name, text in bad_inputs.read_cases() if name == group and "TAKEN" not in text]
    for text in cases[::4]:
        line, _, names = text.removeprefix("? ").partition(" => ")
        answer = bad_inputs.run_line(line, tmp_path)
        answer["seconds"] = 0.0
        assert bad_inputs.judge_line(answer, names.split(), used=text.startswith("? ")) == [], (line, answer)


def test_answers_to_bad_calls_are_clear(bad_folder, monkeypatch):
    monkeypatch.chdir(bad_folder)
    answers = {name: bad_inputs.judge_call(call, names) for name, call, names in bad_calls.CALLS}
    assert {name: answer for name, answer in answers.items() if answer["wrong"]} == {}


@pytest.mark.parametrize(
    ("code", "err", "wrong"),
    [
        (2, "curvireg: error: a.png: lost; find it\n", []),
        (2, "usage: curvireg register\n       more\ncurvireg register: error: a.png: lost\n", []),
        (1, "curvireg: error: a.png: lost\n", ["code 1"]),
        (2, "curvireg: error: a.png\ncurvireg: error: a.png\n", ["2 errors of ours"]),
        (2, "curvireg: error: b.png\n", ["does not name a.png"]),
        (2, "curvireg: error: a.png: KeyError: 3\n", ["a message that is not ours"]),
        (
            2,
            "[ERROR:0] png\ncurvireg: error: a.png\n",
            ["a message that is not ours", "unexpected line '[ERROR:0] png'"],
        ),
    ],
)
def test_judge_of_bad_command_lines(code, err, wrong):
    answer = {"code": code, "out": "", "err": err, "seconds": 0.1}
    assert bad_inputs.judge_line(answer, ["a.png"], used=False) == wrong
    late = bad_inputs.judge_line({**answer, "seconds": 7.0}, ["a.png"], used=False)
    assert late == [*wrong, "7.0 s"]


def test_record_of_bad_inputs_has_every_case_and_all_are_clear():
    record = json.loads(bad_inputs.RESULT.read_text())
    names = {line.removeprefix("? ").partition(" => ")[0] for _, line in bad_inputs.read_cases()}
    names |= {name for name, *_ in bad_calls.CALLS}
    assert len(names) >= 180
    assert names <= {row["case"] for row in record["cases"]}
    assert record["clear"] == [len(record["cases"])] * 2
    assert [row for row in record["cases"] if row["wrong"]] == []
