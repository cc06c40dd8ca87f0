"""Check that memory, open files and threads do not grow over many registrations in one process.

    python scripts/robustness/soak.py                     2000 registrations in each of two processes with one cache
    python scripts/robustness/soak.py --count 100 --processes 1

Every process registers noisy copies of one synthetic photograph, and reopens its bank from the shared cache every
``--reopen`` registrations. The cache limit is 0, so each process also removes banks that the other one reads.
``scripts/results/soak.json`` records resident memory, open files and threads over time, and the growth: the median of
the last quarter minus that of the second quarter (the first one warms up). Exit code 1 if memory grew by more than
``--allow`` MB, or files or threads grew at all.
"""

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from curvireg_torch import Pipeline, Registrar, camera_matrix, sample_views
from curvireg_torch.matching import cached_bank
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph
from scripts._shared import RESULTS, commit, today

CAMERA, SIZE = (260.0, 260.0, 119.5, 89.5), (180, 240)
Sample = dict[str, float]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="registrations of each process (default: 2000)")
    parser.add_argument("--processes", type=int, default=2, help="processes that share one cache (default: 2)")
    parser.add_argument("--reopen", type=int, default=10, help="registrations per opened bank (default: 10)")
    parser.add_argument("--allow", type=float, default=20.0, metavar="MB", help="largest growth (default: 20)")
    parser.add_argument("--out", type=Path, default=RESULTS / "soak.json", metavar="FILE")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        os.environ.update(CURVIREG_CACHE=cache, CURVIREG_CACHE_LIMIT="0")
        work = [(arguments.count, arguments.reopen, seed) for seed in range(arguments.processes)]
        with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
            courses = pool.starmap(soak, work, chunksize=1)
            pool.close()
            pool.join()
        left = sorted(path.suffix for path in Path(cache).rglob("*") if path.is_file())
    processes = [{"growth": growth(course), "course": course} for course in courses]
    flat = all(is_flat(process["growth"], arguments.allow) for process in processes) and set(left) <= {".safetensors"}
    head = {"registrations": arguments.count, "flat": flat, "allowed_mb": arguments.allow, "left_in_cache": left}
    result = {**head, "processes": processes, "date": today(), "commit": commit()}
    arguments.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({**head, "growth": [process["growth"] for process in processes]}))
    return int(not flat)


def soak(count: int, reopen: int, seed: int) -> list[Sample]:
    """Register ``count`` times; returns about a hundred samples of the resources."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(seed)
    mesh, K = example_mesh(), camera_matrix(*CAMERA, dtype=torch.float64)
    truth = random_pose(mesh, K, SIZE, generator)
    image, box = synthesize_photograph(mesh, truth, K, SIZE, generator)
    views = sample_views(azimuth_step=30, elevations=[0, 30])
    course, start = [], time.monotonic()
    for i in tqdm(range(count), unit="registration", position=seed):
        if i % reopen == 0:
            settings = BankSettings(image_size=64 if i // reopen % 2 else 96)  # each size removes the other's bank
            registrar = Registrar(cached_bank(mesh, views, pipeline=Pipeline(bank=settings), progress=False))
        noisy = (image + 0.02 * torch.randn(image.shape, generator=generator)).clamp(0, 1)
        result = registrar([noisy], box[None], K)[0]
        if not bool(torch.isfinite(result.rotation).all()):
            raise AssertionError(f"registration {i}: rotation {result.rotation.tolist()}")
        if i % max(1, count // 100) == 0:
            course.append({"registration": i, "seconds": time.monotonic() - start, **resources()})
    return course


def resources() -> Sample:
    """Resident memory in MB, open files and threads of this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "rss_mb": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "files": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
    }


def growth(course: list[Sample]) -> Sample:
    """Median of the last quarter minus that of the second quarter, for each resource."""
    quarter = len(course) // 4

    def median(samples: list[Sample], name: str) -> float:
        return statistics.median(sample[name] for sample in samples)

    return {
        name: median(course[-quarter:], name) - median(course[quarter : 2 * quarter], name)
        for name in ("rss_mb", "files", "threads")
    }


def is_flat(grown: dict[str, Any], allow: float) -> bool:
    return grown["rss_mb"] <= allow and grown["files"] <= 0 and grown["threads"] <= 0


if __name__ == "__main__":
    sys.exit(main())
