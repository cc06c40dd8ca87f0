"""Measure localization without a box beside OpenCV's LINEMOD, and fit the presence model.

    python scripts/speed/location.py BENCH --rows rows.jsonl [--preset learned] [--pose upright] [--form exact]
    python scripts/speed/location.py --rows rows.jsonl --table     # fits presence; writes record, table and picture

BENCH is the folder of scripts/benchmark/make.py. Each photograph in which more than 0.7 of the object's silhouette is
visible becomes a quarter of a mosaic of 640 x 480 px, beside three photographs of other kinds of objects; a second
mosaic does not contain the object. Rows hold the overlap of the proposals with the visible box and the features of
presence; an interrupted run can be resumed. LINEMOD gets the same representative views, shaded grey, at the same sizes;
it needs opencv-contrib-python-headless in place of opencv-python-headless.
"""

import argparse
import json
import random
import time
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score, roc_curve
from sklearn.model_selection import GroupKFold, cross_val_predict
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.geometry import box_iou
from curvireg_torch.matching import cached_bank
from curvireg_torch.pipeline import DEFAULT, PRESETS, preset_named
from curvireg_torch.registration.confidence import presence
from curvireg_torch.registration.inputs import ImageItem
from curvireg_torch.registration.localization import ScoredCandidates
from curvireg_torch.registration.locator import representative_views
from scripts._shared import REPOSITORY, RESULTS, commit, table_lines, today, update_page, write_json

Row = dict[str, Any]
Curves = dict[str, tuple[list[bool], list[float]]]
"""Labels and presence probabilities of each task."""

SIZE = (480, 640)
VISIBLE = 0.7
"""Photographs become mosaics where more than this fraction of the object's silhouette is seen."""
RECORD = RESULTS / "location.json"
PAGE = REPOSITORY / "docs" / "guides" / "without-a-box.md"
PICTURE = REPOSITORY / "docs" / "images" / "presence.png"
UNITS = np.array([1.0, 0.1])  # scale of the features, so that weights have similar sizes
FORMS = ("exact", "sibling")
FITTED = ("learned", "classical")
"""Presets for which presence is fitted: one that locates by appearance, and one that compares fields."""

TASKS = {"photographs": "photographs with the object", "places": "right proposals"}
"""Binary classifications that presence is evaluated on."""


def mosaic(half: Path, items: list[Row], shown: Row | None, seed: int) -> tuple[Tensor, Tensor | None]:
    """(3, 480, 640) mosaic of four photographs, and the visible box of the object if ``shown`` is one of them."""
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
    """(P, 4) best boxes by LINEMOD's similarity, and seconds."""
    bank, located = registrar.bank, registrar.locator
    views = representative_views(bank, located.settings.views)
    pictures = registrar.matcher.describers[0].shaded(bank.rotations[views], bank.distances[views])[:, :1]
    start = time.perf_counter()
    longer, boxes, scores = max(SIZE), [], []
    side = located.settings.min_size * longer
    while side <= longer:
        detector = cv2.linemod.getDefaultLINE()
        S = round(side / 0.83)  # including the margin around the object
        small = F.interpolate(pictures, size=(S, S), mode="bilinear", antialias=True)
        frames = {}
        for view in small:
            grey = np.repeat((view[0].numpy() * 255).astype(np.uint8)[..., None], 3, axis=2)
            number, frame = detector.addTemplate([grey], "object", (grey[..., 0] < 255).astype(np.uint8) * 255)
            frames[number] = frame
        photograph = np.ascontiguousarray((image.permute(1, 2, 0) * 255).byte().numpy()[..., ::-1])
        for match in detector.match([photograph], 50.0, ["object"])[0][:500]:
            _, _, wide, high = frames[match.template_id]
            boxes.append([match.x, match.y, match.x + wide, match.y + high])
            scores.append(match.similarity)
        side *= 2**0.5
    order = np.argsort(scores)[::-1][:500]
    selected: list[int] = []
    found = torch.tensor(boxes, dtype=torch.float32).view(-1, 4)
    for k in order.tolist():
        if len(selected) < count and (not selected or float(box_iou(found[k, None], found[selected]).max()) <= 0.5):
            selected.append(k)
    return found[selected], time.perf_counter() - start


