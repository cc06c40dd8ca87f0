"""Two runs of the benchmark side by side."""

import pytest
from PIL import Image

from scripts.benchmark.changes import errors_of, largest_changes, paired_table, sheet

ITEM = {"pose": "upright", "t": [0.0, 3.0, 4.0]}


def row(error: float, shift: float = 0.0) -> dict:
    return {"errors": [error, 0.0], "answer": [None, [shift, 3.0, 4.0]]}


def test_errors_are_those_of_the_first_pose_and_a_failure_is_the_worst():
    assert errors_of(row(7.0, shift=0.5), ITEM) == pytest.approx((7.0, 0.1))
    assert errors_of({"failed": "no edges"}, ITEM) == (180.0, float("inf"))


def test_paired_table_counts_won_and_lost_photographs():
    before = [row(3.0), row(40.0), row(40.0), row(4.0), row(4.0, shift=1.0)]
    after = [row(3.0), row(1.0), row(4.0), row(90.0), row(4.0)]
    lines = paired_table([ITEM] * 5, before, after).splitlines()
    found = {line.split("|")[3].strip(): [cell.strip() for cell in line.split("|")[4:7]] for line in lines[2:]}
    assert found["5°"] == ["0.600", "0.800", "2, 1"]
    assert found["5° and 5 %"] == ["0.400", "0.800", "3, 1"]
    assert found["2°"] == ["0.000", "0.200", "1, 0"]


def test_largest_changes_are_ordered_and_exclude_small_ones():
    """Not counted: below 5 degrees before and after, and errors that differ by a factor below 1.5."""
    pairs = [(90.0, 45.0), (90.0, 1.0), (1.0, 60.0), (2.0, 10.0), (4.0, 0.2), (30.0, 25.0)]
    assert largest_changes(pairs) == ([1, 0], [2, 3])
    assert largest_changes(pairs, count=1) == ([1], [2])


def test_sheet_breaks_lines_at_its_width():
    pictures = [Image.new("RGB", (w, 50), "black") for w in (100, 80, 90, 250)]
    out = sheet(pictures, width=220, gap=10)
    assert out.size == (250, 3 * 50 + 2 * 8)  # 100 + 80, 90, and a picture that is wider than the sheet
    assert out.getpixel((99, 49)) == (0, 0, 0)
    assert out.getpixel((105, 20)) == (255, 255, 255)
