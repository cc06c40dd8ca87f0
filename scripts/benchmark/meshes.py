#!/usr/bin/env python
"""Real textured meshes for the benchmark: fetched, unpacked, brought into one frame and catalogued.

The meshes are those of Debian's package sweethome3d-furniture 1.8-1: 820 OBJ with materials and textures; CC0, CC BY
3.0 and, model by model, what the package's ``copyright`` and the catalogue's ``license`` say. Nothing of them belongs
to this project: they stay in OUT. In OUT/meshes every object stands on its own with z up, its front along -y, in
metres. OUT/meshes.json lists name, kind, half (``held-out`` or ``train``: by a hash of the name; copies of held-out
ones are left out), licence, and the turns under which shape and look stay what they are.

    python scripts/benchmark/meshes.py --out /data/benchmark [--deb sweethome3d-furniture_1.8-1_all.deb]
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
import zipfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from tqdm import tqdm

from scripts.benchmark.textured import Textured, look_symmetries

PACKAGE = "sweethome3d-furniture"
SHA256 = "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668"
MOST_FACES, FLATTEST = 20_000, 0.04
LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}

DATASETS = {
    "chair": r"((oak|osaka|ryokan|cafe|folding|plastic|teck|child|children) )?chair|chair with cushion|class seat",
    "armchair": r"(modern |rattan |winchester )?armchair",
    "sofa": r"(burlap |clear |rattan |winchester )?(sofa|couch)( [23] seats)?|futon couch|convertible sofa bz",
    "bed": r"(child |iron |hospital |captain's |baby )?bed",
    "bench": r"(painted )?bench|wood bank",
    "bookcase": r"(full )?bookcase|shelves|vertical shelves",
    "cabinet": r"wardrobe|cupboard|dresser.*|drawers cabinet|(small )?lower cabinet|high cabinet|filing cabinet"
    r"|bedside table|sink cabinet|glass door cabinet",
    "cooker": r"(double |small )?oven|(large )?stove|cooker|microwave|(clothes )?washing machine|dryer machine"
    r"|(large )?fridge|refrigerator",
    "washbasin": r"washbasin|vanity",
    "toilet": r"toilets unit",
    "car": r"chevrolet|concept sedan.*|ford focus|peugeot.*|renault.*|suv|seat leon|smart car|vw new beetle|van"
    r"|car model",
    "bus": r"(city )?bus",
    "bicycle": r"bicycle|bike",
    "standing person": r"female|male|boy|girl|mannequin.*|holding.*",
    "screen": r"tv( 16:9)?|wall flat tv|apple imac.*",
    "laptop": r"laptop|apple ibook",
}
"""Objects of one kind have one front and one build: looked at on contact sheets, and kinds left out where it is not so
(animals, cups, desks, two-wheelers with an engine, bathtubs, pianos, shoes, people who sit). Others have no kind."""

UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""From the catalogue's frame (y up, front +z) to ours (z up, front -y)."""


def fetched(source: Path, package: str, sha256: str) -> Path:
    """The package's file in ``source``, downloaded where it is not there: of no other edition."""
    source.mkdir(parents=True, exist_ok=True)
    if not list(source.glob(f"{package}_*.deb")):
        subprocess.run(["apt-get", "download", package], cwd=source, check=True)
    return checked(next(iter(source.glob(f"{package}_*.deb"))), sha256)


def checked(deb: Path, sha256: str) -> Path:
    found = hashlib.sha256(deb.read_bytes()).hexdigest()
    if found != sha256:
        sys.exit(f"{deb}: another edition (sha256 {found}); the benchmark's list is that of {sha256}")
    return deb


def fetch(out: Path, deb: Path | None) -> Path:
    """Folder with the unpacked libraries."""
    source = out / "source"
    deb = fetched(source, PACKAGE, SHA256) if deb is None else checked(deb, SHA256)
    unpacked = source / "unpacked"
    if not (unpacked / "done").exists():
        unpacked.mkdir(parents=True, exist_ok=True)
        subprocess.run(["dpkg-deb", "-x", deb.resolve(), unpacked], check=True)
        for archive in unpacked.rglob("*.sh3f"):
            with zipfile.ZipFile(archive) as file:
                file.extractall(unpacked / archive.stem)
        (unpacked / "done").touch()
    return unpacked


