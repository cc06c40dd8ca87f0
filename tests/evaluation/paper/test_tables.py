import sys

import pytest

from curvireg_torch.evaluation.paper import Table, write_table
from curvireg_torch.visualization import plots

TABLE = Table(
    "t", "A title", "Shares, N = 2.", ["category", "a", "b"], [["car", 0.123456, 1.0], ["all", float("nan"), 2.0]]
)


def test_table_markdown():
    lines = TABLE.markdown().splitlines()
    assert lines[:3] == ["## A title", "", "Shares, N = 2."]
    assert lines[4:] == ["| category | a | b |", "|---|---|---|", "| car | 0.123 | 1 |", "| all | - | 2 |"]


@pytest.mark.parametrize("curve", [False, True])
def test_write_table(tmp_path, curve, monkeypatch):
    pytest.importorskip("matplotlib")
    name, drawn = "curves" if curve else "bars", []
    plain = getattr(plots, name)
    monkeypatch.setattr(plots, name, lambda *words, **options: drawn.append(words) or plain(*words, **options))
    table = Table("t", "T", "D", ["k", "a"], [[1.0, 0.5], [2.0, 0.7]], curve=curve)
    paths = write_table(table, tmp_path / "new")
    assert [p.name for p in paths] == ["t.csv", "t.md", "t.png"]
    assert paths[2].read_bytes().startswith(b"\x89PNG")
    assert drawn == [(table.columns, table.rows)]


def test_write_table_without_matplotlib(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    table, text = write_table(TABLE, tmp_path)
    assert table.read_text() == "category,a,b\ncar,0.123456,1.0\nall,nan,2.0\n"
    assert text.read_text() == TABLE.markdown()
