"""Time the steps from process start to pose, in this checkout and, in turn, in another one.

    python scripts/speed/speed.py                                # this checkout alone
    git worktree add ../before HEAD~20
    python scripts/speed/speed.py --against ../before            # A B A B, with the ratio of each
    step python scripts/speed/speed.py --device cuda --steps bank one many layers --out gpu.json

Writes scripts/results/speed.json and, without --out, the table of docs/performance.md. Every
measurement has a process of its own; each step counts with its least time and memory over the
rounds. Ratios are fair on a busy machine, times only on an idle one. The other checkout is of
2026-11-23 or later.

New photographs were never registered with the cache in use: what a first registration describes may
not be kept for the second. An earlier command has registered ten others of the same mesh, but for
``cold`` and ``fresh``.

- cold, warm: ``curvireg register`` from process start to its files, a new photograph, without and
  with a cached bank
- bank: ``ViewBank.build`` of all views
- rank: a new photograph without contour fit
- fresh: each of the first ten photographs of a mesh whose bank is cached, one by one
- one: a new photograph; repeated: the same photograph again; many: each of many new photographs in
  one call
- follow: each frame of a video in which the photograph moves by 2 px
- layers: forward and backward pass of three filter layers, each followed by HOG; a photograph of a
  batch
"""

import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scripts import _shared

ROOT = Path(__file__).resolve().parents[2]
STEPS = ("cold", "warm", "bank", "rank", "fresh", "one", "repeated", "many", "follow", "layers")
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


def measure_layers(photographs: int, device: str) -> float:
    """Seconds of a forward and backward pass of three filter layers, each followed by HOG, for one
    of a batch."""
    import torch

    import curvireg_torch as cr

    layers = [
        cr.ImageCurvilinearSaliency(),
        cr.MultiScaleCurvilinearSaliency(),
        cr.MultiScaleFocusCurves(),
    ]
    hog = cr.HOG().to(device)
    images = torch.rand(photographs, 1, 480, 640, generator=torch.Generator().manual_seed(0)).to(
        device
    )
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        for layer in layers:
            pixels = images.clone().requires_grad_()
            hog(layer.to(device)(pixels)).sum().backward()
            assert pixels.grad.isfinite().all()  # waits for a GPU
        seconds.append(time.perf_counter() - start)
    return min(seconds) / photographs


def measure(step: str, folder: str, photographs: int, device: str) -> dict[str, float]:
    """Wall and processor seconds of a step in whichever checkout this process imports."""
    from dataclasses import replace

    import torch

    import curvireg_torch as cr

    if step == "layers":
        return {"seconds": measure_layers(photographs, device)}
    mesh = cr.load_mesh(Path(folder, "mesh.ply"))
    K = cr.camera_matrix(*CAMERA, dtype=torch.float64)
    if step == "bank":
        watch = Stopwatch()
        cr.ViewBank.build(mesh, progress=False, device=device)
        return watch.seconds(1)
    paths = [str(Path(folder, f"photo{k}.png")) for k in range(EARLIER + photographs)]
    boxes = torch.tensor(_shared.read_json(Path(folder, "boxes.json")))
    pipeline = replace(cr.Pipeline(), contours=step != "rank")
    registrar = cr.Registrar(mesh, pipeline=pipeline, device=device, progress=False)
    if step == "follow":
        from curvireg_torch.data import read_image
        from curvireg_torch.registration import Follower

        first = read_image(paths[0])
        follower = Follower(registrar, K)
        assert follower(first, boxes[0]).ok
        frames = [first.roll(2 * k, dims=-1) for k in range(1, FRAMES)]
        watch = Stopwatch()
        for frame in frames:
            follower(frame)
        return watch.seconds(len(frames))

    def register(index: Sequence[int]) -> None:
        results = registrar([paths[k] for k in index], boxes[list(index)], K)
        assert all(result.ok for result in results)

    earlier = range(EARLIER)
    new = range(EARLIER, EARLIER + photographs)
    if step == "earlier":
        register(earlier)
        return {"seconds": 0.0}
    if step == "fresh":
        one_by_one = earlier
    else:
        register(earlier[:1])  # loads what every later photograph shares
        one_by_one = new[:NEW]
    if step == "repeated":
        for k in one_by_one:
            register([k])
    watch = Stopwatch()
    if step == "many":
        register(new)
        return watch.seconds(len(new))
    for k in one_by_one:
        register([k])
    return watch.seconds(len(one_by_one))


class Stopwatch:
    """Wall and processor time since it was made."""

    def __init__(self) -> None:
        self.wall = time.perf_counter()
        self.processor = time.process_time()

    def seconds(self, count: int) -> dict[str, float]:
        """Of one of ``count`` equal parts."""
        wall = (time.perf_counter() - self.wall) / count
        processor = (time.process_time() - self.processor) / count
        return {"seconds": wall, "processor_seconds": processor}


