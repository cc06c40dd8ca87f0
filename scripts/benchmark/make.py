"""Render photographs with known poses in BOP's layout, for `curvireg evaluate bop`.

    python scripts/benchmark/make.py --kind printed --count 300 --out /data/printed [--jobs 2]
    python scripts/benchmark/make.py --kind shelf --objects 8 20 --cameras 3 --out /data/shelf
    python scripts/benchmark/make.py --kind furniture --meshes /data/furniture --out /data/chairs

--kind: ``printed`` packages, whose labels alone tell their sides apart; ``furniture`` of meshes.py;
``shapes``, the procedural families of scripts/scenes; ``tied`` ones, of which several poses look
the same from most sides; ``shelf``, several printed packages side by side, all annotated. --models
packages or shapes are there to choose from; a shelf has --objects LOW HIGH of them. A scene has one
photograph, or one for each of --cameras, or --frames of a moving camera. --cut LOW HIGH puts a
fraction of the object outside the photograph; of a target that does not stand on a shelf
--occlusion LOW HIGH is hidden; --bare is the fraction of the objects that get one uniform colour.
To calibrate confidence, --cad annotates an object as another one: similar, of its kind; wrong, any
other; print, a package of the same shape with another print; mirrored, a tied shape's mirror image;
variant, the shape with one part folded, moved, left out, or of another size. Scene i depends only
on the seed, --models and i; an interrupted run can be resumed. Boxes are exact: ``bbox_obj`` of the
whole silhouette inside the picture, ``bbox_visib`` of its visible part. OUT/benchmark.json holds
the options, and the group of each object for scripts/calibration.
"""

import shutil
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.mesh import mesh_symmetries
from scripts._shared import Record, in_processes, read_json, run, write_json
from scripts.scenes.families import FAMILIES, random_shape
from scripts.scenes.materials import random_texture
from scripts.scenes.packages import package
from scripts.scenes.scene import SIZE, Scene, View, camera_path, cut, shelf, simulate_camera, single
from scripts.scenes.surfaces import Array, Rng, middle_of
from scripts.scenes.textured import Placed, TexturedMesh, plain_texture
from scripts.scenes.tied import FAMILIES as TIED_FAMILIES
from scripts.scenes.tied import tied_shape

# fraction of the surface that has the same material after a symmetry of the appearance
SAME_LOOK = 0.97
TWINS = ("print", "mirrored", "variant")
"""Of these an object is annotated as another one, which has its number and ``TWIN``."""

TWIN = 100_000
ATTEMPTS = 60  # at a scene of which as much is hidden as is asked for
COARSE = 5  # times smaller, a picture from which an attempt is given up
MIN_PIXELS = 400  # of a silhouette; smaller ones are not annotated
PART_AREA = (0.08, 0.5)  # fraction of the surface that differs in a variant
# factor between the proportions of similar objects; if none is within it, the closest is taken
MAX_PROPORTION = 1.6
# symmetries about z of a body of revolution, whose azimuth is undefined: it is excluded
FULL_TURN = 12


class Packages:
    """Printed packages; object k depends only on the seed and k. A twin has another print."""

    def __init__(self, options: Namespace) -> None:
        self.seed = options.seed
        self.cad = options.cad
        self.ids = list(range(1, options.models + 1))

    @property
    def written(self) -> list[int]:
        """Objects with a mesh file."""
        return [k + TWIN for k in self.ids] if self.cad in TWINS else self.ids

    def rng(self, purpose: int, obj_id: int) -> Rng:
        """Random numbers of an object, others for each purpose."""
        return np.random.default_rng((self.seed, purpose, obj_id))

    @lru_cache(maxsize=100)  # noqa: B019 (lives as long as its process)
    def mesh(self, obj_id: int) -> TexturedMesh:
        other = self.rng(2, obj_id) if obj_id >= TWIN else None
        return package(self.rng(0, obj_id % TWIN), other)

    def symmetries(self, obj_id: int) -> Array:
        return np.eye(3)[None]

    def group(self, obj_id: int) -> str:
        return f"{obj_id}"

    def similar(self, obj_id: int, rng: Rng) -> int:
        raise SystemExit("--cad similar: printed packages have no kinds; take --kind furniture")

    def clutter(self, rng: Rng) -> TexturedMesh:
        return self.mesh(rng.choice(self.ids))

    def texture(self, rng: Rng) -> Array:
        """Of walls and floors."""
        return random_texture(rng)


