"""Render photographs of real textured meshes with known poses, from the meshes that meshes.py has fetched.

Picture i depends only on the seed, i and the meshes. Four forms alternate: the CAD model to register is that of the
object itself or of another object of its kind, and the object stands upright or has any orientation. Rooms, light with
shadows, clutter, occluders and the camera are random; a fifth of the objects have a uniform colour. An interrupted run
can be resumed.

    python scripts/benchmark/make.py --out /data/benchmark [--half held-out] [--count 1200] [--jobs 2]

OUT/<half>/items.jsonl has one line per picture; OUT/README.md explains its keys.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from shutil import copyfile

import cv2
import numpy as np
import torch
from tqdm import tqdm

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.cameras import rotation_towards
from curvireg_torch.training.scenes.materials import random_colour, random_picture
from curvireg_torch.training.scenes.rotations import random_rotation
from curvireg_torch.training.scenes.scene import simulate_camera
from scripts.benchmark.textured import TexturedMesh, render

FORMS = [(cad, pose) for cad in ("exact", "sibling") for pose in ("upright", "free")]
SIZES = [(320, 320), (320, 400), (360, 480), (400, 320), (400, 400)]  # rows, columns
MIN_VISIBLE = 0.35
MAX_PROPORTION = 1.6
"""Largest factor between the proportions of siblings; if no sibling is within it, the closest one is taken."""

FULL_TURN = 12
"""A mesh with so many symmetries about z is a body of revolution, whose azimuth is undefined. It is excluded."""


class Meshes:
    """Meshes of one half of the catalogue, loaded on demand."""

    def __init__(self, out: Path, half: str) -> None:
        listing = json.loads((out / "meshes.json").read_text())
        self.out, self.rotations = out, np.array(listing["turns"])
        about_z = [k for k, R in enumerate(self.rotations) if R[2, 2] > 0.99]
        self.all = [m for m in listing["meshes"] if m["half"] == half]
        self.good = [m for m in self.all if min(m["extents"]) > 0.08 * max(m["extents"])]
        self.good = [m for m in self.good if len(set(m["look_symmetries"]) & set(about_z)) < FULL_TURN]
        self.clutter = [m for m in self.all if m["faces"] < 6000]
        self.kinds = {}
        for kind in sorted({m["kind"] for m in self.good if m["kind"]}):
            members = [m for m in self.good if m["kind"] == kind]
            if len({m["like"] for m in members}) > 1:
                self.kinds[kind] = members
        textures = [p for m in self.all for p in sorted((out / m["path"]).parent.glob("*.jpg"))]
        self.textures = [p for p in textures if p.stat().st_size > 8000]

    @lru_cache(maxsize=120)  # noqa: B019 (lives as long as its process)
    def load(self, path: str) -> TexturedMesh:
        return TexturedMesh.load(self.out / path)

    def texture(self, rng: np.random.Generator) -> np.ndarray:
        """(T, T, 3) linear colours: a texture of the half's meshes, or a random picture."""
        if rng.random() < 0.12 or not self.textures:
            return random_picture(rng, 128)
        while True:
            picture = cv2.imread(str(self.textures[rng.integers(len(self.textures))]))
            if picture is not None:
                picture = cv2.resize(picture, (256, 256), interpolation=cv2.INTER_AREA)[..., ::-1]
                return (picture / 255.0).astype(np.float32) ** 2.2


def proportion_gap(one: list[float], other: list[float]) -> float:
    """Largest factor between the sides of two boxes scaled to equal diagonals."""
    a, b = (np.array(side) / np.linalg.norm(side) for side in (one, other))
    return float(np.exp(np.abs(np.log(a / b)).max()))


