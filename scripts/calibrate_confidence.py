"""Fits the constants of curvireg_torch.registration.confidence on scenes made in code, where the truth is known.

    python scripts/calibrate_confidence.py [--out scripts/results/confidence_calibration.json]

Assemblies of boxes, cylinders, cones and spheres are photographed at random poses, from easily to hardly. Each
photograph is ranked against its own mesh, and a logistic regression on the evidence of the rankings tells right answers
(the best view within 30 degrees of the truth) from wrong ones. Every other mesh is held out to judge a first fit; the
constants come from all. Rankings against the next mesh, a wrong one, are judged and take no part in the fit.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from _record import write_json
from sklearn.linear_model import LogisticRegression

import curvireg_torch as cr
from curvireg_torch.geometry import rotation_from_quaternion, rotation_towards
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.geometry.mesh import mesh_centre, mesh_radius
from curvireg_torch.matching import cached_bank
from curvireg_torch.pipeline import DEFAULT, preset_named
from curvireg_torch.registration.confidence import EVIDENCE, ranking_evidence
from curvireg_torch.synthetic import example_mesh, procedural_background, random_pose, synthesize_photograph

SIZE = (240, 320)
CAMERA = cr.camera_matrix(400.0, 400.0, 159.5, 119.5, dtype=torch.float64)


def assembly(seed: int) -> trimesh.Trimesh:
    """Five to eight solids, each touching the first; seed 0 is the toy truck of the demo."""
    if seed == 0:
        return example_mesh()
    rng = np.random.default_rng(seed)
    parts = [trimesh.creation.box(rng.uniform(0.3, 1.0, 3))]
    for _ in range(rng.integers(4, 8)):
        kind, size = rng.integers(4), rng.uniform(0.1, 0.5, 3)
        part = (
            trimesh.creation.box(size * 1.5),
            trimesh.creation.cylinder(size[0] / 2, 2 * size[1]),
            trimesh.creation.cone(size[0], 2 * size[1]),
            trimesh.creation.icosphere(2, size[0]),
        )[kind]
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)) if kind else np.eye(4))
        part.apply_translation(parts[0].extents * rng.uniform(-0.6, 0.6, 3))
        parts.append(part)
    mesh = trimesh.util.concatenate(parts)
    mesh.units = "m"
    return mesh


def any_pose(mesh: trimesh.Trimesh, generator: torch.Generator) -> torch.Tensor:
    quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
    u = torch.rand(3, generator=generator, dtype=torch.float64)
    ray = torch.linalg.inv(CAMERA) @ torch.tensor([SIZE[1] * (0.4 + 0.2 * u[0]), SIZE[0] * (0.4 + 0.2 * u[1]), 1.0])
    R = rotation_from_quaternion(quaternion)
    distance = 2.0 * mesh_radius(mesh) * float(CAMERA[0, 0]) / ((0.4 + 0.3 * float(u[2])) * SIZE[0])
    return transform(R, ray / ray.norm() * distance - R @ mesh_centre(mesh))


def photograph(mesh: trimesh.Trimesh, pose: str, generator: torch.Generator):
    """image, box, and the rotation seen by a camera that looks straight at the box.

    From easy to hard: texture, sharpness of the background, error of the box (up to 20 %), an occluder, and the object
    stretched along its axes, as objects of one category differ.
    """
    hard, texture, cover, *_ = torch.rand(4, generator=generator).tolist()
    stretched = mesh.copy()
    factors = torch.exp(0.3 * hard * torch.randn(3, generator=generator)).numpy()
    stretched.vertices = mesh_centre(mesh).numpy() + (mesh.vertices - mesh_centre(mesh).numpy()) * factors
    make = any_pose if pose == "any" else lambda m, g: random_pose(m, CAMERA, SIZE, g)
    T = make(stretched, generator)
    image, box = synthesize_photograph(
        stretched, T, CAMERA, SIZE, generator, texture=0.1 + 2.0 * hard * texture, defocus=0.1 + 1.8 * (1.0 - hard)
    )
    x0, y0, x1, y1 = (round(v) for v in box.tolist())
    if cover < 0.5:
        w, h = (max(1, round(0.7 * hard * side)) for side in (x1 - x0, y1 - y0))
        u = torch.rand(2, generator=generator).tolist()
        x, y = max(0, round(x0 + u[0] * (x1 - x0 - w))), max(0, round(y0 + u[1] * (y1 - y0 - h)))
        patch = procedural_background((h, w), generator)[:, : SIZE[0] - y, : SIZE[1] - x]
        image[:, y : y + h, x : x + w] = patch
    moves = 2.0 * torch.rand(4, generator=generator) - 1.0
    given = box + 0.2 * hard * moves * (box[2:] - box[:2]).repeat(2)
    centre = torch.stack([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, torch.tensor(1.0)]).double()
    return image, given, rotation_towards(torch.linalg.inv(CAMERA) @ centre).T @ T[:3, :3]


@torch.no_grad()
def collect(pose: str, meshes: int, scenes: int) -> list[dict]:
    """One row per ranking: mesh, evidence, error in degrees, whether the mesh was the right one."""
    preset = preset_named(DEFAULT)
    objects = [assembly(seed) for seed in range(meshes)]
    rows = []
    shots = []
    for i, mesh in enumerate(objects):
        generator = torch.Generator().manual_seed(1000 * (pose == "any") + i)
        shots.append([photograph(mesh, pose, generator) for _ in range(scenes)])
    for i, mesh in enumerate(objects):
        matcher = cr.ViewMatcher(cached_bank(mesh, pipeline=preset.posed(pose), progress=False))
        for j in (i, (i - 1) % meshes):
            images, boxes = [s[0] for s in shots[j]], torch.stack([s[1] for s in shots[j]])
            ranking = matcher(images, boxes)
            evidence = ranking_evidence(ranking, matcher.bank.rotations)
            found = matcher.bank.rotations[ranking.order[:, 0]].double()
            errors = cr.rotation_error(found, torch.stack([s[2] for s in shots[j]]))
            for e, error in zip(evidence.tolist(), errors.tolist(), strict=True):
                rows.append({"pose": pose, "mesh": i, "right_mesh": i == j, "error": error, "evidence": e})
        print(f"{pose} {i + 1}/{meshes}", flush=True)
    return rows


def arrays(rows: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) evidence and (n,) whether the answer is right, of the right meshes."""
    own = [r for r in rows if r["right_mesh"]]
    return np.array([r["evidence"] for r in own]), np.array([r["error"] < 30.0 for r in own])


