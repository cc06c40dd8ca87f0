"""Which tests a run has."""

from types import SimpleNamespace

import pytest

from tests.conftest import pytest_collection_modifyitems


@pytest.mark.parametrize(
    ("expression", "kept"),
    [("", ["plain"]), ("not slow", ["plain"]), ("browser", ["page", "plain"])],
)
def test_tests_in_a_browser_are_a_run_of_their_own(expression, kept):
    items = [
        SimpleNamespace(name=name, get_closest_marker=marks.get)
        for name, marks in (("page", {"browser": True}), ("plain", {}))
    ]
    left_out = []
    hook = SimpleNamespace(pytest_deselected=lambda items: left_out.extend(items))
    config = SimpleNamespace(option=SimpleNamespace(markexpr=expression), hook=hook)
    pytest_collection_modifyitems(config, items)
    assert [item.name for item in items] == kept
    assert {item.name for item in left_out} == {"page", "plain"} - set(kept)
