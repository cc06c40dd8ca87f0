"""Measure registrations of several photographs on scenes with several cameras, from scripts/benchmark/make.py.

    python scripts/benchmark/make.py --kind shelf --cameras 5 --count 20 --out /data/shelf
    python scripts/calibration/several.py rows.jsonl /data/shelf [...]

Every photograph is registered once; groups of two, three and five of them are registered together, with errors of
0, 0.5 and 1 degree in the cameras' relative orientations. Each sixth rig is also registered to a wrong mesh. Rows are
appended to the file, and finished rigs of it are not measured again. A table is printed.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.conversions import axis_angle_from_rotation
from curvireg_torch.registration import several
from curvireg_torch.registration.inputs import image_items
from curvireg_torch.registration.rig import RigPhotograph
from scripts.calibration.calibrate import Row, errors_of, truth_of

SIZES, ERRORS, FIRSTS = (2, 3, 5), (0.0, 0.5, 1.0), 1
"""Photographs of a group, errors of the cameras in degrees, and first photographs of groups with errors."""


def disturbed(cameras: Tensor, degrees: float, generator: torch.Generator) -> Tensor:
    """(V, 4, 4) poses whose cameras, but the first, are turned by an angle about random axes."""
    axes = torch.nn.functional.normalize(torch.randn(len(cameras), 3, generator=generator, dtype=torch.float64), dim=1)
    turned = cameras.clone()
    turned[1:, :3] = rotation_from_axis_angle(np.radians(degrees) * axes)[1:] @ cameras[1:, :3]
    return turned


def groups(count: int, generator: torch.Generator) -> Iterator[tuple[float, list[int]]]:
    """Errors of the cameras, and numbers of photographs, the first one first."""
    for first in range(count):
        others = [k for k in torch.randperm(count, generator=generator).tolist() if k != first]
        for error in ERRORS if first < FIRSTS else ERRORS[:1]:
            for size in SIZES:
                if size <= count and (size < count or first == 0):
                    yield error, [first, *others[: size - 1]]


@torch.no_grad()
def rows_of(registrar: cr.Registrar, samples: list[Row], *, wrong: bool) -> Iterator[Row]:
    """Rows of one rig: the photographs alone, and groups of them. With a wrong mesh there is no truth."""
    cameras = torch.stack([truth_of(s) for s in samples])  # the world is the object's frame
    K = torch.stack([s["camera_matrix"].double() for s in samples])
    items = image_items([s["image"] for s in samples], torch.stack([s["box"] for s in samples]), K)
    start = time.process_time()
    found = several._registered(registrar, items, cameras, range(len(samples)))
    seconds = (time.process_time() - start) / len(samples)
    generator = torch.Generator().manual_seed(samples[0]["scene_id"])
    alone = [(0.0, [k]) for k in range(len(samples))]
    for error, chosen in [*alone, *groups(len(samples), generator)]:
        if wrong and (error or chosen[0]):
            continue
        rig, some = disturbed(cameras[chosen], error, generator), {}
        for k, i in enumerate(chosen):
            one = found[i]
            some[k] = replace(one, camera=rig[k], index=k) if isinstance(one, RigPhotograph) else one
        if not any(isinstance(one, RigPhotograph) for one in some.values()):
            continue
        start = time.process_time()
        result = several._registration(registrar, some, rig)
        together = time.process_time() - start
        first = samples[chosen[0]]
        in_first = [cameras[chosen[0]] @ h.transform for h in result.hypotheses]
        best, truth = in_first[0], cameras[chosen[0]]
        row = {"photographs": len(chosen), "error": error, "wrong": wrong, "seconds": seconds, "together": together}
        row |= {"features": dict(result.confidence_features), "confidence": result.confidence}
        row |= {"evidence": [h.evidence for h in result.hypotheses], "failed": [v.failure for v in result.views]}
        row |= {"errors": errors_of(torch.stack(in_first)[:, :3, :3], first).tolist(), "reliable": result.reliable}
        row["shift"] = float((best[:3, 3] - truth[:3, 3]).norm() / truth[:3, 3].norm())
        C = result.hypotheses[0].covariance
        if C is not None:
            turn = axis_angle_from_rotation(result.rotation.T)
            e = torch.cat([turn, -result.translation])
            row["distance2"] = float(e @ torch.linalg.solve(C, e))
        yield row


@lru_cache(maxsize=2)
def registrar_of(mesh: str) -> cr.Registrar:
    return cr.Registrar(cr.load_mesh(mesh, unit="mm"))


def measure(folder: Path, done: set[tuple[str, int, int]], out: Path) -> None:
    """Append the rows of a folder's rigs."""
    data = BOPDataset(folder, targets=False)
    rigs = defaultdict(list)
    for i in range(len(data)):
        known = data.annotation(i)
        if known["visib_fract"] >= 0.3:
            rigs[known["obj_id"], known["scene_id"]].append(i)
    meshes = {obj_id: data[indices[0]]["model_path"] for (obj_id, _), indices in sorted(rigs.items())}
    for number, ((obj_id, scene_id), indices) in enumerate(sorted(rigs.items())):
        if (folder.name, scene_id, obj_id) in done or len(indices) < 2:
            continue
        samples = [data[i] for i in indices]
        other = next((k for k in meshes if k > obj_id), min(meshes))
        names = [obj_id, other] if number % 6 == 0 and other != obj_id else [obj_id]
        rows: list[dict[str, Any]] = []
        for name in names:
            rows += rows_of(registrar_of(meshes[name]), samples, wrong=name != obj_id)
        with out.open("a") as file:
            file.write(json.dumps({"rig": [folder.name, scene_id, obj_id], "rows": rows}) + "\n")


def table(rows: list[Row]) -> None:
    """Print shares within 2, 5, 15 and 30 degrees, confidence, coverage of the 90 % ellipsoid, and time."""
    print("photographs error n 2 5 15 30 median shift confidence reliable right-if-reliable covered time")
    for size in (1, *SIZES):
        for error in ERRORS:
            some = [r for r in rows if (r["photographs"], r["error"], r["wrong"]) == (size, error, False)]
            if not some:
                continue
            e = np.array([r["errors"][0] for r in some])
            sure = np.array([r["reliable"] for r in some])
            d2 = np.array([r["distance2"] for r in some if "distance2" in r and r["errors"][0] < 15])
            together = sum(r["together"] for r in some) / sum(r["seconds"] * size for r in some)
            numbers = [*((e < limit).mean() for limit in (2, 5, 15, 30)), np.median(e)]
            numbers += [np.median([r["shift"] for r in some]), np.mean([r["confidence"] for r in some]), sure.mean()]
            numbers += [(e[sure] < 30).mean() if sure.any() else np.nan, (d2 < 10.645).mean(), 1 + together]
            print(size, error, len(some), *(f"{v:.3f}" for v in numbers))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("folders", type=Path, nargs="*")
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    done = {tuple(json.loads(line)["rig"]) for line in lines}
    for folder in options.folders:
        measure(folder, done, options.out)
    table([row for line in options.out.read_text().splitlines() for row in json.loads(line)["rows"]])


if __name__ == "__main__":
    main()