def fit(rows: list[dict]) -> tuple[list[float], float]:
    model = LogisticRegression(C=10.0, max_iter=1000).fit(*arrays(rows))
    return [round(float(v), 3) for v in model.coef_[0]], round(float(model.intercept_[0]), 3)


def judge(rows: list[dict], weights: list[float], bias: float) -> dict:
    """Calibration on the right meshes: mean confidence, accuracy, expected calibration error in 10 bins."""
    X, y = arrays(rows)
    p = 1.0 / (1.0 + np.exp(-(X @ weights + bias)))
    bins = np.minimum((p * 10).astype(int), 9)
    error = sum(abs(p[bins == b].mean() - y[bins == b].mean()) * (bins == b).mean() for b in np.unique(bins))
    wrong = np.array([r["evidence"] for r in rows if not r["right_mesh"]])
    q = 1.0 / (1.0 + np.exp(-(wrong @ weights + bias)))
    auc = float((p[:, None] > q[None]).mean() + 0.5 * (p[:, None] == q[None]).mean())
    return {
        "n": len(p),
        "accuracy": float(y.mean()),
        "mean_confidence": float(p.mean()),
        "ece": float(error),
        "auc_right_answer": float((p[y][:, None] > p[~y][None]).mean()) if 0 < y.sum() < len(y) else math.nan,
        "auc_right_mesh": auc,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", type=int, nargs=2, default=(6, 0), help="upright, any orientation")
    parser.add_argument("--scenes", type=int, default=24, help="photographs of each")
    parser.add_argument("--rows", type=Path, help="keep the collected rows in this file, or read them from it")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "confidence_calibration.json")
    arguments = parser.parse_args()
    if arguments.rows and arguments.rows.exists():
        rows = json.loads(arguments.rows.read_text())
    else:
        rows = [
            row
            for pose, meshes in zip(("upright", "any"), arguments.meshes, strict=True)
            for row in collect(pose, meshes, arguments.scenes)
        ]
        if arguments.rows:
            arguments.rows.write_text(json.dumps(rows))
    held = [r for r in rows if r["mesh"] % 2]
    weights, bias = fit([r for r in rows if r["mesh"] % 2 == 0])
    result = {
        "held_out": {
            pose: judge([r for r in held if r["pose"] == pose], weights, bias) for pose in {r["pose"] for r in held}
        },
        "evidence": list(EVIDENCE),
        "weights": fit(rows)[0],
        "bias": fit(rows)[1],
        "scenes_per_mesh": arguments.scenes,
        "meshes": list(arguments.meshes),
    }
    write_json(arguments.out, result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
