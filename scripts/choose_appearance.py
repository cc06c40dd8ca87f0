"""What the appearance term is worth on generated photographs: stage, mask, crops, weight, how many views it judges.

    python scripts/choose_appearance.py BENCH --out RAW [--pose upright free]    measure what is not measured yet
    python scripts/choose_appearance.py --out RAW --table                        sweep what was measured

BENCH holds items.jsonl and images/ of generated photographs, the folder above it their meshes. An item names its
photograph ("image"), the CAD to register ("mesh"), "box", "K", the true "R", "symmetries" (rotations), "form" ("exact"
CAD, or that of a "sibling"), "pose" ("upright" or "free"), "id", "kind", "occluded" and "bare".

Each object is ranked against the bank of its CAD by S_hog S_rep S_box, preset by preset; the appearance of all views
(upright) or of the best distinct ones (free) is then compared in every variant, and the raw scores of each CAD's
photographs are kept in RAW as one .npz, so that weights are swept without measuring again. Stop it and run it again at
will. The table goes to scripts/results/appearance.json and to docs/accuracy.md: shares of photographs within 30
degrees, and differences to the ranking without the term with the 95 % interval of paired resamples over CADs.
"""

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from _intervals import interval
from _record import REPOSITORY, between, commit, today
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.errors import CurviregError
from curvireg_torch.geometry import rotation_towards
from curvireg_torch.io import read_image
from curvireg_torch.io.meshes.mesh import mesh_radius
from curvireg_torch.matching import ViewBank, ViewMatcher, cached_bank
from curvireg_torch.matching.describe import ViewDescriber
from curvireg_torch.metrics import symmetric_rotation_error
from curvireg_torch.models.backbone import Backbone
from curvireg_torch.pipeline import preset_named
from curvireg_torch.rendering.shading import shade
from curvireg_torch.terms import crop_regions, jittered_boxes

KEPT = REPOSITORY / "scripts" / "results" / "appearance.json"
PAGE = REPOSITORY / "docs" / "accuracy.md"
BEGIN, END = "<!-- appearance:begin -->", "<!-- appearance:end -->"
PRESETS = ("learned", "classical")
WEIGHTS = (0.25, 0.5, 1.0, 2.0, 4.0)
CROPS = {1: [0], 3: [0, 5, 6], 7: list(range(7))}
KEEP, APART = 160, 15.0
"""Views of free photographs that are judged: so many distinct ones of each preset's ranking, degrees apart."""
VARIANTS = {
    "upright": [(s, m, c) for s in ("8", "16", "both") for m in ("all", "mask") for c in CROPS],
    "free": [("8", "all", 1), ("16", "all", 1), ("both", "all", 1), ("both", "all", 7)],
}
"""Strides, cells that count, crops of the photograph."""
WAYS = {
    "upright": {"all": (10_000, 0.0)},
    "free": {f"{k}, {a:g}°": (k, a) for k in (20, 40, 80, 160) for a in (15.0, 20.0, 30.0)},
}
"""Which views are judged: how many, and degrees apart."""
USED = {"upright": ("all", "both", "all", 1), "free": ("40, 20°", "both", "all", 1)}
"""What the term does."""


def distinct(order: np.ndarray, rotations: np.ndarray, angle: float, count: int) -> np.ndarray:
    """The first ``count`` of ``order`` that are ``angle`` degrees or more from each before them."""
    flat, limit = rotations.reshape(-1, 9), np.cos(np.radians(angle))
    free, chosen = np.ones(len(flat), bool), []
    for i in order:
        if free[i] and len(chosen) < count:
            chosen.append(i)
            free &= 0.5 * (flat @ flat[i] - 1.0) < limit
    return np.array(chosen)


def cells(features: Tensor, spread: Tensor) -> Tensor:
    """(N, C, cells) of length 1 over channels."""
    centred = features - features.mean(dim=(2, 3), keepdim=True)
    return F.normalize(centred / spread[:, None, None], dim=1).flatten(2)


