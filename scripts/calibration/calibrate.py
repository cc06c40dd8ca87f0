"""Fit the constants of confidence, covariance, detection, refinement and following on generated
photographs.

    python scripts/calibration/calibrate.py WORK [--meshes FURNITURE] [--count 400] [--models
    instance] [--write]

The script renders the sets that WORK lacks (make.py: the object's own mesh, also cut by the border,
half hidden, grey, or with several poses that look alike; a similar one; a wrong one, or one with
another print; and sequences), registers, refines, follows and detects their objects into
WORK/*.jsonl, of which finished rows are kept, and fits. Everything depends on the seeds in SETS
alone: an interrupted run goes on, with any number of --jobs. FURNITURE, the folder of
scripts/benchmark/meshes.py, adds real meshes to the procedural ones. Folds are by kind of object,
so every measure is of kinds that the fit has not seen. --write stores the constants in
curvireg_torch/calibration/calibration.json and their quality in scripts/results/calibration.json.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
import trimesh
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logsumexp
from scipy.stats import chi2
from sklearn.metrics import roc_auc_score
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.errors import LostObjectError
from curvireg_torch.evidence import Evidence
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_from_axis_angle
from curvireg_torch.geometry.crops import box_iou
from curvireg_torch.inspection.photographs import without_colours
from curvireg_torch.registration import Follower, mirror
from curvireg_torch.registration.confidence import (
    DOUBT_FEATURES,
    EVIDENCE_FEATURES,
    RELIABLE,
    LogisticModel,
    are_near,
)
from curvireg_torch.registration.detection import SAME_OBJECT_OVERLAP
from scripts._shared import REPOSITORY, RESULTS, commit, today, write_json

Row: TypeAlias = dict[str, Any]

CONSTANTS = REPOSITORY / "curvireg_torch" / "calibration" / "calibration.json"
FURNITURE = ("--kind", "furniture", "--bare", "0.2")
SHAPES = ("--kind", "shapes")
PRINTED = ("--kind", "printed")
TIED = ("--kind", "tied")
CUT = ("--cut", "0.1", "0.6")
SETS: dict[str, tuple[float, tuple[str, ...]]] = {
    "furniture": (1.0, (*FURNITURE, "--cad", "exact")),
    "shapes": (1.0, (*SHAPES, "--seed", "101")),
    "packages": (0.5, (*PRINTED, "--seed", "102")),
    "shelves": (0.25, ("--kind", "shelf", "--objects", "6", "14", "--seed", "103")),
    "tied": (0.6, (*TIED, "--seed", "104")),
    "cut": (0.5, (*SHAPES, *CUT, "--seed", "105")),
    "cut_packages": (0.25, (*PRINTED, *CUT, "--seed", "106")),
    "print": (0.5, (*PRINTED, "--cad", "print", "--seed", "107")),
    "mirrored": (0.2, (*TIED, "--cad", "mirrored", "--seed", "108")),
    "wrong": (0.25, (*SHAPES, "--cad", "wrong", "--seed", "109")),
    "furniture_similar": (1.0, (*FURNITURE, "--cad", "similar")),
    "similar": (1.0, (*SHAPES, "--cad", "similar", "--bare", "0.2", "--seed", "110")),
    "sequences": (0.1, (*SHAPES, "--frames", "30", "--seed", "111")),
}
"""Of each set: scenes, as a fraction of --count, and options of make.py."""

ESTIMATED = {
    "estimated_shapes": "shapes",
    "estimated_packages": "packages",
    "estimated_wrong": "wrong",
}
"""Sets whose camera is withheld and estimated, and those with the same photographs."""

SCENES_PER_MESH = 2.0

SHARES = {
    "tied": 0.05,
    "cut": 0.1,
    "cut_packages": 0.05,
    "print": 0.03,
    "mirrored": 0.01,
    "wrong": 0.05,
    "estimated_wrong": 0.05,
}
"""Assumed shares of the photographs that users have; those of the other sets have the rest, each
the same weight."""

ABSENT = (
    "print",
    "mirrored",
    "wrong",
    "estimated_wrong",
)  # sets whose photographs do not show the mesh: no pose is right
UPRIGHT = (
    "furniture",
    "shapes",
    "estimated_shapes",
    "furniture_similar",
    "similar",
    "sequences",
)  # sets of which half stand upright
GREY = {
    "shapes": 3,
    "packages": 3,
    "shelves": 2,
    "cut": 3,
    "cut_packages": 3,
    "estimated_shapes": 3,
    "estimated_packages": 3,
}
"""Sets in which every n-th mesh loses its colours."""

RIGHT = 30.0  # degrees within which a registration is right
# and fraction of the distance, within which a refined or tracked pose is right
FINE_DEGREES = 10.0
FINE_FRACTION = 0.1

STARTS = (
    (5.0, 0.0),
    (10.0, 0.0),
    (15.0, 0.0),
    (20.0, 0.0),
    (30.0, 0.0),
    (0.0, 0.05),
    (0.0, 0.1),
    (0.0, 0.2),
)
"""Degrees and fraction of the distance by which the starts of refinements are off."""

FOLDS = 5
RESOLUTIONS = np.arange(0.5, 1.55, 0.1).round(2).tolist()
"""Those that are tried. Scores of two poses that look the same differ by up to 0.5."""
MODELS = {
    "instance": (
        *("furniture", "shapes", "packages", "shelves", "tied", "cut", "cut_packages", *ABSENT),
        *("estimated_shapes", "estimated_packages"),
    ),
    "category": ("furniture_similar", "similar"),
    "refinement": ("shapes",),
    "tracking": ("sequences",),
    "detection": ("shapes",),
}
"""Of each model: the sets that it is fitted on."""

KINDS = {"refinement": "refined", "tracking": "sequences", "detection": "detected"}
"""Of each model that is not of registrations: what is measured."""


def sets_of(models: Sequence[str], meshes: Path | None) -> list[str]:
    """Sets of the models, without those of furniture where there is none."""
    names = dict.fromkeys(name for model in models for name in MODELS[model])
    return [
        name
        for name in names
        if meshes is not None or "furniture" not in SETS[photographs_of(name)][1]
    ]


def photographs_of(name: str) -> str:
    """The set that has the photographs of a set."""
    return ESTIMATED.get(name, name)


def render_sets(
    work: Path, meshes: Path | None, count: int, jobs: int, models: Sequence[str]
) -> None:
    """Render the sets of ``models`` that ``work`` lacks; finished scenes are kept."""
    for name in dict.fromkeys(map(photographs_of, sets_of(models, meshes))):
        fraction, options = SETS[name]
        scenes = max(1, round(fraction * count))
        words: list[Any] = ["--out", work / name, "--count", scenes, "--jobs", jobs, *options]
        words += ["--meshes", meshes] if "furniture" in options else []
        words += ["--models", max(16, round(scenes / SCENES_PER_MESH))]
        command = [sys.executable, REPOSITORY / "scripts" / "benchmark" / "make.py", *words]
        subprocess.run([str(word) for word in command], check=True)


def symmetries_of(sample: Row, registrar: cr.Registrar | None = None) -> Tensor:
    """(S, 3, 3) rotations after which the object counts as the same: those of the set, and those
    that an exact mesh without colours has for the registrar, unless a notable feature of it tells
    them apart."""
    listed = sample["model_info"].get("symmetries_discrete", [])
    known = [
        torch.eye(3).double()[None],
        *(torch.tensor(values).view(1, 4, 4)[:, :3, :3].double() for values in listed),
    ]
    found = None
    if registrar is not None and not registrar.telling_symmetries.notable:
        found = registrar.symmetries_of(exact=True)
    return torch.cat(known if found is None else [*known, found[:, :3, :3].double()])


def errors_of(R: Tensor, sample: Row, S: Tensor | None = None) -> Tensor:
    """(N,) degrees between rotations (N, 3, 3) and the truth, up to symmetries ``S`` (S, 3, 3)."""
    S = symmetries_of(sample) if S is None else S
    return cr.rotation_error(R[:, None].double(), (sample["rotation"].double() @ S)[None]).amin(
        dim=1
    )


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
    seen = sample
    R = torch.stack(
        [h.rotation if K is not None else h.allocentric_rotation for h in result.hypotheses]
    )
    if K is None:  # compare as seen by a camera that looks straight at the object
        ray = sample["rotation"].double() @ model_centre(sample) + sample["translation"].double()
        seen = sample | {
            "rotation": cr.geometry.rotation_towards(ray).T @ sample["rotation"].double()
        }
    evidence = Evidence.of_hypotheses([h.evidence for h in result.hypotheses])
    scores = evidence.scores(registrar.score_weights(exact=registrar.is_exact))
    S = symmetries_of(sample, registrar if registrar.is_exact else None)
    # near the best one up to symmetries, they are right if it is
    is_rival = ~are_near(R.float(), R[0].float(), S)
    is_rival[0] = True
    row = {"features": dict(result.confidence_features), "scores": scores[is_rival].tolist()}
    row |= {"evidence": evidence.table[is_rival].tolist()}
    row |= {"errors": errors_of(R, seen, S)[is_rival].tolist()}
    row |= {"mirror": mirror.WARNING in result.warnings}
    best = result.hypotheses[0]
    is_unique = len(S) == 1  # else the covariance is that of another pose
    if best.covariance is not None and is_unique and row["errors"][0] < RIGHT:
        turn = axis_angle_from_rotation(sample["rotation"].double() @ best.rotation.T)
        e = torch.cat([turn, sample["translation"].double() - best.translation])
        row["distance2"] = float(e @ torch.linalg.solve(best.covariance.double(), e))
    yield row


def model_centre(sample: Row) -> Tensor:
    """(3,) middle of the model's box, in mm."""
    info = sample["model_info"]
    return torch.tensor(
        [info[f"min_{c}"] + 0.5 * info[f"size_{c}"] for c in "xyz"], dtype=torch.float64
    )


