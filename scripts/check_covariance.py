"""Does the covariance tell the truth? Shares of generated scenes whose true pose lies in the 50, 90, 95 % ellipsoids.

    python scripts/check_covariance.py [--scenes 240] [--jobs 2] [--evaluated DATA RUNS] [--rows ROWS]

The meshes of ``measure_refinement.py``, half of the scenes before clutter and half before one colour; the contour stage
starts about 3 degrees and 1.5 % of the distance off. Poses within 15 degrees after it count. Scenes of even number are
those that constants may be chosen on, the others are the report. --rows takes what ``run_benchmark.py`` wrote:
photographs of textured meshes, on half of which SCALE was chosen. --evaluated takes the real sets in DATA and what
``curvireg evaluate bop DATA/bop/NAME --out RUNS/NAME`` predicted. Both have covariances where answers are reliable.
Writes scripts/results/covariance.json and the table of docs/method.md.
"""

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch
from _record import REPOSITORY, SETS, benchmark, between, commit, today, write_json
from measure_refinement import CAMERA, MESHES, SIZE
from scipy.stats import chi2
from torch import Tensor

from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_error, rotation_from_axis_angle, transform
from curvireg_torch.geometry.mesh import mesh_centre, mesh_radius
from curvireg_torch.metrics import symmetry_transforms
from curvireg_torch.registration import fit_contours
from curvireg_torch.registration.contour_covariance import SCALE
from curvireg_torch.rendering import make_renderer
from curvireg_torch.synthetic import random_pose, synthesize_photograph

LEVELS = (0.5, 0.9, 0.95)
WITHIN = math.radians(15.0)
TURN, SHIFT = math.radians(3.0), 0.015
PAGE, KEPT = REPOSITORY / "docs" / "method.md", REPOSITORY / "scripts" / "results" / "covariance.json"
BEGIN, END = "<!-- covariance:begin -->", "<!-- covariance:end -->"
UNKNOWN = 0.5
"""Standard deviation of a direction that counts as unknown, in units of pi (turns) and of the distance (shifts)."""


def measure(scene: tuple[int, str, bool]) -> float | None:
    """Probability of the smallest ellipsoid that holds the truth; None for a wrong pose or one without covariance."""
    torch.set_num_threads(1)
    seed, name, clutter = scene
    mesh, generator = MESHES[name](), torch.Generator().manual_seed(9000 + seed)
    T = random_pose(mesh, CAMERA, SIZE, generator)
    plain = torch.rand(3, 1, 1, generator=generator).expand(3, *SIZE).contiguous()
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, generator, **({} if clutter else {"background": plain}))
    off = torch.randn(6, generator=generator, dtype=torch.float64)
    centre, start = mesh_centre(mesh), T.clone()
    start[:3, :3] = rotation_from_axis_angle(TURN / math.sqrt(3) * off[:3]) @ T[:3, :3]
    start[:3, 3] += (T[:3, :3] - start[:3, :3]) @ centre + SHIFT * T[2, 3] * off[3:] * torch.tensor([0.3, 0.3, 1.0])
    fit = fit_contours(make_renderer(mesh), image, box, CAMERA, start[None], centre=centre, radius=mesh_radius(mesh))
    found = fit.transform[0]
    return ellipsoid(found, T, fit.covariance[0])


def ellipsoid(found: Tensor, truth: Tensor, covariance: Tensor) -> float | None:
    """Probability of the smallest ellipsoid about a pose that holds the true one; None for a wrong pose, or none."""
    turn = axis_angle_from_rotation(truth[:3, :3] @ found[:3, :3].T)
    if float(turn.norm()) > WITHIN or not bool(covariance.isfinite().all()):
        return None
    return float(chi2.cdf(*squared_distance(found, truth, covariance)))


def squared_distance(found: Tensor, truth: Tensor, covariance: Tensor) -> tuple[float, int]:
    """Mahalanobis' of a pose from the true one, along directions that are known; how many these are."""
    turn = axis_angle_from_rotation(truth[:3, :3] @ found[:3, :3].T)
    error = torch.cat([turn, truth[:3, 3] - found[:3, 3]])
    wide = torch.tensor([math.pi] * 3 + [float(found[:3, 3].norm())] * 3, dtype=torch.float64)
    value, axes = torch.linalg.eigh(covariance / wide[:, None] / wide)
    known = value.sqrt() < UNKNOWN
    square = ((axes.T @ (error / wide)).square() / value)[known].sum()
    return float(square), int(known.sum())


