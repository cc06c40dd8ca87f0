"""Basin and confidence of refined poses, measured on the photographs of scripts/benchmark/make.py.

    python scripts/calibration/refinement.py BENCH --out ROWS.jsonl [--half held-out] [--limit 150] [--jobs 2] [--write]

For each "exact" photograph, starts are the true pose rotated by 5 to 30 degrees about a random axis, or moved by 5 to
20 % of the distance, and the same true pose in the photograph of another object. A row says where the refinement ended,
and where cv2.rapid ended from the same start (skipped where it is absent, see scripts/_rapid.py).
--write fits the confidence (within 10 degrees and 10 % of the distance) on half of the meshes, reports it on the other
half, stores its weights in curvireg_torch/registration/refinement.json, and the table in
scripts/results/refinement_basin.json and docs/guides/known-pose.md.
"""

import argparse
import hashlib
import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.registration import refinement
from scripts._rapid import AVAILABLE, Rapid
from scripts._shared import REPOSITORY, commit, table_lines, today, update_page, write_json

ANGLES, DISTANCES = (5.0, 10.0, 15.0, 20.0, 30.0), (0.05, 0.1, 0.2)
CALIBRATION = Path(cr.__file__).parent / "registration" / "refinement.json"


def start_of(T: Tensor, angle: float, distance: float, generator: torch.Generator) -> Tensor:
    """``T`` rotated by ``angle`` degrees about the object's centre, and farther or nearer by a fraction."""
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    sign = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
    out = T.clone()
    out[:3, :3] = rotation_from_axis_angle(axis * torch.deg2rad(torch.tensor(angle, dtype=torch.float64))) @ T[:3, :3]
    out[:3, 3] = T[:3, 3] * (1.0 + sign * distance)
    return out


def rows_of(task: dict[str, Any]) -> list[Any]:
    """Rows of the photographs of one mesh."""
    torch.set_num_threads(1)
    refinement.LOST = -1.0  # lost poses are measured too
    folder = task["folder"] / task["half"]
    mesh = cr.load_mesh(task["folder"] / task["items"][0]["mesh"])
    views = cr.sample_views(azimuth_step=90, elevations=[0])
    registrar = cr.Registrar(cr.ViewBank.build(mesh, views, progress=False))
    rapid = Rapid(mesh, steps=100) if AVAILABLE else None
    rows = []
    for item in task["items"]:
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3], T[:3, 3] = torch.tensor(item["R"]), torch.tensor(item["t"])
        K, generator = torch.tensor(item["K"], dtype=torch.float64), torch.Generator().manual_seed(item["id"])
        image, symmetries = read_image(folder / item["image"]), torch.tensor(item["symmetries"], dtype=torch.float64)
        kinds = [("rotation", a, 0.0) for a in ANGLES] + [("distance", 0.0, d) for d in DISTANCES]
        kinds.append(("absent", 0.0, 0.0))
        for kind, angle, distance in kinds:
            shown = read_image(folder / item["other"]) if kind == "absent" else image
            start = start_of(T, angle, distance, generator)
            result = registrar.refine([shown], K, [start])[0]
            row = {"id": item["id"], "mesh": item["mesh"], "kind": kind, "angle": angle, "distance": distance}
            row |= {"visible": item["visible"], "clutter": item["clutter"], "lost": not result.ok}
            if result.ok:
                row |= dict(result.confidence_features) | errors(result.transform, T, symmetries)
            if rapid and kind != "absent":
                ended = rapid((shown * 255).round().byte(), K, start)
                row["rapid"] = {"lost": True} if ended is None else {"lost": False} | errors(ended, T, symmetries)
            rows.append(row)
    return rows


def errors(ended: Tensor, T: Tensor, symmetries: Tensor) -> dict[str, float]:
    """Error of the rotation in degrees, and of the translation as a fraction of the distance."""
    return {
        "rotation_error": float(cr.rotation_error(ended[:3, :3], T[:3, :3] @ symmetries).min()),
        "position_error": float((ended[:3, 3] - T[:3, 3]).norm() / T[:3, 3].norm()),
    }


def measure(folder: Path, out: Path, half: str, limit: int, jobs: int) -> list[dict[str, Any]]:
    """Rows of all photographs; those that ``out`` holds are not measured again."""
    items = [json.loads(line) for line in (folder / half / "items.jsonl").read_text().splitlines()]
    items = [item for item in items if item["form"] == "exact"][:limit]
    for item, other in zip(items, [*items[1:], items[0]], strict=True):
        item["other"] = other["image"]
    out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {row["id"] for row in rows}
    todo = sorted((item for item in items if item["id"] not in known), key=lambda item: item["mesh"])
    tasks = [
        {"folder": folder, "half": half, "items": list(group)} for _, group in groupby(todo, key=lambda i: i["mesh"])
    ]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool, out.open("a") as file:
        for future in tqdm(as_completed([pool.submit(rows_of, task) for task in tasks]), total=len(tasks)):
            new = future.result()
            rows += new
            file.write("".join(json.dumps(row) + "\n" for row in new))
            file.flush()
    return rows


