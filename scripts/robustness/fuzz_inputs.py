"""Inputs of fuzz.py: valid files with structure-aware faults."""

import json
import math
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io
import torch
import trimesh
from safetensors.torch import load, save

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, WebCollection, read_bop_csv, read_photo
from curvireg_torch.data.mat_files import read_mat
from curvireg_torch.errors import CurviregError
from curvireg_torch.matching.bank_file import tensor_digest
from curvireg_torch.synthetic import example_mesh

NUMBERS = [0, 1, -1, 2, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 10**9, 10**18, 0.5, 1e308, math.nan, math.inf]
BOXES = {"bbox_obj": [1, 2, 30, 20], "bbox_visib": [1, 2, 3, 4]}
WORDS = b" -1 0 1 nan inf 1e999 99999999999 4294967295 1000000000 x -0 3.5".split(b" ")


def mutate_bytes(data: bytes, rng: np.random.Generator, other: bytes) -> bytes:
    """Add one to four random faults: changed bits and numbers; missing, repeated, foreign or truncated parts."""
    out = bytearray(data)
    for _ in range(min(4, int(rng.geometric(0.6)))):
        n = len(out)
        if n < 8:
            break
        # Half of the faults are in the header, which is short and decisive.
        start = int(rng.integers(0, min(n, 400) if rng.random() < 0.5 else n))
        stop = min(n, start + int(rng.geometric(0.05)))
        match int(rng.integers(0, 8)):
            case 0:
                out[start] ^= 1 << int(rng.integers(0, 8))
            case 1:
                out[start] = int(rng.choice([0, 1, 127, 128, 255]))
            case 2:
                value = int(rng.choice([0, 1, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x3B9ACA00]))
                out[start : start + 4] = struct.pack("<>"[int(rng.integers(2))] + "I", value)
            case 3:
                del out[start:stop]
            case 4:
                out[start:start] = out[start:stop] * int(rng.integers(1, 4))
            case 5:
                source = int(rng.integers(0, max(1, len(other))))
                out[start:stop] = other[source : source + stop - start]
            case 6:
                del out[start:]
            case 7:
                found = list(re.finditer(rb"-?\d+(?:\.\d+)?", bytes(out[start : start + 200])))
                if found:
                    chosen = found[int(rng.integers(len(found)))]
                    out[start + chosen.start() : start + chosen.end()] = WORDS[int(rng.integers(len(WORDS)))]
    return bytes(out)


def mutate_json(tree: Any, rng: np.random.Generator) -> Any:
    """Replace, remove, repeat or nest one to three values of a JSON tree."""
    tree = json.loads(json.dumps(tree))
    for _ in range(min(3, int(rng.geometric(0.6)))):
        places: list[tuple[Any, Any]] = []
        ahead = [tree]
        while ahead:
            node = ahead.pop()
            keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else []
            places += [(node, key) for key in keys]
            ahead += [node[key] for key in keys]
        if not places:
            break
        node, key = places[int(rng.integers(len(places)))]
        match int(rng.integers(0, 6)):
            case 0 | 1:
                node[key] = NUMBERS[int(rng.integers(len(NUMBERS)))]
            case 2:
                node[key] = [None, "", "x" * 300, [], {}, True, "data:,", "../a", "http://a/b"][int(rng.integers(9))]
            case 3:
                node.pop(key)
            case 4:
                node[key] = [node[key]] * int(rng.integers(1, 50))
            case 5:
                inner: Any = node[key]
                for _ in range(int(rng.choice([1, 50, 3000]))):
                    inner = [inner]
                node[key] = inner
    return tree


def to_json(tree: Any) -> bytes:
    try:
        return json.dumps(tree).encode()
    except RecursionError:
        return b"[" * 100_000


@cache
def images() -> dict[str, list[bytes]]:
    rng = np.random.default_rng(0)
    found: dict[str, list[bytes]] = {}
    for suffix in (".jpg", ".png", ".webp", ".tiff", ".bmp", ".ppm"):
        for shape in ((24, 31, 3), (17, 9), (8, 8, 4)):
            if (suffix == ".ppm" and shape != (24, 31, 3)) or (suffix == ".jpg" and len(shape) > 2 and shape[2] == 4):
                continue
            for dtype in (np.uint8, np.uint16) if suffix in (".png", ".tiff") else (np.uint8,):
                pixels = rng.integers(0, np.iinfo(dtype).max, shape).astype(dtype)
                flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, len(shape) - 2] if suffix == ".jpg" else []
                found.setdefault(suffix, []).append(cv2.imencode(suffix, pixels, flags)[1].tobytes())
    body = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    jpeg = found[".jpg"][0]
    found[".jpg"].append(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:])
    return found


