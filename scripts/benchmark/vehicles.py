"""Fetch textured vehicles for a second benchmark: aircraft, ships, cars and trains, in one frame and catalogued.

The meshes are those of Debian's packages flightgear-data-ai and flightgear-data-models 2020.3.16 and torcs-data 1.3.7
(GPL-2, some Free Art: see the packages' ``copyright``), in AC3D files (.ac, .acc). They are not part of this project
and stay in OUT. BENCH is the folder of meshes.py, whose furniture serves as clutter and whose textures cover the rooms.
make.py --out OUT then photographs the vehicles.

    python scripts/benchmark/vehicles.py BENCH --out /data/vehicles
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree
from tqdm import tqdm

from scripts.benchmark.ac3d import Part, read_ac3d
from scripts.benchmark.meshes import (
    candidate_rotations,
    copy_of,
    describe,
    fetch_package,
    half_of,
    sample_points,
    write_listing,
)
from scripts.benchmark.textured import TexturedMesh

PACKAGES = {
    "flightgear-data-ai": "a86b2acbf99ff2d49698abd2a2f4bc28ab0cf5a744218b4ca4d8aede8a67dc2f",
    "flightgear-data-models": "e3f24a2e1b5fb34168aed4440e7cbfa41f8ce1196e42351abc5012f6e4263b4c",
    "torcs-data": "33a170ec9db8bdf7e33cb07b96b9854d5ef9e47b1f82705e4c24d6caaf13fb99",
}
MIN_FACES, MAX_FACES = 60, 45_000
TEXTURE = 512
"""Longer side of the stored textures in px."""

FIGHTERS = "buccaneer f15 f18 f4 ja37 jaguargr1 mig21bis mirage2000 eurofighter f14b f16 t38 vulcanb2 a4f ka6d"
PROPELLERS = (
    "a6m2 arups2 beechcraftstaggerwing dr400 dh82 diamondda42 cub cricri fk9mk2 fokkers11 dragonfly polikarpovi16 "
    "spitfire bf109 c172 c177 c182 c182rg c310 c310u3a ercoupe pa28 cessna337 cessna208caravan cessna421goldeneagle "
    "beech200 beech99 b1900d"
)
NO_KIND = (
    "flash2a bluebird spaceshuttle sr71 centrair101 lightning seahawk barge largetrawler trawler sailboat1 psc9 "
    "sailboatunderpower sailboatunderpower11m sailboatundersail car1ow1 buggy 110bus humveepickupodrablowpoly "
    "hoskoshti1500 tendera4 wagonore"
)
"""Vehicles of a unique build, or with detached parts, as checked by eye."""

AFT_UP = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
"""Rotation from FlightGear's AC3D frame (x aft, y up) to ours (z up, front -y)."""

FORE_UP = np.array([[0, 0, -1.0], [-1, 0, 0], [0, 1, 0]])
"""Rotation from TORCS's frame (x forward, y up) to ours."""


def fetch(out: Path) -> Path:
    """Download and unpack the packages; returns their folder."""
    source = out / "source"
    for package, sha256 in PACKAGES.items():
        deb = fetch_package(source, package, sha256)
        if not (source / package / "usr").exists():
            subprocess.run(["dpkg-deb", "-x", deb.resolve(), source / package], check=True)
    return source


def largest(folder: Path, unwanted: str = "light|prop|refuel|gear|pilot|wheel|shadow") -> list[Path]:
    """The largest AC3D file of a folder that is not a component of another."""
    files = [p for p in sorted(folder.rglob("*.ac")) if not re.search(unwanted, str(p.relative_to(folder)), re.I)]
    return sorted(files, key=lambda p: p.stat().st_size)[-1:]


