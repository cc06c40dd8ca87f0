"""scripts/accuracy_tables.py: the three tables of docs/accuracy.md from the records."""

import sys

import pytest

from scripts import accuracy_tables
from scripts.accuracy_tables import BEGIN, END, SETS, precision, right_answers, trust


def test_page_has_the_recorded_numbers(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["accuracy_tables.py", "--check"])
    assert accuracy_tables.main() == 0, "run python scripts/accuracy_tables.py"


def test_writes_between_the_markers_and_reports_old_tables(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n{BEGIN}\nold\n{END}\nend\n")
    monkeypatch.setattr(sys, "argv", ["accuracy_tables.py", "--check"])
    assert accuracy_tables.main(page) == 1
    assert "page.md is out of date" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["accuracy_tables.py"])
    assert accuracy_tables.main(page) == 0
    text = page.read_text()
    assert text.startswith(f"# Title\n{BEGIN}\n\n## How often")
    assert text.endswith(f"{END}\nend\n")
    assert "\nold\n" not in text
    assert text.count("\n## ") == 3


def test_tables_take_each_number_from_its_record():
    hints = {"sets": {key: {"azimuth:45": [0.01 * k]} for k, key in enumerate(SETS)}}
    del hints["sets"]["lm"]["azimuth:45"]
    shares = {
        "exact upright": {"n": 7, "answer": [0.751, 0.6, 0.9]},
        "sibling upright": {"n": 8, "answer": [0.5, 0, 1]},
    }
    summaries = {name: {"n": k, "acc_30_deg": 0.125 * k, "med_err_deg": 12.34} for k, name in enumerate(list(SETS)[2:])}
    summaries["pascal3d_mini"] |= {"acc_pi_6": 0.4, "symmetry_aware": {"acc_pi_6": 0.625}}
    evaluations = {name: {"summary": summary} for name, summary in summaries.items()}
    rows = right_answers(hints, {"shares": shares}, evaluations)
    assert rows[1] == ["generated, upright, exact mesh", "yes", "7", "0.75", "0.00", "-"]
    assert rows[2][2:] == ["8", "0.50", "0.01", "-"]
    assert rows[3][2:] == ["0", "0.62", "0.02", "12.3°"]
    assert rows[4] == ["hope, exact mesh, in clutter (16 views x 5 lightings)", "yes", "1", "0.12", "0.03", "12.3°"]
    assert rows[5][3:] == ["0.25", "-", "12.3°"]
    names = [key for _, _, key in SETS.values()]
    confidence = {name: {"n": 9, "reliable": k, "reliable_and_right": 0} for k, name in enumerate(names)}
    sets = {name: {"coverage": 0.901, "mean_size": 2.04} for name in names}
    split = [{name: part[name] for name in some} for part in (confidence, sets) for some in (names[:2], names[2:])]
    keys = ("held_out", "real", "answer_sets", "real_answer_sets")
    assert trust(dict(zip(keys, split, strict=True)))[7] == ["buddha, exact mesh", "9", "6", "0", "0.90", "2.0"]
    degrees = {"n": 5, "best view": 6.09, "rotation median": 0.324, "rotation 90 %": 10.94}
    found = degrees | {"translation median": 0.00155, "translation 90 %": 0.026}
    table = precision({"exactness": {"upright": found, "free": found | {"n": 4}}})
    assert table[1] == ["generated, upright, exact mesh", "5", "6.1°", "0.32°", "11°", "0.15 %", "2.6 %"]
    assert table[2][:2] == ["generated, free, exact mesh", "4"]


@pytest.mark.parametrize("value", [None, 0.0, 0.995])
def test_share(value):
    assert accuracy_tables.share(value) == {None: "-", 0.0: "0.00", 0.995: "0.99"}[value]
