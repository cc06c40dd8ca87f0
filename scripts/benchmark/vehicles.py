#!/usr/bin/env python
"""Textured vehicles for a second benchmark: aircraft, ships, cars and trains, brought into one frame and catalogued.

The meshes are those of Debian's packages flightgear-data-ai and flightgear-data-models 2020.3.16 and torcs-data 1.3.7
(GPL-2, some Free Art: see the packages' ``copyright``). Nothing of them belongs to this project: they stay in OUT, as
benchmark_meshes.py leaves furniture in BENCH, which lends clutter and the rooms' papers. make_benchmark.py --out OUT
then photographs the vehicles.

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

from scripts.benchmark import ac3d as _ac3d
from scripts.benchmark.meshes import copy_of, fetched, half_of, measured, samples, turns, write_listing
from scripts.benchmark.textured import Textured

PACKAGES = {
    "flightgear-data-ai": "a86b2acbf99ff2d49698abd2a2f4bc28ab0cf5a744218b4ca4d8aede8a67dc2f",
    "flightgear-data-models": "e3f24a2e1b5fb34168aed4440e7cbfa41f8ce1196e42351abc5012f6e4263b4c",
    "torcs-data": "33a170ec9db8bdf7e33cb07b96b9854d5ef9e47b1f82705e4c24d6caaf13fb99",
}
FEWEST_FACES, MOST_FACES = 60, 45_000
TEXTURE = 512
"""Side in px of the textures that are kept."""

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
"""Of no build that others share, or with parts beside the object: looked at on a contact sheet."""

AFT_UP = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
"""From FlightGear's AC3D frame (x aft, y up) to ours (z up, front -y)."""

FORE_UP = np.array([[0, 0, -1.0], [-1, 0, 0], [0, 1, 0]])
"""From TORCS's (x forward, y up)."""


def fetch(out: Path) -> Path:
    """Folder with the unpacked packages."""
    source = out / "source"
    for package, sha256 in PACKAGES.items():
        deb = fetched(source, package, sha256)
        if not (source / package / "usr").exists():
            subprocess.run(["dpkg-deb", "-x", deb.resolve(), source / package], check=True)
    return source


def largest(folder: Path, unwanted: str = "light|prop|refuel|gear|pilot|wheel|shadow") -> list[Path]:
    """The folder's model: its largest AC3D file that is no part of another."""
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


def painted(name: str | None, model: Path, folder: Path) -> str | None:
    """Copy the texture into ``folder``, of an airliner's liveries one by lot: its file's name there."""
    if name is None:
        return None
    short = Path(name).name
    own = next((p for p in model.parents if p.parent.name == "Aircraft"), model.parent)
    liveries = sorted(own.glob(f"Textures/*/{short}"))
    if liveries:
        lot = int(hashlib.sha256(folder.name.encode()).hexdigest(), 16)
        places = [liveries[lot % len(liveries)]]
    else:
        bases = [model.parent / name, model.parent / short, model.parent.parent / short]
        places = [p for base in bases for p in (base, *map(base.with_suffix, (".png", ".rgb", ".jpg"))) if p.is_file()]
    for place in places:
        try:
            picture = Image.open(place).convert("RGBA").convert("RGB")
        except OSError:
            continue
        picture.thumbnail((TEXTURE, TEXTURE))
        kept = re.sub(r"\W", "_", place.stem) + ".jpg"
        picture.save(folder / kept, quality=92)
        return kept
    return None


def wheels(car: Path) -> list[_ac3d.Part]:
    """Four wheels where the car's description has them: the model comes without."""
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
    after = np.roll(rim, -1, axis=0)
    tyre, hub = [], []
    for axle in ("Front", "Rear"):
        for side in ("Right", "Left"):
            name = f"{axle} {side} Wheel"
            inner, width = 0.5 * number(name, "rim diameter"), number(name, "tire width")
            outer = inner + width * number(name, "tire height-width ratio", 0.5)
            middle = np.array([number(f"{axle} Axle", "xpos"), outer, -number(name, "ypos")])

            def ring(
                circle: np.ndarray, radius: float, out: float, middle: np.ndarray = middle, width: float = width
            ) -> np.ndarray:
                return middle + np.column_stack([radius * circle, np.full(len(circle), out * width / 2)])

            tyre += _band(ring(rim, outer, -1), ring(after, outer, -1), ring(rim, outer, 1), ring(after, outer, 1))
            for out in (-1.0, 1.0):
                tyre += _band(*(ring(c, r, out) for r in (outer, inner) for c in (rim, after)))
                centre = np.tile(middle + np.array([0, 0, 0.4 * out * width]), (len(rim), 1))
                hub.append(np.stack([ring(rim, inner, out), ring(after, inner, out), centre], axis=1))
    return [
        _ac3d.Part(colour, gloss, None, corners := np.concatenate(made), np.zeros((len(corners), 3, 2)))
        for colour, gloss, made in (([0.04] * 3, 0.1, tyre), ([0.55, 0.55, 0.58], 0.5, hub))
    ]


