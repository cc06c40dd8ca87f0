from unittest.mock import Mock

import pytest

from curvireg_torch.errors import InvalidInputError, OutputError
from curvireg_torch.jobs.store import ResultStore, Workers

DIGESTS = {"request": "a", "photo": "b"}


def row(key, **values):
    return {"key": key, "digests": DIGESTS, **values}


def test_rows_are_read_again(tmp_path):
    store = ResultStore(tmp_path / "new")
    keys = ["a/1", "a-1", "../a", "é"]
    for i, key in enumerate(keys):
        with pytest.raises(InvalidInputError, match=r"no result for .*; run again"):
            store.read(key)
        store.append(row(key, i=i, value=float("nan"), values=[float("inf"), 1.5]))
    for again in (store, ResultStore(tmp_path / "new")):
        expected = [row(key, i=i, value=None, values=[None, 1.5]) for i, key in enumerate(keys)]
        assert [again.read(key) for key in keys] == expected
        assert again.is_complete(dict.fromkeys(keys, DIGESTS))
        assert not again.is_complete(dict.fromkeys([*keys, "b"], DIGESTS))
        assert not again.is_complete({key: {**DIGESTS, "photo": "c"} for key in keys})


@pytest.mark.parametrize("workers", [None, Workers(1, 2)])
def test_rows_replace_older_ones(tmp_path, workers):
    """Those of other digests, also in the file of another process that sorts later; of the same
    digests, the last."""
    ResultStore(tmp_path, Workers(2, 3)).append(
        {**row("a", i=0), "digests": {"request": "a", "photo": "old"}}
    )
    for i in (1, 2):
        store = ResultStore(tmp_path, workers)
        store.append(row("a", i=i))
        assert store.is_complete({"a": DIGESTS})
        assert store.read("a")["i"] == i
    store.merge()
    assert [path.name for path in tmp_path.iterdir()] == ["results.jsonl"]
    assert store.read("a") == ResultStore(tmp_path).read("a") == row("a", i=2)


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
    assert [reader.is_current(key, DIGESTS) for key in "abc"] == [True, True, False]
    store.append(row("c"))
    assert (store.path.read_bytes(), store.read("c")) == (whole, row("c"))


@pytest.mark.parametrize(
    "content", ['{"score": 1}\n', "[1]\n", "no JSON\n", '{"key": "a"}\n', "[" * 100_000 + "\n"]
)
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "results.jsonl").write_text(content)
    with pytest.raises(InvalidInputError, match=r"results\.jsonl: not results"):
        ResultStore(tmp_path)


def test_folder_that_cannot_be_written(tmp_path, monkeypatch):
    store = ResultStore(tmp_path)
    monkeypatch.setattr("os.fsync", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OutputError, match="No space left"):
        store.append(row("x"))