def catalogue(unpacked: Path) -> list[dict]:
    rows = []
    for library in sorted(LICENCES):
        entries: dict[int, dict[str, str]] = {}
        text = (unpacked / library / "PluginFurnitureCatalog.properties").read_text(encoding="latin1")
        for name, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
            entries.setdefault(int(number), {})[name] = value.encode("latin1").decode("unicode_escape").strip()
        for _, entry in sorted(entries.items()):
            name = re.sub(r"\W+", "-", f"{library}-{Path(entry['model']).stem}").lower()
            rows.append(
                {
                    "id": name,
                    "name": entry["name"],
                    "category": entry["category"],
                    "licence": entry.get("license") or LICENCES[library],
                    "creator": entry.get("creator", library),
                    "source": f"{library}{entry['model']}",
                    "turn": [float(x) for x in entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()],
                    "size": [float(entry[k]) / 100 for k in ("width", "depth", "height")],
                }
            )
    return rows


def kind_of(name: str) -> str | None:
    return next((kind for kind, pattern in DATASETS.items() if re.fullmatch(pattern, name.lower())), None)


def convert(row: dict, unpacked: Path, folder: Path) -> str | None:
    """Write the object in our frame: the file's own lines, with other coordinates. The answer is why not, or None."""
    source = unpacked / row["source"]
    lines = source.read_text(encoding="latin1").splitlines()
    if sum(len(line.split()) - 3 for line in lines if line.startswith("f ")) > MOST_FACES:
        return "many faces"
    points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    R = UP @ np.array(row["turn"]).reshape(3, 3)
    turned = points @ R.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    if (high - low).min() < FLATTEST * (high - low).max():
        return "flat"
    if (folder / "model.obj").exists():
        return None
    zoom = max(row["size"]) / (high - low).max()
    shift = np.array([*(-0.5 * (low + high)[:2]), -low[2]])
    turned = iter((turned + shift) * zoom)
    written = []
    folder.mkdir(parents=True, exist_ok=True)
    for line in lines:
        if line.startswith("v "):
            line = "v {:.6g} {:.6g} {:.6g}".format(*next(turned))
        elif line.startswith("vn "):
            line = "vn {:.5g} {:.5g} {:.5g}".format(*(R @ np.array(line.split()[1:4], dtype=float)))
        written.append(line)
    for other in source.parent.iterdir():
        if other.is_file() and other.suffix.lower() != ".obj":
            (folder / other.name).write_bytes(other.read_bytes())
    part = folder / "model.obj.part"  # complete when it bears its name: a second run goes on where the first stopped
    part.write_text("\n".join(written) + "\n", encoding="latin1")
    part.replace(folder / "model.obj")
    return None


