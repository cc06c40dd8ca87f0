"""Time each step from process start to pose in this checkout and in another one, alternately, with peak memory.

    git worktree add ../before 9b0fb33
    python scripts/speed/paired.py --against ../before     # scripts/results/paired.json; plot and table of the docs

Every measurement has a process of its own; each step counts with its least time and memory. On an idle machine only.

- cold, warm: ``curvireg register`` from process start to its files, without and with a cached bank
- bank: ``ViewBank.build`` of all views
- one: a further photograph by the same ``Registrar`` (the first call of all builds the bank, which is then cached)
- many_1, many_2: each of many photographs in one call, on one and on two threads
- follow: each frame of a video in which the photograph moves by 2 px (not in checkouts without ``Follower``)
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
STEPS = ("cold", "warm", "bank", "one", "many_1", "many_2", "follow")
FRAMES = 12
FOCAL, CENTRE, MEGAPIXELS = 900.0, (319.5, 239.5), 0.3072
"""Camera of a photograph of 640 x 480 px."""


def write_inputs(folder: str, faces: int, megapixels: float) -> None:
    """Write a mesh, a photograph of it and its box; runs in this checkout."""
    import cv2
    import torch

    from curvireg_torch.synthetic import random_pose, synthesize_photograph
    from curvireg_torch.visualization.overlay import to_uint8
    from scripts.speed.pipeline import dented_sphere

    mesh, generator = dented_sphere(faces), torch.Generator().manual_seed(0)
    mesh.export(Path(folder, "mesh.ply"))
    fx, fy, cx, cy = camera(megapixels)
    K, size = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), size_of(megapixels)
    photograph, box = synthesize_photograph(mesh, random_pose(mesh, K, size, generator), K, size, generator)
    cv2.imwrite(str(Path(folder, "photo.jpg")), to_uint8(photograph)[..., ::-1])
    Path(folder, "case.json").write_text(json.dumps({"faces": len(mesh.faces), "box": box.tolist()}))


def size_of(megapixels: float) -> tuple[int, int]:
    scale = (megapixels / MEGAPIXELS) ** 0.5
    return round(480 * scale), round(640 * scale)


def camera(megapixels: float) -> tuple[float, float, float, float]:
    scale = size_of(megapixels)[0] / 480
    return FOCAL * scale, FOCAL * scale, (CENTRE[0] + 0.5) * scale - 0.5, (CENTRE[1] + 0.5) * scale - 0.5


def measure(step: str, folder: str, megapixels: float, photographs: int) -> float:
    """Seconds of a step in whichever checkout this process imports."""
    import torch

    from curvireg_torch import Registrar, ViewBank, load_mesh

    mesh = load_mesh(Path(folder, "mesh.ply"))
    if step == "bank":
        start = time.perf_counter()
        ViewBank.build(mesh, progress=False)
        return time.perf_counter() - start
    count = 1 if step == "one" else photographs
    registrar = Registrar(mesh)
    box = json.loads(Path(folder, "case.json").read_text())["box"]
    fx, fy, cx, cy = camera(megapixels)
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    def register(n: int) -> float:
        start = time.perf_counter()
        results = registrar([str(Path(folder, "photo.jpg"))] * n, torch.tensor([box] * n), K)
        assert all(result.ok for result in results)
        return (time.perf_counter() - start) / n

    if step == "follow":
        return follow(registrar, str(Path(folder, "photo.jpg")), box, K)
    register(1)
    return register(count) if count > 1 else min(register(1) for _ in range(3))


def follow(registrar: Any, photograph: str, box: list[float], K: Any) -> float:
    """Seconds of each tracked frame of a video of a photograph that moves to the right, and comes back on the left."""
    from curvireg_torch.data import read_image
    from curvireg_torch.registration import Follower

    first, follower = read_image(photograph), Follower(registrar, K)
    assert follower(first, box).ok
    frames = [first.roll(2 * k, dims=-1) for k in range(1, FRAMES)]
    start = time.perf_counter()
    results = [follower(frame) for frame in frames]
    seconds = (time.perf_counter() - start) / len(frames)
    assert all("flow" in result.confidence_features for result in results), "a frame was registered, not tracked"
    return seconds


def steps_of(checkout: Path) -> tuple[str, ...]:
    """The steps that a checkout knows."""
    follows = (checkout / "curvireg_torch" / "registration" / "following.py").is_file()
    return tuple(step for step in STEPS if step != "follow" or follows)


def run(words: Sequence[str], checkout: Path, folder: Path, cache: Path, threads: int = 2) -> tuple[float, float, str]:
    """Seconds, peak memory in MB and output of a process that imports ``checkout``."""
    from scripts._shared import run_process

    environment = {**os.environ, "PYTHONPATH": str(checkout), "CURVIREG_CACHE": str(cache)}
    environment["OMP_NUM_THREADS"] = str(threads)
    seconds, usage, output = run_process(words, folder, environment)
    return seconds, usage.ru_maxrss / 1024, output


def measured(
    step: str, checkout: Path, folder: Path, cache: Path, megapixels: float, photographs: int
) -> dict[str, float]:
    """Seconds and MB of a step in a checkout."""
    if step in ("cold", "warm"):
        numbers = [*json.loads((folder / "case.json").read_text())["box"], *camera(megapixels)]
        words = ["-m", "curvireg_torch", "register", "photo.jpg", "mesh.ply", "--out", "out", "--box"]
        words += [*map(str, numbers[:4]), "--camera", *map(str, numbers[4:])]
        if step == "cold":
            cache = Path(tempfile.mkdtemp(dir=folder))
        seconds, megabytes, _ = run(words, checkout, folder, cache)
        return {"seconds": seconds, "megabytes": megabytes}
    call = f"measure({step!r}, {str(folder)!r}, {megapixels}, {photographs})"
    threads = 1 if step == "many_1" else 2
    _, megabytes, output = run(["-c", f"{HERE}; print({call})"], checkout, folder, cache, threads)
    return {"seconds": float(output.split()[-1]), "megabytes": megabytes}


HERE = f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from paired import measure, write_inputs"
"""Import of this file in a process that imports another checkout's package."""


