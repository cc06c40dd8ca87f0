"""The largest and slowest input that each limit of SECURITY.md still lets in: how long it takes, and how much memory.

    python scripts/robustness/worst_cases.py              all of them
    python scripts/robustness/worst_cases.py obj off      some; the others stay as they were measured

Each input is made, then read in a process of its own on one thread: its seconds of CPU, and its memory, libraries
included. ``scripts/results/worst_cases.json`` keeps them, and SECURITY.md has their table. Exit code 1 if one ends in
anything but a result or one of our errors, or takes longer or more than the table states.
"""

import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from curvireg_torch import limits
from curvireg_torch.errors import CurviregError
from scripts._shared import REPOSITORY, commit, replace_between, today, write_json

RESULT = REPOSITORY / "scripts" / "results" / "worst_cases.json"
DOCUMENT = REPOSITORY / "SECURITY.md"
BEGIN, END = "<!-- worst cases:begin -->", "<!-- worst cases:end -->"
SIDE = int(limits.MAX_IMAGE_PIXELS**0.5)


@dataclass(frozen=True)
class Case:
    """What is read, by what, and the seconds and MB that it may take."""

    says: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    seconds: float
    megabytes: int


def photo(path: Path) -> Any:
    from curvireg_torch.io import read_photo

    return read_photo(path)


def floats(path: Path) -> Any:
    from curvireg_torch.io import read_image

    return read_image(path)


def mesh(path: Path) -> Any:
    from curvireg_torch import load_mesh

    return load_mesh(path)


def table(path: Path) -> Any:
    from curvireg_torch.data import read_bop_csv

    return read_bop_csv(path)


def json_file(path: Path) -> Any:
    from curvireg_torch.io.json_files import read_json

    return read_json(path, dict, "docs/datasets.md")


def mat(path: Path) -> Any:
    from curvireg_torch.io.mat_files import read_mat

    return read_mat(path, "record")


def sliver(path: Path) -> Any:
    """A picture 2 px high, with every preset."""
    import torch

    import curvireg_torch as cr
    from curvireg_torch.pipeline import PRESETS
    from curvireg_torch.synthetic import example_mesh

    image = torch.rand(3, 2, 600, generator=torch.Generator().manual_seed(0))
    K = cr.camera_matrix(600.0, 600.0, 300.0, 1.0)
    for preset in ("learned", "classical"):
        pipeline = PRESETS[preset]
        views = cr.sample_views(azimuth_step=45, elevations=[20])
        bank = cr.ViewBank.build(example_mesh(), views, pipeline=pipeline, progress=False)
        cr.Registrar(bank, pipeline=pipeline)([image], torch.tensor([[0.0, 0.0, 599.0, 1.0]]), K)
    del path


def png(path: Path) -> None:
    """16 bits, three channels, noise in the low bits would not fit the bytes: one colour."""
    packer = zlib.compressobj(1)
    row = bytes([0]) + b"\x12\x34" * (3 * SIDE)

    def chunk(file: BinaryIO, kind: bytes, content: bytes) -> None:
        file.write(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content)))

    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        chunk(file, b"IHDR", struct.pack(">IIBBBBB", SIDE, SIDE, 16, 2, 0, 0, 0))
        for _ in range(SIDE):
            if part := packer.compress(row):
                chunk(file, b"IDAT", part)
        chunk(file, b"IDAT", packer.flush())
        chunk(file, b"IEND", b"")


def jpeg(path: Path) -> None:
    """Progressive, the last scan said again and again."""
    rng = np.random.default_rng(0)
    tile = np.kron(rng.integers(0, 256, (128, 128, 3), dtype=np.uint8), np.ones((8, 8, 1), np.uint8))
    repeats = -(-SIDE // 1024)
    picture = np.tile(tile, (repeats, repeats, 1))[:SIDE, :SIDE]
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 90]
    data = cv2.imencode(".jpg", picture, options)[1].tobytes()
    scans = [i for i in range(len(data) - 1) if data[i : i + 2] == b"\xff\xda"]
    last = data[scans[-1] : -2]
    room = (limits.MAX_IMAGE_BYTES - len(data)) // len(last)
    path.write_bytes(data[:-2] + last * min(limits.MAX_IMAGE_SCANS - len(scans), room) + data[-2:])


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a bumpy square and its quads."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(side), np.arange(side)))
    at = np.arange(side * side).reshape(side, side)
    quads = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
    return np.stack([x, y, (x * y) % 7], axis=1), quads


