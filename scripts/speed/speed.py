"""Time the steps from process start to pose, in this checkout and, in turn, in another one.

    python scripts/speed/speed.py                                # this checkout alone
    git worktree add ../before HEAD~20
    python scripts/speed/speed.py --against ../before            # A B A B, with each step's ratio

Writes scripts/results/speed.json and the table of docs/performance.md. Every measurement has a
process of its own; each step counts with its least time and memory over the rounds. Ratios are fair
on a busy machine, times only on an idle one. The other checkout is of 2026-11-23 or later.

New photographs were never registered with the cache in use: what a first registration describes may
not be kept for the second. An earlier command has registered ten others of the same mesh, but for
``fresh``.

- warm: ``curvireg register`` from process start to its files, a new photograph, with a cached bank
- bank: ``ViewBank.build`` of all views
- fresh: each of the first ten photographs of a mesh whose bank is cached, one by one
- one: a new photograph; repeated: the same photograph again; many: each of many new photographs in
  one call
- follow: each frame of a video in which the photograph moves by 2 px
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from scripts import _shared

STEPS = ("warm", "bank", "fresh", "one", "repeated", "many", "follow")
FRAMES = 12
EARLIER = 10  # photographs that an earlier command registered
NEW = 4  # new photographs of the steps that register one after another
SUBDIVISIONS = 6  # of an icosphere: 81,920 faces
SIZE = (480, 640)
CAMERA = (900.0, 900.0, 319.5, 239.5)  # fx, fy, cx, cy of a photograph of 640 x 480 px

HERE = (
    f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from speed import measure, "
    f"write_inputs"
)
"""Import of this file in a process that imports another checkout's package."""


def dented_sphere(subdivisions: int) -> Any:
    """A mesh of 20 x 4^subdivisions faces."""
    import numpy as np
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    waves = np.random.default_rng(0).normal(size=(3, 6)) * 3
    bumps = np.sin(mesh.vertices @ waves).mean(axis=1)
    mesh.vertices = mesh.vertices * (1 + 0.35 * bumps[:, None]) * [1.0, 0.7, 0.5]
    return mesh


class Photographs:
    """Generated photographs (3, H, W) uint8 of a mesh in random poses, with boxes (N, 4)."""

    def __init__(self, mesh: Any, count: int, seed: int) -> None:
        import torch

        import curvireg_torch as cr
        from curvireg_torch.synthetic import random_pose, synthesize_photograph

        self.K = cr.camera_matrix(*CAMERA, dtype=torch.float64)
        generator = torch.Generator().manual_seed(seed)
        self.images = []
        self.boxes = torch.zeros(count, 4)
        self.poses = []
        for k in range(count):
            pose = random_pose(mesh, self.K, SIZE, generator)
            image, self.boxes[k] = synthesize_photograph(mesh, pose, self.K, SIZE, generator)
            self.images.append((255.0 * image).round().to(torch.uint8))
            self.poses.append(pose)


def write_inputs(folder: str, photographs: int) -> None:
    """Write a dented sphere, photographs of it and their boxes; runs in this checkout."""
    import cv2

    mesh = dented_sphere(SUBDIVISIONS)
    mesh.export(Path(folder, "mesh.ply"))
    generated = Photographs(mesh, EARLIER + photographs, seed=0)
    for k, image in enumerate(generated.images):
        cv2.imwrite(str(Path(folder, f"photo{k}.png")), image.permute(1, 2, 0).flip(2).numpy())
    _shared.write_json(Path(folder, "boxes.json"), generated.boxes.tolist())


def measure(step: str, folder: str, photographs: int) -> dict[str, float]:
    """Wall and processor seconds of a step in whichever checkout this process imports."""
    import torch

    import curvireg_torch as cr

    mesh = cr.load_mesh(Path(folder, "mesh.ply"))
    if step == "bank":
        return timed(lambda mesh: cr.ViewBank.build(mesh, progress=False), [mesh])
    K = cr.camera_matrix(*CAMERA, dtype=torch.float64)
    paths = [str(Path(folder, f"photo{k}.png")) for k in range(EARLIER + photographs)]
    # not by _shared, which is the other checkout's here
    boxes = torch.tensor(json.loads(Path(folder, "boxes.json").read_text("utf-8")))
    registrar = cr.Registrar(mesh, progress=False)
    if step == "follow":
        from curvireg_torch.data import read_image
        from curvireg_torch.registration import Follower

        first = read_image(paths[0])
        follower = Follower(registrar, K)
        assert follower(first, boxes[0]).ok
        return timed(follower, [first.roll(2 * k, dims=-1) for k in range(1, FRAMES)])

    def register(index: Sequence[int]) -> None:
        results = registrar([paths[k] for k in index], boxes[list(index)], K)
        assert all(result.ok for result in results)

    earlier = range(EARLIER)
    new = range(EARLIER, EARLIER + photographs)
    if step == "earlier":
        register(earlier)
        return {"seconds": 0.0}
    if step == "fresh":
        return timed(register, [[k] for k in earlier])
    register(earlier[:1])  # loads what every later photograph shares
    if step == "many":
        together = timed(register, [new])
        return {name: value / photographs for name, value in together.items()}
    calls = [[k] for k in new[:NEW]]
    if step == "repeated":
        timed(register, calls)
    return timed(register, calls)


