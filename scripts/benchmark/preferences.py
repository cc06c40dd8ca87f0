"""Which of two poses does a measure prefer, the one that the contour fit found or the true one?

    python scripts/benchmark/preferences.py FOLDER [--half held-out] [--limit 150]

For photographs of scripts/benchmark/make.py with their exact mesh, four starts are rotated by 4 to 20 degrees away from
the truth and fitted without a mask (:func:`fit_contours`). For poses that ended beside the truth, the fraction in which
a measure is larger at the truth; 0.5 is chance. Writes scripts/results/preferences.json and its table in
docs/experiments.md.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.features.learned_field import LearnedCurvilinearSaliency, doubled_angle
from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.geometry.cameras import rotation_towards, transform
from curvireg_torch.geometry.crops import crop_transforms, square_boxes
from curvireg_torch.geometry.translation import pose_from_box
from curvireg_torch.mesh.mesh import extreme_points, mesh_centre, mesh_radius
from curvireg_torch.registration import fit_contours
from curvireg_torch.registration.contours.descent import ContourProblem, pixels
from curvireg_torch.registration.contours.fit import SIZE
from curvireg_torch.registration.contours.mask import ObjectMask
from curvireg_torch.registration.contours.points import EdgeField
from curvireg_torch.rendering import make_renderer
from curvireg_torch.terms import crop_regions
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json

STARTS, ANGLES, MARGIN = 4, (4.0, 20.0), 0.1
GROUPS = {"2 to 5 degrees": (2.0, 5.0), "5 to 10": (5.0, 10.0), "10 to 30": (10.0, 30.0)}
OFF = 0.02
"""Poses within 2 degrees and this fraction of the distance are left out: they are the truth."""

NEAR, BESIDE = torch.arange(-3.0, 4.0, dtype=torch.float64), torch.tensor([2.0, 3.5, 5.0, 7.0], dtype=torch.float64)
"""Offsets in px along the normals at which edges and colours are read."""


def starts_around(R: Tensor, t: Tensor, centre: Tensor, hull: Tensor, box: Tensor, K: Tensor, seed: int) -> Tensor:
    """(STARTS, 4, 4) poses that fill a box, rotated away from a true one."""
    generator = torch.Generator().manual_seed(seed)
    view = rotation_towards(R @ centre + t).mT @ R
    axis = F.normalize(torch.randn(STARTS, 3, generator=generator, dtype=torch.float64), dim=1)
    angle = ANGLES[0] + (ANGLES[1] - ANGLES[0]) * torch.rand(STARTS, 1, generator=generator, dtype=torch.float64)
    turned = rotation_from_axis_angle(torch.deg2rad(angle) * axis) @ view
    return transform(*pose_from_box(hull, turned, box.expand(STARTS, 4), K.expand(STARTS, 3, 3)))


def sampled(picture: Tensor, uv: Tensor) -> Tensor:
    """(N, C, P, L) values of a picture (C, S, S) at pixels (N, P, L, 2)."""
    grid = ((2.0 * uv + 1.0) / picture.shape[-1] - 1.0).float()
    return F.grid_sample(picture.expand(len(uv), -1, -1, -1), grid, padding_mode="border", align_corners=False)


def mean_over(values: Tensor, chosen: Tensor) -> Tensor:
    """(N,) mean of (N, P) values where ``chosen``."""
    out: Tensor = (values * chosen).sum(dim=1) / chosen.sum(dim=1).clamp(min=1)
    return out


class Measures:
    """Measures of poses in the crop of one photograph."""

    def __init__(self, problem: ContourProblem, crop: Tensor, network: LearnedCurvilinearSaliency) -> None:
        field = network(crop)
        self.problem, self.crop = problem, crop[0]
        self.field, self.probability = doubled_angle(field)[0], network.mask(crop)[0, 0]
        self.saliency = torch.linalg.vector_norm(field[0], dim=0)
        self.level = self.saliency.square().mean().sqrt().clamp(min=1e-6)
        self.mask = ObjectMask(self.probability[None, None])

    def __call__(self, T: Tensor) -> dict[str, Tensor]:
        """(N,) values of each measure at poses (N, 4, 4); more is better."""
        problem = self.problem[torch.zeros(len(T), dtype=torch.long)]
        state, size = problem.state(T), (SIZE, SIZE)
        points, n = state.points, state.points.normals
        uv = pixels(points.model, T, problem.K, problem.centre)
        gradient = problem.edges.strength(uv, n, NEAR, problem.image_index)
        learned = self._learned(uv, n)
        near = torch.exp(-0.5 * NEAR**2)
        best = {"gradient": gradient, "learned": learned, "product": gradient * learned}
        at = {name: (strength * near).amax(dim=-1) for name, strength in best.items()}
        outline, inner = points.outline, points.valid & ~points.outline
        weighted = gradient * near * self.mask.weights(uv, points, NEAR, problem.image_index, SIZE)
        silhouette = (problem.renderer.render(T, problem.K, size).cpu()[:, 0] > 0).float()
        logit = torch.logit(self.probability.clamp(0.02, 0.98))
        return {
            "gradient edges (edge support)": mean_over(at["gradient"], points.valid),
            "gradient edges of the outline": mean_over(at["gradient"], outline),
            "gradient edges of creases and inner contours": mean_over(at["gradient"], inner),
            "edges of the learned field": mean_over(at["learned"], points.valid),
            "edges of the learned field, outline": mean_over(at["learned"], outline),
            "gradient times learned": mean_over(at["product"], points.valid),
            "gradient times learned, outline": mean_over(at["product"], outline),
            "learned edges within the silhouette that no contour explains": self._unexplained(uv, points, silhouette),
            "local colours inside and outside, outline": mean_over(self._contrast(uv, n), outline),
            "learned mask, likelihood of the silhouette": (silhouette * logit).sum(dim=(1, 2)),
            "gradient edges weighted by the mask (adopted)": mean_over(weighted.amax(dim=-1), points.valid),
        }

    def _learned(self, uv: Tensor, n: Tensor) -> Tensor:
        """(N, P, L) strength of the learned field across contours, as :meth:`EdgeField.strength` of gradients."""
        x, y = sampled(self.field, uv[:, :, None] + NEAR[:, None] * n[:, :, None]).double().unbind(1)
        length = torch.hypot(x, y).clamp(min=1e-9)
        nx, ny = n[:, :, None].unbind(-1)
        cosine = (x * (nx * nx - ny * ny) + y * 2.0 * nx * ny) / length  # of twice the angle
        r = length.square() * (0.5 * (1.0 + cosine)).square()
        return r / (r + self.level)

    def _unexplained(self, uv: Tensor, points: Any, silhouette: Tensor) -> Tensor:
        """(N,) minus the saliency that is farther than 4 px from the contours of a silhouette."""
        index = uv.round().long().clamp(0, SIZE - 1) @ torch.tensor([1, SIZE])
        drawn = torch.zeros(len(uv), SIZE * SIZE).scatter_reduce_(1, index, points.valid.float(), "amax")
        explained = F.max_pool2d(drawn.view(-1, 1, SIZE, SIZE), 9, 1, 4)[:, 0]
        strength = self.saliency / (self.saliency + self.level)
        out: Tensor = -(strength * silhouette * (1.0 - explained)).sum(dim=(1, 2))
        return out

    def _contrast(self, uv: Tensor, n: Tensor) -> Tensor:
        """(N, P) squared difference of the mean colours on both sides, as a fraction of itself plus their variances."""
        sides = [sampled(self.crop, uv[:, :, None] + s * BESIDE[:, None] * n[:, :, None]) for s in (-1.0, 1.0)]
        difference = (sides[0].mean(dim=-1) - sides[1].mean(dim=-1)).square().sum(dim=1)
        spread = sum(side.var(dim=-1).sum(dim=1) for side in sides)
        out: Tensor = difference / (difference + spread + 1e-3)
        return out


def compare(folder: Path, half: str, item: dict[str, Any], network: LearnedCurvilinearSaliency) -> list[dict[str, Any]]:
    """For each pose that ended beside the truth, its error and the measures that prefer the truth."""
    image, mesh = read_image(folder / half / item["image"]), cr.load_mesh(folder / item["mesh"])
    R, t, K, S = (torch.tensor(item[k], dtype=torch.float64) for k in ("R", "t", "K", "symmetries"))
    box, centre, radius = torch.tensor(item["box"]), mesh_centre(mesh), mesh_radius(mesh)
    renderer, truths = make_renderer(mesh), transform(R @ S, t.expand(len(S), 3))
    starts = starts_around(R, t, centre, extreme_points(mesh), box.double(), K, item["id"])
    found = fit_contours(renderer, image, box, K, starts, centre=centre, radius=radius).transform
    angles = rotation_error(found[:, None, :3, :3], truths[None, :, :3, :3])
    nearest = truths[angles.argmin(dim=1)]
    crop = crop_regions([image], box[None, None], size=SIZE, margin=MARGIN)[:, 0].float()
    crop_K = crop_transforms(square_boxes(box[None], MARGIN), SIZE).double() @ K
    problem = ContourProblem(renderer, EdgeField(crop), torch.tensor([0]), crop_K, SIZE, centre, radius)
    measures = Measures(problem, crop, network)
    at_found, at_truth = measures(found), measures(nearest)
    lengths = [torch.linalg.vector_norm(T[:, :3, :3] @ centre + T[:, :3, 3], dim=1) for T in (found, nearest)]
    rows = []
    for k, error in enumerate(angles.amin(dim=1).tolist()):
        distance = float(lengths[0][k] / lengths[1][k]) - 1.0
        prefer = {name: bool(at_truth[name][k] > values[k]) for name, values in at_found.items()}
        rows.append({"id": item["id"], "error": error, "distance": distance, "prefer": prefer})
    return rows


def page(record: dict[str, Any]) -> str:
    """The table, one line for each measure."""
    groups = record["groups"]
    head = ["prefers the truth", *(f"{name} ({found['n']})" for name, found in groups.items())]
    names = next(iter(groups.values()))["truth"]
    lines = [head, *([name, *(f"{found['truth'][name]:.2f}" for found in groups.values())] for name in names)]
    where = (
        f"`python scripts/benchmark/preferences.py`, {record['poses']} poses of {record['photographs']} photographs, "
        f"{record['date']}, commit {record['commit']}."
    )
    return "\n".join([*table_lines(lines), "", where, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--limit", type=int, default=150)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines = (arguments.folder / arguments.half / "items.jsonl").read_text().splitlines()
    items = [item for item in map(json.loads, lines) if item["form"] == "exact"][: arguments.limit]
    network, rows = LearnedCurvilinearSaliency(), []
    with torch.no_grad():
        for item in tqdm(items, unit="photograph"):
            rows += compare(arguments.folder, arguments.half, item, network)
    beside = [r for r in rows if r["error"] < 30.0 and (r["error"] >= 2.0 or abs(r["distance"]) >= OFF)]
    groups = {"all beside it": beside}
    groups |= {name: [r for r in beside if low <= r["error"] < high] for name, (low, high) in GROUPS.items()}
    shares = {
        name: {"n": len(g), "truth": {m: sum(r["prefer"][m] for r in g) / max(1, len(g)) for m in rows[0]["prefer"]}}
        for name, g in groups.items()
    }
    record = {"date": today(), "commit": commit(), "photographs": len(items), "poses": len(rows), "groups": shares}
    write_json(RESULTS / "preferences.json", record)
    update_page(REPOSITORY / "docs" / "experiments.md", "preferences", page(record))
    print(page(record))


if __name__ == "__main__":
    main()