def rows_of(folder: Path, item: Row, items: list[Row], half: Path, preset: str) -> Row:
    pipeline = preset_named(preset).with_pose_prior("upright" if item["pose"] == "upright" else "any")
    by_appearance = any(term.name == "appearance" for term in pipeline.terms)
    if by_appearance:
        pipeline = pipeline.with_term("appearance", exhaustive_limit=0)
    bank = cached_bank(cr.load_mesh(folder / item["mesh"]), pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline)
    others = [o for o in items if o["shown"] != item["shown"] and o["mesh"] != item["mesh"]]
    others = [o for o in others if item["kind"] is None or o["kind"] != item["kind"]]
    row: Row = {"preset": preset, **{name: item[name] for name in ("id", "pose", "form", "mesh")}}
    registrar.locator  # noqa: B018 (prepares its views before the clock starts)
    for name, shown in (("present", item), ("absent", None)):
        image, box = mosaic(half, others, shown, item["id"])
        start = time.perf_counter()
        located = registrar.locator([image])[0]
        seconds = time.perf_counter() - start
        count = registrar.pipeline.locate.candidates
        with torch.no_grad():
            scored = ScoredCandidates.score_boxes(
                registrar, ImageItem(image, box, None), located.boxes[:count], located.scores[:count]
            )
        overlaps = [0.0] * len(located.boxes) if box is None else box_iou(located.boxes, box[None])[:, 0].tolist()
        row[name] = {"overlaps": overlaps, "evidence": scored.evidence, "seconds": seconds}
        if hasattr(cv2, "linemod") and by_appearance and box is not None:
            boxes, spent = linemod_boxes(registrar, image, len(located.boxes))
            row["linemod"] = {"overlaps": box_iou(boxes, box[None])[:, 0].tolist(), "seconds": spent}
    return row


def recall(rows: list[Row], name: str, count: int) -> float:
    return float(np.mean([max(row[name]["overlaps"][:count], default=0.0) >= 0.5 for row in rows]))


class Proposal(NamedTuple):
    """A scored proposal of a photograph, with its probability of being right."""

    photograph: tuple[int, str]
    right: bool
    presence: float


def score_proposals(rows: list[Row], *, fit: bool) -> tuple[Row, list[Proposal]]:
    """Fitted parameters and presence of each proposal, cross-validated over meshes; or presence by the library."""
    columns = [
        ((n, name), evidence, overlap >= 0.5, row["mesh"])
        for n, row in enumerate(rows)
        for name in ("present", "absent")
        for evidence, overlap in zip(row[name]["evidence"], row[name]["overlaps"], strict=False)  # only some are scored
    ]
    photographs, evidence, right, meshes = (list(column) for column in zip(*columns, strict=True))
    if not fit:
        return {}, [Proposal(*one) for one in zip(photographs, right, map(presence, evidence), strict=True)]
    values, units = np.array(evidence), UNITS[-len(evidence[0]) :]
    model = LogisticRegression(C=10.0, max_iter=1000)
    folds = {"groups": meshes, "cv": GroupKFold(5), "method": "predict_proba"}
    probability = cross_val_predict(model, values / units, right, **folds)[:, 1].tolist()
    model.fit(values / units, right)
    fitted = {"weights": (model.coef_[0] / units).round(3).tolist(), "bias": round(float(model.intercept_[0]), 3)}
    return fitted, [Proposal(*one) for one in zip(photographs, right, probability, strict=True)]


def best_proposals(proposals: list[Proposal]) -> list[Proposal]:
    """The most probable proposal of each photograph."""
    best: dict[tuple[int, str], Proposal] = {}
    for one in proposals:
        best[one.photograph] = max(best.get(one.photograph, one), one, key=lambda p: p.presence)
    return list(best.values())


def curves(proposals: list[Proposal]) -> Curves:
    best = best_proposals(proposals)
    return {
        "photographs": ([p.photograph[1] == "present" for p in best], [p.presence for p in best]),
        "places": ([p.right for p in proposals], [p.presence for p in proposals]),
    }


def record_of(rows: list[Row]) -> tuple[Row, dict[str, Curves]]:
    """The record, and the curves of the figure."""
    record: Row = {"commit": commit(), "date": today(), "presence": {}, "sets": []}
    drawn = {}
    for preset in PRESETS:
        some = [row for row in rows if row["preset"] == preset]
        if not some:
            continue
        fitted, proposals = score_proposals(some, fit=preset in FITTED)
        if preset in FITTED:
            record["presence"][preset] = {**fitted, "forms": {}}
            for form in FORMS:
                if mine := [p for p in proposals if some[p.photograph[0]]["form"] == form]:
                    found = drawn[f"{preset}, {form}"] = curves(mine)
                    record["presence"][preset]["forms"][form] = {
                        name: {"n": len(truth), "true": sum(truth), "auc": float(roc_auc_score(truth, probability))}
                        for name, (truth, probability) in found.items()
                    }
        right = {p.photograph: p.right for p in best_proposals(proposals)}
        for pose, form in product(("upright", "free"), FORMS):
            numbers = [n for n, row in enumerate(some) if (row["pose"], row["form"]) == (pose, form)]
            mine = [some[n] for n in numbers]
            peers = [row for row in mine if "linemod" in row]
            if mine:
                one: Row = {
                    "set": f"{form} {pose}",
                    "preset": preset,
                    "n": len(mine),
                    **{f"recall_{k}": recall(mine, "present", k) for k in (1, 5, 20)},
                    "surest": float(np.mean([right[n, "present"] for n in numbers])),
                    "linemod_n": len(peers),
                    "linemod": {f"recall_{k}": recall(peers, "linemod", k) for k in (1, 5, 20)} if peers else None,
                }
                record["sets"].append(one)
    return record, drawn