def timed(function: Callable[[Any], object], values: Sequence[Any]) -> dict[str, float]:
    """Wall and processor seconds of a call, for each of the values."""
    wall = time.perf_counter()
    processor = time.process_time()
    for value in values:
        function(value)
    count = len(values)
    return {
        "seconds": (time.perf_counter() - wall) / count,
        "processor_seconds": (time.process_time() - processor) / count,
    }


def run_process(words: Sequence[str], folder: Path, environment: dict[str, str]) -> tuple[Any, ...]:
    """Seconds, resources and output of a Python process in a folder; the script ends if the process
    fails. On Windows, which does not count resources, an AttributeError.

    Args:
        words: arguments of the interpreter.
    """
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words], env=environment, stdout=subprocess.PIPE, text=True, cwd=folder
    )
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{words} failed with PYTHONPATH={environment['PYTHONPATH']}")
    return seconds, usage, output


def measured(
    step: str,
    checkout: Path,
    folder: Path,
    cache: Path,
    photographs: int,
) -> dict[str, float]:
    """Seconds, processor seconds and MB of a step in a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "CURVIREG_CACHE": str(cache)}
    # modules are compiled in the first round alone, as after an installation
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if step != "warm":
        call = f"measure({step!r}, {str(folder)!r}, {photographs})"
        words = ["-c", f"{HERE}; import json; print(json.dumps({call}))"]
        _, usage, output = run_process(words, folder, environment)
        return {**json.loads(output.splitlines()[-1]), "megabytes": usage.ru_maxrss / 1024}
    # another checkout refuses to replace files that it did not write
    shutil.rmtree(folder / "out", ignore_errors=True)
    boxes = _shared.read_json(folder / "boxes.json")
    words = ["-m", "curvireg_torch", "register", f"photo{EARLIER}.png", "mesh.ply", "--out", "out"]
    words += ["--box", *map(str, boxes[EARLIER]), "--camera", *map(str, CAMERA)]
    seconds, usage, _ = run_process(words, folder, environment)
    processor = usage.ru_utime + usage.ru_stime
    return {"seconds": seconds, "processor_seconds": processor, "megabytes": usage.ru_maxrss / 1024}


def compare(
    checkouts: dict[str, Path],
    steps: Sequence[str],
    photographs: int,
    rounds: int,
) -> dict[str, dict[str, Any]]:
    """Least seconds and megabytes of each step in each checkout, measured in turn."""
    found = {name: {} for name in checkouts}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        environment = {**os.environ, "PYTHONPATH": str(_shared.REPOSITORY)}
        command = f"{HERE}; write_inputs({temporary!r}, {photographs})"
        run_process(["-c", command], folder, environment)
        for name, checkout in checkouts.items():
            bank_alone = folder / f"{name}-bank"
            measured("follow", checkout, folder, bank_alone, photographs)  # stores the bank
            for features in bank_alone.glob("banks/views-*"):
                features.unlink()
            used = folder / f"{name}-used"
            shutil.copytree(bank_alone, used)
            measured("earlier", checkout, folder, used, photographs)
        for step in tuple(steps) * rounds:
            for name, checkout in checkouts.items():
                # a copy for each measurement: what this one stores, the next one lacks
                cache = folder / "cache"
                shutil.copytree(folder / f"{name}-{'bank' if step == 'fresh' else 'used'}", cache)
                new = measured(step, checkout, folder, cache, photographs)
                shutil.rmtree(cache)
                print(f"{step}, {name}: {cell(new)}", file=sys.stderr)
                old = found[name].get(step, new)
                found[name][step] = {key: min(old[key], value) for key, value in new.items()}
    return found


def table(record: dict[str, Any]) -> str:
    """Seconds and memory of each step in Markdown, with the ratio of processor times if there are
    two checkouts."""
    times = record["times"]
    columns = [f"{name} ({record['commits'][name]})" for name in times]
    rows = [["step", *columns, "ratio of processor times"]]
    for step in times["now"]:
        measurements = [steps[step] for steps in times.values()]
        ratio = measurements[-1]["processor_seconds"] / measurements[0]["processor_seconds"]
        rows.append([f"`{step}`", *map(cell, measurements), f"{ratio:.2f}"])
    if len(times) == 1:
        rows = [row[:-1] for row in rows]
    many = f"{record['photographs']} photographs in `many`"
    stamp = f"{20 * 4**SUBDIVISIONS} faces, {many}; {record['processor']}, {record['date']}."
    return f"{_shared.markdown_table(rows)}\n{stamp}\n"


def cell(measurement: dict[str, float]) -> str:
    """Seconds, processor seconds and memory of a step."""
    return "{seconds:.2f} s ({processor_seconds:.2f}), {megabytes:.0f} MB".format(**measurement)


def main(
    *,
    against: Path | None = None,
    steps: list[Literal[*STEPS]] = STEPS,
    photographs: int = 16,
    rounds: int = 3,
) -> None:
    checkouts = {"before": against.resolve()} if against else {}
    checkouts["now"] = _shared.REPOSITORY
    record = {
        "date": _shared.today(),
        "commits": {name: _shared.commit(root) for name, root in checkouts.items()},
        "processor": _shared.processor(),
        "photographs": photographs,
        "times": compare(checkouts, steps, photographs, rounds),
    }
    _shared.write_json(_shared.RESULTS / "speed.json", record)
    _shared.update_page(_shared.REPOSITORY / "docs" / "performance.md", "speed", table(record))
    print(table(record))


if __name__ == "__main__":
    _shared.run(main)
