"""Confidence of tracked poses, measured on sequences of scripts/benchmark/sequences.py.

    python scripts/calibration/tracking.py BENCH --rows ROWS.jsonl [--half train] [--sequences 20] [--write]

Each sequence is tracked from its first true pose, by every frame, by every second and by every third, without search;
and every fifth pose is tracked in a frame of another sequence too, where the object is absent. A row holds the features
and the errors. The rows of the half "train" fit the confidence (within 10 degrees and 10 % of the distance), which
--write stores in curvireg_torch/registration/tracking.json; those of "held-out" only test it.
"""

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.errors import LostObjectError
from curvireg_torch.mesh.mesh import extreme_points, mesh_centre, mesh_radius
from curvireg_torch.registration.confidence import LogisticModel
from curvireg_torch.registration.tracking import Tracker
from curvireg_torch.rendering import make_renderer
from scripts._shared import write_json
from scripts.benchmark.make import Meshes
from scripts.benchmark.sequences import make_sequence

CALIBRATION = Path(cr.__file__).parent / "registration" / "tracking.json"
FEATURES = ("edge_support", "region", "flow", "keyframe")
STRIDES = (1, 2, 3)
"""Every frame, every second and every third: steps of up to 5, 10 and 15 degrees."""

ABSENT_EVERY = 5
DEGREES, FRACTION = 10.0, 0.1
"""A pose is right within so many degrees, and so large a fraction of the object's distance."""


def rows_of(
    mesh: Any, frames: Sequence[Tensor], poses: Tensor, K: Tensor, symmetries: Tensor, others: Sequence[Tensor]
) -> list[dict[str, Any]]:
    """Features and errors of one sequence (N, 4, 4); ``others`` are frames without the object."""
    centre, rows = mesh_centre(mesh).double(), []
    for stride in STRIDES:
        tracker = Tracker(make_renderer(mesh), extreme_points(mesh), centre=centre, radius=mesh_radius(mesh))
        tracker.start(frames[0], K, poses[0])
        for number in range(stride, len(frames), stride):
            if stride == 1 and number % ABSENT_EVERY == 0:
                with suppress(LostObjectError):
                    absent = tracker.track(others[number], K)
                    rows.append({"kind": "absent", "frame": number, "right": False, **absent.features})
            try:
                found = tracker.track(frames[number], K)
            except LostObjectError:
                break
            tracker.accept(found)
            T, truth = found.T[0], poses[number]
            turn = float(cr.rotation_error(T[:3, :3], truth[:3, :3] @ symmetries).min())
            place, true_place = (P[:3, :3] @ centre + P[:3, 3] for P in (T, truth))
            shift = float((place - true_place).norm() / true_place.norm())
            row = {"kind": f"stride {stride}", "frame": number, "degrees": turn, "fraction": shift}
            rows.append({**row, "right": turn <= DEGREES and shift <= FRACTION, **found.features})
    return rows


def measure(folder: Path, half: str, count: int, frames: int, seed: int, out: Path) -> list[dict[str, Any]]:
    """Rows of all sequences; those that ``out`` holds are not measured again."""
    meshes = Meshes(folder, half)
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {row["sequence"] for row in rows}
    others: list[Tensor] = []
    for index in tqdm(range(count), unit="sequence"):
        if index in known:
            continue
        made = make_sequence(meshes, seed, index, frames)
        pictures = list(made.frames())
        others = others or list(make_sequence(meshes, seed, (index or count) - 1, frames).frames())
        mesh = cr.load_mesh(folder / made.mesh)
        new = rows_of(mesh, pictures, made.poses, made.camera_matrix, made.symmetries, others)
        new = [{"half": half, "sequence": index, "mesh": made.mesh, **row} for row in new]
        with out.open("a") as file:
            file.write("".join(json.dumps(row) + "\n" for row in new))
        rows, others = rows + new, pictures
    return rows


def fitted(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Weights, bias and number of rows of the logistic regression; rows of both outcomes weigh as they occur."""
    from sklearn.linear_model import LogisticRegression

    model = LogisticRegression(C=100.0).fit([[row[n] for n in FEATURES] for row in rows], [r["right"] for r in rows])
    weights = {name: round(float(w), 4) for name, w in zip(FEATURES, model.coef_[0], strict=True)}
    return {"weights": weights, "bias": round(float(model.intercept_[0]), 4), "n": len(rows)}


def report(rows: list[dict[str, Any]], model: dict[str, Any]) -> dict[str, Any]:
    """How well a model separates right from wrong poses."""
    from sklearn.metrics import roc_auc_score

    confidence = LogisticModel(model["weights"], model["bias"])
    p = [confidence({name: row[name] for name in FEATURES}) for row in rows]
    here = [k for k, row in enumerate(rows) if row["kind"] != "absent"]
    right = [row["right"] for row in rows]
    sure = [k for k in range(len(rows)) if p[k] >= 0.9]
    return {
        "n": len(rows),
        "wrong": right.count(False),
        "auc": round(float(roc_auc_score(right, p)), 3),
        "auc where the object is there": round(float(roc_auc_score([right[k] for k in here], [p[k] for k in here])), 3),
        "mean confidence": round(sum(p) / len(p), 3),
        "right": round(sum(right) / len(right), 3),
        "right where the confidence is at least 0.9": round(sum(right[k] for k in sure) / max(len(sure), 1), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="BENCH")
    parser.add_argument("--half", default="train", choices=("train", "held-out"))
    parser.add_argument("--sequences", type=int, default=20)
    parser.add_argument("--frames", type=int, default=30, help="of each sequence")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--write", action="store_true", help="store the weights (half train)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = measure(options.folder, options.half, options.sequences, options.frames, options.seed, options.rows)
    if options.half == "held-out":
        print(json.dumps(report(rows, json.loads(CALIBRATION.read_text(encoding="utf-8"))), indent=2))
        return
    model = fitted(rows)
    print(json.dumps({"model": model, "in sample": report(rows, model)}, indent=2))
    if options.write:
        write_json(CALIBRATION, model)


if __name__ == "__main__":
    main()