def refined(registrar: cr.Registrar, sample: Row, other: Row) -> Iterator[Row]:
    """Rows of refinements from wrong starts, and in the photograph ``other``, which does not show
    the object."""
    T = truth_of(sample)
    K = sample["camera_matrix"].double()
    generator = torch.Generator().manual_seed(sample["scene_id"])
    for degrees, fraction in (*STARTS, (0.0, 0.0)):
        axis = torch.nn.functional.normalize(
            torch.randn(3, generator=generator, dtype=torch.float64), dim=0
        )
        sign = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
        start = T.clone()
        start[:3, :3] = rotation_from_axis_angle(axis * np.radians(degrees)) @ T[:3, :3]
        start[:3, 3] *= 1.0 + sign * fraction
        absent = degrees == fraction == 0.0
        result = registrar.refine([(other if absent else sample)["image"]], K, [start])[0]
        if result.ok:
            yield {
                "features": dict(result.confidence_features),
                "right": not absent and fine(result.transform, sample),
            }


def followed(registrar: cr.Registrar, frames: Sequence[Row]) -> Iterator[Row]:
    """Rows of a sequence tracked from its first true pose, by every frame and by every third."""
    for stride in (1, 3):
        follow = Follower(registrar, frames[0]["camera_matrix"].double())
        follow.start(frames[0]["image"], truth_of(frames[0]))
        for sample in frames[stride::stride]:
            result = follow(sample["image"])
            if result.ok and "region" in result.confidence_features:
                yield {
                    "features": dict(result.confidence_features),
                    "right": fine(result.transform, sample),
                }


