"""What registrations, refinements, trackers and detections say of generated photographs, and
whether it is true: a row for each."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.errors import LostObjectError
from curvireg_torch.evaluation.metrics import symmetric_rotation_error
from curvireg_torch.evidence import Evidence
from curvireg_torch.geometry import (
    axis_angle_from_rotation,
    rotation_from_axis_angle,
    rotation_towards,
    symmetry_transforms,
    transform,
)
from curvireg_torch.geometry.cameras import point_in_cameras
from curvireg_torch.geometry.crops import box_iou
from curvireg_torch.matching.detector import SAME_OBJECT_OVERLAP
from curvireg_torch.mesh import Mesh
from curvireg_torch.registration import Follower
from curvireg_torch.registration.confidence import are_near
from curvireg_torch.registration.doubts import MIRROR_WARNING
from scripts._shared import RIGHT_DEG, Record, measured, read_json, request_digest
from scripts.calibration.sets import photographs_of, set_of

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


def symmetries_of(sample: Record, registrar: cr.Registrar | None = None) -> Tensor:
    """(S, 3, 3) rotations after which the object counts as the same: those of the set, and those
    that an exact mesh without colours has for the registrar, unless a notable feature of it tells
    them apart."""
    known = symmetry_transforms(sample["model_info"])
    if registrar is not None and not registrar.telling_symmetries.notable:
        found = registrar.symmetries_of(exact=True)
        if found is not None:
            known = torch.cat([known, found.double()])
    return known[:, :3, :3]


def errors_of(R: Tensor, sample: Record, S: Tensor | None = None) -> Tensor:
    """(N,) degrees between rotations (N, 3, 3) and the truth, up to symmetries ``S`` (S, 3, 3)."""
    S = symmetries_of(sample) if S is None else S
    return symmetric_rotation_error(R.double(), sample["rotation"].double(), S)


def truth_of(sample: Record) -> Tensor:
    """(4, 4) true pose of a sample."""
    return transform(sample["rotation"].double(), sample["translation"].double())


def fine(T: Tensor, sample: Record) -> bool:
    """Whether a pose (4, 4) is near the truth."""
    t = sample["translation"].double()
    near = (T[:3, 3] - t).norm() <= FINE_FRACTION * t.norm()
    return bool(near and errors_of(T[None, :3, :3], sample) <= FINE_DEGREES)


def registered(registrar: cr.Registrar, sample: Record, *, with_camera: bool) -> Iterator[Record]:
    """One row: features, scores and errors of the hypotheses."""
    K = sample["camera_matrix"].double() if with_camera else None
    result = registrar([sample["image"]], sample["box"][None], K)[0]
    if not result.ok:
        return
    best = result.hypotheses[0]
    seen = sample
    if with_camera:
        R = torch.stack([h.rotation for h in result.hypotheses])
    else:  # compare as seen by a camera that looks straight at the object
        R = torch.stack([h.allocentric_rotation for h in result.hypotheses])
        straight = rotation_towards(true_centre(sample))
        seen = sample | {"rotation": straight.T @ sample["rotation"].double()}
    evidence = Evidence.of_hypotheses([h.evidence for h in result.hypotheses])
    scores = evidence.scores(registrar.score_weights(exact=registrar.is_exact))
    S = symmetries_of(sample, registrar if registrar.is_exact else None)
    errors = errors_of(R, seen, S)
    # near the best one up to symmetries, they are right if it is
    is_rival = ~are_near(R.float(), R[0].float(), S)
    is_rival[0] = True
    row = {
        "features": dict(result.confidence_features),
        "scores": scores[is_rival].tolist(),
        "errors": errors[is_rival].tolist(),
        "mirror": MIRROR_WARNING in result.warnings,
    }
    is_unique = len(S) == 1  # else the covariance is that of another pose
    if best.covariance is not None and is_unique and errors[0] < RIGHT_DEG:
        turn = axis_angle_from_rotation(sample["rotation"].double() @ best.rotation.T)
        e = torch.cat([turn, sample["translation"].double() - best.translation])
        row["distance2"] = float(e @ torch.linalg.solve(best.covariance.double(), e))
    yield row


def true_centre(sample: Record) -> Tensor:
    """(3,) middle of the model's box at the true pose, in mm."""
    info = sample["model_info"]
    middle = [info[f"min_{c}"] + 0.5 * info[f"size_{c}"] for c in "xyz"]
    return point_in_cameras(truth_of(sample), torch.tensor(middle, dtype=torch.float64))


def refined(registrar: cr.Registrar, sample: Record, other: Record) -> Iterator[Record]:
    """Rows of refinements from wrong starts, and in the photograph ``other``, which does not show
    the object."""
    T = truth_of(sample)
    K = sample["camera_matrix"].double()
    generator = torch.Generator().manual_seed(sample["scene_id"])
    for degrees, fraction in (*STARTS, (0.0, 0.0)):
        vector = torch.randn(3, generator=generator, dtype=torch.float64)
        turn = rotation_from_axis_angle(np.radians(degrees) * vector / vector.norm())
        sign = 1.0 if torch.rand((), generator=generator) < 0.5 else -1.0
        start = transform(turn @ T[:3, :3], T[:3, 3] * (1.0 + sign * fraction))
        absent = degrees == fraction == 0.0
        result = registrar.refine([(other if absent else sample)["image"]], K, [start])[0]
        if result.ok:
            yield {
                "features": dict(result.confidence_features),
                "right": not absent and fine(result.transform, sample),
            }