def _band(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> list[np.ndarray]:
    """Two triangles for each quadrilateral a b d c."""
    return [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]


def convert(row: dict, folder: Path) -> str | None:
    """Write the vehicle in our frame as OBJ with its textures. The answer is why not, or None."""
    parts = _ac3d.read(row["file"])
    if row["id"].startswith("car-"):
        parts += wheels(row["file"])
    faces = sum(len(p.corners) for p in parts)
    if not FEWEST_FACES <= faces <= MOST_FACES:
        return "many faces" if faces > MOST_FACES else "few faces"
    R = FORE_UP if row["id"].startswith("car-") else AFT_UP
    every = np.concatenate([p.corners.reshape(-1, 3) for p in parts]) @ R.T
    low, high = every.min(axis=0), every.max(axis=0)
    shift = np.array([*(-0.5 * (low + high)[:2]), -low[2]])
    folder.mkdir(parents=True, exist_ok=True)
    materials, lines, first = [], ["mtllib model.mtl"], 1
    for number, part in enumerate(parts):
        picture = painted(part.texture, row["file"], folder)
        colour, gloss = ([1.0] * 3 if picture else part.colour), 0.5 * part.gloss
        materials += [f"newmtl m{number}", "Kd {} {} {}".format(*colour), f"Ks {gloss} {gloss} {gloss}"]
        materials += [f"map_Kd {picture}"] if picture else []
        lines.append(f"usemtl m{number}")
        lines += ["v {:.6g} {:.6g} {:.6g}".format(*p) for p in part.corners.reshape(-1, 3) @ R.T + shift]
        lines += ["vt {:.5g} {:.5g}".format(*p) for p in part.places.reshape(-1, 2)]
        corners = np.arange(first, first + 3 * len(part.corners)).reshape(-1, 3)
        lines += ["f {0}/{0} {1}/{1} {2}/{2}".format(*three) for three in corners]
        first += corners.size
    (folder / "model.mtl").write_text("\n".join(materials) + "\n")
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    return None


def furniture(bench: Path, out: Path) -> list[dict]:
    """BENCH's meshes, as clutter and paper alone: no photograph is of a thing without extent."""
    rows = json.loads((bench / "meshes.json").read_text())["meshes"]
    away = os.path.relpath(bench, out)
    return [{**row, "kind": None, "extents": [0.0] * 3, "path": f"{away}/{row['path']}"} for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path, metavar="BENCH", help="folder of benchmark_meshes.py")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows = catalogue(fetch(arguments.out))
    listing = {"packages": PACKAGES, "turns": turns().tolist(), "meshes": [], "left_out": {}}
    kept: dict[str, tuple[np.ndarray, cKDTree]] = {}
    for row in tqdm(sorted(rows, key=lambda row: (half_of(row["id"]), row["id"])), desc="vehicles"):
        folder = arguments.out / "meshes" / row["id"]
        try:
            why = convert(row, folder)
        except ValueError as error:
            why = str(error)
        if why is None:
            model = Textured.load(folder / "model.obj")
            cloud = samples(model)
            like = copy_of(cloud, kept)
            if like is not None and half_of(like) != half_of(row["id"]):
                why = "a copy of one held out"
        if why is not None:
            listing["left_out"][row["id"]] = why
            continue
        kept[row["id"]] = np.ptp(cloud, axis=0), cKDTree(cloud)
        known = {k: row[k] for k in ("id", "name", "kind")} | measured(row["id"], model, cloud)
        listing["meshes"].append({**known, "half": half_of(row["id"]), "like": like or row["id"]})
    vehicles = len(listing["meshes"])
    listing["meshes"] += furniture(arguments.bench, arguments.out)
    write_listing(arguments.out, listing)
    print(f"{vehicles} vehicles; left out {len(listing['left_out'])}")


if __name__ == "__main__":
    main()
