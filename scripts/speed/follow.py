"""Follow objects through videos with `Follower` and with OpenCV's `cv2.rapid`, from the same first pose.

    python scripts/speed/follow.py BENCH --rows rows.jsonl [--sequences 30] [--frames 60] [--half held-out]
    python scripts/speed/follow.py --real DATA --rows rows.jsonl
    python scripts/speed/follow.py --rows rows.jsonl --table     # writes record and table

BENCH is the folder of scripts/benchmark/make.py; its sequences are those of scripts/benchmark/sequences.py. DATA holds
bop/dino: its photographs become sequences in the order of their angles. Both methods start from the true pose of the
first frame. cv2.rapid is skipped where it is absent, see scripts/_rapid.py. An interrupted run can be resumed.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import cv2
import torch
import trimesh
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset, read_image
from curvireg_torch.matching import cached_bank
from curvireg_torch.mesh.mesh import mesh_centre
from curvireg_torch.registration import Follower
from scripts._rapid import ABSENT, AVAILABLE, Rapid
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json
from scripts.benchmark.make import Meshes
from scripts.benchmark.sequences import make_sequence

Row = dict[str, Any]
Tracker = Callable[[Tensor], Tensor | None]
"""Takes the next (3, H, W) uint8 frame and returns its (4, 4) pose, or None if the object is lost; in the first frame
it begins from the true pose."""

RECORD = RESULTS / "follow.json"
PAGE = REPOSITORY / "docs" / "guides" / "follow.md"
DEGREES, FRACTION = 5.0, 0.05
"""A pose is right within so many degrees, and so large a fraction of the object's distance."""
LARGEST_GAP = 15.0
"""Degrees between photographs of dino above which a new sequence begins."""
METHODS = ("curvireg", "cv2.rapid")
SETS = {"generated": "generated", "dino": "dino photographs"}


class Video(NamedTuple):
    """Frames of one object with (N, 4, 4) true poses; ``mesh`` is in the unit of the poses."""

    name: str
    mesh: trimesh.Trimesh
    K: Tensor
    poses: Tensor
    symmetries: Tensor
    frames: Iterable[Tensor]


def generated(folder: Path, half: str, sequences: Iterable[int], count: int, seed: int) -> Iterator[tuple[str, Video]]:
    meshes = Meshes(folder, half)
    for index in sequences:
        made = make_sequence(meshes, seed, index, count)
        mesh = cr.load_mesh(folder / made.mesh)
        name = f"{seed}-{index}"
        yield "generated", Video(name, mesh, made.camera_matrix, made.poses, made.symmetries, made.frames())


def photographs(data: Path) -> Iterator[tuple[str, Video]]:
    """Photographs of dino, each followed by the nearest one that is left."""
    dataset = BOPDataset(data / "bop" / "dino")
    samples = [dataset.annotation(k) for k in range(len(dataset))]
    poses = torch.eye(4, dtype=torch.float64).repeat(len(samples), 1, 1)
    poses[:, :3, :3] = torch.stack([s["rotation"] for s in samples]).double()
    poses[:, :3, 3] = torch.stack([s["translation"] for s in samples]).double()
    mesh = cr.load_mesh(samples[0]["model_path"], unit="mm")
    for number, order in enumerate(chains(poses[:, :3, :3], LARGEST_GAP)):
        frames = (read_image(samples[k]["image_path"], dtype=torch.uint8) for k in order)
        K = samples[order[0]]["camera_matrix"].double()
        yield "dino", Video(f"dino-{number}", mesh, K, poses[order], torch.eye(3, dtype=torch.float64)[None], frames)


def chains(rotations: Tensor, largest: float) -> list[list[int]]:
    """Orders of at least three rotations (N, 3, 3), each followed by the nearest that is left, if it is near."""
    left, found = list(range(len(rotations))), []
    while left:
        order = [left.pop(0)]
        while left:
            errors = cr.rotation_error(rotations[order[-1]], rotations[left])
            if float(errors.min()) > largest:
                break
            order.append(left.pop(int(errors.argmin())))
        found.append(order)
    return [order for order in found if len(order) >= 3]


def curvireg_tracker(video: Video, registrar: cr.Registrar) -> Tracker:
    follow, started = Follower(registrar, video.K), False

    def track(frame: Tensor) -> Tensor | None:
        nonlocal started
        if not started:
            follow.start(frame, video.poses[0])
            started = True
            return video.poses[0]
        result = follow(frame)
        return result.transform if result.ok else None

    return track


def rapid_tracker(video: Video) -> Tracker:
    rapid, last = Rapid(video.mesh), None

    def track(frame: Tensor) -> Tensor | None:
        nonlocal last
        if last is None:
            last = video.poses[0]
            return last
        T = rapid(frame, video.K, last)
        last = last if T is None else T
        return T

    return track


