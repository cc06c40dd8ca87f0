"""Malicious photographs and annotations end in a one-line error, soon and in little memory."""

import contextlib
import struct
import time
import tracemalloc
import zlib
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, images, read_bop_csv, read_photo
from curvireg_torch.data.image_headers import read_header
from curvireg_torch.data.mat_files import read_mat
from curvireg_torch.errors import CurviregError, ImageError, InvalidInputError
from curvireg_torch.utils import json_files
from tests._support.matlab import element, file
from tests._support.miniature import write_bop, write_image


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_bomb(width: int, height: int) -> bytes:
    """A valid PNG of one colour that packs a thousandfold."""
    packer = zlib.compressobj(9)
    row = bytes(1 + -(-width // 8))
    body = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def jpeg(width: int, height: int, scans: int = 1) -> bytes:
    frame = b"\xff\xc0" + struct.pack(">HBHHB", 11, 8, height, width, 1) + b"\x01\x11\0"
    return b"\xff\xd8" + frame + (b"\xff\xda\0\x08\x01\x01\0\0\x3f\0" + b"\0" * 4) * scans + b"\xff\xd9"


def tiff(width: int, height: int) -> bytes:
    entries = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (262, 3, 1, 1)]
    return b"II*\0\x08\0\0\0" + struct.pack("<H", 4) + b"".join(struct.pack("<HHII", *e) for e in entries) + bytes(4)


def bmp(width: int, height: int) -> bytes:
    return b"BM" + bytes(12) + struct.pack("<IiiHH", 40, width, height, 1, 24) + bytes(24)


BOMBS = {
    "a.png": png_bomb(20_000, 20_000),
    "a.jpg": jpeg(65_000, 65_000),
    "a.tif": tiff(100_000, 100_000),
    "a.bmp": bmp(100_000, -100_000),
    "a.ppm": b"P5 # x\n100000 100000 255\n",
    "a.webp": b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + b"\xff" * 6,
}


@pytest.mark.parametrize("name", BOMBS)
def test_read_photo_counts_pixels_before_it_decodes(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(BOMBS[name])
    tracemalloc.start()
    start = time.perf_counter()
    with pytest.raises(ImageError, match=r"px, more than 134,217,728 pixels; scale it down"):
        read_photo(tmp_path / name)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert time.perf_counter() - start < 2


def test_read_photo_bounds_scans_and_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(1000, 1000, scans=1000))
    with pytest.raises(ImageError, match="1000 scans"):
        read_photo(tmp_path / "a.jpg")
    monkeypatch.setattr(images, "MAX_IMAGE_BYTES", 100)
    with pytest.raises(ImageError, match="larger than 100 bytes"):
        read_photo(tmp_path / "a.jpg")


def test_read_header_takes_linear_time() -> None:
    start = time.perf_counter()
    with pytest.raises(ValueError, match="truncated"):
        read_header(b"\xff\xd8" + b"\xff" * 20_000_000)
    assert time.perf_counter() - start < 5


def test_read_photo_ignores_the_film_of_a_motion_photo(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    film = b"\0\0\0\x18ftypmp42" + np.random.default_rng(0).bytes(100_000) + b"\xff\xda no end"
    (tmp_path / "b.jpg").write_bytes(data + film)
    assert torch.equal(read_photo(tmp_path / "a.jpg").image, read_photo(tmp_path / "b.jpg").image)
    (tmp_path / "b.jpg").write_bytes(data[:-200] + film)  # the end of the picture is missing
    with pytest.raises(ImageError, match=r"truncated|decoded"):
        read_photo(tmp_path / "b.jpg")


@pytest.mark.parametrize("shape", [(2, 600), (600, 2), (1, 1), (1, 5000)])
def test_learned_field_does_not_enlarge_slivers(shape: tuple[int, int]) -> None:
    field = cr.LearnedCurvilinearSaliency()
    field.network.forward = Mock(side_effect=lambda x: x.new_zeros(len(x), 3, x.shape[2] // 2, x.shape[3] // 2))
    assert field(torch.rand(1, 3, *shape)).shape == (1, 2, *shape)
    assert field.network.forward.call_args.args[0][0, 0].numel() <= 8 * 128 * 128


def test_read_mat_bounds_all_compressed_variables_together(tmp_path: Path) -> None:
    bomb = zlib.compress(element(14, bytes(20_000_000)), 9)
    (tmp_path / "a.mat").write_bytes(file((struct.pack("<II", 15, len(bomb)) + bomb) * 200))
    start = time.perf_counter()
    with pytest.raises(InvalidInputError, match="unpacks to more"):
        read_mat(tmp_path / "a.mat", "record")
    assert time.perf_counter() - start < 5


@pytest.mark.parametrize("content", [b"[" * 2_000_000, b'{"0": ' + b"1" * 100_000 + b"}", b'{"0": NaN}', b"\xff"])
def test_read_json_refuses_malicious_files(tmp_path: Path, content: bytes) -> None:
    write_bop(tmp_path)
    (tmp_path / "models" / "models_info.json").write_bytes(content)
    if content.endswith(b"NaN}"):  # this entry is skipped
        assert BOPDataset(tmp_path).skipped["missing_model_info"] > 0
        return
    with pytest.raises(CurviregError, match="models_info") as caught:
        BOPDataset(tmp_path)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 1000


def test_check_table_size_bounds_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bop(tmp_path)
    for path, read, given in (("camera.json", BOPDataset, tmp_path), ("a.csv", read_bop_csv, tmp_path / "a.csv")):
        with open(tmp_path / path, "wb") as file:
            file.truncate(1 << 27)  # a sparse file
        with pytest.raises(InvalidInputError, match="33,554,432 bytes"):
            read(given)
    (tmp_path / "some").write_bytes(bytes(100))
    for limit in (99, 100):
        monkeypatch.setattr(json_files, "MAX_TABLE_BYTES", limit)
        with contextlib.nullcontext() if limit == 100 else pytest.raises(InvalidInputError, match="99 bytes"):
            json_files.check_table_size(tmp_path / "some")
