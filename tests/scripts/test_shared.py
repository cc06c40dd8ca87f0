"""Command lines of scripts, as the parameters of their ``main`` describe them."""

import sys
from pathlib import Path
from typing import Literal

import pytest

from curvireg_torch.errors import InvalidInputError
from scripts._shared import run

KINDS = {"box": 1, "ball": 2}


def main(
    work: Path,
    more: list[Path] = (),
    *,
    out: Path,
    kind: Literal[*KINDS] = "box",
    kinds: list[Literal[*KINDS]] = tuple(KINDS),
    cut: tuple[float, float] | None = None,
    few_views: bool = False,
    limit: int | None = None,
) -> dict[str, object]:
    if limit == 0:
        raise InvalidInputError("nothing to do")
    return locals()


def called(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["script.py", *words])
    return run(main)


def test_parameters_are_arguments(monkeypatch):
    assert called(monkeypatch, "work", "--out", "out") == {
        "work": Path("work"),
        "more": [],
        "out": Path("out"),
        "kind": "box",
        "kinds": ("box", "ball"),
        "cut": None,
        "few_views": False,
        "limit": None,
    }
    words = ["--kind", "ball", "--kinds", "ball", "box", "--cut", ".1", ".6", "--few-views"]
    found = called(monkeypatch, "work", "a", "b", "--out", "out", "--limit", "3", *words)
    assert (found["more"], found["limit"]) == ([Path("a"), Path("b")], 3)
    assert (found["kind"], found["kinds"], found["cut"]) == ("ball", ["ball", "box"], [0.1, 0.6])
    assert found["few_views"] is True


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["work"], "required: --out"),
        (["--out", "out"], "required: work"),
        (["work", "--out", "out", "--kind", "cone"], "'cone' (choose from"),
        (["work", "--out", "out", "--cut", "0.1"], "expected 2 arguments"),
        (["work", "--out", "out", "--limit", "0"], "script.py: error: nothing to do"),
    ],
)
def test_mistakes_end_in_one_line(monkeypatch, capsys, words, message):
    with pytest.raises(SystemExit, match="2"):
        called(monkeypatch, *words)
    assert message in capsys.readouterr().err


def test_the_help_is_the_docstring(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="0"):
        called(monkeypatch, "--help")
    assert __doc__ in capsys.readouterr().out
