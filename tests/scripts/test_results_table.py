"""The scripts that store results and write the README's table."""

import json

import pytest

from scripts import _shared, results_table
from tests._support import refused


def bop_summary(*, acc_15_deg=0.5, med_err_deg=3.25):
    """A summary of ``curvireg evaluate bop`` with the keys that the tables read."""
    scores = {
        "acc_15_deg": acc_15_deg,
        "acc_30_deg": 0.75,
        "med_err_deg": med_err_deg,
        "add_recall_0.1d": 0.25,
        "mssd_ar": 0.4,
        "mspd_ar": 0.6,
    }
    return {
        "n": 8,
        **scores,
        "subsets": {"unoccluded": {"n": 4, "acc_30_deg": 1.0}},
        "limit": None,
        "skipped": {"no box": 2},
        "failed": 1,
        "protocol": "box=annotated",
        "settings": {"dataset": "bop", "split": "test", "preset": "learned"},
    }


def write_summary(folder, **scores):
    folder.mkdir(parents=True)
    path = folder / "summary.json"
    path.write_text(json.dumps(bop_summary(**scores)))
    return path


@pytest.fixture
def results(tmp_path, monkeypatch):
    folder = tmp_path / "results"
    monkeypatch.setattr(results_table, "RESULTS", folder)
    return folder


def test_recorded_summary_becomes_a_row_of_the_table(tmp_path, results):
    path = results_table.store(write_summary(tmp_path / "run"), "cups")
    stored = json.loads(path.read_text())
    assert path == results / "evaluation_cups.json"
    assert (stored["name"], stored["summary"]["n"]) == ("cups", 8)
    assert {"date", "commit"} <= stored.keys()
    table = results_table.table(results)
    assert (
        "| cups | 8 | 50.0 % | 75.0 % | 3.2° | 25.0 % | 40.0 % | 60.0 % | 4 | 100.0 % |\n" in table
    )
    assert "1 failed, 2 skipped" in table


def test_the_table_in_words_names_what_a_set_shows(tmp_path, results):
    for name in ("lego", "buddha", "cups"):
        results_table.store(write_summary(tmp_path / name), name)
    sets = [{"name": "buddha", "reliable": 5, "reliable_right": 4}]
    (results / "confidence.json").write_text(json.dumps({"sets": sets}))
    lines = results_table.table_in_words(results).splitlines()
    assert lines[2:4] == [
        "| A plaster figurine | 8 | 75.0 % | 3.2° | 5 | 4 |",
        "| A LEGO model | 8 | 75.0 % | 3.2° | - | - |",
    ]
    assert lines[4:] == ["", f"Commit {_shared.commit()}."]
    assert list(results_table.WORDS)[-1] == "pascal3d_mini"


def test_followed_frames_are_a_row_before_the_last(tmp_path, results):
    for name in ("lego", "pascal3d_mini"):
        results_table.store(write_summary(tmp_path / name), name)
    videos = [
        {"errors_deg": [1.0, 31.0], "verdicts": ["reliable", "reliable"]},
        {"errors_deg": [3.0, float("inf"), 2.0], "verdicts": ["reliable", "lost", "unsure"]},
    ]
    (results / "videos.json").write_text(json.dumps({"commit": "abc", "videos": videos}))
    lines = results_table.table_in_words(results).splitlines()
    name = "Frames of 2 videos, each followed from its first frame"
    assert lines[3] == f"| {name} | 5 | 60.0 % | 3.0° | 3 | 2 |"
    assert lines[4].startswith("| Cars, chairs")
    assert lines[-1] == f"Commit {', '.join(sorted((_shared.commit(), 'abc')))}."


def test_sets_of_several_lightings_count_views(tmp_path, results):
    results_table.store(write_summary(tmp_path / "run"), "hope")
    assert "| hope | 8 |" in results_table.table(results)  # 8 is no multiple of 5
    assert results_table.counted("hope", 10) == "10 (2 views x 5 lightings)"


def test_comparison_shows_stored_and_new_scores(tmp_path, results):
    results_table.store(write_summary(tmp_path / "old" / "cups"), "cups")
    cups = write_summary(tmp_path / "new" / "cups", acc_15_deg=0.625, med_err_deg=None)
    text = results_table.comparison([cups, write_summary(tmp_path / "new" / "mugs")], results)
    assert "| cups | 8 | acc_15_deg | 50.0 % | 62.5 % |" in text
    assert "| cups | 8 | med_err_deg | 3.2° | - |" in text
    assert "| mugs | 8 | acc_15_deg | - | 50.0 % |" in text, "it was never stored"
    cups.write_text(json.dumps({"settings": {"dataset": "web"}}))
    with refused(r"cups/summary\.json: dataset: expected one of 'pascal3d', 'bop', got 'web'"):
        results_table.comparison([cups], results)


def test_page_is_replaced_between_its_markers_alone(tmp_path):
    page = tmp_path / "page.md"
    text = "before\n<!-- rows:begin -->\nold\n<!-- rows:end -->\nafter\n"
    page.write_text(text)
    _shared.update_page(page, "rows", "new\n")
    replaced = text.replace("old", "new")
    assert page.read_text() == replaced
    with pytest.raises(ValueError, match="substring"):
        _shared.update_page(page, "columns", "new\n")
    assert page.read_text() == replaced
