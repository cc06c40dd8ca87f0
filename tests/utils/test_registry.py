import sys

import pytest

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.utils.registry import Registry


def test_registry_imports_an_entry_on_first_use(tmp_path, monkeypatch):
    (tmp_path / "plugged_in.py").write_text("class Filter: pass")
    monkeypatch.syspath_prepend(tmp_path)
    registry = Registry("field", {"mine": "plugged_in:Filter", "other": "nowhere:Nothing"})
    assert list(registry) == ["mine", "other"]
    assert len(registry) == 2
    assert "mine" in registry
    assert "plugged_in" not in sys.modules
    assert registry["mine"] is registry["mine"] is sys.modules["plugged_in"].Filter
    monkeypatch.delitem(sys.modules, "plugged_in")
    with pytest.raises(ModuleNotFoundError, match="nowhere"):
        registry["other"]


def test_registry_register_as_call_and_as_decorator():
    registry = Registry("term")
    assert registry.register("one", int) is int

    @registry.register("two")
    def two():
        return 2

    assert dict(registry) == {"one": int, "two": two}
    registry.register("one", float)
    assert registry["one"] is float


def test_registry_names_what_is_known():
    registry = Registry("detector", {"canny": 1, "sobel": 2})
    with pytest.raises(InvalidInputError, match="detector: expected one of 'canny', 'sobel', got 'kanny'"):
        registry["kanny"]
    assert "kanny" not in registry
