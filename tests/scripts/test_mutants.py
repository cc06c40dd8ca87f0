"""The mutation script changes what it says, and tells a test that bites from one that does not."""

import importlib
import json

import pytest

from tests._support.scripts import imported

SOURCE = b'''"""A docstring with 1 < 2."""
import math

_CHUNK = 1 << 20
SIZE: int = 3


def area(a: float | None, b=2.0, *, exact=True):
    """Says 3 + 4."""
    if a is None or b < 0:
        raise ValueError(f"expected {a + 1}")
    total = 0
    total += a * b
    if not exact:
        print(total, b)
    return max(total, -a) + [7][0] + 1e-9
'''


@pytest.fixture
def mutants():
    with imported("mutants") as script:
        yield script


def test_every_kind_is_found_and_nothing_that_the_rules_leave_out(mutants):
    found = {(m.line, m.kind, m.diff(SOURCE)[1]) for m in mutants.mutants_of("x.py", SOURCE)}
    assert found == {
        (5, "number", "SIZE: int = 4"),
        (5, "number", "SIZE: int = 2"),
        (8, "number", "def area(a: float | None, b=4.0, *, exact=True):"),
        (8, "number", "def area(a: float | None, b=1.6, *, exact=True):"),
        (8, "switch", "def area(a: float | None, b=2.0, *, exact=False):"),
        (10, "never", "if False:"),
        (10, "comparison", "if a is not None or b < 0:"),
        (10, "and/or", "if a is None and b < 0:"),
        (10, "comparison", "if a is None or b <= 0:"),
        (10, "comparison", "if a is None or b >= 0:"),
        (10, "number", "if a is None or b < 1:"),
        (12, "number", "total = 1"),
        (13, "dropped statement", "pass"),
        (13, "arithmetic", "total += a / b"),
        (14, "never", "if False:"),
        (14, "dropped sign", "if (exact):"),
        (15, "dropped statement", "pass"),
        (15, "arguments", "print(b, total)"),
        (16, "arithmetic", "return max(total, -a) - [7][0] + 1e-9"),
        (16, "arithmetic", "return max(total, -a) + [7][0] - 1e-9"),
        (16, "function", "return min(total, -a) + [7][0] + 1e-9"),
        (16, "dropped sign", "return max(total, (a)) + [7][0] + 1e-9"),
        (16, "number", "return max(total, -a) + [8][0] + 1e-9"),
        (16, "number", "return max(total, -a) + [6][0] + 1e-9"),
        (16, "number", "return max(total, -a) + [7][1] + 1e-9"),
    }


def test_keys_outlive_a_shift_of_lines_but_not_a_change_of_the_function(mutants):
    keys = {m.key for m in mutants.mutants_of("x.py", SOURCE)}
    shifted = {m.key for m in mutants.mutants_of("x.py", SOURCE.replace(b"import math", b"import math\n\n"))}
    changed = {m.key for m in mutants.mutants_of("x.py", SOURCE.replace(b"-a)", b"-b)"))}
    assert len(keys) == 25
    assert shifted == keys
    assert changed & keys == {k for k in keys if "SIZE" in k}


@pytest.mark.usefixtures("mutants")
def test_the_page_has_the_scores_that_are_stored():
    mutate = importlib.import_module("mutate")
    text = mutate.TABLE.read_text()
    assert text.split(mutate.BEGIN)[1].split(mutate.END)[0] == f"\n{mutate.table()}"
    for package, row in mutate.stored().items():
        assert row["killed"] + len(row["survivors"]) == row["sampled"] == len(row["outcomes"]), package


@pytest.mark.usefixtures("mutants")
def test_a_small_sample_does_not_say_much():
    """Wilson's interval: 11 of 12 are 64.6 to 98.5 %, 12 of 12 are 75.7 to 100 %."""
    mutate = importlib.import_module("mutate")
    assert mutate.share(11, 12) == "65 to 99 %"
    assert mutate.share(12, 12) == "76 to 100 %"
    assert mutate.share(0, 0) == "unknown"


@pytest.mark.usefixtures("mutants")
def test_mutants_placed_by_hand_are_counted():
    mutate = importlib.import_module("mutate")
    found = json.loads(mutate.BY_HAND.read_text())
    assert found["placed"] == found["killed"] + len(found["survivors"])
    assert found["killed"] == len(found["noticed"])
    for one in (*found["noticed"], *found["survivors"]):
        assert one["before"] in (mutate.ROOT / one["file"]).read_text(), "the code is another now: place it again"
    for one in found["noticed"]:
        path, test = one["by"].split("::")
        assert f"def {test.partition('[')[0]}(" in (mutate.ROOT / path).read_text(), one