def is_right(row: dict[str, Any], degrees: float, fraction: float) -> bool:
    """Whether a refinement ended near the truth."""
    ended = row.get("kind") != "absent" and not row["lost"]
    return ended and row["rotation_error"] <= degrees and row["position_error"] <= fraction


def report(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Fitted confidence, and the table of the basin."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import roc_auc_score

    names = ("similarity", "edge_support")
    measured = [row for row in rows if not row["lost"]]
    X = [[row[name] for name in names] for row in measured]
    y = [is_right(row, 10.0, 0.1) for row in measured]
    fold = [hashlib.md5(row["mesh"].encode()).digest()[0] % 2 for row in measured]
    first = [k for k, f in enumerate(fold) if f == 0]
    second = [k for k, f in enumerate(fold) if f == 1]
    held = LogisticRegression(C=100.0).fit([X[k] for k in first], [y[k] for k in first])
    auc = roc_auc_score([y[k] for k in second], held.predict_proba([X[k] for k in second])[:, 1])
    model = LogisticRegression(C=100.0).fit(X, y)
    weights = {name: round(float(w), 4) for name, w in zip(names, model.coef_[0], strict=True)}
    basin = {}
    for kind, size in [*(("rotation", a) for a in ANGLES), *(("distance", d) for d in DISTANCES)]:
        mine = [row for row in rows if row["kind"] == kind and size in (row["angle"], row["distance"])]
        name = f"{size:g}°" if kind == "rotation" else f"{100 * size:g} % of the distance"
        basin[name] = fractions_right(mine)
        if rapid := [row["rapid"] for row in mine if "rapid" in row]:
            basin[name]["cv2.rapid"] = fractions_right(rapid)
    confidence = model.predict_proba(X)[:, 1]
    lost = confidence < refinement.LOST
    return {
        "commit": commit(REPOSITORY),
        "date": today(),
        "model": {"weights": weights, "bias": round(float(model.intercept_[0]), 4), "n": len(measured)},
        "auc on the other meshes": round(float(auc), 3),
        "occluded": fraction_of(np.array([row["visible"] < 0.95 for row in rows]), [True] * len(rows)),
        "lost": {
            "right poses": fraction_of(lost, y),
            "photographs without the object": fraction_of(lost, [row["kind"] == "absent" for row in measured]),
        },
        "basin": basin,
    }


def fractions_right(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of rows, and the fractions of them that ended near the truth."""
    limits = {"within 2 degrees and 2 %": (2.0, 0.02), "within 5 degrees and 5 %": (5.0, 0.05)}
    right = {name: sum(is_right(row, *limit) for row in rows) / len(rows) for name, limit in limits.items()}
    return {"n": len(rows), **right}


def fraction_of(chosen: Any, among: list[bool]) -> float:
    """Fraction of the marked rows that are chosen, to three digits."""
    return round(float(chosen[among].mean()), 3)


def page_table(found: dict[str, Any]) -> str:
    """The table of docs/guides/known-pose.md."""
    columns = ("within 2 degrees and 2 %", "within 5 degrees and 5 %")
    first = next(iter(found["basin"].values()))
    n, beside = first["n"], "cv2.rapid" in first
    rows = []
    for name, row in found["basin"].items():
        both = [row, row["cv2.rapid"]] if beside else [row]
        rows.append([name, *(f"{one[column]:.2f}" for one in both for column in columns)])
    header = [*columns, *(f"`cv2.rapid`: {column}" for column in columns if beside)]
    lost = found["lost"]
    return "\n".join(
        [
            *table_lines([["start is off by", *header], *rows]),
            "",
            f"N = {n} generated photographs of held-out meshes in clutter, {found['occluded']:.0%} of them at least "
            f"5 % hidden; {found['date']}, commit {found['commit']}.",
            f"AUC of the confidence on meshes it was not fitted on: {found['auc on the other meshes']:.2f}. "
            f"Called lost: {lost['right poses']:.1%} of the right poses,",
            f"{lost['photographs without the object']:.0%} of the photographs without the object.",
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--limit", type=int, default=150)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--write", action="store_true", help="store weights and table")
    options = parser.parse_args()
    found = report(measure(options.folder, options.out, options.half, options.limit, options.jobs))
    print(json.dumps(found, indent=2))
    if options.write:
        write_json(CALIBRATION, found["model"])
        write_json(REPOSITORY / "scripts" / "results" / "refinement_basin.json", found)
        update_page(REPOSITORY / "docs" / "guides" / "known-pose.md", "refinement", page_table(found))


if __name__ == "__main__":
    main()
