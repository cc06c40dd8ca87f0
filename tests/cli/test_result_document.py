"""Result documents and their schema, ``--json``, and examples in the help."""

import argparse
import json
import re
import shlex
from pathlib import Path

import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.cli import build_parser, main, parse
from curvireg_torch.registration.document import result_document
from tests._support.lists import CAMERA, box_of, written
from tests._support.scenes import unrefined

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "curvireg_torch" / "registration" / "result.schema.json").read_text())


@pytest.fixture(scope="module")
def check():
    """Raise for a document that violates the schema."""
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return jsonschema.Draft202012Validator(SCHEMA).validate


def run_register(*words):
    return main(["register", *map(str, words), "--quiet"])


def printed(capsys):
    return capsys.readouterr().out


def test_register_json_prints_only_the_document(folder, tmp_path, capsys, check):
    files = [folder / "photos" / "0.png", folder / "truck.safetensors"]
    words = [*files, "--box", *box_of(0), "--camera", *CAMERA, "--json"]
    assert run_register(*words) == 0
    document = json.loads(printed(capsys))
    check(document)
    assert run_register(*words, "--out", tmp_path / "one") == 0
    again = json.loads(printed(capsys))
    check(again)
    assert json.loads((tmp_path / "one" / "result.json").read_text()) == again
    assert {**again, "seconds": 0} == {**document, "seconds": 0}
    assert run_register(folder / "none.png", files[1], "--json") == 2
    assert printed(capsys) == ""


@pytest.mark.parametrize(
    ("named", "unit"), [(None, None), ("none", None), ("yards", None), ("mm", "mm"), ("ft", "ft"), ("meters", "m")]
)
def test_result_document_has_the_unit_of_the_mesh(tmp_path, check, named, unit):
    """trimesh writes "none" for None, and "meters" where we say "m"."""
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    if named is not None:
        mesh.units = named
    views = cr.sample_views(azimuth_step=90, elevations=[20])
    bank = cr.ViewBank.build(mesh, views, image_size=32, progress=False)
    bank.save(tmp_path / "box.safetensors")
    for one in (bank, cr.ViewBank.load(tmp_path / "box.safetensors")):
        assert one.mesh.units == unit
        registrar = cr.Registrar(one, pipeline=unrefined(one))
        result = registrar([torch.rand(3, 64, 64)], torch.tensor([[10.0, 10, 50, 50]]))[0]
        document = result_document(result, registrar, {"bank": 0.0, "register": 0.0})
        assert document["unit"] == unit
        check({**json.loads(json.dumps(document)), "inputs": {"box": [10, 10, 50, 50]}})


def test_register_json_without_a_box_has_the_localization(folder, tmp_path, capsys, check):
    words = [folder / "photos" / "0.png", folder / "truck.safetensors", "--camera", *CAMERA, "--no-refine"]
    assert run_register(*words, "--json", "--instances", "2") == 0
    document = json.loads(printed(capsys))
    check(document)
    found = document["localization"]
    assert document["inputs"]["box"] == found["instances"][0]["box"] == found["proposals"][0]["box"]
    assert document["rotation"] == found["instances"][0]["rotation"]
    assert found["presence"] == found["instances"][0]["presence"] >= found["instances"][-1]["presence"]
    assert document["confidence"] <= found["presence"]
    assert run_register(*words, "--out", tmp_path / "found") == 0
    assert re.search(r"found in box [-\d ]+: there with probability 0\.\d\d", printed(capsys))
    assert run_register(*words, "--box", *box_of(0), "--json") == 0
    assert "localization" not in json.loads(printed(capsys))


def test_register_list_json_prints_one_line_per_row(folder, capsys, check):
    rows = [["photos/0.png", *box_of(0)], ["none.png", "", "", "", ""], ["photos/1.png", "1", "", "", ""]]
    path = written(folder / "list.csv", "photo,x0,y0,x1,y1", *rows)
    before = sorted(found.name for found in folder.iterdir())
    assert run_register("--list", path, folder / "truck.safetensors", "--no-refine", "--json") == 0
    found = capsys.readouterr()
    documents = [json.loads(line) for line in found.out.splitlines()]
    assert [document["status"] for document in documents] == ["ok", "failed", "failed"]
    for document in documents:
        check(document)
    first, second, last = found.err.splitlines()
    assert first.startswith("failed: row 2: ")
    assert second.startswith("failed: row 3: ")
    assert re.fullmatch("3 photographs: 1 ok, 2 failed, [01] reliable", last)
    assert sorted(found.name for found in folder.iterdir()) == before


def test_schema_refuses_other_documents(folder, capsys, check):
    import jsonschema

    files = [folder / "photos" / "0.png", folder / "truck.safetensors"]
    assert run_register(*files, "--no-refine", "--json") == 0
    good = json.loads(printed(capsys))
    check(good)
    for change in (
        {"rotation": good["rotation"][:2]},
        {"confidence": 1.5},
        {"new": 1},
        {"status": "failed"},
        {"top": []},
        {"translation": [1, 2, None]},
        {"inputs": {**good["inputs"], "box": None}},
    ):
        with pytest.raises(jsonschema.ValidationError):
            check({**good, **change})
    assert "corrected_box" in good
    for missing in set(good) - {"localization", "mesh"}:
        with pytest.raises(jsonschema.ValidationError, match=f"'{missing}' is a required property"):
            check({key: value for key, value in good.items() if key != missing})


def test_demo_document_follows_the_schema(tmp_path, monkeypatch, check):
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    assert main(["demo", "--out", str(tmp_path / "demo"), "--preset", "fast", "--quiet"]) == 0
    check(json.loads((tmp_path / "demo" / "result.json").read_text()))


def test_schema_command_prints_the_schema(capsys):
    assert main(["schema"]) == 0
    assert json.loads(printed(capsys)) == SCHEMA


def keys(schema):
    """Names of all properties, however deep."""
    for name, inside in schema.get("properties", {}).items():
        yield name
        if isinstance(inside, dict):
            yield from keys(inside)
    for inside in [*schema.get("$defs", {}).values(), *schema.get("anyOf", [])]:
        yield from keys(inside)


def test_results_page_explains_every_key():
    text = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"`(\w+)`", text))
    assert set(keys(SCHEMA)) - explained == set()


def commands(parser, words=()):
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from commands(below, (*words, name))


@pytest.mark.parametrize(
    ("words", "parser"), [pytest.param(w, p, id=" ".join(w)) for w, p in commands(build_parser()) if w]
)
def test_help_shows_examples_that_parse(words, parser):
    text = parser.format_help()
    assert "\nexamples:\n" in text
    for line in text.split("\nexamples:\n")[1].splitlines():
        name, *said = shlex.split(line.partition(">")[0])
        assert (name, *said[: len(words)]) == ("curvireg", *words)
        parse(said)