def plan(meshes: Meshes, seed: int, index: int) -> dict:
    """Choose the object, the CAD model to register and the form of picture ``index``."""
    cad, pose = FORMS[index % 4]
    cad = cad if meshes.kinds else "exact"
    rng = np.random.default_rng((seed, index))
    if cad == "exact":
        order = np.random.default_rng((seed, 1)).permutation(len(meshes.good))
        shown = wanted = meshes.good[order[(index // 4 + 7 * (pose == "free")) % len(order)]]
    else:
        names = list(meshes.kinds)
        weight = np.array([min(len({m["like"] for m in meshes.kinds[n]}), 8) for n in names], float)
        members = meshes.kinds[names[rng.choice(len(names), p=weight / weight.sum())]]
        shown = members[rng.integers(len(members))]
        others = [m for m in members if m["like"] != shown["like"]]
        gaps = [proportion_gap(m["extents"], shown["extents"]) for m in others]
        others = [m for m, gap in zip(others, gaps, strict=True) if gap <= max(MAX_PROPORTION, min(gaps))]
        wanted = others[rng.integers(len(others))]
    return {"cad": cad, "pose": pose, "shown": shown, "wanted": wanted, "rng": rng}


def ground_and_walls(meshes: Meshes, toward: np.ndarray, rng: np.random.Generator) -> list[TexturedMesh]:
    """A floor and up to two walls on the far side; ``toward`` (2,) is the horizontal direction to the camera."""
    reach = float(rng.choice([3.0, 8.0, 40.0]))
    floor = TexturedMesh.plane([(-reach, -reach, 0), (reach, -reach, 0), (reach, reach, 0), (-reach, reach, 0)])
    surfaces = [floor.with_texture(meshes.texture(rng), reach / rng.uniform(0.5, 3.0))]
    for _ in range(int(rng.choice([0, 1, 1, 2]))):
        back = -toward + rng.normal(0, 0.5, 2)
        back = back / np.linalg.norm(back)
        side, far, high = np.array([-back[1], back[0]]), rng.uniform(1.2, 5.0), rng.uniform(2.0, 8.0)
        a, b = back * far - 12 * side, back * far + 12 * side
        wall = TexturedMesh.plane([(*a, 0), (*b, 0), (*b, high), (*a, high)])
        surfaces.append(wall.with_texture(meshes.texture(rng), 12 / rng.uniform(0.7, 4.0)))
    return surfaces


def scene_camera(obj: TexturedMesh, size: tuple[int, int], rng: np.random.Generator):
    """R and t (world -> camera) and K such that the object's box has a random size and lies in the picture."""
    H, W = size
    focal = 0.5 * max(H, W) / np.tan(np.radians(rng.uniform(22, 60)) / 2)
    K = np.array([[focal, 0, (W - 1) / 2], [0, focal, (H - 1) / 2], [0, 0, 1.0]])
    azimuth, elevation = rng.uniform(0, 360), rng.choice([rng.uniform(-4, 25), rng.uniform(5, 60)])
    R = rotation_from_viewpoint(azimuth, elevation, rng.normal(0, 4)).numpy()
    pixel = np.array([W * rng.uniform(0.38, 0.62), H * rng.uniform(0.4, 0.62), 1.0])
    ray = np.linalg.inv(K) @ pixel
    ray /= np.linalg.norm(ray)
    R = rotation_towards(torch.from_numpy(ray)).numpy() @ R
    side = rng.uniform(100, min(250, 0.8 * min(H, W)))
    points = obj.hull_points()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    distance = 4.0
    for _ in range(12):
        placed = (points - middle) @ R.T + distance * ray
        flat = placed[:, :2] / np.maximum(placed[:, 2:], 0.05) * focal
        distance *= np.ptp(flat, axis=0).max() / side if placed[:, 2].min() > 0.05 else 1.5
        distance = max(distance, 1.25)
    return R, distance * ray - R @ middle, K


def clutter_around(
    meshes: Meshes, reach: float, eye: np.ndarray, count: int, occluder: bool, rng
) -> list[TexturedMesh]:
    """Other meshes on the floor; an occluder stands between the object and the camera."""
    clutter = []
    for k in range(count + occluder):
        row = meshes.clutter[rng.integers(len(meshes.clutter))]
        try:
            other = meshes.load(row["path"])
        except Exception:  # unreadable files are not used as clutter
            continue
        scale = float(np.exp(rng.uniform(-0.9, 0.4))) * (0.6 if k >= count else 1.0)
        rotation = random_rotation(rng) if rng.random() < 0.15 else None
        other = other.standing(rotation, scale, rng.uniform(0, 2 * np.pi))
        radius = 0.5 * float(np.linalg.norm(np.ptp(other.hull_points(), axis=0)[:2]))
        if k >= count:
            direction = eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9)
            aside = np.array([-direction[1], direction[0]]) * rng.uniform(-0.8, 0.8)
            position = direction * (reach + radius + rng.uniform(0.05, 0.4)) + aside
            if np.linalg.norm(eye[:2] - position) < radius + 0.6:
                continue
        else:
            angle = rng.uniform(0, 2 * np.pi)
            direction = np.array([np.cos(angle), np.sin(angle)])
            position = direction * (reach + radius + rng.exponential(0.7))
            if np.linalg.norm(eye[:2] - position) < radius + 1.0:
                continue
        clutter.append(other.translated((*position, 0.0)))
    return clutter


def outline(mask: np.ndarray) -> list[float]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [float(columns[0]) - 0.5, float(rows[0]) - 0.5, float(columns[-1]) + 0.5, float(rows[-1]) + 0.5]


def make(meshes: Meshes, seed: int, index: int) -> tuple[np.ndarray, dict]:
    chosen = plan(meshes, seed, index)
    rng, shown, wanted, upright = chosen["rng"], chosen["shown"], chosen["wanted"], chosen["pose"] == "upright"
    bare = bool(rng.random() < 0.2)
    size = SIZES[rng.integers(len(SIZES))]
    model = meshes.load(shown["path"])
    rotation = np.eye(3) if upright else random_rotation(rng)
    radius, centre = model.radius_and_centre()
    obj = model.standing(rotation, 1.0, 0.0)
    if bare:
        obj = obj.with_colour(random_colour(rng))
    for attempt in range(20):
        R, t, K = scene_camera(obj, size, rng)
        eye = -R.T @ t
        points = obj.hull_points()
        reach = float(np.linalg.norm(points[:, :2], axis=1).max())
        count, occluder = int(rng.choice([0, 1, 3, 5])), bool(rng.random() < 0.3 and attempt < 12)
        shapes = [obj]
        if eye[2] > 0.05 and rng.random() < 0.9:
            shapes += ground_and_walls(meshes, eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9), rng)
        shapes += clutter_around(meshes, 0.8 * reach, eye, count, occluder, rng)
        picture, seen, whole = render(shapes, R, t, K, size, rng)
        if whole.sum() < 400:
            continue
        visible = float(seen.sum() / whole.sum())
        if visible >= MIN_VISIBLE:
            break
    else:
        raise RuntimeError(f"{index}: {shown['id']} is hidden in every attempt")
    image = simulate_camera(picture, rng)
    exact = np.array(outline(whole))
    side = np.tile(exact[2:] - exact[:2], 2)
    box = np.clip(exact + rng.normal(0, 0.012, 4) * side, -0.5, [size[1] - 0.5, size[0] - 0.5] * 2)
    # True pose, model (metres) -> camera: the object was centred, scaled to radius 1, rotated and put on the floor.
    pose = R @ rotation
    translation = (R @ model.floor_offset(rotation) + t) * radius - pose @ centre
    names = "look_symmetries" if wanted is shown else "shape_symmetries"
    symmetries = sorted(set(shown[names]) | set(wanted[names]))
    item = {
        "id": index,
        "form": chosen["cad"],
        "pose": chosen["pose"],
        "image": f"images/{index:05d}.jpg",
        "size": list(size),
        "kind": shown["kind"],
        "mesh": wanted["path"],
        "shown": shown["path"],
        "name": shown["name"],
        "box": box.round(2).tolist(),
        "box_exact": exact.tolist(),
        "box_visible": outline(seen),
        "K": K.tolist(),
        "R": pose.round(9).tolist(),
        "t": translation.round(6).tolist(),
        "symmetries": meshes.rotations[symmetries].astype(float).round(9).tolist(),
        "visible": round(visible, 3),
        "clutter": len(shapes) - 1,
        "occluded": visible < 0.9,
        "bare": bare,
        "seed": seed,
    }
    return image, item


_meshes: Meshes | None = None


def _start(out: Path, half: str) -> None:
    global _meshes
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _meshes = Meshes(out, half)


def _one(task: tuple[int, int, Path]) -> dict:
    seed, index, folder = task
    image, item = make(_meshes, seed, index)
    cv2.imwrite(str(folder / item["image"]), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    return item


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--half", choices=("held-out", "train", "printed"), default="held-out")
    parser.add_argument("--count", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    folder = arguments.out / arguments.half
    (folder / "images").mkdir(parents=True, exist_ok=True)
    context = get_context("spawn")
    listing = folder / "items.jsonl"
    lines = listing.read_text().splitlines(keepends=True) if listing.exists() else []
    done = {json.loads(line)["id"] for line in lines if line.endswith("\n")}  # resume an interrupted run
    listing.write_text("".join(line for line in lines if line.endswith("\n")))
    tasks = [(arguments.seed, index, folder) for index in range(arguments.count) if index not in done]
    start = (arguments.out, arguments.half)
    with (
        ProcessPoolExecutor(arguments.jobs, mp_context=context, initializer=_start, initargs=start) as pool,
        listing.open("a") as file,
    ):
        for item in tqdm(pool.map(_one, tasks), total=len(tasks), desc="photographs"):
            file.write(json.dumps(item) + "\n")
            file.flush()
    copyfile(Path(__file__).with_name("FORMAT.md"), arguments.out / "README.md")


if __name__ == "__main__":
    main()
