"""What the errors on PASCAL3D+ are made of, before and after: the second table of docs/accuracy.md.

    python scripts/error_taxonomy.py DIR [DIR ...]           --out of "curvireg evaluate pascal3d", beside the record
    python scripts/error_taxonomy.py DIR --pictures OUT --root ROOT [--pixel-origin 0]      draws the errors

Every object gets the first kind that holds: right (within 30 degrees, symmetries of the class taken into account);
half a turn (azimuth off by 180 +- 30 degrees); mirrored (azimuth as in a mirror, left for right, +- 30 degrees);
elevation or in-plane angle (azimuth within 30 degrees); other. Pictures show the photograph's crop beside the depth
view of the pose that was found; they are for looking at, not for committing.
"""

import argparse
import csv
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import torch
from _record import REPOSITORY, between, write_json

from curvireg_torch.data import Pascal3DPlus, read_image
from curvireg_torch.geometry import crop_images, load_mesh, rotation_from_viewpoint
from curvireg_torch.matching import BankSettings, ViewDescriber

KINDS = ("right", "half a turn", "mirrored", "elevation or in-plane angle", "other")
PAGE = REPOSITORY / "docs" / "accuracy.md"
KEPT = REPOSITORY / "scripts" / "results" / "error_taxonomy.json"
BEGIN, END = "<!-- taxonomy:begin -->", "<!-- taxonomy:end -->"
TILE = 128


def kind(row: dict[str, str]) -> str:
    if float(row["symmetric_error_deg"]) < 30:
        return "right"
    azimuth, truth = float(row["azimuth"] or "nan"), float(row["true_azimuth"])
    if apart(azimuth, truth + 180) < 30:
        return "half a turn"
    if apart(azimuth, -truth) < 30:
        return "mirrored"
    return "elevation or in-plane angle" if apart(azimuth, truth) < 30 else "other"


def apart(one: float, other: float) -> float:
    return abs((one - other + 180) % 360 - 180)


def read(folder: Path) -> list[dict[str, str]]:
    with (folder / "predictions.csv").open(newline="") as lines:
        return list(csv.DictReader(lines))


def count(rows: list[dict[str, str]]) -> dict[str, dict[str, int]]:
    """Objects of each kind: all, those seen whole, and those that are not."""
    hidden = [any(row[flag] == "1" for flag in ("truncated", "occluded", "difficult")) for row in rows]
    kinds = [kind(row) for row in rows]
    return {
        "all": Counter(kinds),
        "seen whole": Counter(k for k, h in zip(kinds, hidden, strict=True) if not h),
        "cut, hidden or difficult": Counter(k for k, h in zip(kinds, hidden, strict=True) if h),
    }


def table(results: dict[str, dict[str, dict[str, int]]]) -> str:
    lines = [["pipeline", "objects", "N", *KINDS], ["---"] * (3 + len(KINDS))]
    for name, parts in results.items():
        for part, counts in parts.items():
            lines.append([name, part, str(sum(counts.values())), *(str(counts.get(k, 0)) for k in KINDS)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def picture(row: dict[str, str], dataset: Pascal3DPlus, index: int) -> np.ndarray:
    s = dataset.annotation(index)
    crop = crop_images([read_image(s["image_path"])], s["box"][None], size=TILE)[0][0]
    cad = Path(s["cad_path"]).with_name(row["mesh"])
    describe = ViewDescriber(load_mesh(cad), BankSettings(image_size=TILE))
    R = rotation_from_viewpoint(*(float(row[name]) for name in ("azimuth", "elevation", "theta")))
    depth = describe.depth(R[None], torch.tensor([5.0 * float(describe.hull.norm(dim=1).max())]))[0][0, 0]
    seen = depth > 0
    shade = torch.where(seen, 1 - 0.8 * (depth - depth[seen].min()) / (depth.max() - depth[seen].min() + 1e-9), 0.0)
    tile = torch.cat([crop, shade.expand(3, -1, -1)], dim=2).permute(1, 2, 0)
    return np.ascontiguousarray((255 * tile.clamp(0, 1)).byte().numpy()[..., ::-1])


def draw(rows: list[dict[str, str]], dataset: Pascal3DPlus, out: Path) -> None:
    keys = {}
    for i in range(len(dataset)):
        s = dataset.annotation(i)
        keys[s["category"], str(s["image_id"]), str(s["object_index"])] = i
    tiles: list[np.ndarray] = []
    for k in KINDS[1:]:
        for row in (r for r in rows if kind(r) == k):
            tile = picture(row, dataset, keys[row["category"], row["image_id"], row["object_index"]])
            cv2.putText(tile, k, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 255), 1, cv2.LINE_AA)
            tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 6)
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), np.vstack([np.hstack(tiles[i : i + 6]) for i in range(0, len(tiles), 6)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="results of an evaluation")
    parser.add_argument("--names", nargs="+", metavar="NAME", help="of the pipelines; default: names of the folders")
    parser.add_argument("--pictures", type=Path, metavar="OUT", help="draw the first folder's errors; no table")
    parser.add_argument("--root", type=Path, help="of the dataset, for --pictures")
    parser.add_argument("--pixel-origin", type=int, choices=(0, 1), default=1)
    arguments = parser.parse_args()
    if arguments.pictures is not None:
        dataset = Pascal3DPlus(arguments.root, "val", pixel_origin=arguments.pixel_origin)
        draw(read(arguments.folders[0]), dataset, arguments.pictures)
        return
    names = arguments.names or [folder.name for folder in arguments.folders]
    results = json.loads(KEPT.read_text())
    results |= {name: count(read(folder)) for name, folder in zip(names, arguments.folders, strict=True)}
    write_json(KEPT, results, 1)
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(between(text, BEGIN, END, table(results)), encoding="utf-8")


if __name__ == "__main__":
    main()
