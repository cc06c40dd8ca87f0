"""Photographs, meshes, lists and other files of bad_inputs.py: a few good ones, and many with one fault each."""

import json
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file

from curvireg_torch import ViewBank, camera_matrix, sample_views
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from curvireg_torch.visualization.overlay import to_uint8

__all__ = ["write_files"]

SIZE, FOCAL = (180, 240), 260.0
FACES = "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
LISTS = {
    "semicolon.csv": "photo;x0;y0;x1;y1\nphoto.png;30;25;210;160\n",
    "tabs.csv": "photo\tx0\ty0\tx1\ty1\nphoto.png\t30\t25\t210\t160\n",
    "no_photo.csv": "picture,x0,y0,x1,y1\nphoto.png,30,25,210,160\n",
    "no_y1.csv": "photo,x0,y0,x1\nphoto.png,30,25,210\n",
    "no_header.csv": "photo.png,30,25,210,160\n",
    "only_header.csv": "photo,x0,y0,x1,y1\n",
    "empty.csv": "",
    "blank.csv": "\n\n  \n",
    "twice.csv": "photo,x0,x0,y0,x1,y1\nphoto.png,30,30,25,210,160\n",
    "quote.csv": 'photo,x0,y0,x1,y1\n"photo.png,30,25,210,160\n',
    "long_row.csv": "photo,x0,y0,x1,y1\nphoto.png,30,25,210,160,7\n",
    "short_row.csv": "photo,x0,y0,x1,y1\nphoto.png,30,25\n",
    "word.csv": "photo,x0,y0,x1,y1\nphoto.png,thirty,25,210,160\n",
    "comma.csv": 'photo,x0,y0,x1,y1\nphoto.png,"30,5",25,210,160\n',
    "nan.csv": "photo,x0,y0,x1,y1\nphoto.png,nan,25,210,160\n",
    "half_box.csv": "photo,x0,y0,x1,y1\nphoto.png,30,25,,\n",
    "half_camera.csv": "photo,x0,y0,x1,y1,fx,fy\nphoto.png,30,25,210,160,260,260\n",
    "typo.csv": "photo,x0,y0,x1,y1,azimut\nphoto.png,30,25,210,160,3\n",
    "side.csv": "photo,x0,y0,x1,y1,side\nphoto.png,30,25,210,160,upside\n",
    "lost.csv": "photo,x0,y0,x1,y1\nlost.png,30,25,210,160\n",
    "reversed.csv": "photo,x0,y0,x1,y1\nphoto.png,210,160,30,25\n",
    "outside.csv": "photo,x0,y0,x1,y1\nphoto.png,900,900,950,950\n",
    "lost_mesh.csv": "photo,x0,y0,x1,y1,mesh\nphoto.png,30,25,210,160,lost.ply\n",
    "no_mesh.csv": "photo,x0,y0,x1,y1,mesh\nphoto.png,30,25,210,160,\n",
    "camera.csv": "photo,x0,y0,x1,y1,fx,fy,cx,cy\nphoto.png,30,25,210,160,0,260,119.5,89.5\n",
    "broken.json": '{"photo": ',
    "empty.json": "",
    "number.json": "7",
    "no_rows.json": "[]",
    "strings.json": '["photo.png"]',
    "no_photo.json": '[{"box": [30, 25, 210, 160]}]',
    "box.json": '[{"photo": "photo.png", "box": [30, 25, 210]}]',
    "coco.json": '{"images": [], "annotations": []}',
}
POSE = {"rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "translation": [0, 0, 4]}
STARTS: dict[str, Any] = {
    "start_keys.json": {"rotation": POSE["rotation"]},
    "start_scaled.json": {**POSE, "rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]},
    "start_mirror.json": {**POSE, "rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]},
    "start_nan.json": {**POSE, "translation": [0, None, 4]},
    "start_behind.json": {**POSE, "translation": [0, 0, -4]},
    "start_mm.json": {**POSE, "translation": [0, 0, 4000]},
    "start_aside.json": {**POSE, "translation": [400, 0, 4]},
    "start_text.json": {**POSE, "rotation": "none"},
    "start_list.json": [1, 2, 3],
}


def write_files(folder: Path) -> None:
    """Write them all."""
    write_photographs(folder)
    write_meshes(folder)
    for name, text in LISTS.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "bom.csv").write_text("photo,x0,y0,x1,y1\nlost.png,30,25,210,160\n", encoding="utf-16")
    (folder / "latin.csv").write_bytes("photo,x0,y0,x1,y1\nb\u00e4r.png,30,25,210,160\n".encode("latin-1"))
    (folder / "binary.csv").write_bytes((folder / "photo.png").read_bytes())
    for name, content in STARTS.items():
        (folder / name).write_text(json.dumps(content))
    (folder / "pipeline.json").write_text('{"terms": 3}')
    (folder / "file").write_text("a file where a folder is expected")
    for name in ("empty", "folder.png", "bop/test/000001/rgb", "bop/models", "pascal/Annotations", "frames"):
        (folder / name).mkdir(parents=True)
    (folder / "bop/test/000001/scene_gt.json").write_text("{")
    (folder / "bop/test/000001/scene_camera.json").write_text("{}")
    (folder / "frames/0.png").write_text("not a picture")
    (folder / "film.mp4").write_bytes(b"\0\0\0 ftypisom" + bytes(200))
    write_results(folder)


def write_photographs(folder: Path) -> None:
    generator = torch.Generator().manual_seed(1)
    K = camera_matrix(FOCAL, FOCAL, 119.5, 89.5, dtype=torch.float64)
    T = random_pose(example_mesh(), K, SIZE, generator, elevations=(5.0, 50.0))
    picture = to_uint8(synthesize_photograph(example_mesh(), T, K, SIZE, generator)[0])[..., ::-1]
    pictures = {
        "photo.png": picture,
        "photo.jpg": picture,
        "one.png": picture[:1, :1],
        "row.png": picture[:1],
        "small.png": picture[:9, :9],
        "flat.png": np.full_like(picture, 90),
        "deep.png": picture.astype(np.uint16) * 257,
        "alpha.png": np.dstack([picture, np.zeros(SIZE, np.uint8)]),
        "nan.tiff": np.full((*SIZE, 3), np.nan, np.float32),
    }
    for name, pixels in pictures.items():
        cv2.imwrite(str(folder / name), pixels)
    image = Image.fromarray(np.ascontiguousarray(picture[..., ::-1]))
    image.convert("CMYK").save(folder / "cmyk.jpg")
    image.save(folder / "moving.gif", save_all=True, append_images=[image.rotate(9)])
    image.save(folder / "moving.webp", save_all=True, append_images=[image.rotate(9)])
    whole = {suffix: (folder / f"photo{suffix}").read_bytes() for suffix in (".png", ".jpg")}
    for suffix, data in whole.items():
        (folder / f"truncated{suffix}").write_bytes(data[: len(data) // 2])
        (folder / f"header{suffix}").write_bytes(data[:40])
        (folder / f"empty{suffix}").touch()
    (folder / "text.jpg").write_text("not a picture")
    (folder / "photo.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    (folder / "photo.cr2").write_bytes(b"II*\0" + bytes(64))
    (folder / "photo.pdf").write_bytes(b"%PDF-1.7" + bytes(64))
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    (folder / "huge.png").write_bytes(whole[".png"][:8] + chunk + whole[".png"][33:])


def write_meshes(folder: Path) -> None:
    mesh = example_mesh()
    mesh.export(folder / "truck.ply")
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]

    def obj(name: str, points: Any, faces: str = FACES) -> None:
        lines = [f"v {' '.join(str(value) for value in point)}\n" for point in points]
        (folder / name).write_text("".join(lines) + faces)

    obj("tiny.obj", [[1e-9 * value for value in point] for point in corners])
    obj("huge.obj", [[1e30 * value for value in point] for point in corners])
    obj("far.obj", [[value + 1e9 for value in point] for point in corners])
    obj("nan.obj", [(0, 0, 0), (1, 0, 0), ("nan", 1, 0), (0, 0, 1)])
    obj("point.obj", [(1, 1, 1)] * 4)
    obj("line.obj", [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)])
    obj("points.obj", corners, "")
    obj("index.obj", corners, "f 1 2 9\n")
    obj("word.obj", [(0, 0, 0), (1, 0, 0), (0, "one", 0), (0, 0, 1)])
    obj("no_mtl.obj", corners, "mtllib lost.mtl\nusemtl red\n" + FACES)
    (folder / "red.mtl").write_text("newmtl red\nmap_Kd lost.png\n")
    obj("no_texture.obj", corners, "mtllib red.mtl\nusemtl red\nvt 0 0\n" + FACES.replace(" 1 ", " 1/1 "))
    for suffix in (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".safetensors"):
        (folder / f"empty{suffix}").touch()
    (folder / "page.obj").write_text("<!DOCTYPE html><html>404</html>")
    (folder / "picture.stl").write_bytes((folder / "photo.png").read_bytes())
    shutil.copy(folder / "truck.ply", folder / "really_ply.obj")
    ply = (folder / "truck.ply").read_bytes()
    (folder / "truncated.ply").write_bytes(ply[: len(ply) // 2])
    (folder / "no_bin.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "lost.bin"}]}))
    (folder / "broken.gltf").write_text("{")
    for suffix in (".fbx", ".step", ".blend", ".txt"):
        (folder / f"truck{suffix}").write_bytes(b"unknown")
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    bank = ViewBank.build(mesh, views, pipeline=PRESETS["fast"], image_size=64, progress=False)
    bank.save(folder / "bank.safetensors")
    data = (folder / "bank.safetensors").read_bytes()
    (folder / "truncated.safetensors").write_bytes(data[: len(data) // 2])
    save_file({"weight": torch.zeros(3)}, folder / "other.safetensors")


def write_results(folder: Path) -> None:
    """Folders of results: of another version, without tables, and with damaged ones."""
    tables = {
        "old": {"summary.json": '{"settings": {"version": "0.0.1"}}', "predictions.csv": "a,b\n1,2\n"},
        "damaged": {"predictions.csv": "azimuth,true_azimuth\n1,two\n", "results.jsonl": "{"},
        "ragged": {"predictions.csv": "azimuth,true_azimuth\n1\n"},
        "other": {"results.jsonl": '{"key": "x"}\n', "settings.json": '{"pipeline": "another"}'},
    }
    for name, files in tables.items():
        (folder / name).mkdir()
        for file, text in files.items():
            (folder / name / file).write_text(text)
    (folder / "words.csv").write_text("k,a\n1,many\n")
