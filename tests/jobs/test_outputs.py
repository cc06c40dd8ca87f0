"""The rule for files that commands write: no input, and nothing of others, is written or
removed."""

import json
import os

import pytest

from curvireg_torch.jobs.outputs import FILES, MARKER, check_output_file, output_folder
from tests._support import refused


def marked(folder):
    return json.loads((folder / MARKER).read_text())["commands"]


@pytest.mark.parametrize(
    ("command", "name"), [(command, name) for command in FILES for name in FILES[command]]
)
def test_files_of_others_are_refused_and_named(tmp_path, command, name):
    file = tmp_path / name.replace("*", "1")
    file.write_text("of others")
    with (
        refused(rf"{file.name}: not written by this command; move it away"),
        output_folder(tmp_path, command),
    ):
        pytest.fail("work began")
    assert file.read_text() == "of others"
    assert not (tmp_path / MARKER).exists()


def test_own_files_are_replaced_and_others_beside_them_do_not_matter(tmp_path):
    (tmp_path / "notes.txt").write_text("of others")
    for _ in range(2):
        with output_folder(tmp_path, "register"):
            (tmp_path / "result.json").write_text("{}")
    assert marked(tmp_path) == {"register": {"files": ["result.json"], "source": []}}
    (tmp_path / "pose.glb").write_text("a mesh that came later")
    with refused(r"pose\.glb: not written"), output_folder(tmp_path, "register"):
        pytest.fail("work began")


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
    killed(tmp_path, "register several", "results.jsonl")
    marker = (tmp_path / MARKER).stat().st_mtime_ns
    with output_folder(tmp_path, "register several"):
        assert (tmp_path / MARKER).stat().st_mtime_ns == marker, "it is not written again"
        assert (tmp_path / "results.jsonl").exists(), "rows are resumed"


@pytest.mark.parametrize("source", [["a.csv"], ["b.csv"]])
def test_of_two_runs_at_a_time_the_second_is_refused(tmp_path, source):
    with output_folder(tmp_path, "register several", source=["a.csv"]):
        marker = (tmp_path / MARKER).read_bytes()
        second = output_folder(tmp_path, "register several", source=source)
        with refused("another run is writing its results here"):
            second.__enter__()
        assert (tmp_path / MARKER).read_bytes() == marker
    with output_folder(tmp_path, "register several", source=source):
        pass


def test_a_run_of_another_source_that_was_stopped_is_not_taken_over(tmp_path):
    """Even before it has a result: who started it resumes it."""
    killed(tmp_path, "register several", None, source=["a.csv"])
    marker = (tmp_path / MARKER).read_bytes()
    with refused(r"a run of a\.csv was stopped here"):
        output_folder(tmp_path, "register several", source=["b.csv"]).__enter__()
    assert (tmp_path / MARKER).read_bytes() == marker
    with output_folder(tmp_path, "register several", source=["a.csv"]):
        pass
    with output_folder(tmp_path, "register several", source=["b.csv"]):
        pass


@pytest.mark.parametrize("command", FILES)
def test_what_an_earlier_run_left_goes_first_but_for_rows_that_are_resumed(tmp_path, command):
    names = [name.replace("*", "1") for name in FILES[command]]
    with output_folder(tmp_path, command):
        for name in names:
            (tmp_path / name).write_text("of the first photograph")
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


PAIRS = [
    ("follow", "results.csv", "register several"),
    ("evaluate", "results.jsonl", "register several"),
    ("demo", "result.json", "register"),
]


@pytest.mark.parametrize(("first", "name", "second"), PAIRS)
def test_files_of_another_command_are_refused(tmp_path, first, name, second):
    with output_folder(tmp_path, first):
        (tmp_path / name).write_text("")
    with refused(rf"{name}: a result of 'curvireg {first}'"):
        output_folder(tmp_path, second).__enter__()
    (tmp_path / name).unlink()
    with output_folder(tmp_path, second):
        (tmp_path / name).write_text("")
    with refused(f"a result of 'curvireg {second}'"):
        output_folder(tmp_path, first).__enter__()


def test_inputs_are_refused_under_any_name(tmp_path):
    """Also one that the command itself wrote before, and a link to it."""
    out = tmp_path / "out"
    with output_folder(out, "register"):
        (out / "result.json").write_text("{}")
    os.link(out / "result.json", tmp_path / "start.json")
    (tmp_path / "link.json").symlink_to(out / "result.json")
    for path in (
        out / "result.json",
        out / ".." / "out" / "result.json",
        tmp_path / "start.json",
        tmp_path / "link.json",
    ):
        with refused(rf"{path.name}: an input of this command"):
            output_folder(out, "register", inputs=[tmp_path / "none", path]).__enter__()


def test_results_of_another_source_would_be_lost(tmp_path):
    with output_folder(tmp_path, "register several", source=["a.jpg", "b.jpg"]):
        (tmp_path / "results.csv").write_text("")
    with refused(r"holds results of b\.jpg, which would be lost"):
        output_folder(tmp_path, "register several", source=["a.jpg", "c.jpg"]).__enter__()
    with output_folder(tmp_path, "register several"):
        pass
    assert marked(tmp_path)["register several"]["source"] == ["a.jpg", "b.jpg"], (
        "where none is given, it stays"
    )
    with output_folder(tmp_path, "register several", source=["c.jpg", "b.jpg", "a.jpg"]):
        pass
    assert marked(tmp_path)["register several"]["source"] == ["c.jpg", "b.jpg", "a.jpg"]


@pytest.mark.parametrize(
    "content", ["[]", "{", '{"commands": [1]}', '{"commands": {"register": {"files": 1}}}']
)
def test_damaged_markers_are_refused(tmp_path, content):
    (tmp_path / MARKER).write_text(content)
    with refused(rf"{MARKER}: "):
        output_folder(tmp_path, "register").__enter__()


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
