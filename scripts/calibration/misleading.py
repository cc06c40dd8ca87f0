"""How often an answer is called reliable though its photograph, camera or mesh misleads.

    python scripts/calibration/misleading.py WORK [--each 50] [--jobs 2] [--sets shapes variant]

WORK is a folder of calibrate.py, whose photographs serve; finished rows in WORK/misleading.jsonl
are kept; --each is the number of photographs of a kind. Each kind misleads in one or several ways:

- camera: a matrix of half, two thirds or 1.6 times the size, a focal length of 0.7 or 1.3 times, a
  photograph stretched by 1.25, a lens whose distortion is not known
- cropped: a part of the photograph in whose middle the object is not, without a camera
- sizes: the mesh and one 1.25 times as large, in both orders, of which one has to be chosen
- chosen: the mesh, and one of which a part differs
- variant: a mesh of which a part is folded, moved, left out or of another size
- stranger: another mesh
- twins: a nearly symmetric mesh; what tells its turns apart is small, or not in sight
- round: a body of revolution with one hole

An answer is wrong by more than 30 degrees, by more than 15 % of the distance where a camera is
given, or if its mesh is another one: of a variant, the pose of the shared parts is right. An axis
is wrong beyond its tolerance. "ordinary" are photographs with their own camera; some are
"confident", of a high enough confidence, and yet not called reliable. Writes
scripts/results/misleading.json.
"""

import json
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.registration.confidence import RELIABLE
from scripts._shared import (
    RESULTS,
    RIGHT_DEG,
    Record,
    measured,
    read_json,
    run,
    stamp,
    write_json,
)
from scripts.benchmark.make import TWIN, Variants
from scripts.calibration.measure import errors_of, mesh_of, symmetries_of, true_centre
from scripts.calibration.sets import SETS

SOURCES = {name: each.misleads for name, each in SETS.items() if each.misleads}
"""Of each set: the kinds that it serves."""

WAYS = {"camera": 7, "sizes": 2, "chosen": 2}
"""Kinds for which a photograph is taken in several ways."""

ROUND = "holed"  # the family of bodies of revolution among the tied ones
OTHER_SIZES = (0.5, 2.0 / 3.0, 1.6)
OTHER_FOCAL_LENGTHS = (0.7, 1.3)
STRETCH = 1.25
BARREL = (-0.3, 0.08, 0.0, 0.0)  # k1, k2, p1, p2 of OpenCV
LARGER = 1.25
CROPPED = 0.62  # of both sides
WRONG_DISTANCE = 0.15


Case: TypeAlias = tuple[str, Tensor, Tensor, Tensor | None]
"""A way of misleading: its name, photograph, box and camera."""


def cases_of(kind: str, sample: Record) -> list[Case]:
    """The ways in which a kind misleads with a photograph."""
    image = sample["image"]
    box = sample["box"].double()
    K = sample["camera_matrix"].double()
    if kind == "cropped":
        return [cropped(image, box)]
    if kind != "camera":
        return [(kind, image, box, K)]
    cases = []
    for size in OTHER_SIZES:
        wrong = torch.diag(K.new_tensor([size, size, 1.0])) @ K
        cases.append((f"size {size:.2f}", image, box, wrong))
    for factor in OTHER_FOCAL_LENGTHS:
        wrong = K.clone()
        wrong[[0, 1], [0, 1]] *= factor
        cases.append((f"focal length {factor}", image, box, wrong))
    return [*cases, stretched(image, box, K), distorted(image, box, K)]


def stretched(image: Tensor, box: Tensor, K: Tensor) -> Case:
    """Wider by ``STRETCH``, with the same focal length in both directions."""
    H, W = image.shape[-2:]
    wide = round(STRETCH * W)
    picture = F.interpolate(image[None], (H, wide), mode="bilinear")[0]
    box = box.clone()
    box[[0, 2]] *= wide / W
    wrong = K.clone()
    wrong[0, 2] *= wide / W
    return "stretched", picture, box, wrong