def followed(registrar: cr.Registrar, frames: Sequence[Record]) -> Iterator[Record]:
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


def detected(registrar: cr.Registrar, sample: Record, other: Record) -> Iterator[Record]:
    """Rows of detections without a box, in a photograph of the object and in one without it."""
    for shown in (sample, other):
        result = registrar([shown["image"]], None, shown["camera_matrix"].double())[0]
        if result.ok:
            found = result.detection
        elif isinstance(result.error, LostObjectError):
            found = result.error.detection
        else:
            continue
        # a number of keypoints is no similarity
        if found is None or float(found.response).is_integer():
            continue
        query = registrar.matcher.query([shown["image"]], found.box[None].float())
        similarity = float(registrar.matcher.similarity(query))
        overlap = float(box_iou(found.box[None], shown["box"][None].double()))
        yield {
            "features": {"response": found.response, "similarity": similarity},
            "right": shown is sample and overlap >= SAME_OBJECT_OVERLAP,
        }


def is_grey(kind: str, obj_id: int) -> bool:
    """Whether a mesh of a set loses its colours."""
    every = set_of(kind).grey
    return every is not None and obj_id % every == 0


def mesh_of(path: Path, *, grey: bool) -> Mesh:
    """The mesh in a file, ``grey`` without its colours."""
    mesh = cr.load_mesh(path, unit="mm")
    return replace(mesh, colours=None) if grey else mesh


def measure(task: tuple[str, Path, str, list[int], int]) -> list[Record]:
    """Rows of one mesh's photographs."""
    kind, folder, pose, indices, beside = task
    torch.set_num_threads(1)
    data = BOPDataset(folder)
    samples = [data[i] for i in indices]
    obj_id = samples[0]["obj_id"]
    grey = is_grey(kind, obj_id)
    registrar = cr.Registrar(
        mesh_of(samples[0]["model_path"], grey=grey),
        pipeline=cr.Pipeline().with_pose_prior(pose),
        mesh_is="similar" if "similar" in kind else "exact",
    )
    own = set_of(kind)
    with_camera = own.photographs is None and own.model == "instance"
    groups = read_json(folder / "benchmark.json")["groups"]
    same = {
        "group": f"{kind} {groups[str(obj_id)]}",
        "set": kind,
        "object": obj_id,
        "grey": grey,
    }
    rows = []
    for sample in samples:
        if kind == "sequences":
            found = followed(registrar, samples) if sample is samples[0] else ()
        elif kind == "refined":
            found = refined(registrar, sample, data[beside])
        elif kind == "detected":
            found = detected(registrar, sample, data[beside])
        else:
            found = registered(registrar, sample, with_camera=with_camera)
        rows += [{"scene": sample["scene_id"], **same, **row} for row in found]
    return rows


def rows_of(work: Path, kind: str, jobs: int) -> list[Record]:
    """Rows of a set, or of refinements and detections in the set "shapes"; finished meshes are read
    from the file."""
    folder = work / photographs_of(kind)
    data = BOPDataset(folder)
    annotations = [data.annotation(i) for i in range(len(data))]
    listed = [(int(s["scene_id"]), int(s["obj_id"]), i) for i, s in enumerate(annotations)]

    def mesh_and_pose(entry: tuple[int, int, int]) -> tuple[int, int]:
        # of these, make.py alternates upright and any pose
        upright = set_of(kind).upright and entry[0] % 2 == 0
        return entry[1], int(not upright)

    tasks = {}
    for key, group in groupby(sorted(listed, key=mesh_and_pose), key=mesh_and_pose):
        indices = [i for _, _, i in group]
        scenes = {scene for scene, obj_id, _ in listed if obj_id == key[0]}
        beside = next((i for scene, _, i in listed if scene not in scenes), 0)
        pose = "any" if key[1] else "upright"
        request = request_of(kind, pose, [annotations[i] for i in (*indices, beside)])
        tasks[request] = (kind, folder, pose, indices, beside)
    return measured(work / f"{kind}.jsonl", measure, tasks, jobs, kind)


def request_of(kind: str, pose: str, samples: Sequence[Record]) -> str:
    """Digest of all that the rows of a mesh depend on: its photographs, that beside them, and the
    code."""
    chosen = set_of(kind)
    first = samples[0]
    shown = [chosen.photographs, chosen.model, is_grey(kind, first["obj_id"])]
    objects = [(s["scene_id"], s["obj_id"]) for s in samples]
    pictures = [s["image_path"] for s in samples]
    what = [kind, pose, shown, objects]
    return request_digest(what, [Path(__file__)], first["model_path"], pictures)
