"""Measure registration on a GPU: photographs a second, the ranking alone, a bank, and whether poses
agree with those of the CPU.

    python scripts/speed/gpu.py --out gpu.json                     # at most five minutes on an H100
    python scripts/speed/gpu.py --device cpu --photographs 2 --few-views --out gpu.json

Generated photographs of one mesh, of 81,920 faces, and of two, with boxes and cameras given. Each
number is of a second call of the same kind, after a warm-up. The JSON file is written again after
each step, so that a run that is stopped leaves what it has measured.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.matching import ViewMatcher
from curvireg_torch.synthetic import example_mesh
from scripts._shared import Record, processor, run, stamp, write_json
from scripts.speed.speed import Photographs, dented_sphere

AGREE = 4  # photographs that are also registered on the CPU
TOGETHER = (1, 8, 64)  # photographs in one call


def rate(function: Callable[[], object], count: int) -> Record:
    """Seconds of a call with ``count`` photographs, until the device has finished."""
    finish()
    start = time.perf_counter()
    function()
    finish()
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "photographs_per_second": count / seconds}


def finish() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def degrees(results: Any, others: Sequence[Tensor | None]) -> list[float | None]:
    """Between the rotation of each result and another one; None where one is missing."""
    return [
        float(cr.rotation_error(result.rotation.cpu(), R)) if result.ok and R is not None else None
        for result, R in zip(results, others, strict=True)
    ]


def rotations(results: Any) -> list[Tensor | None]:
    return [result.rotation.cpu() if result.ok else None for result in results]


def measure(
    count: int,
    device: str,
    *,
    few_views: bool,
    record: Callable[[str, Any], None],
) -> None:
    views = cr.sample_views(azimuth_step=60, elevations=[0, 30]) if few_views else None
    sphere = dented_sphere(2 if few_views else 6)
    new = Photographs(sphere, count, seed=0)
    others = Photographs(sphere, count, seed=1)
    record("photographs", count)

    def build(mesh: Any = sphere) -> cr.ViewBank:
        return cr.ViewBank.build(mesh, views, progress=False, device=device)

    bank = build()  # kernels are loaded
    record("bank", {"seconds": rate(build, 1)["seconds"], "views": len(bank)})

    matcher = ViewMatcher(bank)
    matcher(others.images, others.boxes)
    matcher(new.images, new.boxes)  # describes the views that it needs
    record("rank", rate(lambda: matcher(new.images, new.boxes), count))

    registrar = cr.Registrar(matcher)

    def register(some: Photographs, first: int, last: int) -> Any:
        return registrar(some.images[first:last], some.boxes[first:last], some.K)

    register(others, 0, count)
    record("new", rate(lambda: register(new, 0, count), count))
    for together in TOGETHER:
        number = min(together, count)
        register(new, 0, number)
        record(f"register_{together}", rate(lambda n=number: register(new, 0, n), number))
    results = register(new, 0, count)
    errors = degrees(results, [pose[:3, :3] for pose in new.poses])
    record("within_5_degrees", sum(error is not None and error < 5 for error in errors) / count)
    few = min(AGREE, count)
    alone = [register(new, k, k + 1)[0] for k in range(few)]
    record("degrees_alone_and_together", degrees(alone, rotations(results[:few])))

    truck = example_mesh()
    of_truck = Photographs(truck, count, seed=2)
    two = cr.Registrar([bank, build(truck)])
    half = count // 2
    images = [*new.images[:half], *of_truck.images[half:]]
    boxes = torch.cat([new.boxes[:half], of_truck.boxes[half:]])
    found = two(images, boxes, new.K)
    right = [result.ok and result.mesh_index == (k >= half) for k, result in enumerate(found)]
    measured = rate(lambda: two(images, boxes, new.K), count)
    record("two_meshes", {**measured, "right_mesh": sum(right) / count})

    on_cpu = cr.Registrar(bank.to("cpu"))
    images = new.images[:few]
    boxes = new.boxes[:few]
    expected = on_cpu(images, boxes, new.K)
    record("cpu", rate(lambda: on_cpu(images, boxes, new.K), few))
    record("degrees_from_cpu", degrees(results[:few], rotations(expected)))


def main(
    *,
    out: Path,
    device: str = "cuda",
    photographs: int = 64,
    few_views: bool = False,
) -> None:
    measured = stamp() | {"processor": processor(device), "torch": torch.__version__}

    def record(name: str, value: Any) -> None:
        measured[name] = value
        print(name, json.dumps(value), flush=True)
        write_json(out, measured)

    measure(photographs, device, few_views=few_views, record=record)


if __name__ == "__main__":
    run(main)