def distorted(image: Tensor, box: Tensor, K: Tensor) -> Case:
    """By a lens of which the camera says nothing."""
    H, W = image.shape[-2:]
    camera = K.numpy()
    lens = np.array(BARREL)
    pixels = np.mgrid[0:H, 0:W][::-1].reshape(2, -1).T.astype(np.float64)
    source = cv2.undistortPoints(pixels, camera, lens, P=camera)
    source = source.reshape(H, W, 2).astype(np.float32)
    picture = cv2.remap(
        image.permute(1, 2, 0).numpy(),
        source,
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    x0, y0, x1, y1 = box.tolist()
    x, y = np.meshgrid(np.linspace(x0, x1, 21), np.linspace(y0, y1, 21))
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = points @ np.linalg.inv(camera).T
    origin = np.zeros(3)
    seen, _ = cv2.projectPoints(rays, origin, origin, camera, lens)
    corners = np.concatenate([seen.min(axis=(0, 1)), seen.max(axis=(0, 1))])
    return "distorted", torch.from_numpy(picture).permute(2, 0, 1), torch.from_numpy(corners), K


def cropped(image: Tensor, box: Tensor) -> Case:
    """The part that holds the box and is as far from the middle of the photograph as it can be."""
    size = torch.tensor([image.shape[-1], image.shape[-2]]).double()
    side = torch.maximum((CROPPED * size).round(), (box[2:] - box[:2]).ceil() + 8.0)
    middle = 0.5 * (box[:2] + box[2:])
    rightmost = (size - side).clamp(min=0.0)
    corner = torch.where(middle > 0.5 * size, rightmost, 0.0)
    corner = torch.maximum(corner, box[2:] + 4.0 - side)
    corner = torch.minimum(corner, box[:2] - 4.0)
    corner = torch.minimum(corner.round().clamp(min=0.0), rightmost)
    x, y = corner.int().tolist()
    wide, high = side.int().tolist()
    part = image[:, y : y + high, x : x + wide].contiguous()
    return "cropped", part, box - torch.cat([corner, corner]), None


def answer_of(
    result: cr.Registration,
    registrar: cr.Registrar,
    sample: Record,
    K: Tensor | None,
    right_mesh: int,
) -> Record:
    """What a result says, and how wrong it is."""
    R = torch.stack([h.rotation.double() for h in result.hypotheses])
    degrees = float(errors_of(R, sample, symmetries_of(sample, registrar))[0])
    distance = float(result.distance) / float(true_centre(sample).norm()) - 1.0
    mesh_is_right = result.mesh_index == right_mesh
    is_far = K is not None and abs(distance) > WRONG_DISTANCE
    turn = sample["rotation"].double() @ R[0].T
    return {
        "verdict": result.verdict,
        "reliable": result.reliable,
        "confidence": result.confidence,
        "warnings": list(result.warnings),
        "degrees": degrees,
        "distance": distance,
        "mesh_is_right": mesh_is_right,
        "axis_is_right": axis_is_right(result, registrar, turn),
        "wrong": degrees > RIGHT_DEG or not mesh_is_right or is_far,
    }


def axis_is_right(result: cr.Registration, registrar: cr.Registrar, turn: Tensor) -> bool:
    """Whether the axis of a result, if it has one, is within its tolerance; ``turn`` (3, 3) leads
    from the first hypothesis to the truth."""
    if result.axis is None or registrar.round_axis is None:
        return False
    cosine = float(turn @ result.axis.direction @ result.axis.direction)
    if registrar.round_axis.ends_are_alike:
        cosine = abs(cosine)
    degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return bool(degrees <= result.axis.tolerance_deg)


def measure(task: tuple[Path, list[str], list[int]]) -> list[Record]:
    """Rows of the photographs of one mesh."""
    folder, kinds, indices = task
    torch.set_num_threads(1)
    data = BOPDataset(folder)
    samples = [data[i] for i in indices]
    alone = cr.Registrar(mesh_of(samples[0]["model_path"], grey=False))
    rows = []
    for kind in kinds:
        for registrar, right_mesh in registrars_of(kind, alone, folder, samples[0]):
            for sample in samples:
                for way, image, box, K in cases_of(kind, sample):
                    row = {"kind": kind, "way": way, "scene": int(sample["scene_id"])}
                    found = registrar([image], box[None].float(), K)[0]
                    if found.ok:
                        row |= answer_of(found, alone, sample, K, right_mesh)
                        row["wrong"] = row["wrong"] or kind == "stranger"
                    else:
                        row |= {"reliable": False, "error": str(found.error)}
                    rows.append(row)
    return rows


def registrars_of(
    kind: str,
    alone: cr.Registrar,
    folder: Path,
    sample: Record,
) -> list[tuple[cr.Registrar, int]]:
    """The registrar of the mesh ``alone``, or two of the mesh and another one, in both orders; and
    which mesh the photograph shows."""
    mesh = alone.bank.mesh
    if kind == "sizes":
        other = replace(mesh, surface=mesh.surface.copy().apply_scale(LARGER))
        shown = 0
    elif kind == "chosen":
        other = original(folder, int(sample["obj_id"]))
        shown = 1
    else:
        return [(alone, 0)]
    pair = [alone.bank, cr.Registrar(other).bank]
    return [(cr.Registrar(pair), shown), (cr.Registrar(pair[::-1]), 1 - shown)]


def original(folder: Path, obj_id: int) -> Any:
    """The mesh that a photograph shows, of which a variant is annotated."""
    words = read_json(folder / "benchmark.json")
    options = Namespace(seed=words["seed"], models=words["models"], cad="exact")
    shown = Variants(options).mesh(obj_id % TWIN)
    path = folder / "models" / f"shown_{obj_id:06d}.ply"
    shown.save_ply(path)
    return mesh_of(path, grey=False)


def tasks_of(work: Path, name: str, each: int) -> Iterator[tuple[Path, list[str], list[int]]]:
    """The photographs of a set, by mesh, and the kinds that they serve; of each kind about
    ``each``."""
    folder = work / name
    data = BOPDataset(folder)
    groups = read_json(folder / "benchmark.json")["groups"]
    by_mesh = {}
    for i in range(len(data)):
        by_mesh.setdefault(int(data.annotation(i)["obj_id"]), []).append(i)
    wanted = -(-each // sum(SOURCES[name][0] in kinds for kinds in SOURCES.values()))
    left = dict.fromkeys(SOURCES[name], wanted)
    for number, (obj_id, indices) in enumerate(by_mesh.items()):
        kinds = [kind for kind in SOURCES[name] if number % WAYS.get(kind, 1) == 0]
        if name == "tied":
            kinds = ["round" if groups[str(obj_id)] == ROUND else "twins"]
        kinds = [kind for kind in kinds if left[kind] > 0]
        for kind in kinds:
            left[kind] -= len(indices) * WAYS.get(kind, 1)
        if kinds:
            yield folder, kinds, indices


def table_of(rows: Sequence[Record]) -> Record:
    """Counts of some rows."""
    sure = [row for row in rows if row["reliable"]]
    axes = [row for row in rows if row.get("verdict") == "reliable axis"]
    return {
        "photographs": len(rows),
        "confident": sum((row.get("confidence") or 0.0) >= RELIABLE for row in rows),
        "reliable": len(sure),
        "reliable and wrong": sum(row["wrong"] for row in sure),
        "axis reliable": len(axes),
        "axis reliable and wrong": sum(not row["axis_is_right"] for row in axes),
    }


def main(
    work: Path,
    *,
    each: int = 50,
    sets: list[Literal[*SOURCES]] = tuple(SOURCES),
    jobs: int = 1,
) -> None:
    tasks = {}
    for name in sets:
        for folder, kinds, indices in tasks_of(work, name, each):
            tasks[str([name, kinds, indices])] = (folder, kinds, indices)
    rows = measured(work / "misleading.jsonl", measure, tasks, jobs, "misleading")
    misleading = [row for row in rows if row["kind"] != "ordinary"]
    record = stamp() | {"misleading": table_of(misleading), "kinds": {}}
    for kind, way in sorted({(row["kind"], row["way"]) for row in rows}):
        name = f"{kind}: {way}" if kind == "camera" else kind
        some = [row for row in rows if (row["kind"], row["way"]) == (kind, way)]
        record["kinds"][name] = table_of(some)
    print(json.dumps(record, indent=2))
    write_json(RESULTS / "misleading.json", record)


if __name__ == "__main__":
    run(main)
