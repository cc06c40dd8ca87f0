"""Time and memory of the largest and slowest inputs that the limits of SECURITY.md admit.

    python scripts/robustness/worst_cases.py              all cases
    python scripts/robustness/worst_cases.py obj off      only these; the records of the others stay

Each input is generated, then read in a separate process on one thread. CPU seconds and memory (libraries included) go
to ``scripts/results/worst_cases.json`` and to the table of SECURITY.md. Exit code 1 if a case ends in anything but a
result or one of our errors, or exceeds the time or memory that the table states.
"""

import argparse
import importlib
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

from curvireg_torch import errors as limits
from curvireg_torch.errors import CurviregError
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json

RESULT = RESULTS / "worst_cases.json"
DOCUMENT = REPOSITORY / "SECURITY.md"
SIDE = int(limits.MAX_IMAGE_PIXELS**0.5)


@dataclass(frozen=True)
class Case:
    """An input, its reader, and the CPU seconds and MB that it may take."""

    caption: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    seconds: float
    megabytes: int


def reader(module: str, name: str, *arguments: Any) -> Callable[[Path], Any]:
    """Function of the package that is imported only by the worker that needs it."""
    return lambda path: getattr(importlib.import_module(f"curvireg_torch.{module}"), name)(path, *arguments)


def sliver(path: Path) -> Any:
    """Register in an image of 2 px height, with two presets."""
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
    """16 bits, three channels, one colour: noise would exceed the limit on file size."""
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
    """Progressive, with the last scan repeated."""
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


def write_off(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    with path.open("wb") as file:
        file.write(b"OFF\n%d %d 0\n" % (len(vertices), len(faces)))
        file.writelines(lines(vertices, ""))
        file.writelines(lines(faces, f"{faces.shape[1]} "))


def off(path: Path) -> None:
    write_off(path, *triangles(limits.MAX_MESH_FACES))


def quads(path: Path) -> None:
    write_off(path, *grid(int(2_000_000**0.5) + 1))


def tangled(path: Path) -> None:
    """Five self-intersecting faces of 2000 corners in random order."""
    rng = np.random.default_rng(0)
    vertices = np.concatenate([rng.standard_normal((2000, 2)), np.zeros((2000, 1))], axis=1)
    write_off(path, vertices, np.tile(rng.permutation(2000), (5, 1)))


def stl(path: Path) -> None:
    row = np.zeros(1, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]))
    rows = np.repeat(row, limits.MAX_MESH_FACES)
    rows["corners"] = np.random.default_rng(0).random((len(rows), 3, 3), dtype=np.float32)
    path.write_bytes(bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes())


def parts(path: Path) -> None:
    """The largest number of parts, each at the largest depth."""
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
    """Small values need the most memory per byte."""
    path.write_bytes(b'{"0": [' + b"[],{}," * ((limits.MAX_TABLE_BYTES - 20) // 6) + b"[]]}")


def csv_rows(path: Path) -> None:
    row = b"1,1,1,0.5,1 0 0 0 1 0 0 0 1,0 0 400,-1\n"
    head = b"scene_id,im_id,obj_id,score,R,t,time\n"
    path.write_bytes(head + row * ((limits.MAX_TABLE_BYTES - len(head)) // len(row)))


def mat_bomb(path: Path) -> None:
    """One array of structs with empty values."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    count = (limits.MAX_MAT_UNPACKED_BYTES - 200) // 8
    head = element(6, struct.pack("<II", 2, 0)) + element(5, struct.pack("<ii", 1, count)) + element(1, b"record")
    head += element(5, struct.pack("<i", 8)) + element(1, b"a".ljust(8, b"\0"))
    packed = zlib.compress(element(14, head + struct.pack("<II", 14, 0) * count))
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed)


def empty(path: Path) -> None:
    path.write_bytes(b"")


PHOTO, MESH = reader("io", "read_photo"), reader("io", "load_mesh")
JSON = reader("io.json_files", "read_json", dict, "docs/datasets.md")
CASES = {
    "png": Case("PNG, 134 million pixels of 16 bits, as bytes", png, PHOTO, 60, 6000),
    "float": Case("the same as float32", png, reader("io", "read_image"), 60, 6000),
    "jpg": Case("progressive JPEG, 134 million pixels, 64 scans", jpeg, PHOTO, 60, 6000),
    "obj": Case("OBJ, 10 million triangles", obj, MESH, 180, 9000),
    "off": Case("OFF, 10 million triangles", off, MESH, 180, 9000),
    "stl": Case("STL, 10 million triangles that share no corner", stl, MESH, 180, 9000),
    "quads": Case("OFF, quads", quads, MESH, 180, 9000),
    "tangled": Case("OFF, five faces of 2000 corners that cross themselves", tangled, MESH, 180, 9000),
    "gltf": Case("glTF, 10,000 parts 200 deep", parts, MESH, 60, 4000),
    "json": Case(
        "JSON, 32 MiB of empty lists",
        deep_json,
        reader("io.json_files", "read_json", dict, "docs/datasets.md"),
        60,
        4000,
    ),
    "csv": Case("CSV, 32 MiB of poses", csv_rows, reader("data", "read_bop_csv"), 60, 4000),
    "mat": Case("MATLAB, 16 MiB unpacked", mat_bomb, reader("io.mat_files", "read_mat", "record"), 60, 4000),
    "sliver": Case("registration of a picture of 2 x 600 px", empty, sliver, 60, 4000),
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


def measure(name: str) -> dict[str, Any]:
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
    record = json.loads(RESULT.read_text()) if RESULT.is_file() else {}
    here, failed = commit(), 0
    for name in options.names or CASES:
        found = measure(name)
        print(f"{name}: {found['bytes'] / 1e6:.0f} MB, {found['seconds']:.1f} s, {found['megabytes']:.0f} MB, "
              f"{found['outcome']}", flush=True)  # fmt: skip
        failed += not within(name, found)
        record[name] = {**found, "date": today(), "commit": here}
        write_json(RESULT, record)
    update_page(DOCUMENT, "worst cases", table(record))
    return int(failed > 0)


def within(name: str, found: dict[str, Any]) -> bool:
    """Whether a case stayed within its limits."""
    limit = CASES[name]
    ended = found["outcome"] == "read" or found["outcome"].startswith("refused")
    return ended and found["seconds"] <= limit.seconds and found["megabytes"] <= limit.megabytes


def table(record: dict[str, Any]) -> str:
    rows = [["input", "outcome", "s", "MB"]]
    for name, case in CASES.items():
        if name in record:
            seconds = f"{record[name]['seconds']:.1f} (at most {case.seconds:g})"
            memory = f"{record[name]['megabytes']:.0f} (at most {case.megabytes})"
            rows.append([case.caption, record[name]["outcome"], seconds, memory])
    return "\n".join([*table_lines(rows), ""])


if __name__ == "__main__":
    sys.exit(main())
