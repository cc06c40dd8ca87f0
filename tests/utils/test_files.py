import csv
import math
import os
import signal
import sys
import unicodedata
from pathlib import Path

import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.errors import CurviregError, MissingFileError, OutputError
from curvireg_torch.utils import files
from curvireg_torch.utils.files import as_stored, file_name, found_in, only_in
from tests._support import refused

OLD = b"a" * 1000
NEW = b"b" * 5_000_000


@pytest.fixture
def path(tmp_path):
    files.write_file(tmp_path / "file", OLD)
    return tmp_path / "file"


def test_write_file_replaces_files_and_targets_of_links(tmp_path):
    path = tmp_path / "new" / "folder" / "file"
    files.write_file(path, OLD)
    with path.open("rb") as reader:
        files.write_file(path, NEW)
        assert reader.read() == OLD, "who has the file open keeps the old content"
    assert (path.read_bytes(), list(path.parent.iterdir())) == (NEW, [path])
    link = tmp_path / "link"
    link.symlink_to(path)
    files.write_file(link, OLD)
    assert link.is_symlink()
    assert path.read_bytes() == OLD


def test_write_file_keeps_the_old_content_if_writing_fails(path):
    resource = pytest.importorskip("resource", reason="limits of files are those of Unix")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with refused(
            r"file: cannot be written \(File too large\); choose another place", OutputError
        ):
            files.write_file(path, NEW)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (path.read_bytes(), list(path.parent.iterdir())) == (OLD, [path])


@pytest.mark.parametrize("name", ["file/x", "folder", "null"])
def test_write_file_refuses_other_targets(tmp_path, name):
    (tmp_path / "file").write_bytes(OLD)
    (tmp_path / "folder").mkdir()
    (tmp_path / "null").symlink_to(os.devnull)
    with refused(f"{name}: cannot be written", CurviregError) as error:
        files.write_file(tmp_path / name, NEW)
    assert isinstance(error.value, OSError)
    assert len(str(error.value).splitlines()) == 1
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder", "null"]
    assert not Path(os.devnull).is_file()


def test_check_writable_leaves_nothing_and_names_the_folder(tmp_path):
    files.check_writable(tmp_path / "a" / "b")
    assert not list((tmp_path / "a" / "b").iterdir())
    (tmp_path / "file").write_bytes(OLD)
    reason = r"file: cannot be written to \(.*\); choose another folder$"
    with refused(reason, OutputError) as caught:
        files.check_writable(tmp_path / "file")
    assert caught.value.kind == "out"


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_write_file_keeps_the_old_content_if_interrupted(number, code, path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _: signal.raise_signal(number))
    monkeypatch.setattr("curvireg_torch.matching.list_cache", lambda: files.write_file(path, NEW))
    handlers = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    # a shell ignores the first for jobs in the background, nohup the last
    before = {name: signal.signal(name, handler) for name, handler in handlers.items()}
    try:
        with pytest.raises(SystemExit, match=str(code)):
            sys.exit(main(["cache"]))
        after = {name: signal.getsignal(name) for name in handlers}
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
    assert (path.read_bytes(), list(path.parent.iterdir())) == (OLD, [path])
    assert after == handlers


def test_a_command_below_nohup_outlives_its_terminal():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with files.terminable():
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_write_csv_leaves_nothing_to_a_spreadsheet_to_compute(tmp_path):
    cells = ["=1+1", "+cmd", "-2+3", "@sum", "\tx", "-1.5", "+2e-3", "a=b", "", -0.5]
    files.write_csv(tmp_path / "t.csv", [cells])
    with (tmp_path / "t.csv").open(newline="") as file:
        (row,) = csv.reader(file)
    assert row == ["'=1+1", "'+cmd", "'-2+3", "'@sum", "'\tx", "-1.5", "+2e-3", "a=b", "", "-0.5"]


