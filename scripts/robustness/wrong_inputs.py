"""Give every command wrong inputs: each must end in a result or in one line of ours, within limits,
never a traceback.

    python scripts/robustness/wrong_inputs.py
    python scripts/robustness/wrong_inputs.py --damaged 5000     # files instead of 200

wrong_inputs.txt lists command lines, and files with one mistake each, and what the message must
contain. Damaged files are good photographs, meshes, cameras, banks and lists with bytes changed,
cut, doubled or removed at random. Each runs in a process with limits on time and memory. The record
is scripts/results/wrong_inputs.json; exit code 1 if anything failed.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from scripts._shared import RESULTS, Record, read_json, run, stamp, write_json

# processor seconds and memory that a command may take
SECONDS = 20.0
MEGABYTES = 4000

GIVEN = Path(__file__).with_name("given")
"""A folder of files of which most are wrong."""

GOOD = Path(__file__).with_name("good")
"""A folder of good cameras, lists and poses."""

LISTED = read_json(Path(__file__).with_name("commands.json"))
COMMANDS = LISTED["commands"]
"""The commands that read the good files which are no calibrations."""

DAMAGED = LISTED["damaged"]
"""Files that are damaged, and the command that reads them."""


def cases(folder: Path) -> list[tuple[str, str]]:
    """Write the inputs of wrong_inputs.txt into a folder; command lines, and what their messages
    must contain."""
    write_files(folder)
    shutil.copytree(GOOD, folder / "good")
    write_rig(folder / "good")
    found = []
    rows = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines()
    for number, row in enumerate(row for row in rows if row and row[0] != "#"):
        line, expected = row.split(" => ")
        if line.count("|") == 2:
            name, old, new = (part.strip() for part in line.split("|"))
            place = folder / f"bad{number}"
            file = name.partition(":")[0]
            shutil.copytree(folder / "good", place)
            text = (place / file).read_text()
            assert old == "*" or old in text, row
            (place / file).write_text(new if old == "*" else text.replace(old, new))
            command = COMMANDS.get(file, "register photo.png truck.ply BOX --camera {}")
            line = command.format(
                f"{place.name}/{name}", folder=f"{place.name}/{Path(name).parent}"
            )
        if "--out" not in line and not line.startswith(("view", "compare")):
            line += " --out out.safetensors" if line.startswith("bank") else " --out out"
        found.append((line.replace("BOX", "--box 30 25 210 160"), expected))
    return found


def write_rig(folder: Path) -> None:
    """Write a rig of photographs of the example mesh, two of which are equal."""
    from curvireg_torch.synthetic import demo_scene

    rows = ["photo,x0,y0,x1,y1,camera,qw,qx,qy,qz,tx,ty,tz"]
    for name, seed, box in (
        ("0.png", 2, "95,54,197,148"),
        ("1.png", 7, "75,59,208,155"),
        ("2.png", 2, ",,,"),
    ):
        scene = demo_scene(seed)
        write_picture(folder / name, scene.image)
        quaternion = Rotation.from_matrix(scene.truth[:3, :3].numpy()).as_quat(scalar_first=True)
        shift = [f"{v:.9f}e+00" for v in scene.truth[:3, 3].tolist()]
        rows.append(",".join([name, box, "camera.json", *map(str, quaternion), *shift]))
    (folder / "rig.csv").write_text("\n".join(rows))


def write_picture(path: Path, image: Tensor) -> None:
    """Write a generated photograph of a quarter of its size."""
    pixels = (255 * image.permute(1, 2, 0).flip(2).numpy()).round().astype(np.uint8)
    cv2.imwrite(str(path), cv2.resize(pixels, (240, 180), interpolation=cv2.INTER_AREA))


def write_files(folder: Path) -> None:
    """Write good and wrong inputs."""
    import curvireg_torch as cr
    from curvireg_torch.synthetic import demo_scene, example_mesh

    shutil.copytree(GIVEN, folder, dirs_exist_ok=True)
    shutil.copy(GOOD / "camera.json", folder)
    write_picture(folder / "photo.png", demo_scene().image)
    cv2.imwrite(str(folder / "photo.jpg"), cv2.imread(str(folder / "photo.png")))
    cv2.imwrite(str(folder / "flat.png"), np.full((60, 80, 3), 90, np.uint8))
    for name in ("truck.ply", "truck.obj", "truck.stl", "truck.off", "truck.glb"):
        example_mesh().export(folder / name)
    views = cr.sample_views(azimuth_step=90, elevations=[20])
    cr.ViewBank.build(example_mesh(), views, image_size=32, progress=False).save(
        folder / "truck.safetensors"
    )
    for name in ("empty", "0001"):
        (folder / name).mkdir()
    for name in ("photo.png", "truck.ply", "truck.safetensors"):
        data = (folder / name).read_bytes()
        half = folder / f"cut{Path(name).suffix}"
        half.write_bytes(data[: len(data) // 2])
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(5, 3))).export(folder / "points.ply")


def limited() -> None:
    """Limit the process that is about to start."""
    import resource  # not on Windows

    resource.setrlimit(resource.RLIMIT_CPU, (int(SECONDS) + 20, int(SECONDS) + 20))
    resource.setrlimit(resource.RLIMIT_DATA, (MEGABYTES << 20, MEGABYTES << 20))


def answer(line: str, folder: Path, expected: str | None) -> Record:
    """Run a command line; what is wrong with its answer is under ``failure``.

    ``expected`` must occur in the message; None accepts a result as well.
    """
    start = time.perf_counter()
    command = [sys.executable, "-m", "curvireg_torch", *shlex.split(line)]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            cwd=folder,
            timeout=10 * SECONDS,
            preexec_fn=limited,
        )
    except subprocess.TimeoutExpired:
        return {"line": line, "code": "timeout", "failure": "not done in time"}
    text = done.stderr.strip()
    seconds = round(time.perf_counter() - start, 1)
    found = {"line": line, "code": done.returncode, "seconds": seconds}
    if re.search(r"Traceback|site-packages|File \"", text) or done.returncode not in (0, 1, 2):
        found["failure"] = f"code {done.returncode}: {text[-400:]}"
    elif expected is not None and (done.returncode == 0 or expected not in text):
        found["failure"] = f"expected an error that names {expected}, got: {text[-400:]}"
    return found


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Change, cut, double or remove bytes at random places."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        at = int(rng.integers(len(out) + 1))
        length = int(rng.integers(1, 40))
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


def main(*, damaged: int = 200, jobs: int = 1) -> int:
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(jobs) as pool:
        folder = Path(temporary)
        wrong = cases(folder)
        answers = list(pool.map(lambda case: answer(case[0], folder, case[1]), wrong))
        lines = []
        for k, (name, line) in zip(range(damaged), cycle(DAMAGED.items()), strict=False):
            file = folder / f"damaged{k}{Path(name).suffix}"
            content = damage((folder / name).read_bytes(), np.random.default_rng(k))
            file.write_bytes(content)
            # lists do not share a folder
            lines.append(line.format(file.name).replace("--out out", f"--out out{k}"))
        answers += pool.map(lambda line: answer(line, folder, None), lines)
    failures = [found for found in answers if "failure" in found]
    record = stamp() | {"cases": len(wrong), "damaged": len(lines)}
    record |= {"codes": Counter(str(found["code"]) for found in answers), "failures": failures}
    write_json(RESULTS / "wrong_inputs.json", record)
    print(json.dumps(record, indent=2))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(run(main))