def measured(
    step: str, checkout: Path, folder: Path, cache: Path, photographs: int, device: str
) -> dict[str, float]:
    """Seconds, processor seconds and MB of a step in a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "CURVIREG_CACHE": str(cache)}
    # modules are compiled in the first round alone, as after an installation
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    if step not in ("cold", "warm"):
        words = [
            "-c",
            f"{HERE}; import json; print(json.dumps(measure({step!r}, {str(folder)!r}, "
            f"{photographs}, {device!r})))",
        ]
        _, usage, output = _shared.run_process(words, folder, environment)
        return {**json.loads(output.splitlines()[-1]), "megabytes": usage.ru_maxrss / 1024}
    # another checkout refuses to replace files that it did not write
    shutil.rmtree(folder / "out", ignore_errors=True)
    boxes = _shared.read_json(folder / "boxes.json")
    words = ["-m", "curvireg_torch", "register", f"photo{EARLIER}.png", "mesh.ply", "--out", "out"]
    words += ["--box", *map(str, boxes[EARLIER]), "--camera", *map(str, CAMERA)]
    seconds, usage, _ = _shared.run_process(words, folder, environment)
    processor = usage.ru_utime + usage.ru_stime
    return {"seconds": seconds, "processor_seconds": processor, "megabytes": usage.ru_maxrss / 1024}


def compare(
    checkouts: dict[str, Path], steps: Sequence[str], photographs: int, rounds: int, device: str
) -> Any:
    """Least seconds and megabytes of each step in each checkout, measured in turn."""
    found = {name: {} for name in checkouts}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        _shared.run_process(
            ["-c", f"{HERE}; write_inputs({temporary!r}, {photographs})"], folder, environment
        )
        for name, checkout in checkouts.items():
            bank_alone = folder / f"{name}-bank"
            measured("follow", checkout, folder, bank_alone, photographs, device)  # stores the bank
            for features in bank_alone.glob("banks/views-*"):
                features.unlink()
            used = folder / f"{name}-used"
            shutil.copytree(bank_alone, used)
            measured("earlier", checkout, folder, used, photographs, device)
        for step in tuple(steps) * rounds:
            for name, checkout in checkouts.items():
                # a copy for each measurement: what this one stores, the next one lacks
                cache = folder / "cache"
                if step != "cold":
                    shutil.copytree(
                        folder / f"{name}-{'bank' if step == 'fresh' else 'used'}", cache
                    )
                new = measured(step, checkout, folder, cache, photographs, device)
                shutil.rmtree(cache, ignore_errors=True)
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
        key = "processor_seconds" if "processor_seconds" in measurements[-1] else "seconds"
        ratio = measurements[-1][key] / measurements[0][key]
        rows.append([f"`{step}`", *map(cell, measurements), f"{ratio:.2f}"])
    if len(times) == 1:
        rows = [row[:-1] for row in rows]
    many = f"{record['photographs']} photographs in `many`"
    stamp = f"{20 * 4**SUBDIVISIONS} faces, {many}; {record['processor']}, {record['date']}."
    return "\n".join([*_shared.table_lines(rows), "", stamp, ""])


def cell(measurement: dict[str, float]) -> str:
    """Seconds, processor seconds and memory of a step."""
    processor = measurement.get("processor_seconds")
    also = "" if processor is None else f" ({processor:.2f})"
    return f"{measurement['seconds']:.2f} s{also}, {measurement['megabytes']:.0f} MB"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = _shared.parser_of(__doc__)
    parser.add_argument(
        "--against", type=Path, metavar="CHECKOUT", help="another checkout of this repository"
    )
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS)
    parser.add_argument("--photographs", type=int, default=16)
    parser.add_argument(
        "--device", default="cpu", help="of all steps but the commands (default cpu)"
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--out", type=Path, help="another file than scripts/results/speed.json; no page is changed"
    )
    options = parser.parse_args(arguments)
    checkouts = {"before": options.against.resolve()} if options.against else {}
    checkouts["now"] = ROOT
    record = {
        "date": _shared.today(),
        "commits": {name: _shared.commit(root) for name, root in checkouts.items()},
        "processor": _shared.processor(options.device),
        "photographs": options.photographs,
        "times": compare(
            checkouts, options.steps, options.photographs, options.rounds, options.device
        ),
    }
    _shared.write_json(options.out or _shared.RESULTS / "speed.json", record)
    print(table(record))
    if options.out is None:
        _shared.update_page(_shared.REPOSITORY / "docs" / "performance.md", "speed", table(record))


if __name__ == "__main__":
    main()