class Shapes(Packages):
    """Procedural shapes of several materials; object k is of family k modulo their number, and half
    are uniform."""

    families: Sequence[str] = tuple(FAMILIES)

    @lru_cache(maxsize=100)  # noqa: B019
    def mesh(self, obj_id: int) -> TexturedMesh:
        rng = self.rng(3, obj_id)
        vertices, faces, materials = random_shape(rng, self.group(obj_id))
        paints = [plain_texture(rng) for _ in range(materials.max() + 1)]
        size = np.exp(rng.uniform(np.log(0.05), np.log(1.0)))
        mesh = TexturedMesh.from_arrays(size * vertices, faces, paints, paint=materials)
        return mesh.recoloured(paints[0]) if rng.random() < 0.5 else mesh

    @lru_cache(maxsize=1000)  # noqa: B019
    def symmetries(self, obj_id: int) -> Array:
        """Those of shape and materials."""
        mesh = self.mesh(obj_id)
        solid = trimesh.Trimesh(**trimesh.triangles.to_kwargs(mesh.triangles))
        points, faces = trimesh.sample.sample_surface(solid, 4000, seed=0)
        tree = cKDTree(points)
        paint = mesh.paint[faces]
        kept = []
        for S in mesh_symmetries(solid).numpy():
            _, nearest = tree.query(points @ S[:3, :3].T + S[:3, 3])
            if (paint[nearest] == paint).mean() > SAME_LOOK:
                kept.append(S[:3, :3])
        return np.stack(kept)

    def group(self, obj_id: int) -> str:
        return self.families[obj_id % len(self.families)]

    def similar(self, obj_id: int, rng: Rng) -> int:
        others = [k for k in self.ids if k != obj_id and self.group(k) == self.group(obj_id)]
        return int(rng.choice(others))


class Variants(Shapes):
    """Shapes of several parts, annotated as others of which one part differs."""

    def __init__(self, options: Namespace) -> None:
        super().__init__(options)
        self.ids = [k for k in self.ids if len(self._parts(k))]

    @lru_cache(maxsize=100)  # noqa: B019
    def mesh(self, obj_id: int) -> TexturedMesh:
        mesh = super().mesh(obj_id % TWIN)
        return self._changed(mesh, obj_id) if obj_id >= TWIN else mesh

    @lru_cache(maxsize=1000)  # noqa: B019
    def _parts(self, obj_id: int) -> list[Array]:
        """Of each part of a shape that is neither tiny nor most of it, (F,) whether a face is of
        it."""
        _, _, materials = random_shape(self.rng(3, obj_id), self.group(obj_id))
        area = trimesh.triangles.area(super().mesh(obj_id).triangles)
        low, high = PART_AREA
        parts = [materials == number for number in np.unique(materials)]
        return [part for part in parts if low <= area[part].sum() / area.sum() <= high]

    def _changed(self, mesh: TexturedMesh, obj_id: int) -> TexturedMesh:
        """The mesh with one part folded by 35 to 100 degrees, moved by 0.2 to 0.5 radii, left out,
        or 0.5 to 1.6 times as large."""
        rng = self.rng(5, obj_id)
        parts = self._parts(obj_id % TWIN)
        part = parts[rng.integers(len(parts))]
        change = rng.choice(["folded", "moved", "left out", "another size"])
        if change == "left out":
            columns = ("triangles", "normals", "uv", "paint")
            return replace(mesh, **{name: getattr(mesh, name)[~part] for name in columns})
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        turn = np.eye(3)
        shift = np.zeros(3)
        if change == "folded":
            angle = np.radians(rng.uniform(35.0, 100.0))
            turn = rotation_from_axis_angle(torch.from_numpy(axis * angle)).numpy()
        elif change == "moved":
            shift = axis * mesh.radius * rng.uniform(0.2, 0.5)
        else:
            smaller = rng.uniform(0.5, 0.75)
            larger = rng.uniform(1.3, 1.6)
            turn = turn * rng.choice([smaller, larger])
        own = mesh.triangles[part]
        rest = mesh.triangles[~part].reshape(-1, 3)
        points = own.reshape(-1, 3)
        joint = points[cKDTree(rest).query(points)[0].argmin()]  # where the part is attached
        triangles = mesh.triangles.copy()
        triangles[part] = (own - joint) @ turn.T + joint + shift
        normals = mesh.normals.copy()
        normals[part] = normals[part] @ turn.T
        return replace(mesh, triangles=triangles, normals=normals)


