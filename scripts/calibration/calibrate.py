"""Fit the constants of confidence, rivals, covariance, detection, refinement and following on generated photographs.

    python scripts/calibration/calibrate.py WORK --meshes FURNITURE [--count 400] [--models instance] [--write]

FURNITURE is the folder of scripts/benchmark/meshes.py. The script renders the sets that WORK lacks (make.py: the
object's own mesh, a similar one, a wrong one, and sequences), registers, refines, follows and detects their objects
into WORK/*.jsonl, of which finished rows are kept, and fits. Folds are by kind of object, so every measure is of kinds
that the fit has not seen. --write stores the constants in curvireg_torch/registration/calibration.json and their
quality in scripts/results/calibration.json.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import logsumexp
from scipy.stats import chi2
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.errors import LostObjectError
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_from_axis_angle
from curvireg_torch.geometry.crops import box_iou
from curvireg_torch.registration import Follower
from curvireg_torch.registration.confidence import RELIABLE, LogisticModel
from curvireg_torch.registration.detection import SAME_OBJECT_OVERLAP
from curvireg_torch.registration.poses import POSE_FEATURES, RANK_ALONE, SCORE_WEIGHTS
from scripts._shared import REPOSITORY, RESULTS, commit, today, write_json

Row: TypeAlias = dict[str, Any]

CONSTANTS = REPOSITORY / "curvireg_torch" / "registration" / "calibration.json"
FURNITURE = ["--kind", "furniture", "--cad"]
SETS: dict[str, tuple[float, list[str]]] = {
    "exact": (1.0, [*FURNITURE, "exact", "--bare", "0.2"]),
    "similar": (1.0, [*FURNITURE, "similar", "--bare", "0.2"]),
    "wrong": (0.25, [*FURNITURE, "wrong"]),
    "sequences": (0.1, [*FURNITURE, "exact", "--frames", "30"]),
    "shelves": (0.2, ["--kind", "shelf", "--objects", "8", "20", "--seed", "7"]),
}
"""Of each set: scenes, as a fraction of --count, and options of make.py."""

RIGHT = 30.0  # degrees within which a registration is right
FINE_DEGREES, FINE_FRACTION = 10.0, 0.1  # and fraction of the distance, within which a refined or tracked pose is right

STARTS = ((5.0, 0.0), (10.0, 0.0), (15.0, 0.0), (20.0, 0.0), (30.0, 0.0), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2))
"""Degrees and fraction of the distance by which the starts of refinements are off."""

WRONG_FRACTION = 0.1  # weight of the wrong meshes in the fit, as if one photograph in ten came with a wrong mesh

FOLDS = 5
MODELS = {
    "instance": ("exact", "shelves", "wrong"),
    "category": ("similar",),
    "refinement": ("exact",),
    "tracking": ("sequences",),
    "detection": ("exact",),
}
"""Of each model: the sets that it is fitted on."""

KINDS = {"refinement": "refined", "tracking": "sequences", "detection": "detected"}
"""Of each model that is not of registrations: what is measured."""


def render_sets(work: Path, meshes: Path, count: int, jobs: int, models: Sequence[str]) -> None:
    """Render the sets of ``models`` that ``work`` lacks; finished scenes are kept."""
    for name in dict.fromkeys(name for model in models for name in MODELS[model]):
        fraction, options = SETS[name]
        words = ["--out", work / name, "--count", round(fraction * count), "--jobs", jobs, *options]
        words += ["--meshes", meshes] if "furniture" in options else []
        command = [sys.executable, REPOSITORY / "scripts" / "benchmark" / "make.py", *words]
        subprocess.run([str(word) for word in command], check=True)


def errors_of(R: Tensor, sample: Row) -> Tensor:
    """(N,) degrees between rotations (N, 3, 3) and the truth, up to the object's symmetries."""
    listed = sample["model_info"].get("symmetries_discrete", [])
    S = torch.stack([torch.eye(4), *(torch.tensor(values).view(4, 4) for values in listed)])[:, :3, :3].double()
    return cr.rotation_error(R[:, None].double(), (sample["rotation"].double() @ S)[None]).amin(dim=1)


