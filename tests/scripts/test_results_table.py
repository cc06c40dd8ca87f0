import json
import subprocess
import sys

import pytest

from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, evaluate
from tests._support.scripts import imported


@pytest.fixture
def run(monkeypatch):
    """The script's exit code for a repository and words."""
    with imported("scripts.results_table") as script:

        def exit_code(root, *words):
            monkeypatch.setattr(sys, "argv", ["results_table.py", "--root", str(root), *map(str, words)])
            return script.main()

        yield exit_code


@pytest.fixture
def repository(tmp_path):
    root = tmp_path / "repository"
    root.mkdir()
    root.joinpath("README.md").write_text("# Title\n\n<!-- results:begin -->\nold\n<!-- results:end -->\n\nend\n")
    return root


def test_table_from_summaries(run, repository, pascal, bop, tmp_path):
    for name, benchmark in (
        ("mini", Pascal3DBenchmark(pascal, Protocol())),
        ("cubes", BOPBenchmark(bop, Protocol(pose="any", box=0.1))),
    ):
        evaluate(benchmark, tmp_path / name, progress=False)
        assert run(repository, "--record", tmp_path / name / "summary.json", name) == 0
    assert run(repository, "--check") == 1, "the README still has the old table"
    assert run(repository) == 0
    assert run(repository, "--check") == 0
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
    assert run(repository) == 0
    assert (repository / "README.md").read_text() == text


def test_objects_that_were_photographed_under_several_lightings_are_told():
    with imported("scripts.results_table") as script:
        assert script.counted("hope", 80) == "80 (16 views x 5 lightings)"
        assert script.counted("hope", 12) == "12", "a limited run"
        assert script.counted("dino", 105) == "105"


def test_readme_without_markers(run, repository, capsys):
    repository.joinpath("README.md").write_text("# Title\n")
    assert run(repository) == 2
    assert "results:begin" in capsys.readouterr().err


def test_no_results_no_table(run, repository):
    assert run(repository) == 0
    assert "<!-- results:begin -->\n<!-- results:end -->" in (repository / "README.md").read_text()


def test_commit_is_kept(run, repository, tmp_path):
    tmp_path.joinpath("summary.json").write_text("{}")
    run(repository, "--record", tmp_path / "summary.json", "x")
    path = repository / "scripts" / "results" / "evaluation_x.json"
    assert json.loads(path.read_text())["commit"] == "unknown"
    git = ["git", "-C", str(repository), "-c", "user.name=a", "-c", "user.email=a@b"]
    (repository / "code.py").write_text("x = 1\n")
    for words in (["init", "-q"], ["add", "README.md", "code.py"], ["commit", "-qm", "x"]):
        subprocess.run([*git, *words], check=True)
    run(repository, "--record", tmp_path / "summary.json", "x")
    clean = json.loads(path.read_text())["commit"]
    assert clean.isalnum()
    subprocess.run([*git, "add", "scripts"], check=True)
    repository.joinpath("README.md").write_text("changed")
    run(repository, "--record", tmp_path / "summary.json", "x")
    assert json.loads(path.read_text())["commit"] == clean, "no measurement depends on what the script itself writes"
    (repository / "code.py").write_text("x = 2\n")
    run(repository, "--record", tmp_path / "summary.json", "x")
    assert json.loads(path.read_text())["commit"] == clean + "+"