def catalogue(source: Path) -> list[dict]:
    """Id, name, kind and file of every vehicle."""
    air = source / "flightgear-data-ai/usr/share/games/flightgear/AI/Aircraft"
    models = source / "flightgear-data-models/usr/share/games/flightgear/Models"
    cars = source / "torcs-data/usr/share/games/torcs/cars"
    files: list[tuple[str, str, Path]] = []
    for folder in sorted(air.iterdir()):
        if folder.is_dir() and folder.name not in ("balloon", "Ferry"):
            files += [("aircraft", folder.name, path) for path in largest(folder)]
    for name in ("A4-F", "KA6-D", "KC-130", "KC135"):
        files += [("aircraft", name, path) for path in largest(models / "Geometry" / name)]
    for folder in ("Civilian", "Military"):
        files += [("ship", path.stem, path) for path in sorted((models / "Maritime" / folder).rglob("*.ac"))]
    for name in ("sailboat1", "SanAntonio", "Clemenceau", "Nimitz"):
        files += [("ship", name, path) for path in largest(models / "Geometry" / name)]
    land = [*sorted((models / "Transport").glob("*.ac")), *sorted((models / "Military").glob("humvee*.ac"))]
    files += [("train", path.stem, path) for path in [*land, *sorted((models / "Airport/Vehicle").glob("*.ac"))]]
    files += [("car", path.stem, path) for path in sorted(cars.glob("*/*.acc")) if path.stem == path.parent.name]
    rows = []
    for group, name, path in files:
        short = re.sub(r"\W|_", "", name).lower()
        rows.append({"id": f"{group}-{short}", "name": name, "kind": kind_of(group, short), "file": path})
    return rows


def kind_of(group: str, name: str) -> str | None:
    if name in NO_KIND.split():
        return None
    if group != "aircraft":
        return group
    return "fighter" if name in FIGHTERS.split() else "propeller aircraft" if name in PROPELLERS.split() else "airliner"


def copy_texture(name: str | None, model: Path, folder: Path) -> str | None:
    """Copy a texture into ``folder`` and return its file name there; an airliner gets one of its liveries."""
    if name is None:
        return None
    short = Path(name).name
    root = next((p for p in model.parents if p.parent.name == "Aircraft"), model.parent)
    liveries = sorted(root.glob(f"Textures/*/{short}"))
    if liveries:
        paths = [liveries[int(hashlib.sha256(folder.name.encode()).hexdigest(), 16) % len(liveries)]]
    else:
        bases = [model.parent / name, model.parent / short, model.parent.parent / short]
        paths = [p for base in bases for p in (base, *map(base.with_suffix, (".png", ".rgb", ".jpg"))) if p.is_file()]
    for path in paths:
        try:
            picture = Image.open(path).convert("RGBA").convert("RGB")
        except OSError:
            continue
        picture.thumbnail((TEXTURE, TEXTURE))
        copied = re.sub(r"\W", "_", path.stem) + ".jpg"
        picture.save(folder / copied, quality=92)
        return copied
    return None


def wheels(car: Path) -> list[Part]:
    """Four wheels as the car's XML description places them; TORCS's car models have none."""
    text = car.with_suffix(".xml").read_text(encoding="latin1")

    def number(section: str, name: str, default: float | None = None) -> float:
        part = re.search(rf'<section name="{section}">(.*?)</section>', text, re.DOTALL)
        line = re.search(rf'name="{name}"[^>]*', part[1]) if part else None
        if line is None:
            if default is None:
                raise ValueError(f"{car}: {section} has no {name}")
            return default
        unit = re.search(r'unit="([^"]+)"', line[0])
        metres = {"in": 0.0254, "mm": 0.001, "cm": 0.01}.get(unit[1] if unit else "m", 1.0)
        return float(re.search(r'val="([-\d.]+)"', line[0])[1]) * metres

    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shifted = np.roll(rim, -1, axis=0)
    tyre, hub = [], []
    for axle in ("Front", "Rear"):
        for side in ("Right", "Left"):
            name = f"{axle} {side} Wheel"
            inner, width = 0.5 * number(name, "rim diameter"), number(name, "tire width")
            outer = inner + width * number(name, "tire height-width ratio", 0.5)
            centre = np.array([number(f"{axle} Axle", "xpos"), outer, -number(name, "ypos")])

            def ring(circle: np.ndarray, radius: float, out: float, centre=centre, width=width) -> np.ndarray:
                return centre + np.column_stack([radius * circle, np.full(len(circle), out * width / 2)])

            tyre += _band(ring(rim, outer, -1), ring(shifted, outer, -1), ring(rim, outer, 1), ring(shifted, outer, 1))
            for out in (-1.0, 1.0):
                tyre += _band(*(ring(c, r, out) for r in (outer, inner) for c in (rim, shifted)))
                tip = np.tile(centre + np.array([0, 0, 0.4 * out * width]), (len(rim), 1))
                hub.append(np.stack([ring(rim, inner, out), ring(shifted, inner, out), tip], axis=1))
    return [
        Part(colour, gloss, None, corners := np.concatenate(triangles), np.zeros((len(corners), 3, 2)))
        for colour, gloss, triangles in (([0.04] * 3, 0.1, tyre), ([0.55, 0.55, 0.58], 0.5, hub))
    ]


