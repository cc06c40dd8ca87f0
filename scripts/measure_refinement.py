"""What refinement is worth, on scenes of known truth: best view of the bank, discrete search, contour stage.

    python scripts/measure_refinement.py [--photographs 200] [--out scripts/results/refinement.json]

Five meshes made in code stand upright before clutter, under random light and with a random texture; camera matrix known
(f 600 px, 480 x 360 px), box exact or with every edge moved by up to 5 % of its side. Rotation errors in degrees,
translation errors in per cent of the distance, both over the scenes whose best view was within 30 degrees. "Made worse"
is the share, of those within 5 degrees after the search, that the contour stage moved off by more than 2 degrees.
"sigmas" is the median of |rotation error| / its standard deviation over the three axes (0.67 if the covariance tells
the truth). Seconds are of one image on one core, bank in memory.
"""

import argparse
import json
import math
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from _record import write_json

from curvireg_torch import Registrar, camera_matrix, rotation_error
from curvireg_torch.geometry import axis_angle_from_rotation
from curvireg_torch.matching import cached_bank
from curvireg_torch.metrics import median_error
from curvireg_torch.pipeline import DEFAULT, PRESETS
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph

SIZE = (360, 480)
CAMERA = camera_matrix(600.0, 600.0, 239.5, 179.5, dtype=torch.float64)
RIGHT, WITHIN, WORSE = 30.0, 5.0, 2.0
STAGES = ("view", "search", "contours")

box, cylinder = trimesh.creation.box, trimesh.creation.cylinder


def at(x: float, y: float, z: float, axis: list[int] | None = None) -> np.ndarray:
    T = trimesh.transformations.translation_matrix((x, y, z))
    return T if axis is None else T @ trimesh.transformations.rotation_matrix(math.pi / 2, axis)


def chair() -> trimesh.Trimesh:
    """With one arm rest."""
    parts = [box((0.45, 0.42, 0.05), transform=at(0, 0, 0.45)), box((0.45, 0.04, 0.3), transform=at(0, 0.2, 0.8))]
    for x in (-0.2, 0.2):
        parts.append(box((0.05, 0.05, 0.45), transform=at(x, -0.18, 0.22)))
        parts.append(box((0.05, 0.05, 0.95), transform=at(x, 0.18, 0.47)))
    return trimesh.util.concatenate([*parts, box((0.05, 0.36, 0.04), transform=at(0.22, 0, 0.65))])


def aeroplane() -> trimesh.Trimesh:
    parts = [
        cylinder(0.05, 0.6, transform=at(0, 0, 0.1, [1, 0, 0])),
        box((0.7, 0.12, 0.012), transform=at(0, -0.05, 0.1)),
        box((0.26, 0.08, 0.01), transform=at(0, 0.27, 0.12)),
        box((0.01, 0.1, 0.14), transform=at(0, 0.26, 0.19)),
    ]
    parts += [cylinder(0.03, 0.12, transform=at(x, -0.1, 0.07, [1, 0, 0])) for x in (-0.2, 0.2)]
    return trimesh.util.concatenate(parts)


def mug() -> trimesh.Trimesh:
    """With a spoon in it."""
    handle = trimesh.creation.torus(0.035, 0.008, major_sections=48, minor_sections=16)
    handle.apply_transform(at(0.05, 0, 0.055, [1, 0, 0]))
    wall, floor = trimesh.creation.annulus(0.041, 0.045, 0.1, transform=at(0, 0, 0.05)), cylinder(0.045, 0.006)
    return trimesh.util.concatenate([wall, floor, handle, cylinder(0.004, 0.07, transform=at(-0.035, 0.02, 0.09))])