def choose(seeds: dict[str, list[bytes]], rng: np.random.Generator) -> tuple[str, bytes, bytes]:
    """A random suffix and two files of it."""
    suffix = list(seeds)[int(rng.integers(len(seeds)))]
    data, other = (seeds[suffix][int(rng.integers(len(seeds[suffix])))] for _ in range(2))
    return suffix, data, other


def image(rng: np.random.Generator, folder: Path) -> None:
    suffix, data, other = choose(images(), rng)
    broken = mutate_bytes(data, rng, other)
    if suffix == ".png" and rng.random() < 0.7:
        broken = with_png_checksums(broken)
    path = folder / f"a{suffix}"
    path.write_bytes(broken)
    photo = read_photo(path, dtype=torch.float32 if rng.random() < 0.5 else torch.uint8)
    assert photo.image.shape[0] == 3
    assert bool(((photo.image >= 0) & (photo.image <= (255 if photo.image.dtype == torch.uint8 else 1))).all())
    photo.guessed_camera_matrix()
    json.dumps(photo.facts(), allow_nan=False)


def with_png_checksums(data: bytes) -> bytes:
    out, position = bytearray(data[:8]), 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        body = data[position + 4 : position + 8 + length]
        out += data[position : position + 4] + body + struct.pack(">I", zlib.crc32(body))
        position += 12 + length
    return bytes(out) + data[position:]


@cache
def meshes() -> dict[str, list[bytes]]:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    textured = box.copy()
    textured.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((8, 2)))
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="a")
    scene.add_geometry(trimesh.creation.icosphere(0, 0.1), node_name="b", parent_node_name="a")
    pentagon = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv .2 .2 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1 4/1 5/1\nf -1 -2 -3\n"
    found = {".obj": [*(m.export(file_type="obj", include_texture=False) for m in (box, textured)), pentagon]}
    pentagon = b"OFF\n5 1 0\n0 0 0\n1 0 0\n1 1 0\n.2 .2 0\n0 1 0\n5 0 1 2 3 4\n"
    found[".off"] = [box.export(file_type="off"), pentagon]
    head = b"element vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    head += b"property list uchar int vertex_indices\nend_header\n"
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0.2, 0.2, 0), (0, 1, 0)]
    packed = b"".join(struct.pack("<3f", *p) for p in points) + struct.pack("<B5i", 5, 0, 1, 2, 3, 4)
    text = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in points).encode() + b"5 0 1 2 3 4\n"
    found[".ply"] = [
        box.export(file_type="ply"),
        box.export(file_type="ply", encoding="ascii"),
        b"ply\nformat binary_little_endian 1.0\n" + head + packed,
        b"ply\nformat ascii 1.0\n" + head + text,
    ]
    found[".stl"] = [box.export(file_type="stl"), box.export(file_type="stl_ascii").encode()]
    found[".glb"] = [scene.export(file_type="glb")]
    found[".gltf"] = [bytes(trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)["model.gltf"])]
    return {suffix: [d if isinstance(d, bytes) else d.encode() for d in some] for suffix, some in found.items()}


def mesh(rng: np.random.Generator, folder: Path) -> None:
    suffix, data, other = choose(meshes(), rng)
    if suffix == ".gltf" and rng.random() < 0.8:
        broken = to_json(mutate_json(json.loads(data), rng))
    elif suffix == ".glb" and rng.random() < 0.8:
        (length,) = struct.unpack_from("<I", data, 12)
        text = to_json(mutate_json(json.loads(data[20 : 20 + length]), rng))
        text += b" " * (-len(text) % 4)
        rest = data[20 + length :]
        broken = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest
    else:
        broken = mutate_bytes(data, rng, other)
    path = folder / f"a{suffix}"
    path.write_bytes(broken)
    loaded = cr.load_mesh(path)
    assert np.isfinite(loaded.vertices).all()
    assert 0 <= loaded.faces.min() <= loaded.faces.max() < len(loaded.vertices)


@cache
def mat_files() -> list[bytes]:
    found = []
    folder = Path(tempfile.mkdtemp())
    for compressed in (False, True):
        view = {"azimuth": 30.0, "elevation": 10.0, "distance": 4.0, "px": 41.0, "name": "ü"}
        objects = np.array([("car", np.array([1.0, 2, 30, 40]), view)] * 2, [("class", "O"), ("bbox", "O"), ("v", "O")])
        deep: Any = 1.0
        for _ in range(12):
            deep = {"a": deep}
        scipy.io.savemat(folder / "a.mat", {"record": {"objects": objects, "d": deep}}, do_compression=compressed)
        found.append((folder / "a.mat").read_bytes())
    return found