def follow_video(video: Video, trackers: dict[str, Tracker]) -> dict[str, Row]:
    """Of each method and each frame but the first: error in degrees and as a fraction (None if lost), and seconds."""
    names = ("degrees", "fraction", "seconds")
    found: dict[str, Row] = {method: {name: [] for name in names} for method in trackers}
    centre = mesh_centre(video.mesh)
    for number, (frame, truth) in enumerate(zip(video.frames, video.poses, strict=True)):
        for method, track in trackers.items():
            start = time.perf_counter()
            T = track(frame)
            seconds = time.perf_counter() - start
            if number == 0:
                continue
            errors: tuple[float | None, float | None] = (None, None)
            if T is not None:
                turn = cr.rotation_error(T[:3, :3], truth[:3, :3] @ video.symmetries).min()
                place, true_place = (P[:3, :3] @ centre + P[:3, 3] for P in (T, truth))
                errors = float(turn), float((place - true_place).norm() / true_place.norm())
            for name, value in zip(names, (*errors, seconds), strict=True):
                found[method][name].append(value)
    return found


def row_of(kind: str, video: Video) -> Row:
    registrar = cr.Registrar(cached_bank(video.mesh, progress=False))
    trackers = {"curvireg": curvireg_tracker(video, registrar)}
    if AVAILABLE:
        trackers["cv2.rapid"] = rapid_tracker(video)
    steps = cr.rotation_error(video.poses[1:, :3, :3], video.poses[:-1, :3, :3])
    row = {"set": kind, "name": video.name, "threads": torch.get_num_threads(), "steps": steps.tolist()}
    return row | {"methods": follow_video(video, trackers)}


def record_of(rows: list[Row]) -> Row:
    """Counts, steps, and the results of each method for each set."""
    record: Row = {"commit": commit(), "date": today(), "threads": max(row["threads"] for row in rows), "sets": {}}
    for kind in SETS:
        mine = [row for row in rows if row["set"] == kind]
        if not mine:
            continue
        steps = [step for row in mine for step in row["steps"]]
        one: Row = {"sequences": len(mine), "frames": len(steps), "step": [median(steps), max(steps)], "methods": {}}
        for method in METHODS:
            if results := [row["methods"][method] for row in mine if method in row["methods"]]:
                one["methods"][method] = summary(results)
        record["sets"][kind] = one
    return record


def summary(results: list[Row]) -> Row:
    """Fractions of right and lost frames, of sequences whose last frame is right, and frames per second."""
    right = [[is_right(*pair) for pair in zip(one["degrees"], one["fraction"], strict=True)] for one in results]
    frames = [frame for one in right for frame in one]
    seconds = [s for one in results for s in one["seconds"]]
    return {
        "frames": len(frames),
        "right": sum(frames) / len(frames),
        "lost": sum(degrees is None for one in results for degrees in one["degrees"]) / len(frames),
        "last frame right": sum(one[-1] for one in right) / len(right),
        "frames per second": len(seconds) / sum(seconds),
        "median seconds": median(seconds),
    }


def is_right(degrees: float | None, fraction: float | None) -> bool:
    return degrees is not None and fraction is not None and degrees <= DEGREES and fraction <= FRACTION


def table(record: Row) -> str:
    """Markdown of the record."""
    header = ["frames", "method", "N", "within 5° and 5 %", "lost", "last frame right", "frames per second"]
    cells = [header]
    for kind, one in record["sets"].items():
        for method, found in one["methods"].items():
            shares = [f"{found[name]:.2f}" for name in ("right", "lost", "last frame right")]
            cells.append(
                [SETS[kind], f"`{method}`", str(found["frames"]), *shares, f"{found['frames per second']:.1f}"]
            )
    steps = "; ".join(
        f"{SETS[kind]}: {one['sequences']} sequences, steps of {one['step'][0]:.1f}° (median) to {one['step'][1]:.1f}°"
        for kind, one in record["sets"].items()
    )
    last = f"{steps}. Threads of torch: {record['threads']}; {record['date']}, commit {record['commit']}."
    return "\n".join([*table_lines(cells), "", last, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", metavar="BENCH")
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--sequences", type=int, default=30)
    parser.add_argument("--frames", type=int, default=60, help="of each sequence")
    parser.add_argument("--seed", type=int, default=27)
    parser.add_argument("--real", type=Path, metavar="DATA")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--table", action="store_true", help="write record and table")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    rows = [json.loads(line) for line in options.rows.read_text().splitlines()] if options.rows.exists() else []
    if options.table:
        record = record_of(rows)
        write_json(RECORD, record)
        update_page(PAGE, "follow", table(record))
        print(table(record))
        return
    if not AVAILABLE:
        print(ABSENT)
    done = {row["name"] for row in rows}
    if options.real:
        videos = photographs(options.real)
    else:
        todo = [k for k in range(options.sequences) if f"{options.seed}-{k}" not in done]
        videos = generated(options.folder, options.half, todo, options.frames, options.seed)
    with options.rows.open("a") as file:
        for kind, video in tqdm(videos, unit="sequence"):
            if video.name not in done:
                file.write(json.dumps(row_of(kind, video)) + "\n")
                file.flush()


if __name__ == "__main__":
    main()