def pebble() -> trimesh.Trimesh:
    """Smooth: all its contours slide over the surface."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    waves = np.random.default_rng(3).normal(size=(3, 6)) * 22
    bumps = np.sin(mesh.vertices @ waves + np.arange(6)).mean(axis=1)
    mesh.vertices = mesh.vertices * (1 + 0.5 * bumps[:, None]) * [1.0, 0.75, 0.6]
    return mesh


MESHES = {"truck": example_mesh, "chair": chair, "aeroplane": aeroplane, "mug": mug, "pebble": pebble}


def measure(registrars: dict[str, Registrar], mesh: trimesh.Trimesh, seed: int, jitter: float) -> dict[str, float]:
    generator = torch.Generator().manual_seed(seed)
    T = random_pose(mesh, CAMERA, SIZE, generator)
    image, exact = synthesize_photograph(mesh, T, CAMERA, SIZE, generator)
    sides = (exact[2:] - exact[:2]).repeat(2)
    given = exact + jitter * sides * (2.0 * torch.rand(4, generator=generator) - 1.0)
    row = {}
    for stage, registrar in registrars.items():
        start = time.process_time()
        result = registrar([image], given[None], CAMERA)[0]
        row[f"seconds {stage}"] = time.process_time() - start
        row[f"rotation {stage}"] = float(rotation_error(result.rotation, T[:3, :3]))
        row[f"translation {stage}"] = 100.0 * float((result.translation - T[:3, 3]).norm() / T[:3, 3].norm())
    row["sigmas"] = math.nan
    if result.standard_deviations is not None:
        turn = torch.rad2deg(axis_angle_from_rotation(T[:3, :3] @ result.rotation.T))
        row["sigmas"] = median_error((turn / result.standard_deviations[0]).abs())
    return row


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    table = {name: torch.tensor([row[name] for row in rows], dtype=torch.float64) for name in rows[0]}
    right = table["rotation view"] < RIGHT
    near = right & (table["rotation search"] < WITHIN)
    worse = table["rotation contours"] > table["rotation search"] + WORSE
    result = {"n": len(rows), "right": int(right.sum())}
    for stage in STAGES:
        turn, shift = table[f"rotation {stage}"][right], table[f"translation {stage}"][right]
        result[f"{stage}: rotation median"] = median_error(turn)
        result[f"{stage}: rotation 90 %"] = float(turn.quantile(0.9))
        result[f"{stage}: within 1 degree"] = float((turn < 1).double().mean())
        result[f"{stage}: translation median %"] = median_error(shift)
        result[f"{stage}: seconds"] = median_error(table[f"seconds {stage}"])
    result["within 5 degrees after the search"] = int(near.sum())
    result["made worse"] = float(worse[near].double().mean()) if bool(near.any()) else 0.0
    sigmas = table["sigmas"][right & (table["rotation contours"] < WITHIN)]
    result["sigmas"] = median_error(sigmas[~sigmas.isnan()])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, default=200, help="in all, shared by the meshes")
    parser.add_argument("--meshes", nargs="+", choices=sorted(MESHES), default=list(MESHES))
    parser.add_argument("--jitter", type=float, nargs="+", default=[0.0, 0.05], help="of the box, shares of its sides")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "refinement.json")
    parser.add_argument("--preset", choices=sorted(PRESETS), default=DEFAULT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    preset, rows = PRESETS[arguments.preset], {f"{j:g}": {} for j in arguments.jitter}
    for name in arguments.meshes:
        mesh = MESHES[name]()
        mesh.units = "m"
        bank = cached_bank(mesh, pipeline=preset.with_pose_prior("upright"), progress=False)
        registrars = {
            "view": Registrar(bank, pipeline=replace(bank.pipeline, search=False, contours=False)),
            "search": Registrar(bank, pipeline=replace(bank.pipeline, contours=False)),
            "contours": Registrar(bank),
        }
        for jitter in arguments.jitter:
            own = rows[f"{jitter:g}"][name] = [
                measure(registrars, mesh, seed, jitter)
                for seed in range(arguments.photographs // len(arguments.meshes))
            ]
            print(name, f"box +-{jitter:g}", json.dumps(summary(own), indent=1), flush=True)
    result = {
        "boxes": {
            jitter: {
                "all": summary([row for part in own.values() for row in part]),
                "per_mesh": {n: summary(r) for n, r in own.items()},
            }
            for jitter, own in rows.items()
        },
        "preset": preset.describe(),
        "torch": torch.__version__,
        "machine": platform.machine(),
    }
    print(json.dumps({jitter: r["all"] for jitter, r in result["boxes"].items()}, indent=1))
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