def detected(registrar: cr.Registrar, sample: Row, other: Row) -> Iterator[Row]:
    """Rows of detections without a box, in a photograph of the object and in one without it."""
    for shown in (sample, other):
        result = registrar([shown["image"]], None, shown["camera_matrix"].double())[0]
        lost = not result.ok and isinstance(result.error, LostObjectError)
        found = result.detection if result.ok else result.error.detection if lost else None
        # not a number of keypoints
        if found is not None and not float(found.response).is_integer():
            query = registrar.matcher.query([shown["image"]], found.box[None].float())
            features = {
                "response": found.response,
                "similarity": float(registrar.matcher.similarity(query)),
            }
            overlap = float(box_iou(found.box[None], shown["box"][None].double()))
            yield {
                "features": features,
                "right": shown is sample and overlap >= SAME_OBJECT_OVERLAP,
            }


def is_grey(kind: str, obj_id: int) -> bool:
    """Whether a mesh of a set loses its colours."""
    return kind in GREY and obj_id % GREY[kind] == 0


def mesh_of(path: Path, *, grey: bool) -> trimesh.Trimesh:
    """The mesh in a file, ``grey`` without its colours."""
    mesh = cr.load_mesh(path, unit="mm")
    return without_colours(mesh) if grey else mesh


def measure(task: tuple[str, Path, str, list[int], int]) -> list[Row]:
    """Rows of one mesh's photographs."""
    kind, folder, pose, indices, beside = task
    torch.set_num_threads(1)
    data = BOPDataset(folder)
    samples = [data[i] for i in indices]
    other = data[beside]
    pipeline = cr.Pipeline().with_pose_prior(pose)
    grey = is_grey(kind, samples[0]["obj_id"])
    mesh = mesh_of(samples[0]["model_path"], grey=grey)
    mesh_is = "similar" if "similar" in kind else "exact"
    registrar = cr.Registrar(mesh, pipeline=pipeline, mesh_is=mesh_is)
    if kind == "sequences":
        found = [(samples[0], row) for row in followed(registrar, samples)]
    else:
        methods: dict[str, Callable[[Row], Iterator[Row]]] = {
            "refined": lambda s: refined(registrar, s, other),
            "detected": lambda s: detected(registrar, s, other),
        }
        method = methods.get(
            kind,
            lambda s: registered(
                registrar, s, with_camera=kind not in (*MODELS["category"], *ESTIMATED)
            ),
        )
        found = [(s, row) for s in samples for row in method(s)]
    groups = json.loads((folder / "benchmark.json").read_text())["groups"]
    more = {"set": kind, "object": samples[0]["obj_id"], "grey": grey}
    return [
        {"scene": s["scene_id"], "group": f"{kind} {groups[str(s['obj_id'])]}", **more, **row}
        for s, row in found
    ]


