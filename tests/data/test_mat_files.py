import json
import struct
import zlib
from pathlib import Path

import numpy as np
import scipy.io

from curvireg_torch.data import mat_files
from curvireg_torch.data.mat_files import read_mats
from curvireg_torch.errors import MAX_MAT_BYTES, WorkerError
from tests._support.miniature import pascal_object, write_record
from tests._support.refusals import refused


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def file(content):
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + content


def array(array_class, dims, rest, name=b"record"):
    flags = struct.pack("<II", array_class, 0)
    sizes = struct.pack(f"<{len(dims)}i", *dims)
    return element(14, element(6, flags) + element(5, sizes) + element(1, name) + rest)


FIELD_A = element(5, struct.pack("<i", 8)) + element(1, b"a".ljust(8, b"\0"))  # one field, named a


def nested(depth):
    value = array(6, (1, 1), element(9, struct.pack("<d", 1.0)))
    for _ in range(depth):
        value = array(2, (1, 1), FIELD_A + value)
    return value


def read(path, variable="record"):
    (value,) = read_mats([path], variable)
    return value


def test_values_are_plain_numbers_texts_and_structs(tmp_path):
    types = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
    structs = np.empty((1, 2), dtype=[("a", object), ("b", object)])
    structs[0, 0], structs[0, 1] = ("x", np.eye(2)), ("", np.empty((0, 0)))
    record = {f"n_{kind}": np.array([[1, 2, 3], [4, 5, 100]], kind) for kind in types}
    record |= {"text": "car äβ", "flag": True, "structs": structs, "unknown": np.nan}
    record |= {"complex": np.array([1j]), "cell": np.array([1, "a"], dtype=object)}
    paths = [tmp_path / "a.mat", tmp_path / "b.mat"]
    for path, compress in zip(paths, (False, True), strict=True):
        scipy.io.savemat(path, {"other": 1.0, "record": record}, do_compression=compress)
    (ours,), (compressed,) = read_mats(paths, "record")
    assert str(ours) == str(compressed)
    for kind in types:
        assert ours[f"n_{kind}"] == [1, 4, 2, 5, 3, 100], "by columns"
    assert (ours["text"], ours["flag"], ours["complex"], ours["cell"]) == (
        "car äβ",
        [1],
        None,
        None,
    )
    assert ours["structs"] == [{"a": "x", "b": [1, 0, 0, 1]}, {"a": "", "b": []}]
    assert np.isnan(ours["unknown"]).all()
    assert read(path, "other") == [1.0]
    assert read(path, "third") is None


def test_files_that_end_the_process_or_take_its_memory_cost_no_others(tmp_path):
    """Of these some end SciPy's process by a segmentation fault, others claim what they lack."""
    packed = zlib.compress(array(6, (1, 300_000_000), element(2, b""), b"record"), 9)
    contents = (
        array(6, (1 << 15, 1 << 15), element(9, b"\0" * 8)),
        array(2, (1 << 15, 1 << 15), FIELD_A),
        array(6, (1, 1), element(99, b"\0" * 8)),
        array(4, (1, 1), element(99, b"\0" * 8)),
        nested(3000),
        struct.pack("<II", 15, len(packed)) + packed,
        struct.pack("<II", 14, 1 << 31),
        b"",
        bytes(MAX_MAT_BYTES),
    )
    paths = []
    for number, content in enumerate(contents):
        paths += [tmp_path / f"{number}.mat", tmp_path / f"good_{number}.mat"]
        paths[-2].write_bytes(file(content))
        paths[-1].write_bytes(file(nested(10)))
    values = list(read_mats([*paths, tmp_path / "nothing.mat"], "record"))
    assert [value is None for value in values] == [True, False] * len(contents) + [True]
    assert json.dumps(values[1]).count("a") == 10


def test_no_file_counts_as_damaged_where_scipy_does_not_start(tmp_path, monkeypatch):
    write_record(tmp_path / "a.mat", [pascal_object("car")])
    program = tmp_path / "program.py"
    program.write_text("import no_scipy")
    monkeypatch.setattr("curvireg_torch.data.mat_files._PROGRAM", program)
    with refused("SciPy, .* does not start", WorkerError):
        read(tmp_path / "a.mat")


def test_damaged_files_have_a_value_or_none(tmp_path):
    whole = tmp_path / "whole.mat"
    write_record(whole, [pascal_object("car"), pascal_object("sofa")])
    # without compression damage reaches further
    scipy.io.savemat(whole, {"record": scipy.io.loadmat(whole)["record"]})
    content = whole.read_bytes()
    rng = np.random.default_rng(0)
    paths = []
    for number in range(40):
        part = content[: rng.integers(100, len(content))] if rng.random() < 0.3 else content
        data = bytearray(part)
        for position in rng.integers(0, len(data), rng.integers(1, 8)):
            data[position] = rng.integers(0, 256)
        paths.append(tmp_path / f"{number}.mat")
        paths[-1].write_bytes(data)
    values = list(read_mats([*paths, whole], "record"))
    assert len(values) == 41
    assert values.count(None) > 10
    assert [entry["class"] for entry in values[-1][0]["objects"]] == ["car", "sofa"]


def test_a_file_that_is_read_at_the_time_limit_is_not_lost(monkeypatch):
    calls = []

    def interrupted(_, asked_and_found, **__):
        asked, found = map(Path, asked_and_found)
        _, _, *names = json.loads(asked.read_text())
        calls.append(names)
        found.write_text("".join(f"{json.dumps(name)}\n" for name in names[:2]))

    monkeypatch.setattr(mat_files, "run_program", interrupted)
    paths = [Path(name) for name in "abc"]
    assert list(read_mats(paths, "record")) == ["a", "b", "c"]
    assert calls == [["a", "b", "c"], ["c"]]