def triangles(count: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, quads = grid(int((count / 2) ** 0.5) + 1)
    return vertices, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def lines(values: np.ndarray, before: str) -> Iterator[bytes]:
    for some in np.array_split(values, 50):
        yield "".join(f"{before}{' '.join(map(str, row))}\n" for row in some.tolist()).encode()


def obj(path: Path) -> None:
    vertices, faces = triangles(limits.MAX_MESH_FACES)
    with path.open("wb") as file:
        file.writelines(lines(vertices, "v "))
        file.writelines(lines(faces + 1, "f "))


def off(path: Path) -> None:
    vertices, faces = triangles(limits.MAX_MESH_FACES)
    with path.open("wb") as file:
        file.write(b"OFF\n%d %d 0\n" % (len(vertices), len(faces)))
        file.writelines(lines(vertices, ""))
        file.writelines(lines(faces, "3 "))


def quads_of(count: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        vertices, quads = grid(int(count**0.5) + 1)
        with path.open("wb") as file:
            file.write(b"OFF\n%d %d 0\n" % (len(vertices), len(quads)))
            file.writelines(lines(vertices, ""))
            file.writelines(lines(quads, "4 "))

    return make


def tangled(count: int, corners: int) -> Callable[[Path], None]:
    """Faces that cross themselves, with the same corners in any order."""

    def make(path: Path) -> None:
        rng = np.random.default_rng(0)
        vertices = np.concatenate([rng.standard_normal((corners, 2)), np.zeros((corners, 1))], axis=1)
        face = " ".join([str(corners), *map(str, rng.permutation(corners))]) + "\n"
        with path.open("w") as file:
            file.write(f"OFF\n{corners} {count} 0\n")
            file.writelines(f"{x} {y} {z}\n" for x, y, z in vertices)
            file.writelines([face] * count)

    return make


def stl(path: Path) -> None:
    row = np.zeros(1, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]))
    rows = np.repeat(row, limits.MAX_MESH_FACES)
    rows["corners"] = np.random.default_rng(0).random((len(rows), 3, 3), dtype=np.float32)
    path.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes())


def parts(path: Path) -> None:
    """As many parts as there may be, each as deep as it may be."""
    count, depth = limits.MAX_MESH_PARTS, limits.MAX_MESH_DEPTH
    chain = [{"children": [i + 1], "translation": [1e-3, 0, 0]} for i in range(depth - 2)]
    nodes = [*chain, {"children": list(range(depth - 1, depth - 1 + count))}]
    nodes += [{"mesh": 0, "rotation": [0, 0, 0.6, 0.8]} for _ in range(count)]
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": "b.bin"}],
    }
    path.with_name("b.bin").write_bytes(points)
    path.write_text(json.dumps(content))


