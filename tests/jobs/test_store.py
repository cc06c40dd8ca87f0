import json
from unittest.mock import Mock

import pytest

from curvireg_torch.errors import OutputError
from curvireg_torch.jobs.store import ResultStore
from tests._support import refused

DIGESTS = {"request": "a", "photo": "b"}


def row(key, **values):
    return {"key": key, "digests": DIGESTS, **values}


def test_rows_are_read_again(tmp_path):
    store = ResultStore(tmp_path / "new")
    keys = ["a/1", "a-1", "../a", "é"]
    for i, key in enumerate(keys):
        with refused(r"no result for .*; run again"):
            store.read(key)
        store.append(row(key, i=i, value=float("nan"), values=[float("inf"), 1.5]))
    for again in (store, ResultStore(tmp_path / "new")):
        expected = [row(key, i=i, value=None, values=[None, 1.5]) for i, key in enumerate(keys)]
        assert [again.read(key) for key in keys] == expected
        assert all(again.is_current(key, "a", lambda: "b") for key in keys)
        assert not again.is_current("b", "a", lambda: "b")
        assert not again.is_current("é", "a", lambda: "c")
        assert len(again) == 4


def test_a_photograph_is_digested_only_where_all_else_is_the_same(tmp_path):
    store = ResultStore(tmp_path)
    store.append(row("a"))
    store.append({**row("unreadable"), "digests": {"request": "a", "photo": ""}})
    digest = Mock(return_value="")
    assert not store.is_current("b", "a", digest)
    assert not store.is_current("a", "other", digest)
    assert not store.is_current("unreadable", "a", digest)
    digest.assert_not_called()
    assert not store.is_current("a", "a", digest)
    digest.assert_called_once_with()


def test_rows_replace_older_ones_and_are_sorted(tmp_path):
    ResultStore(tmp_path).append({**row("a", i=0), "digests": {"request": "a", "photo": "old"}})
    for i, key in enumerate("abca", start=1):
        store = ResultStore(tmp_path)
        store.append(row(key, i=i))
        assert store.is_current(key, "a", lambda: "b")
        assert store.read(key)["i"] == i
    store.sort(["c", "a"])
    assert [json.loads(line)["key"] for line in store.path.read_text().splitlines()] == [*"cab"]
    assert store.read("a") == ResultStore(tmp_path).read("a") == row("a", i=4)


@pytest.mark.parametrize("cut", [1, 20, -1])
def test_cut_line_is_removed(tmp_path, cut):
    store = ResultStore(tmp_path)
    for key in "abc":
        store.append(row(key))
    whole = store.path.read_bytes()
    last = whole.splitlines(keepends=True)[-1][:cut]
    store.path.write_bytes(whole[: whole.rindex(b'{"key"')] + last)
    reader = ResultStore(tmp_path)
    store = ResultStore(tmp_path)
    assert [reader.is_current(key, "a", lambda: "b") for key in "abc"] == [True, True, False]
    store.append(row("c"))
    assert (store.path.read_bytes(), store.read("c")) == (whole, row("c"))


@pytest.mark.parametrize(
    "content", ['{"score": 1}\n', "[1]\n", "no JSON\n", '{"key": "a"}\n', "[" * 100_000 + "\n"]
)
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "results.jsonl").write_text(content)
    with refused(r"results\.jsonl: not results"):
        ResultStore(tmp_path)


def test_folder_that_cannot_be_written(tmp_path, monkeypatch):
    store = ResultStore(tmp_path)
    monkeypatch.setattr("os.fsync", Mock(side_effect=OSError(28, "No space left on device")))
    with refused("No space left", OutputError):
        store.append(row("x"))
