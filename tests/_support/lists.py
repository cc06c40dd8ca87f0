"""Lists and rigs of photographs on disk, and the results of a list."""

import csv
import json

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch.geometry import transform
from curvireg_torch.synthetic import example_mesh
from tests._support.miniature import write_json
from tests._support.numbers import double
from tests._support.scenes import check_near, learned_registrar, scene, truck_bank, write_photo
from tests.registration.test_several import EASY, rig_of

CAMERA = ["260", "260", "119.5", "89.5"]
RIG_HEADER = "photo,x0,y0,x1,y1,fx,fy,cx,cy,r11,r12,r13,r21,r22,r23,r31,r32,r33,tx,ty,tz"
"""The columns of a rig."""
RESULTS = ["verdict", "message", "confidence", "reliable"]
RESULTS += [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
RESULTS += ["tx", "ty", "tz", "exactness"]


def write_files(folder):
    """Three photographs, files that are none, a mesh, and two banks: "truck", without confidence,
    and "learned"."""
    (folder / "photos").mkdir()
    for seed in range(3):
        write_photo(folder / "photos" / f"{seed}.png", scene(seed)[0])
    cv2.imwrite(str(folder / "flat.png"), np.full((60, 80, 3), 90, np.uint8))
    (folder / "text.jpg").write_text("not a picture")
    example_mesh().export(folder / "truck.ply")
    truck_bank().save(folder / "truck.safetensors")
    learned_registrar().bank.save(folder / "learned.safetensors")
    return folder


def box_of(seed):
    return [f"{v:.1f}" for v in scene(seed)[1]]


def written(path, header, *rows):
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header.split(","), *rows])
    return path


def table(folder, name="results.csv"):
    with (folder / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def bop_poses(path):
    """The lines of a results file of the BOP challenge, as numbers and arrays."""
    rows = table(path.parent, path.name)
    for row in rows:
        row |= {name: int(row[name]) for name in ("scene_id", "im_id", "obj_id")}
        row |= {name: float(row[name]) for name in ("score", "time")}
        row["R"] = np.array(row["R"].split(), float).reshape(3, 3)
        row["t"] = np.array(row["t"].split(), float)
    return rows


def check_pose(document, T, degrees, share):
    """Check the pose of a result, or of a row of results.csv: its rotation error, and that of the
    translation, as a share of the distance."""
    if "r11" in document:
        R = [[float(document[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)]
        t = [float(document[name]) for name in ("tx", "ty", "tz")]
        document = {"rotation": R, "translation": t}
    found = transform(*(double(document[name]) for name in ("rotation", "translation")))
    check_near(found, T, degrees, share)


def lines(folder):
    text = (folder / "results.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]


def write_rig_photos(folder):
    """Write 0.png to 2.png; returns the rows of their rig: photo, box, camera, rotation and
    translation."""
    rows = []
    for k, (image, box, T) in enumerate(zip(*rig_of(EASY), strict=True)):
        write_photo(folder / f"{k}.png", image)
        rows.append(
            [f"{k}.png", *box.tolist(), *CAMERA, *T[:3, :3].flatten().tolist(), *T[:3, 3].tolist()]
        )
    return rows


def quaternion(row):
    """QW, QX, QY, QZ of the rotation in a row of a rig."""
    x, y, z, w = Rotation.from_matrix(torch.tensor(row[9:18]).view(3, 3).numpy()).as_quat()
    return [w, x, y, z]


def write_colmap(folder, rows, points=""):
    """Write images.txt, with that line of points behind each image, and cameras.txt."""
    lines = ["# Image list"]
    for k, row in enumerate(rows, start=1):
        lines += [" ".join(map(str, [k, *quaternion(row), *row[18:], 1, row[0]])), points]
    (folder / "images.txt").write_text("\n".join(lines))
    (folder / "cameras.txt").write_text("1 PINHOLE 240 180 260 260 120 90\n")


def write_bop_scene(folder, rows, objects, boxes):
    """Write the three files of a scene, with the objects of each photograph and the boxes of
    all."""
    K = [260.0, 0.0, 119.5, 0.0, 260.0, 89.5, 0.0, 0.0, 1.0]
    cameras = {
        k: {"cam_K": K, "cam_R_w2c": row[9:18], "cam_t_w2c": row[18:]} for k, row in enumerate(rows)
    }
    truth = {k: [{"obj_id": number} for number in some] for k, some in enumerate(objects)}
    info = {k: [{"bbox_obj": box} for box in boxes] for k in range(len(rows))}
    for name, content in (("camera", cameras), ("gt", truth), ("gt_info", info)):
        write_json(folder / f"scene_{name}.json", content)