def rows_of(work: Path, kind: str, jobs: int, limit: int | None = None) -> list[Row]:
    """Rows of a set, or of refinements and detections in the set "shapes"; finished meshes are read
    from the file."""
    photographs = photographs_of(kind)
    folder = work / (photographs if photographs in SETS else "shapes")
    out = work / f"{kind}.jsonl"
    data = BOPDataset(folder)
    annotations = [data.annotation(i) for i in range(len(data))]
    listed = [(int(s["scene_id"]), int(s["obj_id"]), i) for i, s in enumerate(annotations)][:limit]
    done = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {tuple(row["task"]) for row in done}

    def mesh_and_pose(entry: tuple[int, int, int]) -> tuple[int, int]:
        # of these, make.py alternates upright and any pose
        upright = kind in UPRIGHT and entry[0] % 2 == 0
        return entry[1], int(not upright)

    tasks = []
    for key, group in groupby(sorted(listed, key=mesh_and_pose), key=mesh_and_pose):
        indices = [i for _, _, i in group]
        if key not in known:
            scenes = {scene for scene, obj_id, _ in listed if obj_id == key[0]}
            beside = next((i for scene, _, i in listed if scene not in scenes), 0)
            tasks.append((key, (kind, folder, "any" if key[1] else "upright", indices, beside)))
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool, out.open("a") as file:
        found = pool.map(measure, [task for _, task in tasks])
        for (key, _), rows in zip(
            tasks, tqdm(found, total=len(tasks), desc=kind, unit="mesh"), strict=True
        ):
            done.append({"task": key, "rows": rows})
            file.write(json.dumps(done[-1]) + "\n")
            file.flush()
    return [row for entry in done for row in entry["rows"]]