def case(checkouts: dict[str, Path], faces: int, megapixels: float, photographs: int, rounds: int) -> dict[str, Any]:
    """One mesh and photograph: least seconds and megabytes of each step in each checkout."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run(["-c", f"{HERE}; write_inputs({temporary!r}, {faces}, {megapixels})"], ROOT, folder, folder)
        found: dict[str, Any] = {name: {} for name in checkouts}
        for step in ("one", *STEPS) + STEPS * (rounds - 1):
            for name, checkout in checkouts.items():
                if step not in steps_of(checkout):
                    continue
                new = measured(step, checkout, folder, folder / name, megapixels, photographs)
                old = found[name].get(step, new)
                found[name][step] = {key: min(old[key], value) for key, value in new.items()}
        actual = json.loads((folder / "case.json").read_text())["faces"]
    return {"faces": actual, "megapixels": megapixels, **found}


def table(record: dict[str, Any]) -> str:
    """Seconds (MB) of each step, before and now, in Markdown."""
    from scripts._shared import table_lines

    rows = [["faces", "megapixels", "step", *record["commits"], "ratio"]]
    for row in record["cases"]:
        for step in STEPS:
            both = [row[name].get(step) for name in record["commits"]]
            cells = [f"{each['seconds']:.2f} s, {each['megabytes']:.0f} MB" if each else "-" for each in both]
            ratio = f"{both[-1]['seconds'] / both[0]['seconds']:.2f}" if all(both) else "-"
            rows.append([str(row["faces"]), f"{row['megapixels']:g}", f"`{step}`", *cells, ratio])
    commits = ", ".join(f"{name} {commit}" for name, commit in record["commits"].items())
    many = f"{record['photographs']} photographs in `many_1` and `many_2`"
    return "\n".join([*table_lines(rows), "", f"{many}; {record['processor']}, {record['date']}; {commits}.", ""])


def plot(record: dict[str, Any], path: Path) -> None:
    """Draw the seconds of each step, before and now, for the mesh and photograph of the first case."""
    from matplotlib import pyplot as plt

    row, names = record["cases"][0], list(record["commits"])
    figure, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
    for k, name in enumerate(names):
        seconds = [row[name][step]["seconds"] for step in STEPS if step in row[name]]
        places = [
            i + 0.8 * (k - 0.5 * (len(names) - 1)) / len(names) for i, step in enumerate(STEPS) if step in row[name]
        ]
        bars = axes.bar(places, seconds, width=0.8 / len(names), label=f"{name} ({record['commits'][name]})")
        axes.bar_label(bars, fmt="%.2f", fontsize=8)
    axes.set_xticks(range(len(STEPS)), STEPS)
    axes.set_ylabel("seconds")
    axes.legend()
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    from scripts._shared import REPOSITORY, RESULTS, commit, processor, today, update_page, write_json

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    help_ = "another checkout of this repository"
    parser.add_argument("--against", type=Path, required=True, metavar="CHECKOUT", help=help_)
    parser.add_argument("--faces", type=int, nargs="+", default=[1_000, 40_000, 1_000_000], help="at the least size")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.3, 2.0, 12.0], help="at the middle mesh")
    parser.add_argument("--photographs", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULTS / "paired.json")
    options = parser.parse_args(arguments)
    checkouts = {"before": options.against.resolve(), "now": ROOT}
    middle, least = options.faces[len(options.faces) // 2], options.megapixels[0]
    cases = [(faces, least) for faces in options.faces] + [(middle, size) for size in options.megapixels[1:]]
    record = {
        "date": today(),
        "commits": {name: commit(root) for name, root in checkouts.items()},
        "photographs": options.photographs,
        "processor": processor(),
        "cases": [case(checkouts, *each, options.photographs, options.rounds) for each in cases],
    }
    write_json(options.out, record)
    print(table(record))
    if options.out == RESULTS / "paired.json":
        update_page(REPOSITORY / "docs" / "performance.md", "paired", table(record))
        plot(record, REPOSITORY / "docs" / "images" / "paired.png")


if __name__ == "__main__":
    main()
