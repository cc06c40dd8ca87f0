"""Give every command wrong inputs: each must end in a result or in one line of ours, within limits, never a traceback.

    python scripts/robustness/wrong_inputs.py                    # command lines with one mistake, then damaged files
    python scripts/robustness/wrong_inputs.py --damaged 5000     # more damaged files

``CASES`` holds command lines with one mistake each, and the word that the message must contain. Damaged files are good
photographs, meshes, cameras, banks and lists with bytes changed, cut, doubled or removed at random. Each runs in a
process with limits on time and memory. The record is scripts/results/wrong_inputs.json; exit code 1 if anything failed.
"""

import argparse
import json
import re
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from scripts._shared import RESULTS, commit, today, write_json

SECONDS, MEGABYTES = 20.0, 4000
"""Processor seconds and memory that a command may take."""

CASES = """
register lost.png truck.ply BOX => lost.png
register text.jpg truck.ply BOX => text.jpg
register empty.png truck.ply BOX => empty.png
register cut.png truck.ply BOX => cut.png
register flat.png truck.ply BOX => flat.png
register truck.ply truck.ply BOX => truck.ply
register photo.png lost.ply BOX => lost.ply
register photo.png text.obj BOX => text.obj
register photo.png nan.obj BOX => nan.obj
register photo.png points.obj BOX => points.obj
register photo.png cut.ply BOX => cut.ply
register photo.png truck.step BOX => truck.step
register photo.png truck.ply --box 1 2 3 => --box
register photo.png truck.ply --box 90 90 10 10 => box
register photo.png truck.ply --box nan 2 30 40 => box
register photo.png truck.ply --box 9000 9000 9100 9100 => box
register photo.png truck.ply BOX --camera 0 0 1 1 => camera
register photo.png truck.ply BOX --camera lost.json => lost.json
register photo.png truck.ply BOX --camera text.jpg => text.jpg
register photo.png truck.ply BOX --unit furlong => --unit
register photo.png truck.ply BOX --pose sideways => --pose
register photo.png truck.ply BOX --side bottomleft => --side
register photo.png truck.ply BOX --preset best => --preset
register photo.png truck.ply BOX --pipeline text.jpg => text.jpg
register photo.png truck.ply BOX --start lost.json => lost.json
register photo.png truck.ply BOX --distanc 3 => --distanc
register photo.png truck.ply BOX --device quantum => --device
register --list lost.csv truck.ply => lost.csv
register --list text.jpg truck.ply => text.jpg
evaluate bop lost => lost
evaluate bop empty => empty
evaluate pascal3d empty => empty
evaluate web empty => empty
evaluate bop empty --protocol box=often => --protocol
evaluate kitti empty => kitti
follow lost.mp4 truck.ply => lost.mp4
follow text.jpg truck.ply --camera 260 260 119.5 89.5 => text.jpg
bank lost.ply => lost.ply
frobnicate => frobnicate
"""


