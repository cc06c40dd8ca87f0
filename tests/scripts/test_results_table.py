"""``scripts/results_table.py``: the README's table from recorded summaries."""

import json
import subprocess
import sys

import pytest

from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, evaluate
from curvireg_torch.pipeline import DEFAULT, PRESETS
from scripts import results_table
from tests.evaluation.small import SMALL


@pytest.fixture
def repository(tmp_path):
    root = tmp_path / "repository"
    root.mkdir()
    root.joinpath("README.md").write_text("# Title\n\n<!-- results:begin -->\nold\n<!-- results:end -->\n\nend\n")
    return root


@pytest.fixture
def run(repository, monkeypatch):
    """Run the script on the repository; returns its exit code."""

    def exit_code(*words):
        monkeypatch.setattr(sys, "argv", ["results_table.py", "--root", str(repository), *map(str, words)])
        return results_table.main()

    return exit_code


def test_results_table_from_summaries(run, repository, pascal, bop, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    for name, benchmark in (
        ("mini", Pascal3DBenchmark(pascal, Protocol())),
        ("cubes", BOPBenchmark(bop, Protocol(pose="any", box=0.1))),
    ):
        evaluate(benchmark, tmp_path / name, progress=False)
        assert run("--record", tmp_path / name / "summary.json", name) == 0
    assert run("--check") == 1, "the README has the old table"
    assert run() == 0
    assert run("--check") == 0
    text = (repository / "README.md").read_text()
    assert text.startswith("# Title\n\n<!-- results:begin -->\n**Viewpoints")
    assert text.endswith("<!-- results:end -->\n\nend\n")
    assert "old" not in text
    summary = json.loads((tmp_path / "mini" / "summary.json").read_text())
    assert f"| mini | {summary['n']} | {100 * summary['acc_pi_6']:.1f} % |" in text
    assert "- cubes: split test; cad=annotated pose=any box=0.1 seed=0; preset learned; 0 failed, " in text
    widths = [line.count("|") for line in text.splitlines() if line.startswith("|")]
    assert set(widths[:3]) == {widths[0]}
    assert set(widths[3:]) == {widths[3]}
    assert run() == 0
    assert (repository / "README.md").read_text() == text
    run("--record", tmp_path / "cubes" / "summary.json", "more")
    run()
    assert "- cubes, more: split test; cad=annotated" in (repository / "README.md").read_text()


def test_counted_names_views_and_lightings():
    assert results_table.counted("hope", 80) == "80 (16 views x 5 lightings)"
    assert results_table.counted("hope", 12) == "12", "a limited run"
    assert results_table.counted("dino", 105) == "105"


def test_results_table_rejects_a_readme_without_markers(run, repository, capsys):
    repository.joinpath("README.md").write_text("# Title\n")
    assert run() == 2
    assert "results:begin" in capsys.readouterr().err


def test_results_table_is_empty_without_results(run, repository):
    assert run() == 0
    assert "<!-- results:begin -->\n<!-- results:end -->" in (repository / "README.md").read_text()


def test_record_stores_the_commit(run, repository, tmp_path):
    def recorded_commit():
        run("--record", tmp_path / "summary.json", "x")
        return json.loads((repository / "scripts" / "results" / "evaluation_x.json").read_text())["commit"]

    tmp_path.joinpath("summary.json").write_text("{}")
    assert recorded_commit() == "unknown"
    git = ["git", "-C", str(repository), "-c", "user.name=a", "-c", "user.email=a@b"]
    (repository / "code.py").write_text("x = 1\n")
    for words in (["init", "-q"], ["add", "README.md", "code.py"], ["commit", "-qm", "x"]):
        subprocess.run([*git, *words], check=True)
    clean = recorded_commit()
    assert clean.isalnum()
    subprocess.run([*git, "add", "scripts"], check=True)
    repository.joinpath("README.md").write_text("changed")
    assert recorded_commit() == clean, "measurements do not depend on files that scripts write"
    (repository / "code.py").write_text("x = 2\n")
    assert recorded_commit() == clean + "+"