def mat(rng: np.random.Generator, folder: Path) -> None:
    seeds = mat_files()
    which = int(rng.random() < 0.2)
    broken = mutate_bytes(seeds[which], rng, seeds[0])
    if which == 0 and rng.random() < 0.3 and len(broken) > 136:  # broken content in a valid compressed variable
        body = zlib.compress(broken[128:])
        broken = broken[:128] + struct.pack("<II", 15, len(body)) + body
    (folder / "a.mat").write_bytes(broken)
    read_mat(folder / "a.mat", "record")


def tables(rng: np.random.Generator, folder: Path) -> None:
    """JSON files of a BOP set, a results file and a web collection."""
    K, R = [300.0, 0, 40, 0, 300, 30, 0, 0, 1], [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
    trees: dict[str, Any] = {
        "test/000001/scene_gt.json": {"0": [{"cam_R_m2c": R, "cam_t_m2c": [1.0, 2, 400], "obj_id": 1}]},
        "test/000001/scene_camera.json": {"0": {"cam_K": K, "depth_scale": 1.0}},
        "test/000001/scene_gt_info.json": {"0": [{**BOXES, "visib_fract": 0.5}]},
        "models/models_info.json": {"1": {"diameter": 86.6}},
        "camera.json": {"fx": 300.0},
        "test_targets_bop19.json": [{"scene_id": 1, "im_id": 0, "obj_id": 1, "inst_count": 1}],
    }
    broken = list(trees)[int(rng.integers(len(trees)))]
    for name, tree in trees.items():
        path = folder / "bop" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = to_json(mutate_json(tree, rng) if name == broken else tree)
        path.write_bytes(mutate_bytes(data, rng, data) if name == broken and rng.random() < 0.3 else data)
    for name in ("bop/test/000001/rgb/000000.png", "bop/models/obj_000001.ply", "web/cup/mesh.off", "web/cup/0.jpg"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    rows = b"scene_id,im_id,obj_id,score,R,t,time\n" + b"1,2,3,0.5,1 0 0 0 1 0 0 0 1,1 2 3,-1\n" * 3
    (folder / "a.csv").write_bytes(mutate_bytes(rows, rng, rows))
    views = b"image,x0,y0,x1,y1,azimuth,elevation,theta,distance\n" + b"0.jpg,10,5,70,55,30,10,-5,3\n" * 2
    (folder / "web" / "cup" / "views.csv").write_bytes(mutate_bytes(views, rng, views))
    for read in (
        lambda: [BOPDataset(folder / "bop").annotation(0)],
        lambda: read_bop_csv(folder / "a.csv"),
        lambda: WebCollection(folder / "web").annotation(0),
    ):
        try:
            read()
        except (CurviregError, IndexError) as error:
            if isinstance(error, IndexError) and "list index" not in str(error):
                raise  # any other index error is a defect; this one means an empty set


@cache
def bank_bytes() -> bytes:
    views = cr.sample_views(azimuth_step=180, elevations=[20])
    bank = cr.ViewBank.build(example_mesh(), views, image_size=32, progress=False)
    bank.save(path := Path(tempfile.mkdtemp()) / "a.safetensors")
    return path.read_bytes()


def bank(rng: np.random.Generator, folder: Path) -> None:
    data = bank_bytes()
    (length,) = struct.unpack_from("<Q", data)
    broken, kind = mutate_bytes(data, rng, data), rng.random()
    if kind < 0.5:  # a header with other values
        header = to_json(mutate_json(json.loads(data[8 : 8 + length]), rng))
        broken = struct.pack("<Q", len(header)) + header + data[8 + length :]
    elif kind < 0.8:  # other numbers with a valid checksum
        tensors, metadata = load(data), json.loads(data[8 : 8 + length])["__metadata__"]
        changed = tensors[str(rng.choice(sorted(tensors)))].view(-1)
        changed[int(rng.integers(len(changed)))] = rng.choice([0, 1, 2, 255 if changed.dtype == torch.uint8 else -1])
        broken = save(tensors, {**metadata, "checksum": tensor_digest(tensors, size=16)})
    elif kind < 0.83:
        broken = save({"descriptors": torch.zeros(2, 3)}, {"format": "curvireg_torch.ViewBank"})
    (folder / "a.safetensors").write_bytes(broken)
    loaded = cr.ViewBank.load(folder / "a.safetensors")
    assert len(loaded) == len(loaded.descriptors) == len(loaded.points)


INPUTS: dict[str, Callable[[np.random.Generator, Path], None]] = {
    "images": image,
    "meshes": mesh,
    "mat": mat,
    "tables": tables,
    "banks": bank,
}
"""Functions that write a broken input to a folder and read it."""
