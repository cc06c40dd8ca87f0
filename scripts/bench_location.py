"""How well and how fast objects are found without a box, beside OpenCV's LINEMOD, and what ``presence`` is worth.

    python scripts/bench_location.py BENCH --rows rows.jsonl [--pose upright] [--form exact] [--photographs 40]
    python scripts/bench_location.py --rows rows.jsonl --table          # fits presence, writes the record and a table

BENCH is the folder of scripts/make_benchmark.py. Each photograph becomes a quarter of a mosaic of 640 x 480 px, three
others, of other kinds of objects, the rest; a second mosaic has none of it. Rows say where the proposals lie (overlap
with the visible box) and what presence is judged by; run again, it goes on. LINEMOD gets the same representative
views, shaded grey, at the same sizes; it needs opencv-contrib-python-headless in place of opencv-python-headless.
"""

import argparse
import json
import random
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from _record import REPOSITORY, between, commit, today, write_json
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import GroupKFold, cross_val_predict
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import box_iou
from curvireg_torch.location import representative_views
from curvireg_torch.matching import cached_bank
from curvireg_torch.registration.confidence import presence_evidence
from curvireg_torch.registration.finding import Places
from curvireg_torch.registration.inputs import Item

Row = dict[str, Any]

SIZE = (480, 640)
RECORD = REPOSITORY / "scripts" / "results" / "location.json"
PAGE = REPOSITORY / "docs" / "guides" / "without-a-box.md"
MARKERS = "<!-- location:begin -->", "<!-- location:end -->"
UNITS = np.array([1.0, 0.1, 0.1])  # of the evidence, so that weights are of one size