def evaluated(data: Path, runs: Path, name: str) -> list[float | None]:
    """The same of predictions for a real set, against the nearest of equally right poses; only those that have one."""
    bench, store = benchmark(data, name), PredictionStore(runs / name / "predictions")
    rows: list[float | None] = []
    for item in bench.items:
        row = store.read(item.key) if item.key in store else {}
        if row.get("covariance") is None:
            continue
        sample = bench.dataset.annotation(item.index)
        truth = transform(sample["rotation"].double(), sample["translation"].double())
        poses = truth @ symmetry_transforms(sample["model_info"]).double()
        found = transform(*(torch.tensor(row[k], dtype=torch.float64) for k in ("rotation", "translation")))
        near = poses[rotation_error(poses[:, :3, :3], found[:3, :3]).argmin()]
        rows.append(ellipsoid(found, near, torch.tensor(row["covariance"], dtype=torch.float64)))
    return rows


def benchmarked(paths: list[Path], half: int) -> list[float | None]:
    """The same of reliable answers for the meshes of one half of the benchmark."""
    rows = [json.loads(line) for path in paths for line in path.read_text(encoding="utf-8").splitlines()]
    rows = [r for r in rows if "squared_distance" in r and sum(map(ord, r["mesh"])) % 2 == half]
    right = [r["errors"][0] <= math.degrees(WITHIN) for r in rows]
    squares = [(r["squared_distance"][0] / SCALE, r["squared_distance"][1]) for r in rows]
    return [float(chi2.cdf(*s)) if good else None for s, good in zip(squares, right, strict=True)]


def summary(rows: list[float | None]) -> dict[str, float]:
    right = [row for row in rows if row is not None]
    shares = {f"{level:g}": sum(row <= level for row in right) / max(len(right), 1) for level in LEVELS}
    return {"scenes": len(rows), "within 15 degrees": len(right), **shares}


def table(record: dict[str, Any]) -> str:
    lines = [
        "| photographs | N | with covariance, within 15 degrees | in the 50 % ellipsoid | 90 % | 95 % |",
        "|" + "---|" * 6,
    ]
    for name, row in record["shares"].items():
        cells = [str(row["scenes"]), str(row["within 15 degrees"]), *(f"{row[f'{level:g}']:.2f}" for level in LEVELS)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    where = f"`python scripts/check_covariance.py`, {record['date']}, commit {record['commit']}"
    return "\n".join([*lines, "", f"{where}. Of generated scenes the odd ones are the report.", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=240)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rows", type=Path, nargs="+", default=[])
    parser.add_argument("--evaluated", type=Path, nargs=2, metavar=("DATA", "RUNS"))
    parser.add_argument("--out", type=Path, default=KEPT)
    arguments = parser.parse_args()
    names = list(MESHES)
    scenes = [(s, names[s // 2 % 5], bool(s // 10 % 2)) for s in range(arguments.scenes)]
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = list(pool.map(measure, scenes))
    each = list(zip(scenes, found, strict=True))
    shares = {
        "generated, odd scenes": summary([p for (seed, _, _), p in each if seed % 2]),
        "generated, even scenes": summary([p for (seed, _, _), p in each if seed % 2 == 0]),
        "before clutter": summary([p for (_, _, clutter), p in each if clutter]),
        "before one colour": summary([p for (_, _, clutter), p in each if not clutter]),
        **{name: summary([p for (_, own, _), p in each if own == name]) for name in names},
    }
    if arguments.rows:
        shares["textured meshes, half that SCALE was chosen on"] = summary(benchmarked(arguments.rows, 0))
        shares["textured meshes, the others"] = summary(benchmarked(arguments.rows, 1))
    for name in (n for n in SETS if arguments.evaluated and not n.startswith("pascal")):
        shares[f"{name}, reliable"] = summary(evaluated(*arguments.evaluated, name))
    record = {"date": today(), "commit": commit(REPOSITORY, but=["docs", "scripts/results"]), "shares": shares}
    print(json.dumps(record, indent=1))
    write_json(arguments.out, record)
    if arguments.out == KEPT:
        PAGE.write_text(between(PAGE.read_text(encoding="utf-8"), BEGIN, END, table(record)), encoding="utf-8")


if __name__ == "__main__":
    main()
