#!/usr/bin/env python
"""Photographs of real textured meshes with truth, to choose settings on: of what benchmark_meshes.py has fetched.

Picture i is a function of seed and i (and of the meshes). Four forms take turns: the CAD of the object itself or of
another object of its kind, standing upright or thrown into any orientation. Rooms, light with shadows, clutter,
occluders and a camera are drawn at random; a fifth of the objects are bare. A stopped run goes on where it was.

    python scripts/benchmark/make.py --out /data/benchmark [--half held-out] [--count 1200] [--jobs 2]

OUT/<half>/items.jsonl has a line for each picture: OUT/README.md says what is in it.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch
from tqdm import tqdm

from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.geometry.cameras import rotation_towards
from curvireg_torch.rendering.embree import RayScene
from curvireg_torch.training.scenes.camera_noise import simulate_camera
from curvireg_torch.training.scenes.light import random_light, shade_points
from curvireg_torch.training.scenes.materials import random_colour, random_picture
from curvireg_torch.training.scenes.rotations import random_rotation
from scripts.benchmark.textured import Textured

FORMS = [(cad, pose) for cad in ("exact", "sibling") for pose in ("upright", "free")]
SIZES = [(320, 320), (320, 400), (360, 480), (400, 320), (400, 400)]  # rows, columns
LEAST_SEEN = 0.35
PROPORTIONS = 1.6
"""Siblings' boxes differ by no more than this factor where there is such a sibling; else the closest is taken."""

ROUND = 12
"""Turns by 30 degrees about z that a body of revolution has: it has no azimuth to be found."""


FORMAT = """# Photographs of textured meshes, with truth

`meshes.json`: the meshes and where they come from. `meshes/<id>/model.obj`: z up, front along -y, metres, with MTL and
textures. `<half>/items.jsonl`: one photograph a line.

| key | meaning |
|---|---|
| `id`, `seed` | picture number and seed; ids 0 to 299 are a sample of all forms |
| `form` | `exact`: `mesh` is the object; `sibling`: `mesh` is another one of its kind |
| `pose` | `upright`, or `free`: any orientation |
| `image`, `size` | file below `<half>/`; rows, columns |
| `mesh` | the CAD to register, below the folder of this file |
| `shown`, `name`, `kind` | the object in the picture |
| `box` | x0, y0, x1, y1 in px as drawn by hand: 1.2 % off; hidden parts included, cut at the border |
| `box_exact`, `box_visible` | of the whole silhouette inside the picture; of what is seen of it |
| `K`, `R`, `t` | camera (pixel (0, 0) is a pixel's middle), model -> camera; `t` in metres, of `shown` |
| `symmetries` | turns S, identity first, with R S as right as R: of the look if `exact`, else of either shape |
| `visible` | share of the silhouette that is seen; `occluded` where below 0.9 |
| `clutter`, `bare` | number of other things; whether the object's colours were painted over |

Error: the smallest angle between the answer and R S. The meshes keep their own licences: see `meshes.json`.
"""


class Meshes:
    """The half's list, and its files as they are asked for."""

    def __init__(self, out: Path, half: str) -> None:
        listing = json.loads((out / "meshes.json").read_text())
        self.out, self.turns = out, np.array(listing["turns"])
        about_z = [k for k, R in enumerate(self.turns) if R[2, 2] > 0.99]
        self.all = [m for m in listing["meshes"] if m["half"] == half]
        self.good = [m for m in self.all if m["extents"][2] > 0 and min(m["extents"]) > 0.08 * max(m["extents"])]
        self.good = [m for m in self.good if len(set(m["look_symmetries"]) & set(about_z)) < ROUND]
        self.clutter = [m for m in self.all if m["faces"] < 6000]
        self.kinds = {}
        for kind in sorted({m["kind"] for m in self.good if m["kind"]}):
            members = [m for m in self.good if m["kind"] == kind]
            if len({m["like"] for m in members}) > 1:
                self.kinds[kind] = members
        textures = [p for m in self.all for p in sorted((out / m["path"]).parent.glob("*.jpg"))]
        self.textures = [p for p in textures if p.stat().st_size > 8000]

    @lru_cache(maxsize=120)  # noqa: B019 (lives as long as its process)
    def load(self, path: str) -> Textured:
        return Textured.load(self.out / path)

    def texture(self, rng: np.random.Generator) -> np.ndarray:
        """(T, T, 3) linear colours: one of the half's own pictures, or one made in code."""
        if rng.random() < 0.12:
            return random_picture(rng, 128)
        while True:
            picture = cv2.imread(str(self.textures[rng.integers(len(self.textures))]))
            if picture is not None:
                picture = cv2.resize(picture, (256, 256), interpolation=cv2.INTER_AREA)[..., ::-1]
                return (picture / 255.0).astype(np.float32) ** 2.2