def test_read_json_refuses_malicious_missing_and_large_files(tmp_path):
    for content in (b"[" * 2_000_000, b'{"0": ' + b"1" * 100_000 + b"}", b"\xff", b"[1]"):
        (tmp_path / "a.json").write_bytes(content)
        with refused(r"a\.json: .*README shows the layout") as caught:
            files.read_json(tmp_path / "a.json", dict, "README")
        assert len(str(caught.value).splitlines()) == 1
        assert len(str(caught.value)) < 1000
    with open(tmp_path / "a.json", "wb") as file:
        file.truncate((1 << 25) + 1)  # a sparse file
    with refused("larger than 33,554,432 bytes"):
        files.read_json(tmp_path / "a.json", dict, "README")
    with refused("no such file; README", MissingFileError):
        files.read_json(tmp_path / "none.json", dict, "README")


def test_finite_numbers_accepts_finite_numbers_only():
    assert files.finite_numbers([1, 2.5], 2) == (1.0, 2.5)
    pairs = ([1, wrong] for wrong in (True, "2", math.nan, 10**400))
    for values in (*pairs, [1], "12", {"a": 1, "b": 2}, None):
        assert files.finite_numbers(values, 2) is None


@pytest.mark.parametrize("digest", [files.tensor_digest, files.tensor_checksum])
def test_tensor_digest_depends_on_name_dtype_shape_and_values(digest):
    x = torch.arange(4.0)
    others = [
        {"b": x},
        {"a": x.double()},
        {"a": x.view(2, 2)},
        {"a": x + 1e-6},
        {"a": x, "b": x},
        {"a": x.bfloat16()},
    ]
    found = {digest(tensors) for tensors in ({"a": x}, *others)}
    assert len(found) == 1 + len(others)
    strided = torch.stack([x, x], dim=1)[:, 0].requires_grad_()
    assert digest({"a": strided}) == digest({"a": x})


def test_digests_have_as_many_digits_as_they_say():
    tensors = {"a": torch.tensor(True)}
    assert len(files.tensor_digest(tensors, size=16)) == 32
    assert len(files.tensor_checksum(tensors)) == 8


def test_only_in_finds_files_of_one_folder(tmp_path):
    find = only_in(tmp_path)
    for name in ("/etc/a.png", "../a.png", "C:\\b\\a.png", "b/../a.png", "\0a\n.png", " a.png "):
        assert find(name) == tmp_path / "a.png"
    for name in ("", "..", "../..", "x/.", "..\\.."):
        assert find(name) == tmp_path / "file"
    assert file_name("ä" * 500 + ".png").endswith("ä.png")
    assert len(file_name("ä" * 500).encode()) < 255


def test_a_csv_file_that_grows_has_each_row_at_once_and_begins_anew(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("older")
    grown = files.CsvFile(path, ["name", "value"])
    assert path.read_text() == "older", "until there is a row"
    grown.add(["=a,b", 1.5])
    assert path.read_bytes() == b'name,value\n"\'=a,b",1.5\n'
    grown.add(["c", ""])
    assert path.read_text().splitlines()[1:] == ['"\'=a,b",1.5', "c,"]
    with refused(r"none.x\.csv: cannot be written", OutputError):
        files.CsvFile(tmp_path / "none" / "x.csv", ["name"]).add(["a"])


@pytest.mark.parametrize("stored", ["NFC", "NFD"])
def test_a_name_is_found_however_its_accents_are_stored(tmp_path, stored):
    folder = tmp_path / unicodedata.normalize("NFD", "Möbel")
    folder.mkdir()
    file = folder / unicodedata.normalize(stored, "Stühle.png")
    file.write_text("")
    forms = ["NFC", "NFD"]
    for form in forms:
        typed = tmp_path / unicodedata.normalize(form, "Möbel/Stühle.png")
        assert as_stored(typed) == file
        assert found_in(tmp_path)(str(typed.relative_to(tmp_path))) == file
        other = typed.with_name("Stuhle.png")
        assert as_stored(other) == other
        missing = typed.with_name(unicodedata.normalize(form, "Tür.png"))
        assert as_stored(missing) == missing


def test_of_two_names_that_differ_in_form_alone_the_typed_one_is_taken(tmp_path):
    names = [unicodedata.normalize("NFC", "ü.png"), unicodedata.normalize("NFD", "ü.png")]
    for name in names:
        (tmp_path / name).write_text("")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system takes them for one name")
    assert [as_stored(tmp_path / name).name for name in names] == names
