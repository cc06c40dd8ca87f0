"""Every wrong input of scripts/robustness/wrong_inputs.txt ends in a message that names it."""

import shlex

from curvireg_torch.cli import main
from curvireg_torch.pipeline import DEFAULT, PRESETS
from scripts.robustness.wrong_inputs import cases
from tests.evaluation.small import SMALL


def test_wrong_inputs_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    wrong = []
    for line, expected in cases(tmp_path):
        try:
            code = main([*shlex.split(line), *([] if line.startswith(("view", "frobnicate")) else ["--quiet"])])
        except SystemExit as stop:  # of argparse
            code = stop.code
        printed = capsys.readouterr().err.splitlines()
        if code != 2 or expected not in printed[-1]:
            wrong.append((line, code, printed[-1:], expected))
    assert not wrong, "\n".join(map(str, wrong))