def write_files(folder: Path) -> None:
    """Write good and wrong inputs."""
    from curvireg_torch.synthetic import demo_scene, example_mesh

    scene = demo_scene()
    pixels = (255 * scene.image.permute(1, 2, 0).flip(2).numpy()).round().astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), cv2.resize(pixels, (240, 180), interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(folder / "photo.jpg"), cv2.imread(str(folder / "photo.png")))
    cv2.imwrite(str(folder / "flat.png"), np.full((60, 80, 3), 90, np.uint8))
    for name in ("truck.ply", "truck.obj", "truck.stl", "truck.off", "truck.glb"):
        example_mesh().export(folder / name)
    (folder / "camera.json").write_text('{"fx": 260, "fy": 260, "cx": 119.5, "cy": 89.5}')
    (folder / "photos.csv").write_text("photo,x0,y0,x1,y1\nphoto.png,30,25,210,160\n")
    for name in ("text.jpg", "text.obj", "truck.step"):
        (folder / name).write_text("not what the name says")
    (folder / "empty.png").touch()
    (folder / "empty").mkdir()
    for name in ("photo.png", "truck.ply"):
        data = (folder / name).read_bytes()
        (folder / name.replace("photo", "cut").replace("truck", "cut")).write_bytes(data[: len(data) // 2])
    (folder / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(5, 3))).export(folder / "points.ply")
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")


def limited() -> None:
    """Limit the process that is about to start."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(SECONDS) + 20, int(SECONDS) + 20))
    resource.setrlimit(resource.RLIMIT_DATA, (MEGABYTES << 20, MEGABYTES << 20))


def answer(line: str, folder: Path, expected: str | None) -> dict[str, Any]:
    """Run a command line; what is wrong with its answer is under ``failure``.

    ``expected`` must occur in the message; None accepts a result as well.
    """
    box = "--box 30 25 210 160"
    words = shlex.split(line.replace("BOX", box))
    words += ["--out", "out.safetensors" if line.startswith("bank") else "out"]
    start = time.perf_counter()
    command = [sys.executable, "-m", "curvireg_torch", *words]
    limit: dict[str, Any] = {"timeout": 10 * SECONDS, "preexec_fn": limited}
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=folder, **limit)
    except subprocess.TimeoutExpired:
        return {"line": line, "code": "timeout", "failure": "not done in time"}
    text = done.stderr.strip()
    found: dict[str, Any] = {"line": line, "code": done.returncode, "seconds": round(time.perf_counter() - start, 1)}
    if re.search(r"Traceback|site-packages|File \"", text) or done.returncode not in (0, 1, 2):
        found["failure"] = f"code {done.returncode}: {text[-400:]}"
    elif expected is not None and (done.returncode == 0 or expected not in text):
        found["failure"] = f"expected an error that names {expected}, got: {text[-400:]}"
    return found


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Change, cut, double or remove bytes at random places."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        at, length = int(rng.integers(len(out) + 1)), int(rng.integers(1, 40))
        kind = rng.integers(4)
        if kind == 0:
            out[at : at + length] = rng.bytes(length)
        elif kind == 1:
            end = len(out) if rng.random() < 0.3 else at + length
            del out[at:end]
        elif kind == 2:
            out[at:at] = out[max(0, at - length) : at]
        else:
            out[at : at + 1] = rng.choice([b"\x00", b"\xff", b"-", b"9", b"nan", b"1e999", b"\n"])
    return bytes(out)


DAMAGED = {
    "photo.png": "register {} truck.ply BOX",
    "photo.jpg": "register {} truck.ply BOX",
    "truck.ply": "register photo.png {} BOX",
    "truck.obj": "register photo.png {} BOX",
    "truck.stl": "register photo.png {} BOX",
    "truck.off": "register photo.png {} BOX",
    "truck.glb": "register photo.png {} BOX",
    "camera.json": "register photo.png truck.ply BOX --camera {}",
    "photos.csv": "register --list {} truck.ply",
}
"""Files that are damaged, and the command that reads them."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--damaged", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS / "wrong_inputs.json")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(options.jobs) as pool:
        folder = Path(temporary)
        write_files(folder)
        cases = [tuple(line.split(" => ")) for line in CASES.strip().splitlines()]
        answers = list(pool.map(lambda case: answer(case[0], folder, case[1]), cases))
        lines = []
        for k in range(options.damaged):
            rng = np.random.default_rng(k)
            name = list(DAMAGED)[k % len(DAMAGED)]
            damaged = folder / f"damaged{k}{Path(name).suffix}"
            damaged.write_bytes(damage((folder / name).read_bytes(), rng))
            lines.append(DAMAGED[name].format(damaged.name))
        answers += pool.map(lambda line: answer(line, folder, None), lines)
    failures = [found for found in answers if "failure" in found]
    record = {"date": today(), "commit": commit(), "cases": len(cases), "damaged": len(lines)}
    record |= {"codes": Counter(str(found["code"]) for found in answers), "failures": failures}
    write_json(options.out, record)
    print(json.dumps(record, indent=2))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