def folds_of(rows: Sequence[Row]) -> np.ndarray:
    """(n,) fold of each row; groups are assigned so that folds have about equal sizes."""
    groups, counts = np.unique([row["group"] for row in rows], return_counts=True)
    size = [0] * FOLDS
    fold = {}
    for k in np.argsort(-counts, kind="stable"):
        fold[groups[k]] = int(np.argmin(size))
        size[fold[groups[k]]] += int(counts[k])
    return np.array([fold[row["group"]] for row in rows])


def fit_logistic(rows: Sequence[Row], weight: np.ndarray, signs: Mapping[str, float]) -> Row:
    """Weights and bias of the probability that a row is ``right``.

    The standardised weights have a unit Gaussian prior, and the sign in ``signs``, if there is one.
    """
    names = list(rows[0]["features"])
    X = np.array([[row["features"][n] or 0.0 for n in names] for row in rows])
    y = np.array([row["right"] for row in rows])
    mean = X.mean(axis=0)
    spread = X.std(axis=0)
    spread[spread < 1e-6] = np.inf  # a constant feature gets weight 0
    Z = (X - mean) / spread

    def loss(p: np.ndarray) -> tuple[float, np.ndarray]:
        logit = Z @ p[:-1] + p[-1]
        value = float(weight @ (np.logaddexp(0.0, logit) - y * logit)) + 0.5 * float(
            p[:-1] @ p[:-1]
        )
        slope = weight * (expit(logit) - y)
        return value, np.append(Z.T @ slope + p[:-1], slope.sum())

    ranges = {1.0: (0.0, None), -1.0: (None, 0.0)}
    bounds = [*(ranges.get(signs.get(name, 0.0), (None, None)) for name in names), (None, None)]
    found = minimize(loss, np.zeros(len(names) + 1), jac=True, bounds=bounds, method="L-BFGS-B").x
    w = found[:-1] / spread
    bias = float(found[-1] - w @ mean)
    return {
        "weights": dict(zip(names, w.round(4).tolist(), strict=True)),
        "bias": round(bias, 4),
        "n": len(y),
    }


def fit_level(rows: Sequence[Row], weight: np.ndarray, constants: Row) -> Row:
    """The model of ``constants`` with a scale and a level of its logit, so that the confidence of
    the first hypothesis, its share included, is right: two numbers, which few photographs
    determine. Slope and resolution of the shares stay."""
    logit = np.array([row_logit(row, constants) for row in rows])
    share = np.array([first_share(row, constants) for row in rows])
    first = np.array([row["first"] for row in rows])

    def loss(p: np.ndarray) -> float:
        confidence = np.clip(expit(p[0] * logit + p[1]) * share, 1e-9, 1.0 - 1e-9)
        return float(-weight @ np.log(np.where(first, confidence, 1.0 - confidence)))

    scale, level = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    weights = {name: round(float(scale) * value, 4) for name, value in constants["weights"].items()}
    bias = round(float(scale * constants["bias"] + level), 4)
    return constants | {"weights": weights, "bias": bias, "n": len(rows)}


