"""The rule for files that commands write: no input, and nothing of others, is written or
removed."""

import json
import os

import pytest

from curvireg_torch.jobs.outputs import FILES, MARKER, check_output_file, output_folder
from tests._support import refused

SEVERAL = "register several"


def marked(folder):
    return json.loads((folder / MARKER).read_text())["commands"]


def begin(folder, command, **how):
    """What a command does before its work."""
    output_folder(folder, command, **how).__enter__()


def complete(folder, command, *names, **how):
    """A run of a command that writes these files."""
    with output_folder(folder, command, **how):
        for name in names:
            (folder / name).write_text("{}")


@pytest.mark.parametrize(
    ("command", "name"), [(command, name) for command in FILES for name in FILES[command]]
)
def test_files_of_others_are_refused_and_named(tmp_path, command, name):
    file = tmp_path / name.replace("*", "1")
    file.write_text("of others")
    with refused(rf"{file.name}: not written by this command; move it away"):
        begin(tmp_path, command)
    assert file.read_text() == "of others"
    assert not (tmp_path / MARKER).exists()


def test_own_files_are_replaced_and_others_beside_them_do_not_matter(tmp_path):
    (tmp_path / "notes.txt").write_text("of others")
    for _ in range(2):
        complete(tmp_path, "register", "result.json")
    assert marked(tmp_path) == {"register": {"files": ["result.json"], "source": []}}
    (tmp_path / "pose.glb").write_text("a mesh that came later")
    with refused(r"pose\.glb: not written"):
        begin(tmp_path, "register")


def killed(folder, command, name, **how):
    """A process that is killed while ``command`` writes; it has written the file ``name``."""
    child = os.fork()
    if not child:
        context = output_folder(folder, command, **how)
        context.__enter__()
        if name:
            (folder / name).write_text("")
        os._exit(0)
    os.waitpid(child, 0)


def test_a_command_that_was_killed_may_go_on(tmp_path):
    """The marker is written before the files."""
    killed(tmp_path, SEVERAL, "results.jsonl")
    marker = (tmp_path / MARKER).stat().st_mtime_ns
    with output_folder(tmp_path, SEVERAL):
        assert (tmp_path / MARKER).stat().st_mtime_ns == marker, "it is not written again"
        assert (tmp_path / "results.jsonl").exists(), "rows are resumed"


@pytest.mark.parametrize("source", [["a.csv"], ["b.csv"]])
def test_of_two_runs_at_a_time_the_second_is_refused(tmp_path, source):
    with output_folder(tmp_path, SEVERAL, source=["a.csv"]):
        marker = (tmp_path / MARKER).read_bytes()
        with refused("another run is writing its results here"):
            begin(tmp_path, SEVERAL, source=source)
        assert (tmp_path / MARKER).read_bytes() == marker
    complete(tmp_path, SEVERAL, source=source)


def test_a_run_of_another_source_that_was_stopped_is_not_taken_over(tmp_path):
    """Even before it has a result: who started it resumes it."""
    killed(tmp_path, SEVERAL, None, source=["a.csv"])
    marker = (tmp_path / MARKER).read_bytes()
    with refused(r"a run of a\.csv was stopped here"):
        begin(tmp_path, SEVERAL, source=["b.csv"])
    assert (tmp_path / MARKER).read_bytes() == marker
    for name in ("a.csv", "b.csv"):
        complete(tmp_path, SEVERAL, source=[name])


@pytest.mark.parametrize("command", FILES)
def test_what_an_earlier_run_left_goes_first_but_for_rows_that_are_resumed(tmp_path, command):
    names = [name.replace("*", "1") for name in FILES[command]]
    complete(tmp_path, command, *names)
    with pytest.raises(OSError, match="unreadable"), output_folder(tmp_path, command):
        raise OSError("unreadable")
    left = {path.name for path in tmp_path.iterdir()} - {MARKER}
    assert left == {"results.jsonl", "thumbnails"} & {*names}


def test_an_error_of_the_command_keeps_its_files(tmp_path):
    def write():
        (tmp_path / "mesh.ply").write_text("ply")
        (tmp_path / "no" / "photo.png").write_text("png")

    with pytest.raises(OSError, match="No such file"), output_folder(tmp_path, "demo"):
        write()
    assert marked(tmp_path)["demo"]["files"] == ["mesh.ply"]


@pytest.mark.parametrize(
    ("first", "name", "second"),
    [
        ("follow", "results.csv", SEVERAL),
        ("evaluate", "results.jsonl", SEVERAL),
        ("demo", "result.json", "register"),
    ],
)
def test_files_of_another_command_are_refused(tmp_path, first, name, second):
    for one, other in ((first, second), (second, first)):
        complete(tmp_path, one, name)
        with refused(rf"{name}: a result of 'curvireg {one}'"):
            begin(tmp_path, other)
        (tmp_path / name).unlink()


def test_inputs_are_refused_under_any_name(tmp_path):
    """Also one that the command itself wrote before, and a link to it."""
    out = tmp_path / "out"
    complete(out, "register", "result.json")
    os.link(out / "result.json", tmp_path / "start.json")
    (tmp_path / "link.json").symlink_to(out / "result.json")
    for path in (
        out / "result.json",
        out / ".." / "out" / "result.json",
        tmp_path / "start.json",
        tmp_path / "link.json",
    ):
        with refused(rf"{path.name}: an input of this command"):
            begin(out, "register", inputs=[tmp_path / "none", path])


def test_results_of_another_source_would_be_lost(tmp_path):
    complete(tmp_path, SEVERAL, "results.csv", source=["a.jpg", "b.jpg"])
    with refused(r"holds results of b\.jpg, which would be lost"):
        begin(tmp_path, SEVERAL, source=["a.jpg", "c.jpg"])
    complete(tmp_path, SEVERAL)
    assert marked(tmp_path)[SEVERAL]["source"] == ["a.jpg", "b.jpg"], "of none, it stays"
    complete(tmp_path, SEVERAL, source=["c.jpg", "b.jpg", "a.jpg"])
    assert marked(tmp_path)[SEVERAL]["source"] == ["c.jpg", "b.jpg", "a.jpg"]


@pytest.mark.parametrize(
    "content", ["[]", "{", '{"commands": [1]}', '{"commands": {"register": {"files": 1}}}']
)
def test_damaged_markers_are_refused(tmp_path, content):
    (tmp_path / MARKER).write_text(content)
    with refused(rf"{MARKER}: "):
        begin(tmp_path, "register")


def test_files_that_are_named_are_replaced_only_with_our_mark(tmp_path):
    file = tmp_path / "new" / "overlay.png"
    check_output_file(file, [])
    file.write_bytes(b"a picture")
    with refused(r"overlay\.png: exists, and this command did not write it"):
        check_output_file(file, [])
    file.write_bytes(b"a picture by curvireg")
    check_output_file(file, [])
    with refused(r"overlay\.png: an input"):
        check_output_file(file, [file])