def truth_of(sample: Row) -> Tensor:
    """(4, 4) true pose of a sample."""
    return cr.geometry.transform(sample["rotation"].double(), sample["translation"].double())


def fine(T: Tensor, sample: Row) -> bool:
    """Whether a pose (4, 4) is near the truth."""
    t = sample["translation"].double()
    near = (T[:3, 3] - t).norm() <= FINE_FRACTION * t.norm()
    return bool(near and errors_of(T[None, :3, :3], sample) <= FINE_DEGREES)


def registered(registrar: cr.Registrar, sample: Row, *, with_camera: bool) -> Iterator[Row]:
    """One row: features, scores and errors of the hypotheses."""
    K = sample["camera_matrix"].double() if with_camera else None
    result = registrar([sample["image"]], sample["box"][None], K)[0]
    if not result.ok:
        return
    R = torch.stack([h.rotation if K is not None else h.allocentric_rotation for h in result.hypotheses])
    if K is None:  # compare as seen by a camera that looks straight at the object
        ray = sample["rotation"].double() @ model_centre(sample) + sample["translation"].double()
        sample = sample | {"rotation": cr.geometry.rotation_towards(ray).T @ sample["rotation"].double()}
    evidence = torch.tensor([[h.evidence[name] for name in POSE_FEATURES] for h in result.hypotheses]).double()
    weights = torch.tensor(RANK_ALONE if K is None else SCORE_WEIGHTS, dtype=torch.float64)
    row = {"features": dict(result.confidence_features), "scores": (evidence @ weights).tolist()}
    row |= {"errors": errors_of(R, sample).tolist()}
    best = result.hypotheses[0]
    if best.covariance is not None and row["errors"][0] < RIGHT:
        turn = axis_angle_from_rotation(sample["rotation"].double() @ best.rotation.T)
        e = torch.cat([turn, sample["translation"].double() - best.translation])
        row["distance2"] = float(e @ torch.linalg.solve(best.covariance.double(), e))
    yield row


def model_centre(sample: Row) -> Tensor:
    """(3,) middle of the model's box, in mm."""
    info = sample["model_info"]
    return torch.tensor([info[f"min_{c}"] + 0.5 * info[f"size_{c}"] for c in "xyz"], dtype=torch.float64)


def refined(registrar: cr.Registrar, sample: Row, other: Row) -> Iterator[Row]:
    """Rows of refinements from wrong starts, and in the photograph ``other``, which does not show the object."""
    T, K = truth_of(sample), sample["camera_matrix"].double()
    generator = torch.Generator().manual_seed(sample["scene_id"])
    for degrees, fraction in (*STARTS, (0.0, 0.0)):
        axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        sign = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
        start = T.clone()
        start[:3, :3] = rotation_from_axis_angle(axis * np.radians(degrees)) @ T[:3, :3]
        start[:3, 3] *= 1.0 + sign * fraction
        absent = degrees == fraction == 0.0
        result = registrar.refine([(other if absent else sample)["image"]], K, [start])[0]
        if result.ok:
            yield {"features": dict(result.confidence_features), "right": not absent and fine(result.transform, sample)}


def followed(registrar: cr.Registrar, frames: Sequence[Row]) -> Iterator[Row]:
    """Rows of a sequence tracked from its first true pose, by every frame and by every third."""
    for stride in (1, 3):
        follow = Follower(registrar, frames[0]["camera_matrix"].double())
        follow.start(frames[0]["image"], truth_of(frames[0]))
        for sample in frames[stride::stride]:
            result = follow(sample["image"])
            if result.ok and "region" in result.confidence_features:
                yield {"features": dict(result.confidence_features), "right": fine(result.transform, sample)}


def detected(registrar: cr.Registrar, sample: Row, other: Row) -> Iterator[Row]:
    """Rows of detections without a box, in a photograph of the object and in one without it."""
    for shown in (sample, other):
        result = registrar([shown["image"]], None, shown["camera_matrix"].double())[0]
        lost = not result.ok and isinstance(result.error, LostObjectError)
        found = result.detection if result.ok else result.error.detection if lost else None
        if found is not None and not float(found.response).is_integer():  # not a number of landmarks
            query = registrar.matcher.query([shown["image"]], found.box[None].float())
            features = {"response": found.response, "similarity": float(registrar.matcher.similarity(query))}
            overlap = float(box_iou(found.box[None], shown["box"][None].double()))
            yield {"features": features, "right": shown is sample and overlap >= SAME_OBJECT_OVERLAP}


