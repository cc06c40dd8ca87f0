"""Measure registration on a GPU: photographs a second, the ranking alone, a bank, and whether poses
agree with those of the CPU.

    python scripts/speed/gpu.py --out gpu.json                     # at most five minutes on an H100
    python scripts/speed/gpu.py --device cpu --photographs 2 --few-views --out gpu.json

Generated photographs of one mesh, of 81,920 faces, and of two, with boxes and cameras given. Each
number is of a second call of the same kind, after a warm-up. The JSON file is written again after
each step, so that a run that is stopped leaves what it has measured.
"""

import json
import statistics
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.matching import ViewMatcher
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from scripts import _shared
from scripts.speed.speed import CAMERA, dented_sphere

SIZE = (480, 640)
AGREE = 4  # photographs that are also registered on the CPU
TOGETHER = (1, 8, 64)  # photographs in one call


class Photographs:
    """Generated photographs of a mesh, with boxes; poses are random."""

    def __init__(self, mesh: trimesh.Trimesh, count: int, seed: int) -> None:
        self.K = cr.camera_matrix(*CAMERA, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        self.images: list[Tensor] = []
        self.boxes = torch.zeros(count, 4)
        self.poses: list[Tensor] = []
        for k in range(count):
            pose = random_pose(mesh, self.K, SIZE, generator)
            image, self.boxes[k] = synthesize_photograph(mesh, pose, self.K, SIZE, generator)
            self.images.append((255.0 * image).round().to(torch.uint8))
            self.poses.append(pose)


def seconds_of(function: Callable[[], object], device: str) -> float:
    """Of one call, until the device has finished."""
    finish(device)
    start = time.perf_counter()
    function()
    finish(device)
    return time.perf_counter() - start


def finish(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize(device)


def degrees(results: Any, others: Any) -> list[float | None]:
    """Between the rotations of two results of each photograph; None where one has failed."""
    return [
        float(cr.rotation_error(one.rotation.cpu(), other.rotation.cpu()))
        if one.ok and other.ok
        else None
        for one, other in zip(results, others, strict=True)
    ]


def accuracy(results: Any, poses: list[Tensor]) -> dict[str, float]:
    """Shares of poses within 5 and 15 degrees of the truth, of all photographs."""
    errors = [
        float(cr.rotation_error(result.rotation.cpu(), T[:3, :3])) if result.ok else 180.0
        for result, T in zip(results, poses, strict=True)
    ]
    return {f"within_{limit}": sum(e < limit for e in errors) / len(errors) for limit in (5, 15)}


def measure(options: Namespace, record: Callable[[str, Any], None]) -> None:
    device = options.device
    views = cr.sample_views(azimuth_step=60, elevations=[0, 30]) if options.few_views else None
    count = options.photographs
    sphere = dented_sphere(2 if options.few_views else 6)
    new = Photographs(sphere, count, seed=0)
    others = Photographs(sphere, count, seed=1)
    record("photographs", count)

    def build(on: str) -> cr.ViewBank:
        return cr.ViewBank.build(sphere, views, progress=False, device=on)

    if device != "cpu":
        build(device)  # kernels are loaded
    seconds = seconds_of(lambda: build(device), device)
    bank = build(device)
    record("bank", {"seconds": seconds, "views": len(bank)})

    matcher = ViewMatcher(bank)
    matcher(others.images, others.boxes)
    matcher(new.images, new.boxes)  # describes the views that it needs
    seconds = seconds_of(lambda: matcher(new.images, new.boxes), device)
    record("rank", {"seconds": seconds, "photographs_per_second": count / seconds})

    registrar = cr.Registrar(matcher)

    def register(some: Photographs, first: int, last: int) -> Any:
        return registrar(some.images[first:last], some.boxes[first:last], some.K)

    register(others, 0, count)
    seconds = seconds_of(lambda: register(new, 0, count), device)
    record("new", {"seconds": seconds, "photographs_per_second": count / seconds})
    for together in TOGETHER:
        number = min(together, count)
        register(new, 0, number)
        seconds = seconds_of(lambda n=number: register(new, 0, n), device)  # type: ignore[misc]
        measured = {"seconds": seconds, "photographs_per_second": number / seconds}
        record(f"register_{together}", measured)
    results = register(new, 0, count)
    record("accuracy", accuracy(results, new.poses))
    alone = [register(new, k, k + 1)[0] for k in range(min(AGREE, count))]
    record("degrees_alone_and_together", degrees(alone, results[: len(alone)]))

    truck = example_mesh()
    of_truck = Photographs(truck, count, seed=2)
    truck_bank = cr.ViewBank.build(truck, views, progress=False, device=device)
    two = cr.Registrar([bank, truck_bank])
    images = [*new.images[: count // 2], *of_truck.images[count // 2 :]]
    boxes = torch.cat([new.boxes[: count // 2], of_truck.boxes[count // 2 :]])
    two(images, boxes, new.K)
    seconds = seconds_of(lambda: two(images, boxes, new.K), device)
    found = two(images, boxes, new.K)
    models = [0] * (count // 2) + [1] * (count - count // 2)
    pairs = zip(found, models, strict=True)
    right = [result.ok and result.mesh_index == model for result, model in pairs]
    measured = {"seconds": seconds, "photographs_per_second": count / seconds}
    record("two_meshes", {**measured, "right_mesh": sum(right) / count})

    on_cpu = cr.Registrar(bank.to("cpu"))
    number = min(AGREE, count)
    expected = on_cpu(new.images[:number], new.boxes[:number], new.K)
    seconds = seconds_of(lambda: on_cpu(new.images[:number], new.boxes[:number], new.K), "cpu")
    record("cpu", {"seconds": seconds, "photographs_per_second": number / seconds})
    errors = degrees(results[:number], expected)
    known = [error for error in errors if error is not None]
    record("degrees_from_cpu", {"each": errors, "median": statistics.median(known or [180.0])})


def main() -> None:
    parser = _shared.parser_of(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--photographs", type=int, default=64)
    parser.add_argument("--few-views", action="store_true", help="to try the script itself")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    on_cpu = options.device == "cpu"
    start = time.perf_counter()
    measured: dict[str, Any] = {
        **_shared.stamp(),
        "processor": _shared.processor() if on_cpu else torch.cuda.get_device_name(options.device),
        "torch": torch.__version__,
    }

    def record(name: str, value: Any) -> None:
        measured[name] = value
        measured["seconds_until_here"] = round(time.perf_counter() - start, 1)
        print(name, json.dumps(value), flush=True)
        _shared.write_json(options.out, measured)

    measure(options, record)


if __name__ == "__main__":
    main()