class Tied(Shapes):
    """Shapes of one colour that are nearly symmetric; all poses but one are wrong."""

    def __init__(self, options: Namespace) -> None:
        super().__init__(options)
        self.families = ("handed",) if options.cad == "mirrored" else tuple(TIED_FAMILIES)

    @lru_cache(maxsize=100)  # noqa: B019
    def mesh(self, obj_id: int) -> TexturedMesh:
        rng = self.rng(4, obj_id % TWIN)
        vertices, faces = tied_shape(rng, self.group(obj_id % TWIN))
        if obj_id >= TWIN:
            vertices = vertices * (-1.0, 1.0, 1.0)
            faces = faces[:, ::-1]
        paint = plain_texture(rng)
        return TexturedMesh.from_arrays(rng.uniform(0.03, 0.3) * vertices, faces, [paint])

    symmetries = Packages.symmetries


class Furniture(Packages):
    """The meshes that meshes.py has catalogued."""

    def __init__(self, options: Namespace) -> None:
        listing = read_json(options.meshes / "meshes.json")
        rows = listing["meshes"]
        self.folder = options.meshes
        self.turns = np.array(listing["turns"])
        about_z = {k for k, R in enumerate(self.turns) if R[2, 2] > 0.99}
        good = [m for m in rows if min(m["extents"]) > 0.08 * max(m["extents"])]
        good = [m for m in good if len(set(m["look_symmetries"]) & about_z) < FULL_TURN]
        self.surroundings = [m for m in rows if m["faces"] < 6000]
        self.rows = dict(enumerate(good, 1))
        self.seed = options.seed
        self.ids = list(self.rows)
        if options.cad == "similar":
            self.ids = [k for k in self.rows if self._siblings(k)]
        folders = [(self.folder / row["path"]).parent for row in rows]
        pictures = sorted(path for folder in folders for path in folder.glob("*.jpg"))
        self.photographs = [path for path in pictures if path.stat().st_size > 8000]
        self.names = "shape_symmetries" if options.cad == "similar" else "look_symmetries"

    @property
    def written(self) -> list[int]:
        return list(self.rows)

    @lru_cache(maxsize=100)  # noqa: B019
    def _load(self, path: str) -> TexturedMesh:
        return TexturedMesh.load(self.folder / path)

    def mesh(self, obj_id: int) -> TexturedMesh:
        return self._load(self.rows[obj_id]["path"])

    def symmetries(self, obj_id: int) -> Array:
        return np.asarray(self.turns[self.rows[obj_id][self.names]], float)

    def group(self, obj_id: int) -> str:
        return self.rows[obj_id]["kind"] or self.rows[obj_id]["like"]

    def _siblings(self, obj_id: int) -> list[int]:
        own = self.rows[obj_id]
        return [
            other
            for other, row in self.rows.items()
            if own["kind"] and row["kind"] == own["kind"] and row["like"] != own["like"]
        ]

    def similar(self, obj_id: int, rng: Rng) -> int:
        own = self._proportions(obj_id)
        gaps = {
            other: np.exp(np.abs(own - self._proportions(other)).max())
            for other in self._siblings(obj_id)
        }
        limit = max(MAX_PROPORTION, min(gaps.values()))
        return int(rng.choice([k for k, gap in gaps.items() if gap <= limit]))

    def _proportions(self, obj_id: int) -> Array:
        sides = np.array(self.rows[obj_id]["extents"])
        return np.log(sides / np.linalg.norm(sides))

    def clutter(self, rng: Rng) -> TexturedMesh:
        return self._load(self.surroundings[rng.integers(len(self.surroundings))]["path"])

    def texture(self, rng: Rng) -> Array:
        """Half of them are pictures of the catalogue."""
        if not self.photographs or rng.random() < 0.5:
            return random_texture(rng)
        picture = cv2.imread(str(self.photographs[rng.integers(len(self.photographs))]))
        if picture is None:
            return random_texture(rng)
        picture = cv2.resize(picture, (512, 512), interpolation=cv2.INTER_AREA)[..., ::-1]
        return (picture / 255.0).astype(np.float32) ** 2.2


