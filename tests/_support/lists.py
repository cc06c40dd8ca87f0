"""Lists of photographs on disk, and the results of a list."""

import csv
import json

import cv2
import numpy as np
import torch

from curvireg_torch.geometry import rotation_error
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import learned_registrar, scene, truck_bank

__all__ = ["CAMERA", "RESULTS", "bop_poses", "box_of", "check_pose", "lines", "table", "write_files", "written"]

CAMERA = ["260", "260", "119.5", "89.5"]
RESULTS = [*("status", "message", "confidence", "reliable"), *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))]
RESULTS += ["tx", "ty", "tz"]


def write_files(folder):
    """Three photographs, files that are none, a mesh, and two banks: "truck", without confidence, and "learned"."""
    (folder / "photos").mkdir()
    for seed in range(3):
        picture = (scene(seed)[0].permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "photos" / f"{seed}.png"), picture)
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
        row |= {"R": np.array(row["R"].split(), float).reshape(3, 3), "t": np.array(row["t"].split(), float)}
    return rows


def check_pose(document, T, degrees, share):
    """Check the pose of a result, or of a row of results.csv: its rotation error, and that of the translation, as a
    share of the distance."""
    if "r11" in document:
        R = [[float(document[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)]
        document = {"rotation": R, "translation": [float(document[name]) for name in ("tx", "ty", "tz")]}
    R, t = (torch.tensor(document[name], dtype=torch.float64) for name in ("rotation", "translation"))
    assert float(rotation_error(R, T[:3, :3])) < degrees
    assert float((t - T[:3, 3]).norm() / T[:3, 3].norm()) < share


def lines(folder):
    return [json.loads(line) for line in (folder / "results.jsonl").read_text(encoding="utf-8").splitlines()]
