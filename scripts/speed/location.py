"""How well and how fast objects are found without a box, beside OpenCV's LINEMOD, and what ``presence`` is worth.

    python scripts/speed/location.py BENCH --rows rows.jsonl [--preset learned] [--pose upright] [--form exact]
    python scripts/speed/location.py --rows rows.jsonl --table          # fits presence, writes record, table, picture

BENCH is the folder of scripts/benchmark/make.py. Each photograph in which more than 0.7 of the object's silhouette is
seen becomes a quarter of a mosaic of 640 x 480 px, three others, of other kinds of objects, the rest; a second mosaic
has none of it. Rows hold the proposals' overlap with the visible box and the features of presence; a second run
resumes. LINEMOD gets the same representative views, shaded grey, at the same sizes; it needs
opencv-contrib-python-headless in place of opencv-python-headless.
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
from curvireg_torch.geometry import box_iou
from curvireg_torch.io import read_image
from curvireg_torch.matching import cached_bank
from curvireg_torch.pipeline import DEFAULT, PRESETS, preset_named
from curvireg_torch.registration.confidence import presence
from curvireg_torch.registration.inputs import ImageItem
from curvireg_torch.registration.localization import ScoredCandidates
from curvireg_torch.registration.locator import representative_views
from scripts._shared import REPOSITORY, commit, replace_between, today, write_json

Row = dict[str, Any]
Curves = dict[str, tuple[list[bool], list[float]]]
"""For each question: whether it is so, and how sure presence is."""

SIZE = (480, 640)
VISIBLE = 0.7
"""Photographs become mosaics where more than this fraction of the object's silhouette is seen."""
RECORD = REPOSITORY / "scripts" / "results" / "location.json"
PAGE = REPOSITORY / "docs" / "guides" / "without-a-box.md"
MARKERS = "<!-- location:begin -->", "<!-- location:end -->"
PICTURE = REPOSITORY / "docs" / "images" / "presence.png"
UNITS = np.array([1.0, 0.1])  # of the evidence, so that weights are of one size
FORMS = ("exact", "sibling")
FITTED = ("learned", "classical")
"""Presets by whose rows presence is fitted: where the locator looks at pictures, and where it compares fields."""

QUESTIONS = {"photographs": "photographs with the object", "places": "places that are right"}
"""What presence is to tell from photographs without the object, and from other places."""


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
    side = located.settings.min_size * longer
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


def rows_of(folder: Path, item: Row, items: list[Row], half: Path, preset: str) -> Row:
    pipeline = preset_named(preset).with_pose_prior("upright" if item["pose"] == "upright" else "any")
    appearance_scores = any(term.name == "appearance" for term in pipeline.terms)
    if appearance_scores:
        pipeline = pipeline.with_term("appearance", exhaustive_limit=0)
    bank = cached_bank(cr.load_mesh(folder / item["mesh"]), pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline)
    others = [
        o
        for o in items
        if o["shown"] != item["shown"]
        and o["mesh"] != item["mesh"]
        and (item["kind"] is None or o["kind"] != item["kind"])
    ]
    row: Row = {"preset": preset, **{name: item[name] for name in ("id", "pose", "form", "mesh")}}
    registrar.locator  # noqa: B018 (its views are made once)
    for name, shown in (("present", item), ("absent", None)):
        image, box = mosaic(half, others, shown, item["id"])
        start = time.perf_counter()
        located = registrar.locator([image])[0]
        seconds = time.perf_counter() - start
        count = registrar.pipeline.locate.candidates
        with torch.no_grad():
            places = ScoredCandidates.score_boxes(
                registrar, ImageItem(image, box, None), located.boxes[:count], located.scores[:count]
            )
        overlaps = [0.0] * len(located.boxes) if box is None else box_iou(located.boxes, box[None])[:, 0].tolist()
        row[name] = {"overlaps": overlaps, "evidence": places.evidence, "seconds": seconds}
        if hasattr(cv2, "linemod") and appearance_scores and box is not None:
            boxes, spent = linemod_boxes(registrar, image, len(located.boxes))
            row["linemod"] = {"overlaps": box_iou(boxes, box[None])[:, 0].tolist(), "seconds": spent}
    return row


def recall(rows: list[Row], name: str, count: int) -> float:
    return float(np.mean([max(row[name]["overlaps"][:count], default=0.0) >= 0.5 for row in rows]))


class Place(NamedTuple):
    """One of the places of a photograph that were ranked, and how sure presence is of it."""

    photograph: tuple[int, str]
    right: bool
    sure: float