def turns() -> np.ndarray:
    """(32, 3, 3): none, the 23 other turns of a cube, and those by 30 degrees about z that are not among them."""
    signs = [np.diag(s) for s in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T.astype(float)]
    orders = [np.eye(3)[list(p)] for p in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))]
    cube = [s @ o for o in orders for s in signs if np.linalg.det(s @ o) > 0]
    cube.sort(key=lambda R: -np.trace(R))
    about_z = []
    for k in range(1, 12):
        if k % 3:
            c, s = np.cos(np.pi * k / 6), np.sin(np.pi * k / 6)
            about_z.append(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
    return np.array(cube + about_z)


def samples(model: Textured) -> np.ndarray:
    """Many points of the surface about the middle of its box, in radii."""
    radius, centre = model.radius_and_centre()
    corners = model.triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    return (np.asarray(trimesh.sample.sample_surface(mesh, 20_000, seed=0)[0]) - centre) / radius


def symmetries(points: np.ndarray) -> list[int]:
    """Numbers of the turns that leave the shape where it was: nine tenths of its points within 4 % of the radius."""
    tree = cKDTree(points)

    def fits(R: np.ndarray, some: np.ndarray) -> bool:
        return float(np.mean(np.isfinite(tree.query(some @ R.T, distance_upper_bound=0.04)[0]))) >= 0.9

    return [k for k, R in enumerate(turns()) if fits(R, points[::400]) and fits(R, points[::16])]


def copy_of(cloud: np.ndarray, others: dict[str, tuple[np.ndarray, cKDTree]]) -> str | None:
    """Name of the first of the others that has the same shape, to 4 % of the radius for nine tenths of the points."""
    span, some = np.ptp(cloud, axis=0), cloud[::16]
    for name, (extents, tree) in others.items():
        near = np.abs(extents - span).max() < 0.03
        if near and np.isfinite(tree.query(some, distance_upper_bound=0.04)[0]).mean() >= 0.9:
            return name
    return None


def half_of(name: str) -> str:
    return "held-out" if hashlib.sha256(name.encode()).digest()[0] % 2 == 0 else "train"


def examine(task: tuple[dict, Path, Path]) -> tuple[dict, str | None, np.ndarray | None]:
    """Convert one object and find its symmetries: its row, why it is left out, and points of its surface."""
    row, unpacked, out = task
    folder = out / "meshes" / row["id"]
    reason = convert(row, unpacked, folder)
    if reason is not None:
        return row, reason, None
    try:
        model = Textured.load(folder / "model.obj")
    except Exception as error:  # whatever the reader meets in a file
        return row, f"unreadable ({type(error).__name__})", None
    cloud = samples(model)
    described = {
        **{k: row[k] for k in ("id", "name", "category", "licence", "creator", "source")},
        "kind": kind_of(row["name"]),
        **measured(row["id"], model, cloud),
    }
    return described, None, cloud


def measured(name: str, model: Textured, cloud: np.ndarray) -> dict:
    """What make_benchmark.py asks of the mesh ``name`` in the folder meshes, whose surface has these points."""
    alike = symmetries(cloud)
    return {
        "path": f"meshes/{name}/model.obj",
        "faces": len(model.triangles),
        "extents": np.ptp(model.points(), axis=0).round(4).tolist(),
        "shape_symmetries": alike,
        "look_symmetries": look_symmetries(model, alike, turns()),
    }


def write_listing(out: Path, listing: dict) -> None:
    part = out / "meshes.json.part"
    part.write_text(json.dumps(listing, indent=1))
    part.replace(out / "meshes.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--deb", type=Path, help="the package's file; default: apt-get download")
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    unpacked = fetch(arguments.out, arguments.deb)
    once = {row["id"]: row for row in reversed(catalogue(unpacked))}  # some are listed twice
    listing = {"package": PACKAGE, "sha256": SHA256, "turns": turns().tolist(), "meshes": [], "left_out": {}}
    kept: dict[str, tuple[np.ndarray, cKDTree]] = {}
    for half in ("held-out", "train"):
        tasks = [(row, unpacked, arguments.out) for name, row in sorted(once.items()) if half_of(name) == half]
        with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
            answers = list(tqdm(pool.map(examine, tasks), desc=half, total=len(tasks)))
        for row, why, cloud in answers:
            like = None if why else copy_of(cloud, kept)
            if why is None and half == "train" and like is not None and half_of(like) == "held-out":
                why = "a copy of one held out"
            if why is not None:
                listing["left_out"][row["id"]] = why
                continue
            kept[row["id"]] = np.ptp(cloud, axis=0), cKDTree(cloud)
            listing["meshes"].append({**row, "half": half, "like": like or row["id"]})
        write_listing(arguments.out, listing)
        print(
            f"{half}: {sum(m['half'] == half for m in listing['meshes'])} meshes; left out {len(listing['left_out'])}"
        )


if __name__ == "__main__":
    main()
