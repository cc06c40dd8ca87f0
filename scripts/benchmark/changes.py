"""Compare two runs of run.py on the same photographs, with pictures of the ten largest gains and losses.

    python scripts/benchmark/changes.py FOLDER BEFORE.jsonl AFTER.jsonl [--pictures PATTERN]

Prints the fractions of poses within some limits before and after, of photographs with their exact mesh, how many were
won and lost, and the two-sided sign test. PATTERN, such as ``docs/images/changes-{}.webp``, gets "gains" and "losses":
the pose before on the left, after on the right, ordered by the ratio of the errors.
"""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scipy.stats import binomtest

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import transform
from curvireg_torch.rendering import make_renderer
from scripts._shared import table_lines
from scripts.docs_pictures import captioned, drawn, side_by_side, stacked

LIMITS = {
    "2°": (2.0, math.inf),
    "5°": (5.0, math.inf),
    "15°": (15.0, math.inf),
    "30°": (30.0, math.inf),
    "5° and 5 %": (5.0, 0.05),
}
"""Largest rotation error in degrees, and of the translation as a fraction of the distance."""

LEAST, RATIO = 5.0, 1.5
"""Of a change: the larger error in degrees, and the ratio of both errors."""

HEIGHT = 180  # of a picture in px

Row = dict[str, Any]


def errors_of(row: Row, item: Row) -> tuple[float, float]:
    """Rotation error of the first pose in degrees, and of its translation as a fraction of the distance."""
    if "failed" in row:
        return 180.0, math.inf
    true = np.array(item["t"])
    return row["errors"][0], float(np.linalg.norm(np.array(row["answer"][1]) - true) / np.linalg.norm(true))


def paired_table(items: Sequence[Row], before: Sequence[Row], after: Sequence[Row]) -> str:
    """Fractions within each limit before and after, won and lost, and the p value, in Markdown."""
    lines = [["photographs", "N", "within", "before", "after", "won, lost", "p"]]
    for pose in sorted({item["pose"] for item in items}, reverse=True):
        mine = [k for k, item in enumerate(items) if item["pose"] == pose]
        pairs = [[errors_of(rows[k], items[k]) for rows in (before, after)] for k in mine]
        for name, limits in LIMITS.items():
            inside = np.array([[e[0] < limits[0] and e[1] <= limits[1] for e in pair] for pair in pairs])
            won, lost = (int((inside[:, a] & ~inside[:, b]).sum()) for a, b in ((1, 0), (0, 1)))
            p = binomtest(won, won + lost).pvalue if won + lost else 1.0
            shares = [f"{share:.3f}" for share in inside.mean(axis=0)]
            lines.append([f"exact, {pose}", str(len(mine)), name, *shares, f"{won}, {lost}", f"{p:.2g}"])
    return "\n".join(table_lines(lines))


def largest_changes(pairs: Sequence[tuple[float, float]], count: int = 10) -> tuple[list[int], list[int]]:
    """Indices of the largest gains and losses among (before, after) errors in degrees, largest first."""
    change = {k: np.log(max(b, 0.1) / max(a, 0.1)) for k, (b, a) in enumerate(pairs) if max(a, b) >= LEAST}
    gains = sorted((k for k in change if change[k] >= np.log(RATIO)), key=lambda k: -change[k])
    losses = sorted((k for k in change if change[k] <= -np.log(RATIO)), key=lambda k: change[k])
    return gains[:count], losses[:count]


def picture(folder: Path, half: Path, item: Row, rows: Sequence[Row]) -> Image.Image:
    """The object with its contours in the pose of each row, side by side."""
    image = read_image(half / item["image"])
    renderer = make_renderer(cr.load_mesh(folder / item["mesh"]))
    x0, y0, x1, y1 = item["box"]
    margin, (H, W) = 0.15 * max(x1 - x0, y1 - y0), image.shape[-2:]
    window = (max(0, int(x0 - margin)), max(0, int(y0 - margin)), min(W, int(x1 + margin)), min(H, int(y1 + margin)))
    tiles = []
    for row in rows:
        R, t = (torch.tensor(part, dtype=torch.float64) for part in row["answer"])
        pose = transform(R, t), torch.tensor(item["K"], dtype=torch.float64)
        tile = Image.fromarray(drawn(renderer, pose, image, window))
        tile = tile.resize((round(tile.width * HEIGHT / tile.height), HEIGHT), Image.Resampling.LANCZOS)
        tiles.append(captioned(np.asarray(tile), f"{row['errors'][0]:.1f}°"))
    return side_by_side(tiles)


def sheet(pictures: Sequence[Image.Image], width: int = 1200, gap: int = 30) -> Image.Image:
    """Pictures in lines of at most ``width`` px, on white."""
    lines: list[list[Image.Image]] = [[]]
    for one in pictures:
        if lines[-1] and sum(p.width + gap for p in lines[-1]) + one.width > width:
            lines.append([])
        lines[-1].append(one)
    return stacked([side_by_side(line, gap=gap) for line in lines], gap=8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--half", default="held-out", help="of run.py")
    parser.add_argument("--pictures", metavar="PATTERN")
    arguments = parser.parse_args()
    if arguments.pictures and "{}" not in arguments.pictures:
        parser.error("--pictures: the pattern needs {}, which becomes gains or losses")
    half = arguments.folder / arguments.half
    lines = (half / "items.jsonl").read_text().splitlines()
    items = {item["id"]: item for item in map(json.loads, lines) if item["form"] == "exact"}
    runs = [
        {row["id"]: row for row in map(json.loads, path.read_text().splitlines()) if row["id"] in items}
        for path in (arguments.before, arguments.after)
    ]
    both = sorted(runs[0].keys() & runs[1].keys())
    if not both:
        parser.error("no photograph is in both runs")
    if alone := len(runs[0].keys() ^ runs[1].keys()):
        print(f"{alone} photographs are in one of the runs only and left out")
    before, after = ([run[k] for k in both] for run in runs)
    if strange := [row["id"] for row in before + after if row.get("wrong") or not ("answer" in row or "failed" in row)]:
        parser.error(f"photograph {strange[0]}: register it to its own mesh, with its camera, by run.py of today")
    print(paired_table([items[k] for k in both], before, after))
    if arguments.pictures:
        known = [k for k in range(len(both)) if "answer" in before[k] and "answer" in after[k]]
        pairs = [(before[k]["errors"][0], after[k]["errors"][0]) for k in known]
        for name, chosen in zip(("gains", "losses"), largest_changes(pairs), strict=True):
            cases = [known[k] for k in chosen]
            pictures = [picture(arguments.folder, half, items[both[k]], (before[k], after[k])) for k in cases]
            print(f"{len(pictures)} {name}")
            if pictures:
                sheet(pictures).save(arguments.pictures.format(name), quality=80)


if __name__ == "__main__":
    main()
