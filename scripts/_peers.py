"""What a user would pick instead of the library's ranking and descriptors: for ``bench_pipeline.py --peers``.

OpenCV's LINEMOD (Hinterstoisser et al. 2012) is the free detector of a known object without training: the same views,
shaded grey, become its templates (colour gradients alone, since there is no depth), and the photograph's crop is
searched. It needs opencv-contrib-python-headless in place of opencv-python-headless, so an environment of its own.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
import torch.nn.functional as F
from run_benchmark import allocentric, error_up_to
from skimage.feature import hog
from torch import Tensor
from tqdm import tqdm

from curvireg_torch import ViewBank, ViewMatcher, load_mesh
from curvireg_torch.io import read_image
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.pipeline import preset_named

RIGHT = 30.0
CANVAS = (240, 320)
"""LINEMOD's pictures: multiples of its strides, 5 and 16 px; smaller ones it gets wrong, their own templates too."""

Best = Callable[[Tensor], int]
"""Number of the best view of a (3, S, S) crop."""


def linemod(views: Tensor) -> Best:
    detector = cv2.linemod.getDefaultLINE()
    for view in views:
        picture = _bytes(view.expand(3, -1, -1))
        detector.addTemplate([picture], "object", (picture[..., 0] < 255).astype(np.uint8) * 255)
    rims = [(n - views.shape[-1]) // 2 for n in CANVAS]

    def best(crop: Tensor) -> int:
        picture = cv2.copyMakeBorder(_bytes(crop), rims[0], rims[0], rims[1], rims[1], cv2.BORDER_REPLICATE)
        matches, _ = detector.match([picture], 50.0, ["object"])
        return max(matches, key=lambda m: m.similarity).template_id if matches else -1

    return best


def opencv_hog(views: Tensor) -> Best:
    S = views.shape[-1]
    cell = S // 8
    describe = cv2.HOGDescriptor((S, S), (2 * cell, 2 * cell), (cell, cell), (cell, cell), 9)
    return _nearest(views, lambda x: describe.compute(_bytes(x))[:, None].ravel())


def skimage_hog(views: Tensor) -> Best:
    cells = {"pixels_per_cell": (views.shape[-1] // 8,) * 2, "cells_per_block": (2, 2), "block_norm": "L2-Hys"}
    return _nearest(views, lambda x: hog(x.mean(dim=0).numpy(), **cells))


def kornia_sobel(views: Tensor) -> Best:
    return _nearest(views, lambda x: kornia.filters.sobel(x.mean(dim=0)[None, None]).flatten().numpy())


def _nearest(views: Tensor, describe: Callable[[Tensor], np.ndarray]) -> Best:
    """By the cosine of descriptors."""
    known = F.normalize(torch.from_numpy(np.stack([describe(view) for view in views])).float(), dim=1)
    return lambda crop: int((known @ torch.from_numpy(describe(crop)).float()).argmax())


def _bytes(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray((x.permute(1, 2, 0) * 255).round().byte().numpy())


PEERS = {
    "OpenCV LINEMOD, colour gradients": linemod,
    "OpenCV HOG of the picture, cosine": opencv_hog,
    "scikit-image HOG of the picture, cosine": skimage_hog,
    "kornia Sobel, cosine": kornia_sobel,
}
OURS = ("learned", "classical", "fast")


def compare(folder: Path, photographs: int) -> list[dict[str, Any]]:
    """Time and share of right answers of each on the benchmark's first upright photographs with exact CAD."""
    half = folder / "held-out"
    items = [json.loads(line) for line in (half / "items.jsonl").read_text().splitlines()]
    items = [i for i in items if (i["form"], i["pose"]) == ("exact", "upright")][:photographs]
    peers = {name: make for name, make in PEERS.items() if make is not linemod or hasattr(cv2, "linemod")}
    rows = {name: {"prepare": [], "rank": [], "right": []} for name in (*peers, *OURS)}
    for item in tqdm(items):
        mesh = load_mesh(folder / item["mesh"])
        image, box = read_image(half / item["image"]), torch.tensor([item["box"]])
        truth, symmetries = allocentric(item), torch.tensor(item["symmetries"], dtype=torch.float64)
        answers: dict[str, Callable[[], int]] = {}
        for name in OURS:
            pipeline = preset_named(name).with_pose_prior("upright")
            start = time.perf_counter()
            matcher = ViewMatcher(ViewBank.build(mesh, pipeline=pipeline, progress=False), pipeline=pipeline)
            rows[name]["prepare"].append(time.perf_counter() - start)
            answers[name] = lambda m=matcher: int(m([image], box).order[0, 0])  # noqa: B023
        bank, crop = matcher.bank, matcher.query([image], box).crops[0]
        start = time.perf_counter()
        grey = ViewDescriber(mesh, bank.settings, coloured=False)
        views = grey.shaded(bank.rotations, bank.distances)
        shading = time.perf_counter() - start
        for name, make in peers.items():
            start = time.perf_counter()
            best = make(views)
            rows[name]["prepare"].append(time.perf_counter() - start + shading)
            answers[name] = lambda best=best: best(crop)  # noqa: B023
        for name, ask in answers.items():
            start = time.perf_counter()
            found = ask()
            rows[name]["rank"].append(time.perf_counter() - start)
            error = float(error_up_to(bank.rotations[found : found + 1].double(), truth, symmetries))
            rows[name]["right"].append(found >= 0 and error <= RIGHT)
    return [
        {
            "method": name,
            "prepare_s": float(np.median(row["prepare"])),
            "rank_ms": 1000 * float(np.median(row["rank"])),
            "right": float(np.mean(row["right"])),
            "n": len(row["right"]),
        }
        for name, row in rows.items()
    ]


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| method | views ready, s | one photograph, ms | within 30 degrees |", "|---|---|---|---|"]
    names = {name: f"ours, preset `{name}`" for name in OURS}
    for row in rows:
        told = names.get(row["method"], row["method"])
        lines.append(f"| {told} | {row['prepare_s']:.2f} | {row['rank_ms']:.0f} | {row['right']:.2f} |")
    return "\n".join(lines) + "\n"
