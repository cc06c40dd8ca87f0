import json

import pytest

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation.store import PredictionStore, to_json, write_text


def test_keys_do_not_share_files(tmp_path):
    store = PredictionStore(tmp_path / "new" / "predictions")
    store.open({})
    keys = ["a/1", "a-1", "a 1", "a%2F1", "../a", "settings/1"]
    for i, key in enumerate(keys):
        assert key not in store
        store.write(key, {"i": i})
    assert [store.read(key)["i"] for key in keys] == list(range(len(keys)))
    assert {p.parent for p in tmp_path.rglob("*.json")} == {store.folder}


def test_other_settings_are_refused(tmp_path):
    store = PredictionStore(tmp_path)
    store.open({"preset": "a", "seed": 1})
    store.write("x/1", {})
    store.open({"preset": "a", "seed": 1})
    with pytest.raises(InvalidInputError, match=r"preset: 'a' there, 'b' now.*--overwrite"):
        store.open({"preset": "b", "seed": 1})
    assert "x/1" in store
    store.open({"preset": "b", "seed": 1}, overwrite=True)
    assert "x/1" not in store
    store.open({"preset": "b", "seed": 1})


def test_predictions_without_settings_are_refused(tmp_path):
    store = PredictionStore(tmp_path)
    store.write("x/1", {})
    with pytest.raises(InvalidInputError, match="unknown settings"):
        store.open({})


def test_damaged_prediction_is_named(tmp_path):
    store = PredictionStore(tmp_path)
    for content in ("{", "[1]"):
        tmp_path.joinpath("x.json").write_text(content)
        with pytest.raises(InvalidInputError, match=r"x\.json.*remove it"):
            store.read("x")


def test_file_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_text(path, "old")

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(InvalidInputError, match="No space left"):
        write_text(path, "new")
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "old"


def test_folder_that_is_a_file(tmp_path):
    tmp_path.joinpath("out").write_text("")
    with pytest.raises(InvalidInputError, match="choose another --out"):
        PredictionStore(tmp_path / "out" / "predictions").open({})


def test_json_holds_no_nan():
    assert json.loads(to_json({"a": float("nan"), "b": [float("inf"), 1.5]})) == {"a": None, "b": [None, 1.5]}
