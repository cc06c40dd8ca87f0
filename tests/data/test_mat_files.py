import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import scipy.io

from curvireg_torch.data.mat_files import read_mat
from curvireg_torch.errors import MAX_MAT_BYTES, InvalidInputError
from tests._support.matlab import element, file
from tests._support.miniature import pascal_object, write_record


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


@pytest.mark.parametrize("compress", [False, True])
def test_read_mat_agrees_with_scipy(tmp_path, compress):
    types = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
    numbers = {t: np.array([[1, 2, 3], [4, 5, 100]], t) for t in types}
    structs = np.empty((1, 2), dtype=[("a", object), ("b", object)])
    structs[0, 0], structs[0, 1] = ("x", np.eye(2)), ("", np.empty((0, 0)))
    record = {
        **{f"n_{k}": v for k, v in numbers.items()},
        "text": "car äβ",
        "flag": True,
        "structs": structs,
    }
    record |= {"complex": np.array([1j]), "cell": np.array([1, "a"], dtype=object)}
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"other": 1.0, "record": record}, do_compression=compress)
    (ours,) = read_mat(path, "record")
    expected = scipy.io.loadmat(path)["record"][0, 0]
    for kind in numbers:
        np.testing.assert_array_equal(ours[f"n_{kind}"], expected[f"n_{kind}"].ravel("F"))
        assert type(ours[f"n_{kind}"]) is np.ndarray
    assert (ours["text"], ours["flag"]) == (expected["text"][0], [1.0])
    assert [s["a"] for s in ours["structs"]] == ["x", ""]
    np.testing.assert_array_equal(ours["structs"][0]["b"], [1, 0, 0, 1])
    assert ours["structs"][1]["b"].size == 0
    assert ours["complex"] is None
    assert ours["cell"] is None
    assert read_mat(path, "other") == [1.0]


def test_read_mat_refuses_false_claims_and_bounds_all_variables_together(tmp_path):
    for content, message in (
        (array(6, (1 << 15, 1 << 15), element(9, b"\0" * 8)), "claims 1073741824 numbers"),
        (array(2, (1 << 15, 1 << 15), FIELD_A), "struct array claims"),
        (
            array(2, (1 << 15, 1 << 15), element(5, struct.pack("<i", 8)) + element(1, b"")),
            "struct array claims",
        ),
        (array(2, (1, 1), element(5, struct.pack("<i", 0)) + element(1, b"")), "field names"),
        (array(6, (-1, 1), element(9, b"")), "claims -1"),
        (array(6, (1, 1), element(99, b"\0" * 8)), "unknown type"),  # ends scipy's process
        (array(4, (1, 1), element(99, b"\0" * 8)), "unknown type"),
        (array(4, (1, 1), element(16, b"\xff\xfe")), "utf-8"),
        (nested(3000), "16 deep"),
        (element(14, b"\0" * 8), "expected 3"),
        (element(15, b"not zlib"), "damaged"),
        (struct.pack("<II", 14, 1 << 31), "ends inside"),
        (element(14, struct.pack("<HH", 6, 9) + bytes(100)), "ends inside"),
        (b"", "holds no variable"),
    ):
        (tmp_path / "a.mat").write_bytes(file(content))
        tracemalloc.start()
        with pytest.raises(InvalidInputError, match=rf"a\.mat: .*{message}"):
            read_mat(tmp_path / "a.mat", "record")
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()
        (tmp_path / "a.mat").write_bytes(file(nested(10)))
        assert isinstance(read_mat(tmp_path / "a.mat", "record"), list)
    packed = zlib.compress(array(6, (1, 100_000), element(2, bytes(100_000)), b"other"), 9)
    for count in (10, 11):
        (tmp_path / "a.mat").write_bytes(
            file((struct.pack("<II", 15, len(packed)) + packed) * count)
        )
        message = "holds no variable" if count == 10 else "more than 1,048,576 bytes"
        with pytest.raises(InvalidInputError, match=message):
            read_mat(tmp_path / "a.mat", "record")
    (tmp_path / "a.mat").write_bytes(file(bytes(MAX_MAT_BYTES)))
    with pytest.raises(InvalidInputError, match="larger than 1,048,576 bytes"):
        read_mat(tmp_path / "a.mat", "record")


def test_read_mat_raises_no_other_error(tmp_path):
    path = tmp_path / "a.mat"
    write_record(path, [pascal_object("car"), pascal_object("sofa")])
    # without compression damage reaches further
    scipy.io.savemat(path, {"record": scipy.io.loadmat(path)["record"]})
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        data = bytearray(whole[: rng.integers(100, len(whole))] if rng.random() < 0.3 else whole)
        for position in rng.integers(0, len(data), rng.integers(1, 8)):
            data[position] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            read_mat(path, "record")
        except InvalidInputError:
            refused += 1
    assert refused > 100
    for content in (
        b"short",
        b"MATLAB 7.3".ljust(124) + b"\x00\x02IM" + b"\x89HDF",
        b"MATLAB".ljust(124) + b"\1\0MI",
    ):
        path.write_bytes(content)
        with pytest.raises(InvalidInputError, match="MATLAB 5"):
            read_mat(path, "record")
    with pytest.raises(InvalidInputError, match="MATLAB 5"):
        read_mat(tmp_path / "nothing.mat", "record")
