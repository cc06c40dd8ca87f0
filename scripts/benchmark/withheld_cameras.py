"""Compare registrations with the camera and with the camera withheld, on a set in BOP's layout.

    python scripts/benchmark/withheld_cameras.py DATASET --out ROWS.jsonl [--limit 30]

DATASET is the folder of a BOP set, or one that make.py wrote. Objects that are at least 95 %
visible are registered twice; finished rows of ROWS.jsonl are kept. Rotations are compared as seen
by a camera that looks at the object.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.geometry import rotation_towards, symmetry_transforms, transform

UNOCCLUDED = 0.95
WRONG = 30.0  # degrees from which a reliable answer is wrong
Row = dict[str, Any]


def allocentric(T: Tensor, centre: Tensor) -> Tensor:
    """(3, 3) rotation of a pose (4, 4), as seen by a camera that looks straight at the object."""
    position = T[:3, :3] @ centre + T[:3, 3]
    return rotation_towards(position).T @ T[:3, :3]


def measured(registrar: cr.Registrar, sample: Row, K: Tensor | None) -> Row:
    """Error, confidence and focal length of one registration."""
    result = registrar([sample["image"]], sample["box"][None], K)[0]
    if not result.ok:
        return {
            "error": 180.0,
            "reliable": False,
            "confidence": 0.0,
            "focal": None,
            "deviation": None,
        }
    centre = registrar.describer.centre
    truth = transform(sample["rotation"].double(), sample["translation"].double())
    same = symmetry_transforms(sample["model_info"])[:, :3, :3]
    found = allocentric(result.projection[0], centre)
    errors = cr.rotation_error(found, allocentric(truth, centre) @ same)
    return {
        "error": float(errors.min()),
        "reliable": result.reliable,
        "confidence": result.confidence,
        "focal": float(result.camera.matrix[0, 0] / sample["camera_matrix"][0, 0]),
        "deviation": result.camera.focal_deviation,
    }


def summary(rows: list[Row], name: str) -> Row:
    """Shares within 5 and 15 degrees, median error, reliable answers, and the wrong ones among
    these."""
    errors = torch.tensor([row[name]["error"] for row in rows])
    reliable = [row[name] for row in rows if row[name]["reliable"]]
    return {
        "n": len(rows),
        "within 5": float((errors <= 5.0).float().mean()),
        "within 15": float((errors <= 15.0).float().mean()),
        "median": float(errors.median()),
        "reliable": len(reliable),
        "wrong": sum(one["error"] > WRONG for one in reliable),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--limit", type=int, help="objects, spread evenly over the set")
    options = parser.parse_args()
    data = BOPDataset(options.dataset)
    whole = [i for i in range(len(data)) if data.annotation(i)["visib_fract"] >= UNOCCLUDED]
    count = min(options.limit or len(whole), len(whole))
    chosen = [whole[k * len(whole) // count] for k in range(count)]
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = {row["index"]: row for row in map(json.loads, lines)}
    registrars: dict[str, cr.Registrar] = {}
    with options.out.open("a") as file:
        for i in (i for i in chosen if i not in rows):
            sample = data[i]
            path = str(sample["model_path"])
            if path not in registrars:
                registrars[path] = cr.Registrar(cr.load_mesh(path, unit="mm"))
            cameras = {"given": sample["camera_matrix"].double(), "estimated": None}
            found = {name: measured(registrars[path], sample, K) for name, K in cameras.items()}
            rows[i] = {"index": i, **found}
            file.write(json.dumps(rows[i]) + "\n")
            file.flush()
    kept = [rows[i] for i in chosen]
    sure = [row["estimated"] for row in kept if (row["estimated"]["deviation"] or 1.0) < 0.05]
    right = sum(abs(one["focal"] - 1.0) <= 0.1 for one in sure)
    report = {name: summary(kept, name) for name in ("given", "estimated")}
    print(
        json.dumps(
            {**report, "deviation below 5 %": len(sure), "of these within 10 %": right}, indent=2
        )
    )


if __name__ == "__main__":
    main()