class Views:
    """Rendered views of one bank, as the network sees them, with the share of each cell that shows the object."""

    def __init__(self, bank: ViewBank, chosen: np.ndarray, backbone: Backbone) -> None:
        describer = ViewDescriber(bank.mesh, bank.settings)
        S, radius = bank.settings.image_size, mesh_radius(bank.mesh)
        T, K, _ = describer.cameras(bank.rotations[chosen], bank.views.distance[chosen] * radius)
        levels: list[list[Tensor]] = [[], []]
        masks: list[list[Tensor]] = [[], []]
        for i in range(0, len(chosen), 32):
            depth = describer.renderer.render(T[i : i + 32], K[i : i + 32], (S, S))
            answer = backbone(shade(depth, K[i : i + 32]))
            for level, features in enumerate(answer):
                levels[level].append(cells(features, backbone.spreads[level]))
                masks[level].append(F.adaptive_avg_pool2d((depth > 0).float(), features.shape[-2:]).flatten(1))
        self.levels, self.masks = [torch.cat(x) for x in levels], [torch.cat(x) for x in masks]

    def similarities(self, crops: Tensor, backbone: Backbone) -> dict[str, np.ndarray]:
        """(K, N) of K crops by "stride mask"."""
        found = {}
        for level, (stride, features) in enumerate(zip((8, 16), backbone(crops), strict=True)):
            views, mask = self.levels[level], self.masks[level]
            queries = cells(features, backbone.spreads[level]).flatten(1)
            found[f"{stride} all"] = (queries @ views.flatten(1).T / views.shape[2]).numpy()
            inside = (views * (mask / mask.sum(dim=1, keepdim=True).clamp(min=1e-6))[:, None]).flatten(1)
            found[f"{stride} mask"] = (queries @ inside.T).numpy()
        return found


def errors(item: dict[str, Any], rotations: Tensor) -> np.ndarray:
    """Degrees between the truth and views that look straight at the box, up to the object's symmetries."""
    box, K, truth = (torch.tensor(item[k], dtype=torch.float64) for k in ("box", "K", "R"))
    centre = torch.cat([0.5 * (box[:2] + box[2:]), torch.ones(1, dtype=torch.float64)])
    R = rotation_towards(torch.linalg.inv(K) @ centre) @ rotations.double()
    symmetries = torch.tensor(item["symmetries"], dtype=torch.float64)
    return symmetric_rotation_error(R, truth.expand_as(R), symmetries).numpy()


@torch.no_grad()
def measure(mesh: Path, items: list[dict[str, Any]], bench: Path, backbone: Backbone) -> dict[str, np.ndarray]:
    """Raw scores of the photographs that are to be registered to one CAD."""
    upright = items[0]["pose"] == "upright"
    # The classical bank: this script describes appearance by itself.
    pipeline = preset_named("classical").with_pose_prior("upright" if upright else "any")
    bank = cached_bank(cr.load_mesh(mesh, unit="m"), pipeline=pipeline, progress=False)
    R = bank.rotations.double()
    images = [read_image(bench / item["image"]) for item in items]
    boxes = torch.tensor([item["box"] for item in items])
    scores = {}
    for name in PRESETS:
        chosen = replace(preset_named(name), views=pipeline.views, terms=pipeline.terms)
        scores[name] = ViewMatcher(bank, pipeline=chosen)(images, boxes).scores
    judged = []
    for i in range(len(items)):
        orders = [np.argsort(-scores[name][i].numpy(), kind="stable") for name in PRESETS]
        found = [distinct(order, R.numpy(), APART, KEEP) for order in orders]
        judged.append(np.arange(len(bank)) if upright else np.unique(np.concatenate(found)))
    used, place = np.unique(np.concatenate(judged), return_inverse=True)
    shaded = Views(bank, used, backbone)
    raw: dict[str, np.ndarray] = {}
    for i, item in enumerate(items):
        columns, place = place[: len(judged[i])], place[len(judged[i]) :]
        regions = jittered_boxes(boxes[i : i + 1], 0.1)
        crops = crop_regions([images[i]], regions, size=bank.settings.image_size, margin=bank.settings.margin)[0]
        for name, similarity in shaded.similarities(crops, backbone).items():
            raw[f"{i} {name}"] = similarity[:, columns].astype(np.float16)
        for name in PRESETS:
            raw[f"{i} {name}"] = scores[name][i].numpy()[judged[i]]
        raw[f"{i} error"] = errors(item, R[judged[i]]).astype(np.float32)
        raw[f"{i} rotation"] = R[judged[i]].numpy().astype(np.float32)
        raw[f"{i} item"] = np.array(
            json.dumps({k: item[k] for k in ("id", "form", "pose", "kind", "occluded", "bare")})
        )
    return raw


def measure_all(bench: Path, out: Path, poses: list[str], count: int) -> None:
    rows = [json.loads(line) for line in (bench / "items.jsonl").read_text().splitlines()]
    backbone = Backbone()
    for pose in poses:
        chosen = [row for row in rows if row["pose"] == pose and row["id"] < count]
        for mesh in sorted({row["mesh"] for row in chosen}):
            items = [row for row in chosen if row["mesh"] == mesh]
            path = out / pose / f"{Path(mesh).parent.name}-{'-'.join(str(item['id']) for item in items)[:60]}.npz"
            if path.exists():
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                raw = measure(bench.parent / mesh, items, bench, backbone)
            except CurviregError as error:
                print(f"{mesh}: left out ({error})")
                continue
            np.savez(path.with_suffix(".part.npz"), **raw)
            os.replace(path.with_suffix(".part.npz"), path)
            print(f"{pose} {path.stem}: {len(items)}", flush=True)