def mosaic(half: Path, items: list[Row], shown: Row | None, seed: int) -> tuple[Tensor, Tensor | None]:
    """(3, 480, 640) of four photographs, and the visible box of the object of ``shown``, which is one of them."""
    draw = random.Random(seed)
    h, w = SIZE[0] // 2, SIZE[1] // 2
    place = draw.randrange(4) if shown is not None else -1
    canvas, found = torch.zeros(3, *SIZE), None
    for k in range(4):
        item = shown if k == place and shown is not None else draw.choice(items)
        image = read_image(half / item["image"])
        scale = max(h / image.shape[1], w / image.shape[2])
        image = F.interpolate(image[None], scale_factor=scale, mode="bilinear", antialias=True)[0]
        box = torch.tensor(item["box_visible"]) * scale
        middle = (0.5 * (box[:2] + box[2:])).tolist()
        left = int(min(max(middle[0] - w / 2, 0), image.shape[2] - w))
        top = int(min(max(middle[1] - h / 2, 0), image.shape[1] - h))
        x, y = w * (k % 2), h * (k // 2)
        canvas[:, y : y + h, x : x + w] = image[:, top : top + h, left : left + w]
        if k == place:
            inside = torch.tensor([w, h, w, h], dtype=box.dtype)
            shift = torch.tensor([left, top, left, top])
            found = torch.minimum((box - shift).clamp(min=0), inside) + torch.tensor([x, y, x, y])
    return canvas, found


def linemod_boxes(registrar: cr.Registrar, image: Tensor, count: int) -> tuple[Tensor, float]:
    """(P, 4) best places by LINEMOD's similarity, and seconds."""
    bank, located = registrar.bank, registrar.locator
    views = representative_views(bank, located.settings.views)
    pictures = registrar.matcher.describers[0].shaded(bank.rotations[views], bank.distances[views])[:, :1]
    start = time.perf_counter()
    longer, boxes, scores = max(SIZE), [], []
    side = located.settings.smallest * longer
    while side <= longer:
        detector = cv2.linemod.getDefaultLINE()
        S = round(side / 0.83)  # with the margin around the object
        small = F.interpolate(pictures, size=(S, S), mode="bilinear", antialias=True)
        places = {}
        for view in small:
            grey = np.repeat((view[0].numpy() * 255).astype(np.uint8)[..., None], 3, axis=2)
            number, frame = detector.addTemplate([grey], "object", (grey[..., 0] < 255).astype(np.uint8) * 255)
            places[number] = frame
        photograph = np.ascontiguousarray((image.permute(1, 2, 0) * 255).byte().numpy()[..., ::-1])
        for match in detector.match([photograph], 50.0, ["object"])[0][:500]:
            _, _, wide, high = places[match.template_id]
            boxes.append([match.x, match.y, match.x + wide, match.y + high])
            scores.append(match.similarity)
        side *= 2**0.5
    order = np.argsort(scores)[::-1][:500]
    kept: list[int] = []
    found = torch.tensor(boxes, dtype=torch.float32).view(-1, 4)
    for k in order.tolist():
        if len(kept) < count and (not kept or float(box_iou(found[k, None], found[kept]).max()) <= 0.5):
            kept.append(k)
    return found[kept], time.perf_counter() - start


def rows_of(folder: Path, item: Row, items: list[Row], half: Path) -> Row:
    pipeline = cr.Pipeline().posed("upright" if item["pose"] == "upright" else "any").with_term("appearance", coarse=0)
    bank = cached_bank(cr.load_mesh(folder / item["mesh"]), pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline)
    others = [
        o
        for o in items
        if o["shown"] != item["shown"]
        and o["mesh"] != item["mesh"]
        and (item["kind"] is None or o["kind"] != item["kind"])
    ]
    row: Row = {name: item[name] for name in ("id", "pose", "form", "mesh")}
    registrar.locator  # noqa: B018 (its views are made once)
    for name, shown in (("present", item), ("absent", None)):
        image, box = mosaic(half, others, shown, item["id"])
        start = time.perf_counter()
        located = registrar.locator([image])[0]
        seconds = time.perf_counter() - start
        count = registrar.pipeline.locate.followed
        with torch.no_grad():
            places = Places.judged(registrar, Item(image, box, None), located.boxes[:count], located.scores[:count])
        overlaps = [0.0] * len(located.boxes) if box is None else box_iou(located.boxes, box[None])[:, 0].tolist()
        evidence = [presence_evidence(float(s), places.ranking[k : k + 1]) for k, s in enumerate(places.scores)]
        row[name] = {"overlaps": overlaps, "evidence": evidence, "seconds": seconds}
        if hasattr(cv2, "linemod") and box is not None:
            boxes, spent = linemod_boxes(registrar, image, len(located.boxes))
            row["linemod"] = {"overlaps": box_iou(boxes, box[None])[:, 0].tolist(), "seconds": spent}
    return row


def recall(rows: list[Row], name: str, count: int) -> float:
    return float(np.mean([max(row[name]["overlaps"][:count], default=0.0) >= 0.5 for row in rows]))


def table(rows: list[Row]) -> tuple[Row, str]:
    """The record and the docs' table."""
    X, y, mesh, group = [], [], [], []
    for n, row in enumerate(rows):
        for name in ("present", "absent"):
            for k, evidence in enumerate(row[name]["evidence"]):
                X.append(evidence / UNITS)
                y.append(row[name]["overlaps"][k] >= 0.5)
                mesh.append(row["mesh"])
                group.append((n, name))
    values, right = np.array(X), np.array(y)
    model = LogisticRegression(C=10.0, max_iter=1000)
    sure = cross_val_predict(model, values, right, groups=mesh, cv=GroupKFold(5), method="predict_proba")[:, 1]
    fitted = model.fit(values, right)
    best: dict[tuple[int, str], tuple[float, bool]] = {}
    for key, p, good in zip(group, sure, right, strict=True):
        best[key] = max(best.get(key, (-1.0, False)), (float(p), bool(good)))
    # Photographs with the object, where the surest place is right, against those without it.
    told = [(p, name == "present") for (_, name), (p, good) in best.items() if name == "absent" or good]
    record: Row = {
        "commit": commit(REPOSITORY),
        "date": today(),
        "presence": {
            "places": len(right),
            "right": int(right.sum()),
            "weights": (fitted.coef_[0] / UNITS).round(3).tolist(),
            "bias": round(float(fitted.intercept_[0]), 3),
            "auc_places": float(roc_auc_score(right, sure)),
            "auc_photographs": float(roc_auc_score([there for _, there in told], [p for p, _ in told])),
            "photographs": len(told),
        },
        "sets": [],
    }
    lines = ["| set | N | recall@1 | @5 | @20 | surest of 5 is right | LINEMOD @1 | @5 | @20 |", "|---" * 9 + "|"]
    for pose in ("upright", "free"):
        for form in ("exact", "sibling"):
            some = [(n, row) for n, row in enumerate(rows) if (row["pose"], row["form"]) == (pose, form)]
            if not some:
                continue
            mine = [row for _, row in some]
            peers = [row for row in mine if "linemod" in row]
            one: Row = {
                "set": f"{form} {pose}",
                "n": len(mine),
                **{f"recall_{k}": recall(mine, "present", k) for k in (1, 5, 20)},
                "surest": float(np.mean([best.get((n, "present"), (0.0, False))[1] for n, _ in some])),
                "seconds": float(np.median([row["present"]["seconds"] for row in mine])),
                "linemod": {f"recall_{k}": recall(peers, "linemod", k) for k in (1, 5, 20)} if peers else None,
                "linemod_n": len(peers),
                "linemod_seconds": float(np.median([row["linemod"]["seconds"] for row in peers])) if peers else None,
            }
            record["sets"].append(one)
            theirs = [f"{one['linemod'][f'recall_{k}']:.2f}" for k in (1, 5, 20)] if peers else ["", "", ""]
            ours = [f"{one[f'recall_{k}']:.2f}" for k in (1, 5, 20)]
            lines.append("| " + " | ".join([one["set"], str(one["n"]), *ours, f"{one['surest']:.2f}", *theirs]) + " |")
    p = record["presence"]
    lines += [
        "",
        f"Presence tells places that are right from others with an AUC of {p['auc_places']:.2f} ({p['right']} of "
        f"{p['places']}), and photographs where it is right from those without the object with "
        f"{p['auc_photographs']:.2f} (N = {p['photographs']}), meshes left out in turn. "
        f"{record['date']}, commit {record['commit']}.",
    ]
    return record, "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", metavar="BENCH")
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--pose", choices=("upright", "free"), default="upright")
    parser.add_argument("--form", choices=("exact", "sibling"), default="exact")
    parser.add_argument("--photographs", type=int, default=40)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--table", action="store_true", help="fit presence, and write the record and the docs' table")
    arguments = parser.parse_args()
    rows = [json.loads(line) for line in arguments.rows.read_text().splitlines()] if arguments.rows.exists() else []
    if arguments.table:
        record, text = table(rows)
        write_json(RECORD, record)
        PAGE.write_text(between(PAGE.read_text(encoding="utf-8"), *MARKERS, text), encoding="utf-8")
        print(json.dumps(record["presence"], indent=2))
        return
    torch.set_num_threads(1)
    half = arguments.folder / arguments.half
    items = [json.loads(line) for line in (half / "items.jsonl").read_text().splitlines()]
    wanted = [i for i in items if (i["pose"], i["form"]) == (arguments.pose, arguments.form) and i["visible"] > 0.7]
    random.Random(7).shuffle(wanted)
    done = {row["id"] for row in rows}
    with arguments.rows.open("a") as file:
        for item in tqdm(wanted[: arguments.photographs]):
            if item["id"] not in done:
                file.write(json.dumps(rows_of(arguments.folder, item, items, half)) + "\n")
                file.flush()


if __name__ == "__main__":
    main()