KINDS = {
    "printed": Packages,
    "shelf": Packages,
    "furniture": Furniture,
    "shapes": Shapes,
    "tied": Tied,
}


def model_row(objects: Packages, folder: Path, obj_id: int) -> Record:
    """Write the model of an object, a PLY file in mm with one texture, unless it exists; its row of
    models_info."""
    mesh = objects.mesh(obj_id)
    path = folder / f"obj_{obj_id:06d}.ply"
    if not path.exists():
        mesh.save_ply(path)
    low = 1000.0 * mesh.hull.min(axis=0)
    size = 1000.0 * mesh.hull.max(axis=0) - low
    row = {"diameter": 1000.0 * pdist(mesh.hull).max()}
    for k, axis in enumerate("xyz"):
        row[f"min_{axis}"] = low[k]
        row[f"size_{axis}"] = size[k]
    discrete = []
    for S in objects.symmetries(obj_id)[1:]:
        T = np.eye(4)
        T[:3, :3] = S
        T[:3, 3] = 1000.0 * (mesh.centre - S @ mesh.centre)
        discrete.append(T.round(6).ravel().tolist())
    if discrete:
        row["symmetries_discrete"] = discrete
    return row


Annotated = dict[int, tuple[int, TexturedMesh]]
"""Of each object of a scene: what it is annotated as, obj_id and mesh."""


def compose(
    objects: Packages,
    options: Namespace,
    index: int,
    attempt: int,
) -> tuple[Scene, Annotated]:
    """Scene ``index``, a different one at each ``attempt``."""
    rng = np.random.default_rng((options.seed, index, attempt))
    if options.kind == "shelf":
        scene, annotated = full_shelf(objects, options, rng)
    else:
        scene, annotated = lone_object(objects, options, index, attempt, rng)
    if options.frames > 1:
        points = np.concatenate([shape.hull for shape in scene.annotated])
        views = camera_path(scene.views[0], middle_of(points), options.frames, rng)
        scene = replace(scene, views=views)
    return scene, annotated


def full_shelf(objects: Packages, options: Namespace, rng: Rng) -> tuple[Scene, Annotated]:
    low, high = options.objects
    count = min(rng.integers(low, high + 1), len(objects.ids))
    chosen = rng.choice(objects.ids, count, replace=False).tolist()
    annotated = {k: (k, objects.mesh(k)) for k in chosen}
    scene = shelf(
        list(annotated.values()),
        objects.texture,
        rng,
        occlusion=options.occlusion[1],
        cameras=options.cameras,
    )
    return scene, annotated