def proportions_apart(one: list[float], other: list[float]) -> float:
    """Largest factor between the sides of two boxes whose diagonals are made equal."""
    a, b = (np.array(side) / np.linalg.norm(side) for side in (one, other))
    return float(np.exp(np.abs(np.log(a / b)).max()))


def plan(meshes: Meshes, seed: int, index: int) -> dict:
    """Which object, which CAD, and how: a function of seed and index."""
    cad, pose = FORMS[index % 4]
    rng = np.random.default_rng((seed, index))
    if cad == "exact":
        order = np.random.default_rng((seed, 1)).permutation(len(meshes.good))
        shown = wanted = meshes.good[order[(index // 4 + 7 * (pose == "free")) % len(order)]]
    else:
        names = list(meshes.kinds)
        share = np.array([min(len({m["like"] for m in meshes.kinds[n]}), 8) for n in names], float)
        members = meshes.kinds[names[rng.choice(len(names), p=share / share.sum())]]
        shown = members[rng.integers(len(members))]
        others = [m for m in members if m["like"] != shown["like"]]
        gaps = [proportions_apart(m["extents"], shown["extents"]) for m in others]
        others = [m for m, gap in zip(others, gaps, strict=True) if gap <= max(PROPORTIONS, min(gaps))]
        wanted = others[rng.integers(len(others))]
    return {"cad": cad, "pose": pose, "shown": shown, "wanted": wanted, "rng": rng}


def ground_and_walls(meshes: Meshes, toward: np.ndarray, rng: np.random.Generator) -> list[Textured]:
    """Floor, and up to two walls on the far side; ``toward`` is the direction to the camera in the plane."""
    reach = float(rng.choice([3.0, 8.0, 40.0]))
    floor = Textured.plane([(-reach, -reach, 0), (reach, -reach, 0), (reach, reach, 0), (-reach, reach, 0)])
    made = [floor.papered(meshes.texture(rng), reach / rng.uniform(0.5, 3.0))]
    for _ in range(int(rng.choice([0, 1, 1, 2]))):
        back = -toward + rng.normal(0, 0.5, 2)
        back = back / np.linalg.norm(back)
        side, far, high = np.array([-back[1], back[0]]), rng.uniform(1.2, 5.0), rng.uniform(2.0, 8.0)
        a, b = back * far - 12 * side, back * far + 12 * side
        wall = Textured.plane([(*a, 0), (*b, 0), (*b, high), (*a, high)])
        made.append(wall.papered(meshes.texture(rng), 12 / rng.uniform(0.7, 4.0)))
    return made


def scene_camera(obj: Textured, size: tuple[int, int], rng: np.random.Generator):
    """World -> camera rotation and shift, and K: the object's box has the wanted side and lies in the picture."""
    H, W = size
    focal = 0.5 * max(H, W) / np.tan(np.radians(rng.uniform(22, 60)) / 2)
    K = np.array([[focal, 0, (W - 1) / 2], [0, focal, (H - 1) / 2], [0, 0, 1.0]])
    azimuth, elevation = rng.uniform(0, 360), rng.choice([rng.uniform(-4, 25), rng.uniform(5, 60)])
    R = rotation_from_viewpoint(azimuth, elevation, rng.normal(0, 4)).numpy()
    pixel = np.array([W * rng.uniform(0.38, 0.62), H * rng.uniform(0.4, 0.62), 1.0])
    ray = np.linalg.inv(K) @ pixel
    ray /= np.linalg.norm(ray)
    R = rotation_towards(torch.from_numpy(ray)).numpy() @ R
    wanted = rng.uniform(100, min(250, 0.8 * min(H, W)))
    points = obj.points()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    distance = 4.0
    for _ in range(12):
        placed = (points - middle) @ R.T + distance * ray
        flat = placed[:, :2] / np.maximum(placed[:, 2:], 0.05) * focal
        distance *= np.ptp(flat, axis=0).max() / wanted if placed[:, 2].min() > 0.05 else 1.5
        distance = max(distance, 1.25)
    return R, distance * ray - R @ middle, K


def clutter_around(meshes: Meshes, reach: float, eye: np.ndarray, count: int, occluder: bool, rng) -> list[Textured]:
    """Other meshes on the floor; an occluder stands between the object and the camera."""
    made = []
    for k in range(count + occluder):
        row = meshes.clutter[rng.integers(len(meshes.clutter))]
        try:
            other = meshes.load(row["path"])
        except Exception:  # a file that its reader refuses is no clutter; the object's own would stop the script
            continue
        scale = float(np.exp(rng.uniform(-0.9, 0.4))) * (0.6 if k >= count else 1.0)
        turn = random_rotation(rng) if rng.random() < 0.15 else None
        other = other.standing(turn, scale, rng.uniform(0, 2 * np.pi))
        own = 0.5 * float(np.linalg.norm(np.ptp(other.points(), axis=0)[:2]))
        if k >= count:
            direction = eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9)
            aside = np.array([-direction[1], direction[0]]) * rng.uniform(-0.8, 0.8)
            where = direction * (reach + own + rng.uniform(0.05, 0.4)) + aside
            if np.linalg.norm(eye[:2] - where) < own + 0.6:
                continue
        else:
            angle = rng.uniform(0, 2 * np.pi)
            direction = np.array([np.cos(angle), np.sin(angle)])
            where = direction * (reach + own + rng.exponential(0.7))
            if np.linalg.norm(eye[:2] - where) < own + 1.0:
                continue
        made.append(other.shifted((*where, 0.0)))
    return made


def draw(household: list[Textured], R, t, K, size, rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear picture (H, W, 3); where the first thing is seen; where it would be seen alone."""
    H, W = size
    fine = 1.25
    h, w = round(fine * H), round(fine * W)
    zoom = np.array([[w / W, 0, 0.5 * (w / W - 1)], [0, h / H, 0.5 * (h / H - 1)], [0, 0, 1.0]])
    M = np.linalg.inv(zoom @ K)
    v, u = np.mgrid[0:h, 0:w].reshape(2, -1)
    rays = (np.stack([u, v, np.ones(len(u))], -1) @ M.T).astype(np.float32)
    start = np.zeros_like(rays)
    placed = [thing.with_pose_prior(R, t) for thing in household]
    first = np.cumsum([0, *(len(p.triangles) for p in placed)])
    triangles = np.concatenate([p.triangles for p in placed])
    scene = RayScene(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    depth, hit_triangle, _ = scene.hits(start, rays)
    hit = np.flatnonzero(np.isfinite(depth))
    points = rays[hit] * depth[hit, None]
    numbers = hit_triangle[hit]
    owner = np.searchsorted(first, numbers, side="right") - 1
    colour, normal = np.zeros_like(points), np.zeros_like(points)
    gloss, shine = np.zeros(len(hit)), np.ones(len(hit))
    for k in np.unique(owner):
        here = owner == k
        colour[here], normal[here], gloss[here] = placed[k].surface(numbers[here] - first[k], points[here])
        shine[here] = np.exp(rng.uniform(1.5, 5.0))
        gloss[here] *= rng.uniform(0, 1.5)
    view = -points / np.linalg.norm(points, axis=1, keepdims=True)
    normal *= np.sign((normal * view).sum(axis=1, keepdims=True) + 1e-12)
    light = shade_points(scene, points, normal, colour, np.clip(gloss, 0, 1), shine, random_light(R[:, 2], rng))
    side = max(h, w)
    picture = random_picture(rng, side)[:h, :w].reshape(-1, 3).astype(np.float32)
    picture[hit] = light
    seen = np.zeros(h * w, np.float32)
    seen[hit[owner == 0]] = 1.0
    flat = placed[0].points() @ (zoom @ K).T
    flat = flat[:, :2] / flat[:, 2:]
    near = (
        ((u >= flat[:, 0].min() - 1) & (u <= flat[:, 0].max() + 1))
        & (v >= flat[:, 1].min() - 1)
        & (v <= flat[:, 1].max() + 1)
    )
    whole = np.zeros(h * w, np.float32)
    whole[near] = np.isfinite(placed[0].rays().distance(start[near], rays[near]))

    def shrunk(x: np.ndarray) -> np.ndarray:
        return cv2.resize(x.reshape(h, w, -1), (W, H), interpolation=cv2.INTER_AREA)

    return shrunk(picture), shrunk(seen) > 0.5, shrunk(whole) > 0.5


def outline(mask: np.ndarray) -> list[float]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [float(columns[0]) - 0.5, float(rows[0]) - 0.5, float(columns[-1]) + 0.5, float(rows[-1]) + 0.5]


def make(meshes: Meshes, seed: int, index: int) -> tuple[np.ndarray, dict]:
    what = plan(meshes, seed, index)
    rng, shown, wanted, upright = what["rng"], what["shown"], what["wanted"], what["pose"] == "upright"
    bare = bool(rng.random() < 0.2)
    size = SIZES[rng.integers(len(SIZES))]
    model = meshes.load(shown["path"])
    turn = np.eye(3) if upright else random_rotation(rng)
    radius, centre = model.radius_and_centre()
    obj = model.standing(turn, 1.0, 0.0)
    if bare:
        obj = obj.painted(random_colour(rng))
    for attempt in range(20):
        R, t, K = scene_camera(obj, size, rng)
        eye = -R.T @ t
        points = obj.points()
        reach = float(np.linalg.norm(points[:, :2], axis=1).max())
        crowd, covered = int(rng.choice([0, 1, 3, 5])), bool(rng.random() < 0.3 and attempt < 12)
        household = [obj]
        if eye[2] > 0.05 and rng.random() < 0.9:
            household += ground_and_walls(meshes, eye[:2] / (np.linalg.norm(eye[:2]) + 1e-9), rng)
        household += clutter_around(meshes, 0.8 * reach, eye, crowd, covered, rng)
        picture, seen, whole = draw(household, R, t, K, size, rng)
        if whole.sum() < 400:
            continue
        visible = float(seen.sum() / whole.sum())
        if visible >= LEAST_SEEN:
            break
    else:
        raise RuntimeError(f"{index}: {shown['id']} stays hidden")
    image = simulate_camera(picture, rng)
    exact = np.array(outline(whole))
    side = np.tile(exact[2:] - exact[:2], 2)
    box = np.clip(exact + rng.normal(0, 0.012, 4) * side, -0.5, [size[1] - 0.5, size[0] - 0.5] * 2)
    # Truth: model (metres, own frame) -> camera; the object was centred, scaled to radius 1, turned, put on the floor.
    pose = R @ turn
    shift = model.placement(turn)
    translation = (R @ shift + t) * radius - pose @ centre
    names = "look_symmetries" if wanted is shown else "shape_symmetries"
    alike = sorted(set(shown[names]) | set(wanted[names]))
    item = {
        "id": index,
        "form": what["cad"],
        "pose": what["pose"],
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
        "symmetries": meshes.turns[alike].astype(float).round(9).tolist(),
        "visible": round(visible, 3),
        "clutter": len(household) - 1,
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
    parser.add_argument("--half", choices=("held-out", "train"), default="held-out")
    parser.add_argument("--count", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    folder = arguments.out / arguments.half
    (folder / "images").mkdir(parents=True, exist_ok=True)
    context = get_context("spawn")
    listing = folder / "items.jsonl"
    lines = listing.read_text().splitlines(keepends=True) if listing.exists() else []
    done = {json.loads(line)["id"] for line in lines if line.endswith("\n")}  # a stopped run goes on
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
    (arguments.out / "README.md").write_text(FORMAT)


if __name__ == "__main__":
    main()