def photographs(folder: Path) -> Iterator[dict[str, Any]]:
    """One dict of raw scores each."""
    for path in sorted(folder.glob("*.npz")):
        if path.name.endswith(".part.npz"):
            continue
        raw = np.load(path)
        for i in sorted({int(key.split()[0]) for key in raw.files}):
            own = {key.split(" ", 1)[1]: raw[key] for key in raw.files if key.split()[0] == str(i)}
            yield {**own, **json.loads(str(own["item"])), "mesh": path.stem}


def appearance(shot: dict[str, Any], stride: str, mask: str, crops: int) -> np.ndarray:
    levels = ("8", "16") if stride == "both" else (stride,)
    return np.mean([shot[f"{s} {mask}"][CROPS[crops]].astype(float).max(axis=0) for s in levels], axis=0)


def error_of_best(shot: dict[str, Any], preset: str, variant: tuple[str, str, int], weight: float, judged: np.ndarray):
    """Degrees of the view that is best with the term; z-scores are over the views that are judged."""
    a = appearance(shot, *variant)[judged]
    score = np.log(np.maximum(shot[preset][judged], 1e-6)) + weight * (a - a.mean()) / max(float(a.std()), 1e-9)
    return float(shot["error"][judged][int(np.argmax(score))])


def difference(right: np.ndarray, base: np.ndarray, meshes: list[str]) -> tuple[float, float, float, float]:
    """Share, difference to ``base``, and its 95 % interval over paired resamples of the CADs."""
    found = right.mean(), *interval(right - base, meshes)
    return tuple(round(float(v), 4) for v in found)  # type: ignore[return-value]


def sweep(shots: list[dict[str, Any]], preset: str, pose: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    everything = [np.argsort(-shot[preset], kind="stable") for shot in shots]
    base = np.array([float(s["error"][o[0]]) < 30 for s, o in zip(shots, everything, strict=True)], float)
    rows.append({"preset": preset, "n": len(shots), "variant": "without", "share": round(float(base.mean()), 4)})
    for way, (count, angle) in WAYS[pose].items():
        judged = [distinct(o, s["rotation"], angle, count) for s, o in zip(shots, everything, strict=True)]
        for variant in VARIANTS[pose]:
            for weight in WEIGHTS:
                best = [error_of_best(s, preset, variant, weight, j) for s, j in zip(shots, judged, strict=True)]
                right, meshes = np.array([e < 30 for e in best], float), [shot["mesh"] for shot in shots]
                share, gain, low, high = difference(right, base, meshes)
                row = {"preset": preset, "n": len(shots), "views": way, "stride": variant[0], "cells": variant[1]}
                rows.append({**row, "crops": variant[2], "weight": weight, "share": share, "gain": [gain, low, high]})
    return rows


def table(results: dict[str, Any]) -> str:
    """Of each pose and preset: without the term, the variant that is used at every weight, and the three best."""
    lines = [
        "| pose | ranking | N | views | stride | cells | crops | weight | within 30° | gain |",
        "|" + " --- |" * 10,
    ]
    for pose, rows in results["poses"].items():
        for preset in PRESETS:
            own = [row for row in rows if row["preset"] == preset]
            weighted = [row for row in own if "weight" in row]
            best = [row for row in weighted if (row["views"], row["stride"], row["cells"], row["crops"]) == USED[pose]]
            best += sorted((row for row in weighted if row not in best), key=lambda row: -row["share"])[:3]
            lines.append(f"| {pose} | {preset} | {own[0]['n']} | without | | | | | {own[0]['share']:.3f} | |")
            for row in best:
                gain, low, high = row["gain"]
                what = " | ".join(str(row[k]) for k in ("n", "views", "stride", "cells", "crops", "weight"))
                lines.append(
                    f"| {pose} | {preset} | {what} | {row['share']:.3f} | {gain:+.3f} ({low:+.2f} to {high:+.2f}) |"
                )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path, nargs="?", metavar="BENCH", help="folder of items.jsonl")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--pose", nargs="+", choices=("upright", "free"), default=["upright", "free"])
    parser.add_argument("--count", type=int, default=1200, help="photographs by their number, the first so many")
    parser.add_argument("--table", action="store_true", help="only sweep and write the table")
    arguments = parser.parse_args()
    if not arguments.table:
        if arguments.bench is None:
            parser.error("BENCH is needed to measure")
        measure_all(arguments.bench, arguments.out, arguments.pose, arguments.count)
    poses = {}
    for pose in WAYS:
        shots = list(photographs(arguments.out / pose))
        if shots:
            poses[pose] = [row for preset in PRESETS for row in sweep(shots, preset, pose)]
    results = {"date": today(), "commit": commit(REPOSITORY), "poses": poses}
    KEPT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(between(text, BEGIN, END, table(results)), encoding="utf-8")


if __name__ == "__main__":
    main()
