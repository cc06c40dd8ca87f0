"""Measures every part of the ranking on real photographs and writes the tables of docs/method.md.

    python scripts/compare_similarities.py DATA [--out scripts/results/similarities.json]
    python scripts/compare_similarities.py --table        write the tables again from the results, nothing else

DATA holds pascal3d_mini (PASCAL3D+ layout), bop/lm, bop/dino, bop/hope, bop/buddha and backgrounds (photographs without
the objects). Each object is ranked against the bank of its annotated mesh, default preset, and the best view is
compared with the annotation (no refinement, symmetries of the objects taken into account). Boxes are as annotated,
moved by up to 5, 10 and 20 % of their sides, or the whole image. PASCAL3D+ objects are known to stand upright; the
others are not.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from _record import REPOSITORY, SETS, benchmark, between, write_json
from torch.nn.functional import normalize

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.evaluation import Benchmark
from curvireg_torch.evaluation.pascal3d import SYMMETRIES
from curvireg_torch.evaluation.protocol import perturbed_box
from curvireg_torch.geometry import rotation_towards, whole_image_box
from curvireg_torch.matching import (
    DescriptorStatistics,
    Photographs,
    Ranking,
    ViewBank,
    Whitening,
    box_shape_score,
    box_shapes,
    cached_bank,
    repeatability_score,
    unit_score,
)
from curvireg_torch.metrics import symmetric_rotation_error, symmetry_transforms
from curvireg_torch.pipeline import preset_named
from curvireg_torch.synthetic import procedural_background

EVERY = {"dino": 4}
BOXES = {"annotated": 0.0, "5 %": 0.05, "10 %": 0.1, "20 %": 0.2, "whole image": None}

# name: similarity, sigma of S_rep, sigma of S_box, slack
CHOICES: dict[str, tuple[str, float | None, float | None, bool]] = {
    "S_hog": ("plain", None, None, False),
    "S_hog S_rep (0.1)": ("plain", 0.1, None, False),
    "S_hog S_rep (0.2)": ("plain", 0.2, None, False),
    "S_hog S_box (0.1)": ("plain", None, 0.1, False),
    "S_hog S_box (0.2)": ("plain", None, 0.2, False),
    "S_hog S_box (0.3)": ("plain", None, 0.3, False),
    "S_hog S_rep (0.1) S_box (0.2)": ("plain", 0.1, 0.2, False),
    "S_hog S_rep (0.2) S_box (0.2)": ("plain", 0.2, 0.2, False),
    "S_hog S_box (0.2), slack": ("plain", None, 0.2, True),
    "S_hog S_rep (0.2) S_box (0.2), slack": ("plain", 0.2, 0.2, True),
    "**S_hog S_rep (0.1) S_box (0.2), slack**": ("plain", 0.1, 0.2, True),
    **{
        f"{text}, whitened: {name}": (name, sigma, 0.2 if sigma else None, bool(sigma))
        for name in (
            "bank, 0.5",
            "bank, OAS",
            "clutter, 0.5",
            "clutter, OAS",
            "photographs, 0.5",
            "photographs, 0.75",
            "photographs, OAS",
        )
        for text, sigma in (("S_hog", None), ("default", 0.1))
    },
}


@dataclass
class Shot:
    """One object to register; ``error`` maps (N, 3, 3) rotations to degrees."""

    benchmark: Benchmark
    index: int
    image: torch.Tensor
    boxes: dict[str, torch.Tensor]
    camera_matrix: torch.Tensor | None

    def errors(self, views: torch.Tensor, box: torch.Tensor) -> torch.Tensor:
        """Degrees between the truth and views that look straight at the box."""
        sample = self.benchmark.dataset.annotation(self.index)
        truth = sample["rotation"].double()
        if self.camera_matrix is None:
            symmetric = SYMMETRIES.get(sample["category"])
            error = cr.rotation_error if symmetric is None else symmetric[1]
            return error(views, truth.expand_as(views))
        K = self.camera_matrix.double()
        centre = torch.cat([0.5 * (box[:2] + box[2:]), torch.ones(1)]).double()
        R = rotation_towards(torch.linalg.inv(K) @ centre) @ views
        symmetries = symmetry_transforms(sample["model_info"])[:, :3, :3]
        return symmetric_rotation_error(R, truth.expand_as(R), symmetries)


def shots(data: Path, name: str, boxes: dict[str, float | None]) -> Iterator[tuple[ViewBank, Path, list[Shot]]]:
    """The objects of a set, those of one mesh together, with its bank."""
    chosen, preset = benchmark(data, name), preset_named("classical")
    items = chosen.items[:: EVERY.get(name, 1)]
    for meshes in sorted({item.meshes for item in items}):
        bank = cached_bank(cr.load_mesh(meshes[0], unit=chosen.unit), pipeline=preset.posed(SETS[name]), progress=False)
        found = []
        for item in (i for i in items if i.meshes == meshes):
            image = read_image(chosen.dataset.annotation(item.index)["image_path"])
            some = {
                label: whole_image_box(image)
                if share is None
                else perturbed_box(item.box, replace(chosen.protocol, box=share), item.key).float()
                for label, share in boxes.items()
            }
            found.append(Shot(chosen, item.index, image, some, item.camera_matrix))
        yield bank, meshes[0], found


def combined(ranking: Ranking, shapes: torch.Tensor, views: torch.Tensor, rep: float | None, box: float | None):
    scores = unit_score(ranking.hog)
    if rep:
        scores = scores * repeatability_score(ranking.repeatability, sigma=rep)
    return scores * box_shape_score(shapes.float(), views, sigma=box) if box else scores


def exact(query: Photographs) -> Photographs:
    """Without slack."""
    first = {name: getattr(query, name)[:, :1] for name in ("regions", "descriptors", "points")}
    return replace(query, **first)


def populations(data: Path) -> dict[str, DescriptorStatistics]:
    settings, generator = preset_named("classical").bank, torch.Generator().manual_seed(0)
    clutter = [procedural_background((360, 480), generator) for _ in range(12)]
    photographs = []
    for path in sorted((data / "backgrounds").glob("*.jpg")):
        image = read_image(path)
        half = image[None] if min(image.shape[1:]) < 700 else torch.nn.functional.avg_pool2d(image[None], 2)
        photographs.append(half[0])
    return {
        "clutter": DescriptorStatistics.from_images(clutter, settings, crops=240),
        "photographs": DescriptorStatistics.from_images(photographs, settings, crops=240),
    }


def whitenings(data: Path) -> dict[str, Callable[[ViewBank], Whitening]]:
    """How the whitening of each label in CHOICES is made for a bank."""
    given, made = populations(data), {}
    for label in {similarity for similarity, *_ in CHOICES.values()} - {"plain"}:
        population, _, rule = label.partition(", ")
        shrinkage = "oas" if rule == "OAS" else float(rule)
        if population == "bank":
            made[label] = lambda b, a=shrinkage: DescriptorStatistics.from_bank(b).whitening(shrinkage=a)
        else:
            whitening = given[population].whitening(shrinkage=shrinkage)
            made[label] = lambda _, w=whitening: w
    return made


@torch.no_grad()
def measure(data: Path, names: list[str]) -> dict:
    make = whitenings(data)
    result: dict = {}
    for name in names:
        errors: dict[str, dict[str, list[float]]] = {c: {b: [] for b in BOXES} for c in CHOICES}
        for bank, _, group in shots(data, name, BOXES):
            views, shapes = bank.rotations.double(), box_shapes(bank.boxes).float()
            matcher = cr.ViewMatcher(bank)
            queries = [{w: matcher.query([s.image], b[None]) for w, b in s.boxes.items()} for s in group]
            rankings = [
                {(w, s): matcher.rank(q if s else exact(q)) for w, q in by.items() for s in (False, True)}
                for by in queries
            ]
            whitened: dict[str, list[torch.Tensor]] = {}  # (K, N) of each object, box as annotated
            for label, of in make.items():
                whiten = of(bank)
                W = normalize(whiten(bank.descriptors), dim=1)
                whitened[label] = [normalize(whiten(by["annotated"].descriptors[0]), dim=1) @ W.T for by in queries]
            for i, shot in enumerate(group):
                for where, box in shot.boxes.items():
                    best, chosen = [], []
                    for choice, (similarity, rep, sigma, slack) in CHOICES.items():
                        ranking = rankings[i][where, slack]
                        if similarity != "plain":
                            if where != "annotated":
                                continue
                            hog = whitened[similarity][i]
                            best_crop = (hog if slack else hog[:1]).amax(dim=0, keepdim=True)
                            ranking = replace(ranking, terms={**ranking.terms, "hog": best_crop})
                        scores = combined(ranking, queries[i][where].shapes, shapes, rep, sigma)
                        best.append(int(scores.argmax()))
                        chosen.append(choice)
                    for choice, error in zip(chosen, shot.errors(views[best], box).tolist(), strict=True):
                        errors[choice][where].append(error)
        result[name] = {"n": len(errors["S_hog"]["annotated"])}
        for limit in (15, 30):
            result[name][f"acc_{limit}_deg"] = {
                c: {b: sum(e < limit for e in found) / len(found) for b, found in by.items() if found}
                for c, by in errors.items()
            }
        print(name, json.dumps(result[name]["acc_30_deg"]), flush=True)
    return result


def tables(result: dict) -> str:
    """Markdown: all choices on the annotated boxes, and some of them on worse boxes."""
    names = list(result)
    numbers = ", ".join(f"{n} {result[n]['n']}" for n in names)
    lines = [f"Share of best views within 30 degrees of the truth, no refinement. N: {numbers}. Bold: the default.", ""]
    lines += ["| ranking, box as annotated | " + " | ".join(names) + " |", "|" + " --- |" * (len(names) + 1)]
    for choice in CHOICES:
        cells = [f"{result[n]['acc_30_deg'][choice]['annotated']:.2f}" for n in names]
        lines.append(f"| {choice} | " + " | ".join(cells) + " |")
    shown = [c for c in CHOICES if "whitened" not in c and "(0.3)" not in c and "S_box (0.1)" not in c]
    lines += ["", "| ranking, mean of the sets by box | " + " | ".join(BOXES) + " |", "|" + " --- |" * (len(BOXES) + 1)]
    for choice in shown:
        cells = [f"{sum(result[n]['acc_30_deg'][choice][b] for n in names) / len(names):.2f}" for b in BOXES]
        lines.append(f"| {choice} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", metavar="DATA")
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument("--table", action="store_true", help="write docs/method.md from the results")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "scripts" / "results" / "similarities.json")
    arguments = parser.parse_args()
    if arguments.data is not None:
        torch.set_num_threads(1)
        write_json(arguments.out, measure(arguments.data, arguments.sets), 1)
    if arguments.table:
        page = REPOSITORY / "docs" / "method.md"
        begin, end = "<!-- similarities:begin -->", "<!-- similarities:end -->"
        page.write_text(between(page.read_text(), begin, end, tables(json.loads(arguments.out.read_text()))))


if __name__ == "__main__":
    main()
