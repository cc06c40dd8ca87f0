"""Does the covariance tell the truth? Shares of generated scenes whose true pose lies in the 50, 90, 95 % ellipsoids.

    python scripts/check_covariance.py [--scenes 240] [--out scripts/results/covariance.json]

The meshes of ``measure_refinement.py``, half of the scenes before clutter and half before one colour; the contour stage
starts about 3 degrees and 1.5 % of the distance off. Poses within 15 degrees after it count. Scenes of even number are
those that constants may be chosen on, the others are the report.
"""

import argparse
import json
import math
from pathlib import Path

import torch
from _record import write_json
from measure_refinement import CAMERA, MESHES, SIZE
from scipy.stats import chi2
from torch import Tensor

from curvireg_torch.geometry import axis_angle_from_rotation, rotation_from_axis_angle
from curvireg_torch.geometry.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration import fit_contours
from curvireg_torch.rendering import make_renderer
from curvireg_torch.synthetic import random_pose, synthesize_photograph

LEVELS = (0.5, 0.9, 0.95)
WITHIN = math.radians(15.0)
TURN, SHIFT = math.radians(3.0), 0.015


def measure(name: str, seed: int, clutter: bool) -> float | None:
    """Probability of the smallest ellipsoid that holds the truth; None for a wrong pose or one without covariance."""
    mesh, generator = MESHES[name](), torch.Generator().manual_seed(seed)
    T = random_pose(mesh, CAMERA, SIZE, generator)
    plain = torch.rand(3, 1, 1, generator=generator).expand(3, *SIZE).contiguous()
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, generator, **({} if clutter else {"background": plain}))
    off = torch.randn(6, generator=generator, dtype=torch.float64)
    centre, start = mesh_centre(mesh), T.clone()
    start[:3, :3] = rotation_from_axis_angle(TURN / math.sqrt(3) * off[:3]) @ T[:3, :3]
    start[:3, 3] += (T[:3, :3] - start[:3, :3]) @ centre + SHIFT * T[2, 3] * off[3:] * torch.tensor([0.3, 0.3, 1.0])
    fit = fit_contours(make_renderer(mesh), image, box, CAMERA, start[None], centre=centre, radius=mesh_radius(mesh))
    found = fit.transform[0]
    turn = axis_angle_from_rotation(T[:3, :3] @ found[:3, :3].T)
    if float(turn.norm()) > WITHIN or not bool(fit.covariance.isfinite().all()):
        return None
    return ellipsoid(torch.cat([turn, T[:3, 3] - found[:3, 3]]), fit.covariance[0], int(fit.observable))


def ellipsoid(error: Tensor, covariance: Tensor, observable: int) -> float:
    unit = covariance.diagonal().rsqrt()  # radians and model units
    scaled = unit * error
    distance = float(scaled @ torch.linalg.solve(unit[:, None] * covariance * unit, scaled))
    return float(chi2.cdf(distance, observable))


def summary(rows: list[float | None]) -> dict[str, float]:
    right = [row for row in rows if row is not None]
    shares = {f"{level:g}": sum(row <= level for row in right) / max(len(right), 1) for level in LEVELS}
    return {"scenes": len(rows), "within 15 degrees": len(right), **shares}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=240)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "covariance.json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    names = list(MESHES)
    rows = [(s, names[s // 2 % 5], bool(s // 10 % 2)) for s in range(arguments.scenes)]
    found = [(seed, name, clutter, measure(name, 9000 + seed, clutter)) for seed, name, clutter in rows]
    result = {
        "fitted on": summary([p for seed, _, _, p in found if seed % 2 == 0]),
        "report": summary([p for seed, _, _, p in found if seed % 2]),
        "clutter": summary([p for _, _, clutter, p in found if clutter]),
        "one colour": summary([p for _, _, clutter, p in found if not clutter]),
        **{name: summary([p for _, own, _, p in found if own == name]) for name in names},
    }
    print(json.dumps(result, indent=1))
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