def score_boxes(rows: list[Row], *, fit: bool) -> tuple[Row, list[Place]]:
    """Presence of each place: fitted, meshes left out in turn, and what was fitted; or as the library says it."""
    every = [
        ((n, name), evidence, overlap >= 0.5, row["mesh"])
        for n, row in enumerate(rows)
        for name in ("present", "absent")
        for evidence, overlap in zip(row[name]["evidence"], row[name]["overlaps"], strict=False)  # more are proposed
    ]
    where, evidence, right, meshes = (list(column) for column in zip(*every, strict=True))
    told: Row = {}
    if fit:
        values, units = np.array(evidence), UNITS[-len(evidence[0]) :]
        model = LogisticRegression(C=10.0, max_iter=1000)
        sure = cross_val_predict(model, values / units, right, groups=meshes, cv=GroupKFold(5), method="predict_proba")[
            :, 1
        ].tolist()
        model.fit(values / units, right)
        told = {"weights": (model.coef_[0] / units).round(3).tolist(), "bias": round(float(model.intercept_[0]), 3)}
    else:
        sure = [presence(one) for one in evidence]
    return told, [Place(*one) for one in zip(where, right, sure, strict=True)]


def surest(places: list[Place]) -> list[Place]:
    """The one of each photograph."""
    best: dict[tuple[int, str], Place] = {}
    for place in places:
        best[place.photograph] = max(best.get(place.photograph, place), place, key=lambda p: p.sure)
    return list(best.values())


def curves(places: list[Place]) -> Curves:
    best = surest(places)
    return {
        "photographs": ([p.photograph[1] == "present" for p in best], [p.sure for p in best]),
        "places": ([p.right for p in places], [p.sure for p in places]),
    }


def record_of(rows: list[Row]) -> tuple[Row, dict[str, Curves]]:
    """The record, and the curves of the picture."""
    record: Row = {"commit": commit(), "date": today(), "presence": {}, "sets": []}
    drawn = {}
    for preset in PRESETS:
        some = [row for row in rows if row["preset"] == preset]
        if not some:
            continue
        told, places = score_boxes(some, fit=preset in FITTED)
        if preset in FITTED:
            record["presence"][preset] = {**told, "forms": {}}
            for form in FORMS:
                if mine := [p for p in places if some[p.photograph[0]]["form"] == form]:
                    found = drawn[f"{preset}, {form}"] = curves(mine)
                    record["presence"][preset]["forms"][form] = {
                        name: {"n": len(truth), "true": sum(truth), "auc": float(roc_auc_score(truth, sure))}
                        for name, (truth, sure) in found.items()
                    }
        right = {p.photograph: p.right for p in surest(places)}
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
    """The docs' table."""
    lines = [
        f"Only photographs in which more than {VISIBLE:g} of the object's silhouette is seen became mosaics; objects "
        "that are hidden more are not measured here.",
        "",
        "| set | preset | N | recall@1 | @5 | @20 | surest of 5 is right | LINEMOD, N | @1 | @5 | @20 |",
        "|---" * 11 + "|",
    ]
    for one in record["sets"]:
        theirs = [f"{one['linemod'][f'recall_{k}']:.2f}" for k in (1, 5, 20)] if one["linemod"] else [""] * 3
        ours = [*(f"{one[f'recall_{k}']:.2f}" for k in (1, 5, 20)), f"{one['surest']:.2f}"]
        cells = [one["set"], f"`{one['preset']}`", str(one["n"]), *ours, str(one["linemod_n"] or ""), *theirs]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| presence tells | preset | form | N | of them so | AUC |", "|---" * 6 + "|"]
    for preset, told in record["presence"].items():
        for form, answers in told["forms"].items():
            lines += [
                f"| {QUESTIONS[name]} | `{preset}` | {form} | {one['n']} | {one['true']} | {one['auc']:.2f} |"
                for name, one in answers.items()
            ]
    return "\n".join([*lines, "", f"{record['date']}, commit {record['commit']}.", ""])


def draw(drawn: dict[str, Curves]) -> Figure:
    """Receiver operating characteristics, a panel for each question."""
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    for name, axes in zip(QUESTIONS, figure.subplots(1, 2), strict=True):
        for who, found in drawn.items():
            truth, sure = found[name]
            false, true, _ = roc_curve(truth, sure)
            count = f"{sum(truth)} of {len(truth)}"
            axes.plot(false, true, label=f"{who}: AUC {roc_auc_score(truth, sure):.2f} ({count})")
        axes.plot([0, 1], [0, 1], color="0.8", linewidth=0.8, zorder=0)
        axes.set(
            title=QUESTIONS[name], xlim=(0, 1), ylim=(0, 1.01), xlabel="share of the others called so", aspect="equal"
        )
        axes.legend(loc="lower right", fontsize="small")
    figure.axes[0].set_ylabel("share of those that are so, called so")
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
    parser.add_argument(
        "--table", action="store_true", help="fit presence; write the record and the docs' table and picture"
    )
    arguments = parser.parse_args()
    rows = [json.loads(line) for line in arguments.rows.read_text().splitlines()] if arguments.rows.exists() else []
    if arguments.table:
        record, drawn = record_of(rows)
        write_json(RECORD, record)
        PAGE.write_text(replace_between(PAGE.read_text(encoding="utf-8"), *MARKERS, table(record)), encoding="utf-8")
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