def table(record: Row) -> str:
    """Markdown of the record."""
    counts = ["recall@1", "@5", "@20"]
    rows = [["set", "preset", "N", *counts, "most probable of 5 is right", "LINEMOD, N", "@1", "@5", "@20"]]
    for one in record["sets"]:
        theirs = [f"{one['linemod'][f'recall_{k}']:.2f}" for k in (1, 5, 20)] if one["linemod"] else [""] * 3
        ours = [*(f"{one[f'recall_{k}']:.2f}" for k in (1, 5, 20)), f"{one['surest']:.2f}"]
        rows.append([one["set"], f"`{one['preset']}`", str(one["n"]), *ours, str(one["linemod_n"] or ""), *theirs])
    classified = [["presence classifies", "preset", "form", "N", "positives", "AUC"]]
    for preset, fitted in record["presence"].items():
        for form, tasks in fitted["forms"].items():
            for name, one in tasks.items():
                cells = [str(one["n"]), str(one["true"]), f"{one['auc']:.2f}"]
                classified.append([TASKS[name], f"`{preset}`", form, *cells])
    first = f"Mosaics contain only photographs in which more than {VISIBLE:g} of the object's silhouette is visible."
    last = f"{record['date']}, commit {record['commit']}."
    return "\n".join([first, "", *table_lines(rows), "", *table_lines(classified), "", last, ""])


def draw(drawn: dict[str, Curves]) -> Figure:
    """Receiver operating characteristics, one panel per task."""
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    for name, axes in zip(TASKS, figure.subplots(1, 2), strict=True):
        for label, found in drawn.items():
            truth, probability = found[name]
            false, true, _ = roc_curve(truth, probability)
            count = f"{sum(truth)} of {len(truth)}"
            axes.plot(false, true, label=f"{label}: AUC {roc_auc_score(truth, probability):.2f} ({count})")
        axes.plot([0, 1], [0, 1], color="0.8", linewidth=0.8, zorder=0)
        axes.set(title=TASKS[name], xlim=(0, 1), ylim=(0, 1.01), xlabel="false positive rate", aspect="equal")
        axes.legend(loc="lower right", fontsize="small")
    figure.axes[0].set_ylabel("true positive rate")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", metavar="BENCH")
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--pose", choices=("upright", "free"), default="upright")
    parser.add_argument("--form", choices=FORMS, default="exact")
    parser.add_argument("--preset", choices=sorted(PRESETS), default=DEFAULT)
    parser.add_argument("--photographs", type=int, default=40)
    parser.add_argument("--rows", type=Path, required=True)
    parser.add_argument("--table", action="store_true", help="fit presence; write record, table and picture")
    arguments = parser.parse_args()
    rows = [json.loads(line) for line in arguments.rows.read_text().splitlines()] if arguments.rows.exists() else []
    if arguments.table:
        record, drawn = record_of(rows)
        write_json(RECORD, record)
        update_page(PAGE, "location", table(record))
        draw(drawn).savefig(PICTURE, dpi=90)
        print(json.dumps(record["presence"], indent=2))
        return
    torch.set_num_threads(1)
    half = arguments.folder / arguments.half
    items = [json.loads(line) for line in (half / "items.jsonl").read_text().splitlines()]
    wanted = [i for i in items if (i["pose"], i["form"]) == (arguments.pose, arguments.form) and i["visible"] > VISIBLE]
    random.Random(7).shuffle(wanted)
    done = {row["id"] for row in rows if row["preset"] == arguments.preset}
    with arguments.rows.open("a") as file:
        for item in tqdm(wanted[: arguments.photographs]):
            if item["id"] not in done:
                file.write(json.dumps(rows_of(arguments.folder, item, items, half, arguments.preset)) + "\n")
                file.flush()


if __name__ == "__main__":
    main()