def measure(task: tuple[str, Path, str, list[int], int]) -> list[Row]:
    """Rows of one mesh's photographs."""
    kind, folder, pose, indices, beside = task
    torch.set_num_threads(1)
    data = BOPDataset(folder)
    samples, other = [data[i] for i in indices], data[beside]
    pipeline = cr.Pipeline().with_pose_prior(pose)
    registrar = cr.Registrar(cr.load_mesh(samples[0]["model_path"], unit="mm"), pipeline=pipeline)
    if kind == "sequences":
        found = [(samples[0], row) for row in followed(registrar, samples)]
    else:
        methods: dict[str, Callable[[Row], Iterator[Row]]] = {
            "refined": lambda s: refined(registrar, s, other),
            "detected": lambda s: detected(registrar, s, other),
        }
        method = methods.get(kind, lambda s: registered(registrar, s, with_camera=kind != "similar"))
        found = [(s, row) for s in samples for row in method(s)]
    groups = json.loads((folder / "benchmark.json").read_text())["groups"]
    return [{"scene": s["scene_id"], "group": groups[str(s["obj_id"])], **row} for s, row in found]


def rows_of(work: Path, kind: str, jobs: int, limit: int | None = None) -> list[Row]:
    """Rows of a set, or of refinements and detections in the set "exact"; finished meshes are read from the file."""
    folder, out = work / (kind if kind in SETS else "exact"), work / f"{kind}.jsonl"
    data = BOPDataset(folder)
    annotations = [data.annotation(i) for i in range(len(data))]
    listed = [(int(s["scene_id"]), int(s["obj_id"]), i) for i, s in enumerate(annotations)][:limit]
    done = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {tuple(row["task"]) for row in done}

    def mesh_and_pose(entry: tuple[int, int, int]) -> tuple[int, int]:
        return entry[1], entry[0] % 2 or kind == "shelves"  # of furniture, make.py alternates upright and any pose

    tasks = []
    for key, group in groupby(sorted(listed, key=mesh_and_pose), key=mesh_and_pose):
        indices = [i for _, _, i in group]
        if key not in known:
            scenes = {scene for scene, obj_id, _ in listed if obj_id == key[0]}
            beside = next((i for scene, _, i in listed if scene not in scenes), 0)
            tasks.append((key, (kind, folder, "any" if key[1] else "upright", indices, beside)))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool, out.open("a") as file:
        found = pool.map(measure, [task for _, task in tasks])
        for (key, _), rows in zip(tasks, tqdm(found, total=len(tasks), desc=kind, unit="mesh"), strict=True):
            done.append({"task": key, "rows": rows})
            file.write(json.dumps(done[-1]) + "\n")
            file.flush()
    return [row for entry in done for row in entry["rows"]]


def folds_of(rows: Sequence[Row]) -> np.ndarray:
    """(n,) fold of each row; groups are assigned so that folds have about equal sizes."""
    groups, counts = np.unique([row["group"] for row in rows], return_counts=True)
    size, fold = [0] * FOLDS, {}
    for k in np.argsort(-counts, kind="stable"):
        fold[groups[k]] = int(np.argmin(size))
        size[fold[groups[k]]] += int(counts[k])
    return np.array([fold[row["group"]] for row in rows])