def row_logit(row: Row, constants: Row) -> float:
    """Logit of the probability that any hypothesis of a row is right."""
    weights = constants["weights"].items()
    return float(constants["bias"] + sum(w * (row["features"][name] or 0.0) for name, w in weights))


def fit_shares(rows: Sequence[Row], weight: np.ndarray, *, ties: bool) -> Row:
    """Slope and resolution of :func:`curvireg_torch.registration.confidence.shares`, where some
    pose is right and some are not; without ``ties`` the resolution is 0."""
    decided = [k for k, row in enumerate(rows) if row["right"] and max(row["errors"]) >= RIGHT]
    most = max((len(rows[k]["scores"]) for k in decided), default=1)
    behind = np.full((len(decided), most), np.inf)
    right = np.zeros((len(decided), most), bool)
    for place, k in enumerate(decided):
        scores = np.array(rows[k]["scores"])
        behind[place, : len(scores)] = scores.max() - scores
        right[place, : len(scores)] = np.array(rows[k]["errors"]) < RIGHT

    def loss(slope: float, resolution: float) -> float:
        logits = -slope * np.maximum(0.0, behind - resolution)
        of_right = np.where(right, logits, -np.inf)
        return float(
            weight[decided] @ (logsumexp(logits, axis=1) - logsumexp(of_right, axis=1))
            + 0.05 * slope**2
        )

    found = []
    for resolution in RESOLUTIONS if ties else (0.0,):
        best = minimize_scalar(loss, args=(resolution,), bounds=(0.01, 10.0), method="bounded")
        found.append((best.fun, round(float(best.x), 4), resolution))
    _, slope, resolution = min(found)
    return {"slope": slope, "resolution": resolution}


def first_probability(row: Row, constants: Row) -> float:
    """Confidence of a row."""
    any_right = LogisticModel(constants["weights"], constants["bias"])(row["features"])
    doubt = mirror.DOUBT if row.get("mirror") else 1.0
    return doubt * any_right * first_share(row, constants)


def first_share(row: Row, constants: Row) -> float:
    """Share of the first hypothesis in the probability that any is right."""
    scores = np.array(row["scores"])
    logits = -constants["slope"] * np.maximum(0.0, scores.max() - scores - constants["resolution"])
    return float(np.exp(logits[0] - logsumexp(logits)))


def quality_of(p: np.ndarray, right: np.ndarray, weight: np.ndarray) -> Row:
    """How well probabilities (n,) tell the right answers (n,) bool."""
    sure = p >= RELIABLE
    quality: Row = {"n": len(p), "right": float(np.average(right, weights=weight))}
    quality |= {
        "said": float(np.average(p, weights=weight)),
        "reliable": float(np.average(sure, weights=weight)),
    }
    quality["auc"] = (
        float(roc_auc_score(right, p, sample_weight=weight))
        if len(set(right.tolist())) == 2
        else None
    )
    quality["right if reliable"] = (
        float(np.average(right[sure], weights=weight[sure])) if sure.any() else None
    )
    quality["reliable and wrong"] = int((sure & ~right).sum())
    return quality


def errors_within(errors: np.ndarray) -> Row:
    """Fractions of errors (n,) in degrees within 5 and 15, and their median."""
    within = {f"within {limit}": float((errors < limit).mean()) for limit in (5, 15)}
    return within | {"median": float(np.median(errors))}