def _band(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> list[np.ndarray]:
    """Two triangles for each quadrilateral a b d c."""
    return [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]


def convert(row: dict, folder: Path) -> str | None:
    """Write the vehicle in our frame as OBJ with its textures; returns why it is left out, or None."""
    is_car = row["id"].startswith("car-")
    parts = read_ac3d(row["file"]) + (wheels(row["file"]) if is_car else [])
    faces = sum(len(p.corners) for p in parts)
    if not MIN_FACES <= faces <= MAX_FACES:
        return "many faces" if faces > MAX_FACES else "few faces"
    R = FORE_UP if is_car else AFT_UP
    points = np.concatenate([p.corners.reshape(-1, 3) for p in parts]) @ R.T
    low, high = points.min(axis=0), points.max(axis=0)
    shift = np.array([*(-0.5 * (low + high)[:2]), -low[2]])
    folder.mkdir(parents=True, exist_ok=True)
    materials, lines, first = [], ["mtllib model.mtl"], 1
    for number, part in enumerate(parts):
        picture = copy_texture(part.texture, row["file"], folder)
        colour, gloss = ([1.0] * 3 if picture else part.colour), 0.5 * part.gloss
        materials += [f"newmtl m{number}", "Kd {} {} {}".format(*colour), f"Ks {gloss} {gloss} {gloss}"]
        materials += [f"map_Kd {picture}"] if picture else []
        lines.append(f"usemtl m{number}")
        lines += ["v {:.6g} {:.6g} {:.6g}".format(*p) for p in part.corners.reshape(-1, 3) @ R.T + shift]
        lines += ["vt {:.5g} {:.5g}".format(*p) for p in part.uv.reshape(-1, 2)]
        corners = np.arange(first, first + 3 * len(part.corners)).reshape(-1, 3)
        lines += ["f {0}/{0} {1}/{1} {2}/{2}".format(*triangle) for triangle in corners]
        first += corners.size
    (folder / "model.mtl").write_text("\n".join(materials) + "\n")
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path, metavar="BENCH", help="folder of meshes.py")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows = catalogue(fetch(arguments.out))
    listing = {"packages": PACKAGES, "turns": candidate_rotations().tolist(), "meshes": [], "left_out": {}}
    clouds: dict[str, tuple[np.ndarray, cKDTree]] = {}
    for row in tqdm(sorted(rows, key=lambda row: (half_of(row["id"]), row["id"])), desc="vehicles"):
        folder = arguments.out / "meshes" / row["id"]
        try:
            why = convert(row, folder)
        except ValueError as error:
            why = str(error)
        if why is None:
            model = TexturedMesh.load(folder / "model.obj")
            cloud = sample_points(model)
            like = copy_of(cloud, clouds)
            if like is not None and half_of(like) != half_of(row["id"]):
                why = "copy of a held-out mesh"
        if why is not None:
            listing["left_out"][row["id"]] = why
            continue
        clouds[row["id"]] = np.ptp(cloud, axis=0), cKDTree(cloud)
        known = {k: row[k] for k in ("id", "name", "kind")} | describe(row["id"], model, cloud)
        listing["meshes"].append({**known, "half": half_of(row["id"]), "like": like or row["id"]})
    vehicles = len(listing["meshes"])
    # Furniture of BENCH serves only as clutter and as source of textures: make.py never photographs a mesh of extent 0.
    away = os.path.relpath(arguments.bench, arguments.out)
    for mesh in json.loads((arguments.bench / "meshes.json").read_text())["meshes"]:
        listing["meshes"].append({**mesh, "kind": None, "extents": [0.0] * 3, "path": f"{away}/{mesh['path']}"})
    write_listing(arguments.out, listing)
    print(f"{vehicles} vehicles; left out {len(listing['left_out'])}")


if __name__ == "__main__":
    main()