def lone_object(
    objects: Packages,
    options: Namespace,
    index: int,
    attempt: int,
    rng: Rng,
) -> tuple[Scene, Annotated]:
    """Objects take turns, in a random order."""
    order = np.random.default_rng((options.seed, 1)).permutation(len(objects.ids))
    shown = objects.ids[order[index % len(order)]]
    mesh = objects.mesh(shown)
    if options.bare and rng.random() < options.bare:
        mesh = mesh.recoloured(plain_texture(rng))
    scene = single(
        mesh,
        shown,
        objects.clutter,
        objects.texture,
        rng,
        upright=index % 2 == 0,
        occluded=(rng.random() < 0.3 and attempt < 12) or options.occlusion[0] > 0.0,
        cameras=options.cameras,
    )
    named = shown
    if options.cad == "similar":
        named = objects.similar(shown, rng)
    elif options.cad in TWINS:
        named = shown + TWIN
    elif options.cad == "wrong":
        own = objects.group(shown)
        named = int(rng.choice([k for k in objects.ids if objects.group(k) != own]))
    if options.cut:
        fraction = rng.uniform(*options.cut)
        hull = scene.shapes[0].hull
        views = [cut(view, hull, fraction, rng) for view in scene.views]
        scene = replace(scene, views=views)
    return scene, {shown: (named, objects.mesh(named))}


def make_scene(objects: Packages, options: Namespace, index: int) -> None:
    """Write scene ``index`` unless it exists."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    folder = options.out / "test" / f"{index:06d}"
    if folder.exists():
        return
    for attempt in range(ATTEMPTS):
        scene, annotated = compose(objects, options, index, attempt)
        low, high = options.occlusion
        if options.kind != "shelf" and low > 0.0 and hidden_of(scene) < low:
            continue
        pictures = [scene.render(view, SIZE) for view in scene.views]
        seen = np.array([picture.seen.sum(axis=(1, 2)) for picture in pictures])
        whole = np.array([picture.whole.sum(axis=(1, 2)) for picture in pictures])
        hidden = 1.0 - seen / np.maximum(whole, 1)
        in_sight = options.kind == "shelf" or low <= hidden.min() <= hidden.max() <= high
        if in_sight and (whole[:, 0] >= MIN_PIXELS).all():
            break
    else:
        raise RuntimeError(f"scene {index}: --occlusion is missed by every attempt")
    part = folder.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    (part / "rgb").mkdir(parents=True)
    truths = {}
    infos = {}
    cameras = {}
    for k, (view, picture) in enumerate(zip(scene.views, pictures, strict=True)):
        seed = (options.seed, index, 0 if options.frames > 1 else k)  # one camera takes all frames
        image = simulate_camera(picture.linear, np.random.default_rng(seed))
        cv2.imwrite(str(part / "rgb" / f"{k:06d}.png"), image[..., ::-1])
        cameras[k] = camera_row(scene, view)
        truths[k] = []
        infos[k] = []
        masks = zip(scene.annotated, picture.seen, picture.whole, strict=True)
        for shape, seen_mask, whole_mask in masks:
            if whole_mask.sum() >= MIN_PIXELS:
                truths[k].append(truth_row(shape, view, annotated))
                infos[k].append(info_row(seen_mask, whole_mask))
    for name, content in (("gt", truths), ("camera", cameras), ("gt_info", infos)):
        write_json(part / f"scene_{name}.json", content)
    part.rename(folder)


def hidden_of(scene: Scene) -> float:
    """Fraction of the first object that is hidden in the first view, from a small picture of it."""
    R, t, K = scene.views[0]
    shrink = np.diag([1.0 / COARSE, 1.0 / COARSE, 1.0])
    H, W = SIZE
    picture = scene.render((R, t, shrink @ K), (H // COARSE, W // COARSE))
    return 1.0 - picture.seen[0].sum() / max(picture.whole[0].sum(), 1)


def camera_row(scene: Scene, view: View) -> Record:
    """A view in ``scene_camera.json``."""
    R, t, K = view
    mm = 1000.0 / scene.annotated[0].scale
    return {
        "cam_K": K.ravel().tolist(),
        "depth_scale": 1.0,
        "cam_R_w2c": R.ravel().tolist(),
        "cam_t_w2c": (mm * t).tolist(),
    }


def truth_row(shape: Placed, view: View, annotated: Annotated) -> Record:
    """An object of a view in ``scene_gt.json``."""
    R, t, _ = view
    obj_id, mesh = annotated[shape.obj_id]
    rotation, translation = shape.pose(R, t)
    translation = translation + rotation @ (shape.mesh.centre - mesh.centre)
    return {
        "cam_R_m2c": rotation.ravel().tolist(),
        "cam_t_m2c": (1000.0 * translation).tolist(),
        "obj_id": obj_id,
    }


def info_row(seen: Array, whole: Array) -> Record:
    """An object of a view in ``scene_gt_info.json``, by its masks with the others and without."""
    count = int(whole.sum())
    visible = int(seen.sum())
    return {
        "bbox_obj": _box(whole),
        "bbox_visib": _box(seen),
        "px_count_all": count,
        "px_count_visib": visible,
        "px_count_valid": count,
        "visib_fract": visible / count,
    }


def _box(mask: Array) -> list[int]:
    """BOP's x, y, width, height in px between the centres of the outermost pixels; -1 four times
    for none."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return [x, y, width - 1, height - 1] if width else [-1, -1, -1, -1]