def fit_logistic(rows: Sequence[Row], weight: np.ndarray | None = None) -> tuple[Row, Row]:
    """Weights and bias of the probability that a row is ``right``, and their quality on held-out folds.

    The standardised weights have a unit Gaussian prior.
    """
    names = list(rows[0]["features"])
    X = np.array([[row["features"][n] or 0.0 for n in names] for row in rows])
    y, fold = np.array([row["right"] for row in rows]), folds_of(rows)
    weight = np.ones(len(y)) if weight is None else weight

    def fit(train: np.ndarray) -> tuple[np.ndarray, float]:
        mean, spread = X[train].mean(axis=0), X[train].std(axis=0)
        spread[spread < 1e-6] = np.inf  # a constant feature gets weight 0
        model = LogisticRegression(max_iter=2000).fit((X[train] - mean) / spread, y[train], sample_weight=weight[train])
        w = model.coef_[0] / spread
        return w, float(model.intercept_[0] - w @ mean)

    p = np.zeros(len(y))
    for k in range(FOLDS):
        if len(set(y[fold != k])) == 2:
            w, bias = fit(fold != k)
            p[fold == k] = 1.0 / (1.0 + np.exp(-(X[fold == k] @ w + bias)))
    w, bias = fit(np.full(len(y), True))
    quality = {"n": len(y), "right": float(y.mean()), "said": float(np.average(p, weights=weight))}
    quality |= {"auc": float(roc_auc_score(y, p)), "reliable": float((p >= 0.9).mean())}
    quality["right if reliable"] = float(y[p >= 0.9].mean()) if (p >= 0.9).any() else None
    return {"weights": dict(zip(names, w.round(4).tolist(), strict=True)), "bias": round(bias, 4), "n": len(y)}, quality


def fit_rivals(rows: Sequence[Row]) -> Row:
    """Slope of the rivals' scores and level of "none of them", where the first hypothesis is wrong."""
    cases = []
    for row in rows:
        right = np.array(row["errors"]) < RIGHT
        if not right[0] and len(right) > 1:
            scores = np.array(row["scores"])[1:]
            cases.append((np.append(scores - scores.max(), 0.0), np.append(right[1:], not right.any())))

    def loss(p: np.ndarray) -> float:
        logits = [np.exp(p[0]) * s + p[1] * (np.arange(len(s)) == len(s) - 1) for s, _ in cases]
        likelihood = (logsumexp(x) - logsumexp(x[right]) for x, (_, right) in zip(logits, cases, strict=True))
        return 0.05 * float((p**2).sum()) + sum(map(float, likelihood))

    found = minimize(loss, np.zeros(2), method="L-BFGS-B").x
    return {"slope": round(float(np.exp(found[0])), 4), "none": round(float(found[1]), 4)}


def calibrate(work: Path, jobs: int, limit: int | None, models: Sequence[str]) -> tuple[Row, Row]:
    """Constants, those of other ``models`` as they were, and quality of the new ones on held-out kinds of objects."""
    constants: Row = json.loads(CONSTANTS.read_text())
    quality: Row = {}
    for name in models:
        if name in KINDS:
            constants[name], quality[name] = fit_logistic(rows_of(work, KINDS[name], jobs, limit))
            continue
        rows = [row | {"set": s} for s in MODELS[name] for row in rows_of(work, s, jobs, limit)]
        rows = [row | {"right": row["set"] != "wrong" and row["errors"][0] < RIGHT} for row in rows]
        wrong = np.array([row["set"] == "wrong" for row in rows])
        weight = np.where(wrong, WRONG_FRACTION / (1 - WRONG_FRACTION) * (~wrong).sum() / max(1, wrong.sum()), 1.0)
        fitted, quality[name] = fit_logistic(rows, weight)
        constants[name] = fitted | fit_rivals([row for row in rows if row["set"] != "wrong"])
        model = LogisticModel(fitted["weights"], fitted["bias"])
        right = [row for row in rows if row["right"] and "distance2" in row]
        distances = [row["distance2"] for row in right if model(row["features"]) >= RELIABLE]
        if distances:
            scale = constants["covariance_scale"] * float(np.quantile(distances, 0.9)) / float(chi2.ppf(0.9, 6))
            constants["covariance_scale"] = round(scale, 3)
    return constants, quality


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--meshes", type=Path, required=True, help="folder of scripts/benchmark/meshes.py")
    parser.add_argument("--count", type=int, default=400, help="photographs of each set")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--limit", type=int, help="photographs to measure, fewer than there are")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    render_sets(options.work, options.meshes, options.count, options.jobs, options.models)
    constants, quality = calibrate(options.work, options.jobs, options.limit, options.models)
    record = {"date": today(), "commit": commit(), "constants": constants, "held out": quality}
    print(json.dumps(record, indent=2))
    if options.write:
        write_json(CONSTANTS, constants)
        write_json(RESULTS / "calibration.json", record)


if __name__ == "__main__":
    main()