def deep_json(path: Path) -> None:
    """Small values take most memory for their bytes."""
    path.write_bytes(b'{"0": [' + b"[],{}," * ((limits.MAX_TABLE_BYTES - 20) // 6) + b"[]]}")


def csv_rows(path: Path) -> None:
    row = b"1,1,1,0.5,1 0 0 0 1 0 0 0 1,0 0 400,-1\n"
    head = b"scene_id,im_id,obj_id,score,R,t,time\n"
    path.write_bytes(head + row * ((limits.MAX_TABLE_BYTES - len(head)) // len(row)))


def mat_bomb(path: Path) -> None:
    """One array of structs whose values are empty."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    count = (limits.MAX_MAT_UNPACKED_BYTES - 200) // 8
    head = element(6, struct.pack("<II", 2, 0)) + element(5, struct.pack("<ii", 1, count)) + element(1, b"record")
    head += element(5, struct.pack("<i", 8)) + element(1, b"a".ljust(8, b"\0"))
    packed = zlib.compress(element(14, head + struct.pack("<II", 14, 0) * count))
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed)


def nothing(path: Path) -> None:
    path.write_bytes(b"")


CASES = {
    "png": Case("PNG, 134 million pixels of 16 bits, as bytes", png, photo, 60, 6000),
    "float": Case("the same as float32", png, floats, 60, 6000),
    "jpg": Case("progressive JPEG, 134 million pixels, 64 scans", jpeg, photo, 60, 6000),
    "obj": Case("OBJ, 10 million triangles", obj, mesh, 180, 9000),
    "off": Case("OFF, 10 million triangles", off, mesh, 180, 9000),
    "stl": Case("STL, 10 million triangles that share no corner", stl, mesh, 180, 9000),
    "quads": Case("OFF, quads", quads_of(2_000_000), mesh, 180, 9000),
    "tangled": Case("OFF, five faces of 2000 corners that cross themselves", tangled(5, 2000), mesh, 180, 9000),
    "gltf": Case("glTF, 10,000 parts 200 deep", parts, mesh, 60, 4000),
    "json": Case("JSON, 32 MiB of empty lists", deep_json, json_file, 60, 4000),
    "csv": Case("CSV, 32 MiB of poses", csv_rows, table, 60, 4000),
    "mat": Case("MATLAB, 16 MiB unpacked", mat_bomb, mat, 60, 4000),
    "sliver": Case("registration of a picture of 2 x 600 px", nothing, sliver, 60, 4000),
}
SUFFIX = {"float": ".png", "quads": ".off", "tangled": ".off", "sliver": ""}


def worker(name: str, path: Path) -> None:
    begin = time.process_time()
    try:
        CASES[name].read(path)
        outcome = "read"
    except CurviregError as error:
        outcome = f"refused: {str(error).split(': ', 1)[-1][:120]}"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"outcome": outcome, "seconds": time.process_time() - begin, "megabytes": peak}))


def measured(name: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"case{SUFFIX.get(name, '.' + name)}")
        CASES[name].make(path)
        done = subprocess.run(
            [sys.executable, "-m", "scripts.robustness.worst_cases", "--worker", name, str(path)],
            capture_output=True, text=True, timeout=1800, cwd=REPOSITORY,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)},
        )  # fmt: skip
        size = path.stat().st_size
    found = {"outcome": f"died: {done.stderr[-300:]}", "seconds": 0.0, "megabytes": 0.0}
    if done.returncode == 0:
        found = json.loads(done.stdout.splitlines()[-1])
    return {**found, "bytes": size}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.worker[0], Path(options.worker[1]))
        return 0
    kept = json.loads(RESULT.read_text()) if RESULT.is_file() else {}
    here = commit()
    bad = 0
    for name in options.names or CASES:
        found = measured(name)
        print(f"{name}: {found['bytes'] / 1e6:.0f} MB, {found['seconds']:.1f} s, {found['megabytes']:.0f} MB, "
              f"{found['outcome']}", flush=True)  # fmt: skip
        bad += not within(name, found)
        kept[name] = {**found, "date": today(), "commit": here}
        write_json(RESULT, kept)
    text = DOCUMENT.read_text(encoding="utf-8")
    DOCUMENT.write_text(replace_between(text, BEGIN, END, table(kept)), encoding="utf-8")
    return int(bad > 0)


def within(name: str, found: dict[str, Any]) -> bool:
    """Whether a case ended as the table states."""
    most = CASES[name]
    ended = found["outcome"] == "read" or found["outcome"].startswith("refused")
    return ended and found["seconds"] <= most.seconds and found["megabytes"] <= most.megabytes


def table(kept: dict[str, Any]) -> str:
    rows = [
        f"| {case.says} | {kept[name]['outcome']} | {kept[name]['seconds']:.1f} (at most {case.seconds:g}) "
        f"| {kept[name]['megabytes']:.0f} (at most {case.megabytes}) |"
        for name, case in CASES.items()
        if name in kept
    ]
    return "\n".join(["| input | outcome | s | MB |", "| --- | --- | --- | --- |", *rows, ""])


if __name__ == "__main__":
    sys.exit(main())