def write_targets(out: Path, occlusion: float) -> int:
    """List the instances that are visible enough in BOP's ``test_targets_bop19.json``; their
    number."""
    targets = []
    for folder in sorted((out / "test").iterdir()):
        if not folder.name.isdecimal():  # begun
            continue
        truths = read_json(folder / "scene_gt.json")
        infos = read_json(folder / "scene_gt_info.json")
        for key in sorted(truths, key=int):
            for truth, info in zip(truths[key], infos[key], strict=True):
                is_visible = info["visib_fract"] >= 1.0 - occlusion
                if is_visible and min(info["bbox_visib"][2:]) >= 1:
                    target = {"scene_id": int(folder.name), "im_id": int(key)}
                    targets.append(target | {"obj_id": truth["obj_id"], "inst_count": 1})
    write_json(out / "test_targets_bop19.json", targets)
    return len(targets)


def main(
    *,
    kind: Literal[*KINDS] = "printed",
    count: int = 300,
    seed: int = 29,
    out: Path,
    models: int = 60,
    meshes: Path | None = None,
    cad: Literal["exact", "similar", "wrong", "print", "mirrored", "variant"] = "exact",
    bare: float = 0.0,
    objects: tuple[int, int] = (8, 20),
    occlusion: tuple[float, float] = (0.0, 0.6),
    cut: tuple[float, float] | None = None,
    cameras: int = 1,
    frames: int = 1,
    jobs: int = 1,
) -> None:
    options = Namespace(**locals())
    known = (Variants if cad == "variant" else KINDS[kind])(options)
    (out / "test").mkdir(parents=True, exist_ok=True)
    folder = out / "models"
    folder.mkdir(exist_ok=True)
    ids = known.written
    rows = dict(in_processes(partial(model_row, known, folder), ids, jobs, "models"))
    write_json(folder / "models_info.json", {obj_id: rows[obj_id] for obj_id in ids})
    list(in_processes(partial(make_scene, known, options), range(count), jobs, "scenes"))
    kept = {name: value for name, value in vars(options).items() if name not in ("out", "jobs")}
    kept["meshes"] = meshes and str(meshes)
    kept["groups"] = {obj_id: known.group(obj_id % TWIN) for obj_id in ids}
    write_json(out / "benchmark.json", kept)
    print(f"{write_targets(out, occlusion[1])} targets in {count} scenes in {out}")


if __name__ == "__main__":
    run(main)