def fit_registrations(
    rows: list[Row], *, exact: bool, present: Row | None = None
) -> tuple[Row, Row]:
    """Constants of a model of registrations, and their quality on held-out folds, in all and by
    set. With the ``present`` constants only their scale and level are fitted, see
    :func:`fit_level`."""
    for row in rows:
        is_present = row["set"] not in ABSENT
        row["right"] = is_present and min(row["errors"]) < RIGHT
        row["first"] = is_present and row["errors"][0] < RIGHT
    sets = np.array([row["set"] for row in rows])
    ordinary = float(sum(name not in SHARES for name in sets))
    factor = ordinary / (1.0 - sum(SHARES[name] for name in set(sets) if name in SHARES))
    weight = np.array(
        [factor * SHARES[name] / (sets == name).sum() if name in SHARES else 1.0 for name in sets]
    )
    signs = dict.fromkeys(EVIDENCE_FEATURES, 1.0) | dict.fromkeys(DOUBT_FEATURES, -1.0)

    def fit(train: np.ndarray) -> Row:
        # what fits, but is less probable than the mirror image, tells nothing of what fits
        train = train & ~is_mirrored
        some = [row for row, chosen in zip(rows, train, strict=True) if chosen]
        fitted = present or fit_logistic(some, weight[train], signs) | fit_shares(
            some, weight[train], ties=exact
        )
        return fit_level(some, weight[train], fitted)

    is_mirrored = np.array([row.get("mirror", False) for row in rows])
    fold = folds_of(rows)
    p = np.zeros(len(rows))
    for k in range(FOLDS):
        constants = fit(fold != k)
        p[fold == k] = [
            first_probability(row, constants)
            for row, own in zip(rows, fold == k, strict=True)
            if own
        ]
    first = np.array([row["first"] for row in rows])
    quality = quality_of(p, first, weight)
    by_set = {name: sets == name for name in dict.fromkeys(sets.tolist())}
    by_set["grey"] = np.array([row["grey"] for row in rows])
    by_set["with colours"] = ~by_set["grey"]
    errors = np.array([row["errors"][0] for row in rows])
    quality["sets"] = {
        name: quality_of(p[own], first[own], weight[own]) | errors_within(errors[own])
        for name, own in by_set.items()
        if own.any()
    }
    return fit(np.full(len(rows), True)), quality


def calibrate(
    work: Path,
    jobs: int,
    limit: int | None,
    models: Sequence[str],
    meshes: Path | None,
    *,
    level: bool = False,
) -> tuple[Row, Row]:
    """Constants, those of other ``models`` as they were, and quality of the new ones on held-out
    kinds of objects."""
    constants: Row = json.loads(CONSTANTS.read_text())
    quality: Row = {}
    for name in models:
        if name in KINDS:
            rows = rows_of(work, KINDS[name], jobs, limit)
            constants[name] = fit_logistic(rows, np.ones(len(rows)), {})
            continue
        rows = [
            row for chosen in sets_of([name], meshes) for row in rows_of(work, chosen, jobs, limit)
        ]
        constants[name], quality[name] = fit_registrations(
            rows, exact=name == "instance", present=constants[name] if level else None
        )
        right = [row for row in rows if row["first"] and "distance2" in row]
        distances = [
            row["distance2"] for row in right if first_probability(row, constants[name]) >= RELIABLE
        ]
        if distances:
            scale = (
                constants["covariance_scale"]
                * float(np.quantile(distances, 0.9))
                / float(chi2.ppf(0.9, 6))
            )
            quality[name]["covariance_scale"] = round(scale, 3)
    return constants, quality


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--meshes", type=Path, help="folder of scripts/benchmark/meshes.py")
    parser.add_argument("--count", type=int, default=400, help="photographs of each set")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--limit", type=int, help="photographs to measure, fewer than there are")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--level", action="store_true", help="few photographs: fit scale and level alone"
    )
    parser.add_argument("--render", action="store_true", help="render the sets only")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    render_sets(options.work, options.meshes, options.count, options.jobs, options.models)
    if options.render:
        return
    constants, quality = calibrate(
        options.work,
        options.jobs,
        options.limit,
        options.models,
        options.meshes,
        level=options.level,
    )
    record = {"date": today(), "commit": commit(), "constants": constants, "held out": quality}
    print(json.dumps(record, indent=2))
    if options.write:
        write_json(CONSTANTS, constants)
        write_json(RESULTS / "calibration.json", record)


if __name__ == "__main__":
    main()
