"""``curvireg register --list``: the contract of its files."""

import json

import pytest
import torch

from curvireg_torch import Pipeline, ViewBank, sample_views
from curvireg_torch.cli import main
from curvireg_torch.evaluation.lists import register as loop
from curvireg_torch.geometry import rotation_error
from curvireg_torch.synthetic import example_mesh
from tests._support.lists import CAMERA, RESULTS, box_of, lines, table, write_files, written
from tests._support.scenes import scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("list"))


def register(path, *more, mesh="truck.safetensors", out="out"):
    meshes = [] if mesh is None else [str(path.parent / mesh)]
    return main(["register", "--list", str(path), *meshes, "--out", str(path.parent / out), "--quiet", *more])


def pose(row):
    return torch.tensor([[float(row[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)], dtype=torch.float64)


def test_every_row_is_answered_in_the_lists_order(folder, capsys):
    """Columns in any order, others passed through; what is wrong with a row is said there and stops no other."""
    header = "note,photo,x0,y0,x1,y1,fx,fy,cx,cy"
    nothing = [""] * 4
    rows = [
        ['a "quoted", note', "photos/0.png", *box_of(0), *CAMERA],
        ["é\nü", "photos/1.png", *box_of(1), *nothing],
        ["gone", "photos/none.png", *nothing, *nothing],
        ["no picture", "text.jpg", *nothing, *nothing],
        ["outside", "photos/0.png", "900", "1", "950", "9", *nothing],
        ["NaN box", "photos/0.png", "nan", "1", "95", "9", *nothing],
        ["no number", "photos/0.png", "1", "1", "9o", "9", *nothing],
        ["part of a box", "photos/0.png", "1", "1", "", "9", *nothing],
        ["part of a camera", "photos/0.png", *box_of(0), "260", "", "119.5", "89.5"],
        ["NaN camera", "photos/0.png", *box_of(0), "260", "260", "nan", "89.5"],
        ["negative", "photos/0.png", *box_of(0), "-260", "260", "119.5", "89.5"],
        ["one colour", "flat.png", *nothing, *nothing],
        ["short", "photos/0.png"],
        ["looked for", "photos/2.png", *nothing, *nothing],
        ["last", " photos/2.png ", *box_of(2), *CAMERA],
    ]
    path = written(folder / "all.csv", header, *rows)
    assert register(path, "--no-refine") == 0
    out = folder / "out"
    assert (out / "results.csv").read_text().splitlines()[0].split(",") == [*header.split(","), *RESULTS]
    found = table(out)
    assert [
        [row[name] for name in header.split(",")][: len(cells)] for row, cells in zip(found, rows, strict=True)
    ] == rows
    good = {0: 0, 1: 1, 13: None, 14: 2}
    assert [k for k, row in enumerate(found) if row["status"] == "ok"] == list(good)
    for k, seed in good.items():
        assert found[k]["message"] == ""
        assert 0 <= float(found[k]["confidence"]) <= 1
        assert found[k]["reliable"] in ("true", "false")
        if seed is not None:
            assert float(rotation_error(pose(found[k]), scene(seed)[2][:3, :3])) < 15
    t = torch.tensor([float(found[0][name]) for name in ("tx", "ty", "tz")], dtype=torch.float64)
    truth = scene(0)[2][:3, 3]
    assert float((t - truth).norm() / truth.norm()) < 0.1
    assert [found[1][name] for name in ("tx", "ty", "tz")] == [""] * 3
    words = {2: "no such file", 3: "text.jpg", 4: "entirely outside", 5: "finite", 6: "x1: expected a number, got '9o'"}
    words |= {7: "nothing for x1", 8: "nothing for fy", 9: "finite", 10: "focal", 11: "one colour", 12: "2 cells"}
    for k, word in words.items():
        assert found[k]["status"] == "failed"
        assert word in found[k]["message"]
        assert len(found[k]["message"].splitlines()) == 1
        assert [found[k][name] for name in RESULTS[2:]] == ["", "false", *[""] * 12]
    documents = lines(out)
    assert [(d["row"], d["status"], d["message"]) for d in documents] == [
        (number, row["status"], row["message"]) for number, row in enumerate(found, start=1)
    ]
    assert documents[0]["rotation"] == pose(found[0]).tolist()
    assert documents[0]["columns"] == dict(zip(header.split(","), rows[0], strict=True))
    assert {"top", "covariance", "pipeline", "versions", "seconds", "conventions", "inputs"} <= set(documents[0])
    reliable = sum(row["reliable"] == "true" for row in found)
    printed = capsys.readouterr().out.strip()
    assert printed == f"15 photographs: 4 ok, 11 failed, {reliable} reliable; see {out}/results.csv"


def test_the_pose_of_a_row_is_that_of_the_photograph_alone(folder):
    """To the bit, with the network and the search, in which roundings grow."""
    views = sample_views(azimuth_step=45, elevations=[20])
    ViewBank.build(example_mesh(), views, pipeline=Pipeline(), progress=False).save(folder / "learned.safetensors")
    rows = [[f"photos/{seed}.png", *box_of(seed), *CAMERA] for seed in range(2)]
    path = written(folder / "alone.csv", "photo,x0,y0,x1,y1,fx,fy,cx,cy", *rows)
    assert register(path, mesh="learned.safetensors", out="together") == 0
    for line, (photo, *numbers) in zip(lines(folder / "together"), rows, strict=True):
        words = ["--box", *numbers[:4], "--camera", *numbers[4:]]
        files = [str(folder / photo), str(folder / "learned.safetensors"), "--out", str(folder / "one")]
        assert main(["register", *files, *words, "--quiet"]) == 0
        alone = json.loads((folder / "one" / "result.json").read_text())
        same = ("rotation", "translation", "score", "confidence", "covariance", "top", "pipeline")
        assert [line[name] for name in same] == [alone[name] for name in same]


def counted(monkeypatch, stop_after=None):
    """Names of the photographs that are registered from now on; the one behind ``stop_after`` is interrupted."""
    done = []

    def register_entry(entry, *rest, **options):
        if len(done) == stop_after:
            raise KeyboardInterrupt
        done.append(entry.name)
        return true(entry, *rest, **options)

    true = loop.register_entry
    monkeypatch.setattr(loop, "register_entry", register_entry)
    return done


def test_it_goes_on_where_it_was(folder, monkeypatch, capsys):
    names = [f"photos/{seed}.png" for seed in range(3)]
    rows = [[name, *box_of(seed)] for seed, name in enumerate(names)]
    path = written(folder / "resumed.csv", "photo,x0,y0,x1,y1", *rows, rows[0])
    assert register(path, "--no-refine", out="whole") == 0
    out = folder / "resumed"
    for k in (1, 2):  # killed twice, while it wrote
        with monkeypatch.context() as patch:
            counted(patch, stop_after=1)
            assert register(path, "--no-refine", out="resumed") == 130
        torn = (out / "results.jsonl").read_bytes()
        assert [json.loads(line)["inputs"]["photo"] for line in torn.splitlines()] == names[:k]
        assert not (out / "results.csv").exists()
        (out / "results.jsonl").write_bytes(torn + torn.splitlines()[0][:500])
    done = counted(monkeypatch)
    assert register(path, "--no-refine", out="resumed") == 0
    assert done == names[2:]
    whole = (folder / "whole" / "results.csv").read_bytes()
    assert (out / "results.csv").read_bytes() == whole
    assert [line["row"] for line in lines(out)] == [1, 2, 3, 4]
    # Nothing to do, another order and another column: nothing is done.
    path = written(folder / "resumed.csv", "x0,y0,x1,y1,photo,id", *[[*row[1:], row[0], "7"] for row in rows[::-1]])
    assert register(path, "--no-refine", out="resumed") == 0
    assert done == names[2:]
    assert [(line["row"], line["columns"]["photo"]) for line in lines(out)] == list(enumerate(names[::-1], start=1))
    # Another photograph of that name; another box; other options: done again.
    (folder / "photos" / "2.png").rename(folder / "kept.png")
    (folder / "photos" / "2.png").write_bytes((folder / "photos" / "1.png").read_bytes())
    rows[0][1] = "1"
    path = written(folder / "resumed.csv", "photo,x0,y0,x1,y1", *rows)
    done.clear()
    assert register(path, "--no-refine", out="resumed") == 0
    (folder / "kept.png").rename(folder / "photos" / "2.png")
    assert sorted(done) == ["photos/0.png", "photos/2.png"]
    done.clear()
    assert register(path, "--no-refine", "--top", "2", out="resumed") == 0
    assert done == names
    assert "3 photographs: 3 ok" in capsys.readouterr().out


def test_a_photograph_that_was_missing_is_tried_again(folder):
    path = written(folder / "again.csv", "photo,x0,y0,x1,y1", ["photos/0.png", *box_of(0)], ["late.png", *box_of(1)])
    assert register(path, "--no-refine", out="again") == 0
    assert [row["status"] for row in table(folder / "again")] == ["ok", "failed"]
    (folder / "late.png").write_bytes((folder / "photos" / "1.png").read_bytes())
    assert register(path, "--no-refine", out="again") == 0
    (folder / "late.png").unlink()
    assert [row["status"] for row in table(folder / "again")] == ["ok", "ok"]


def test_rows_name_meshes(folder, monkeypatch):
    """Each bank is fetched once, whatever the order of the rows; a mesh that is missing or broken fails its rows."""
    opened = []

    def load(path, **options):
        opened.append(path.name)
        return true(path, **options)

    true = ViewBank.load
    monkeypatch.setattr(ViewBank, "load", load)
    (folder / "other.safetensors").write_bytes((folder / "truck.safetensors").read_bytes())
    (folder / "broken.safetensors").write_bytes((folder / "truck.safetensors").read_bytes()[:1000])
    meshes = ["", "other.safetensors", "", "none.ply", "broken.safetensors", "other.safetensors", "broken.safetensors"]
    rows = [[mesh, "photos/0.png", *box_of(0)] for mesh in meshes]
    path = written(folder / "meshes.csv", "mesh,photo,x0,y0,x1,y1", *rows)
    assert register(path, "--no-refine", out="meshes") == 0
    found = table(folder / "meshes")
    assert [row["status"] for row in found] == ["ok", "ok", "ok", "failed", "failed", "ok", "failed"]
    assert "none.ply" in found[3]["message"]
    assert "build" in found[4]["message"]
    assert opened == ["truck.safetensors", "other.safetensors", "broken.safetensors"]
    assert register(path, "--no-refine", mesh=None, out="own") == 0
    found = table(folder / "own")
    assert [row["status"] for row in found] == ["failed", "ok", "failed", "failed", "failed", "ok", "failed"]
    assert "no MESH" in found[0]["message"]


def test_none_is_exit_code_2_and_the_table_says_why(folder, capsys):
    path = written(folder / "none.csv", "photo,x0,y0,x1,y1", ["none.png", "", "", "", ""])
    assert register(path, "--no-refine", out="none") == 2
    printed = capsys.readouterr()
    assert printed.out.startswith("1 photographs: 0 ok, 1 failed, 0 reliable")
    assert len(printed.err.strip().splitlines()) == 1
    assert "no such file" in table(folder / "none")[0]["message"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["no such file"]),
        (b"", ["no column"]),
        (b"photo,x0,y0,x1,y1\n\n", ["no photographs"]),
        (b"a.png,1,2,3,4\n", ["no column photo"]),
        (b"photo;x0;y0;x1;y1\na.png;1;2;3;4\n", ["no column", "commas"]),
        (b"photo,x0,y0,x1\na.png,1,2,3\n", ["no column y1"]),
        (b"photo,x0,y0,x1,y1,x0\na.png,1,2,3,4,5\n", ["two columns x0"]),
        (b"photo,x0,y0,x1,y1,status\na.png,1,2,3,4,5\n", ["status", "rename"]),
        (b"photo,x0,y0,x1,y1\n\xff.png,1,2,3,4\n", ["UTF-8"]),
        (b'photo,x0,y0,x1,y1\n"a.png,1,2,3,4\n', ["CSV"]),
    ],
)
def test_lists_that_cannot_be_used(folder, tmp_path, capsys, content, words):
    path = tmp_path / "list.csv"
    if content is not None:
        path.write_bytes(content)
    assert main(["register", "--list", str(path), str(folder / "truck.safetensors"), "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    for word in ["list.csv", *words]:
        assert word in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--list", "a.csv", "a.stl", "b.stl"], "at most one MESH"),
        (["--list", "a.csv", "a.stl", "--box", "1", "2", "3", "4"], "leave --box"),
        (["a.jpg"], "expected PHOTO MESH"),
        (["--mesh", "a.stl"], "expected PHOTO MESH"),
        (["a.jpg", "a.stl", "--bogus", "3"], "unrecognized arguments: --bogus"),
    ],
)
def test_words_that_do_not_go_together(words, said, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["register", *words, "--out", "out"])
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


def test_options_between_photograph_and_mesh(folder):
    box = ["--box", *box_of(0)]
    files = [str(folder / "photos" / "0.png"), *box, str(folder / "truck.safetensors")]
    assert main(["register", *files, "--out", str(folder / "between"), "--no-refine", "--quiet"]) == 0


def test_options_that_are_refused_are_no_rows(folder, capsys):
    path = written(folder / "top.csv", "photo,x0,y0,x1,y1", ["photos/0.png", *box_of(0)])
    assert register(path, "--top", "0", out="top") == 2
    assert "hypotheses" in capsys.readouterr().err
    assert not (folder / "top" / "results.csv").exists()


def test_results_of_something_else_stay(folder, capsys):
    path = written(folder / "foreign.csv", "photo,x0,y0,x1,y1", ["photos/0.png", *box_of(0)])
    (folder / "foreign").mkdir()
    (folder / "foreign" / "results.jsonl").write_text('{"score": 1}\n')
    assert register(path, "--no-refine", out="foreign") == 2
    assert "results.jsonl" in capsys.readouterr().err
    assert (folder / "foreign" / "results.jsonl").read_text() == '{"score": 1}\n'
