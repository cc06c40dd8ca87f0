import contextlib
import struct

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from curvireg_torch.data import mat_files
from curvireg_torch.data.mat_files import read_mat
from curvireg_torch.errors import InvalidInputError
from tests._support.matlab import element, file
from tests._support.miniature import pascal_object, write_record


def array(array_class: int, dims: tuple[int, ...], rest: bytes, name: bytes = b"") -> bytes:
    head = element(6, struct.pack("<II", array_class, 0)) + element(5, struct.pack(f"<{len(dims)}i", *dims))
    return element(14, head + element(1, name) + rest)


FIELD_A = element(5, struct.pack("<i", 8)) + element(1, b"a".ljust(8, b"\0"))  # one field, named a


def nested_struct(depth: int) -> bytes:
    value = array(6, (1, 1), element(9, struct.pack("<d", 1.0)))
    for i in range(depth):
        value = array(2, (1, 1), FIELD_A + value, b"record" if i == depth - 1 else b"")
    return value


@pytest.mark.parametrize("compress", [False, True])
def test_read_mat_agrees_with_scipy(tmp_path, compress):
    types = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
    numbers = {t: np.array([[1, 2, 3], [4, 5, 100]], t) for t in types}
    structs = np.empty((1, 2), dtype=[("a", object), ("b", object)])
    structs[0, 0], structs[0, 1] = ("x", np.eye(2)), ("", np.empty((0, 0)))
    record = {**{f"n_{k}": v for k, v in numbers.items()}, "text": "car äβ", "flag": True, "structs": structs}
    record |= {"complex": np.array([1j]), "cell": np.array([1, "a"], dtype=object)}
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"other": 1.0, "record": record}, do_compression=compress)
    (ours,) = read_mat(path, "record")
    expected = scipy.io.loadmat(path)["record"][0, 0]
    for kind in numbers:
        np.testing.assert_array_equal(ours[f"n_{kind}"], expected[f"n_{kind}"].ravel("F"))
        assert type(ours[f"n_{kind}"]) is np.ndarray
    assert ours["text"] == expected["text"][0]
    assert ours["flag"] == [1.0]
    assert [s["a"] for s in ours["structs"]] == ["x", ""]
    np.testing.assert_array_equal(ours["structs"][0]["b"], [1, 0, 0, 1])
    assert ours["structs"][1]["b"].size == 0
    assert ours["complex"] is None
    assert ours["cell"] is None
    assert read_mat(path, "other") == [1.0]


def test_read_mat_reads_big_endian_files(tmp_path):
    def swapped(kind, content):
        return struct.pack(">II", kind, len(content)) + content + b"\0" * (-len(content) % 8)

    small = struct.pack(">HH", 3, 1) + b"abc\0"  # name in the small form
    body = swapped(6, struct.pack(">II", 6, 0)) + swapped(5, struct.pack(">ii", 1, 2)) + small
    body += swapped(9, struct.pack(">dd", 1.5, -2.0))
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI"
    (tmp_path / "a.mat").write_bytes(header + swapped(14, body))
    assert read_mat(tmp_path / "a.mat", "abc").tolist() == [1.5, -2.0]
    np.testing.assert_array_equal(scipy.io.loadmat(tmp_path / "a.mat")["abc"], [[1.5, -2.0]])


def test_read_mat_bounds_depth(tmp_path):
    (tmp_path / "a.mat").write_bytes(file(nested_struct(10)))
    assert isinstance(read_mat(tmp_path / "a.mat", "record"), list)
    (tmp_path / "a.mat").write_bytes(file(nested_struct(3000)))
    with pytest.raises(InvalidInputError, match="16 deep"):
        read_mat(tmp_path / "a.mat", "record")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (array(6, (1 << 15, 1 << 15), element(9, b"\0" * 8), b"record"), "claims 1073741824 numbers"),
        (array(2, (1 << 15, 1 << 15), FIELD_A, b"record"), "struct array claims"),
        (array(2, (1, 1), element(5, struct.pack("<i", 0)) + element(1, b""), b"record"), "field names"),
        (array(6, (-1, 1), element(9, b""), b"record"), "negative"),
        (array(6, (1, 1), element(99, b"\0" * 8), b"record"), "unknown type"),
        (array(4, (1, 1), element(99, b"\0" * 8), b"record"), "unknown type"),
        (array(4, (1, 1), element(16, b"\xff\xfe"), b"record"), "damaged"),
        (element(14, b"\0" * 8), "without flags"),
        (element(15, b"not zlib"), "damaged"),
        (struct.pack("<II", 14, 1 << 31), "ends inside"),
        (b"", "holds no variable"),
    ],
)
def test_read_mat_refuses_false_claims(tmp_path, content, message):
    (tmp_path / "a.mat").write_bytes(file(content))
    with pytest.raises(InvalidInputError, match=rf"a\.mat.*{message}"):
        read_mat(tmp_path / "a.mat", "record")


def test_read_mat_bounds_size(tmp_path, monkeypatch):
    scipy.io.savemat(tmp_path / "a.mat", {"record": np.zeros((1000, 100))}, do_compression=True)
    assert read_mat(tmp_path / "a.mat", "record").size == 100000
    monkeypatch.setattr(mat_files, "MAX_MAT_UNPACKED_BYTES", 100000)
    with pytest.raises(InvalidInputError, match="unpacks to more"):
        read_mat(tmp_path / "a.mat", "record")
    monkeypatch.setattr(mat_files, "MAX_MAT_BYTES", 100)
    with pytest.raises(InvalidInputError, match="larger"):
        read_mat(tmp_path / "a.mat", "record")


def test_read_mat_refuses_other_formats_and_missing_files(tmp_path):
    for content in (b"short", b"MATLAB 7.3".ljust(124) + b"\x00\x02IM" + b"\x89HDF"):
        (tmp_path / "a.mat").write_bytes(content)
        with pytest.raises(InvalidInputError, match="MATLAB 5"):
            read_mat(tmp_path / "a.mat", "record")
    with pytest.raises(InvalidInputError, match="damaged"):
        read_mat(tmp_path / "nothing.mat", "record")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), min_size=1, max_size=8), st.integers(0, 5000))
def test_read_mat_survives_random_damage(tmp_path, changes, cut):
    path = tmp_path / "a.mat"
    if not path.exists():
        write_record(tmp_path / "valid.mat", [pascal_object("car"), pascal_object("sofa")])
        record = scipy.io.loadmat(tmp_path / "valid.mat")["record"]
        scipy.io.savemat(tmp_path / "valid.mat", {"record": record})  # without compression damage reaches further
        path.touch()
    data = bytearray((tmp_path / "valid.mat").read_bytes())
    for position, value in changes:
        data[position % len(data)] = value
    path.write_bytes(data[: max(cut, 200)] if cut % 3 == 0 else data)
    with contextlib.suppress(InvalidInputError):
        read_mat(path, "record")
