"""Registers the benchmark of textured meshes (scripts/make_benchmark.py) and keeps what every hypothesis rests on.

    python scripts/run_benchmark.py FOLDER --out rows.jsonl [--pose upright] [--form sibling] [--limit N] [--share I/N]

One line for each photograph: the errors of the hypotheses in degrees up to the object's symmetries, their evidence,
the evidence of the ranking, the errors of the best views, and how far off it is in its unscaled covariance's units.
``exact`` photographs come with their camera matrix, ``sibling`` ones (another object of the kind) without, as
PASCAL3D+ does. Run again, it goes on. --share takes every N-th mesh, so that several processes work side by side.
--box moves each edge of the boxes by up to that share of the side, as `curvireg evaluate --protocol box=SHARE` does.
--wrong registers "exact" photographs to a mesh that they do not show: any other, or another of the object's kind.
"""

import argparse
import json
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from check_covariance import squared_distance
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.evaluation.protocol import Protocol, perturbed_box
from curvireg_torch.geometry import rotation_towards, transform
from curvireg_torch.pipeline import DEFAULT, PRESETS, preset_named
from curvireg_torch.registration.confidence import ranking_evidence
from curvireg_torch.registration.contour_covariance import SCALE


def error_up_to(R: Tensor, truth: Tensor, symmetries: Tensor) -> Tensor:
    """(N,) degrees between (N, 3, 3) rotations and the nearest of ``truth`` S."""
    return error_up_to_each(R, truth, symmetries).amin(dim=1)


def error_up_to_each(R: Tensor, truth: Tensor, symmetries: Tensor) -> Tensor:
    """(N, S) degrees between (N, 3, 3) rotations and each of ``truth`` S."""
    return cr.rotation_error(R[:, None], (truth @ symmetries)[None])


def allocentric(item: dict[str, Any]) -> Tensor:
    """(3, 3) the true rotation as a camera sees it that looks straight at the given box."""
    x0, y0, x1, y1 = item["box"]
    K = torch.tensor(item["K"], dtype=torch.float64)
    ray = torch.linalg.inv(K) @ torch.tensor([(x0 + x1) / 2, (y0 + y1) / 2, 1.0], dtype=torch.float64)
    return rotation_towards(ray).T @ torch.tensor(item["R"], dtype=torch.float64)


def rows_of(
    items: list[Any], root: Path, half: Path, pipeline: cr.Pipeline, wrong: str | None, protocol: Protocol
) -> list[Any]:
    """Rows of photographs of one mesh; ``wrong``: registered to this one instead, which none of them shows."""
    mesh = cr.load_mesh(root / (wrong or items[0]["mesh"]))
    registrar = cr.Registrar(cr.ViewBank.build(mesh, pipeline=pipeline, progress=False), pipeline=pipeline)
    rows = []
    for item in items:
        image = read_image(half / item["image"])
        box = perturbed_box(torch.tensor(item["box"]), protocol, str(item["id"]))[None]
        exact = item["form"] == "exact"
        K = torch.tensor(item["K"], dtype=torch.float64) if exact else None
        result = registrar([image], box, K)[0]
        row = {name: item[name] for name in ("id", "form", "pose", "kind", "mesh", "visible", "clutter", "bare")}
        if not result.ok:
            rows.append({**row, "failed": str(result.error)})
            continue
        symmetries = torch.tensor(item["symmetries"], dtype=torch.float64)
        straight = allocentric(item)
        truth = torch.tensor(item["R"], dtype=torch.float64) if exact else straight
        found = torch.stack([h.rotation for h in result.hypotheses])
        views = registrar.bank.rotations[result.ranking.order[0, :20]].double()
        row["errors"] = error_up_to(found, truth, symmetries).tolist()
        row["view_errors"] = error_up_to(views, straight, symmetries).tolist()
        row["evidence"] = [dict(h.evidence) for h in result.hypotheses]
        row["ranking"] = ranking_evidence(result.ranking, registrar.bank.rotations)[0].tolist()
        row["confidence"] = result.confidence
        row["corrected_box"] = None if result.corrected_box is None else result.corrected_box.tolist()
        if result.covariance is not None and wrong is None:
            nearest = truth @ symmetries[error_up_to_each(found[:1], truth, symmetries)[0].argmin()]
            poses = transform(found[0], result.translation), transform(nearest, torch.tensor(item["t"]).double())
            row["squared_distance"] = squared_distance(*poses, result.covariance / SCALE)
        rows.append(row)
    return rows


def wrong_meshes(which: str | None, items: list[Any], like: dict[str, str]) -> dict[str, str | None]:
    """The mesh to register to in place of each: none, the next one, or the next one of its kind where there is one.

    ``like`` names what a mesh is a copy of: copies are not wrong.
    """
    kinds = {i["mesh"]: i["kind"] for i in items}
    names = sorted(kinds)
    out: dict[str, str | None] = {}
    for n, name in enumerate(names):
        others = [m for m in names[n + 1 :] + names[:n] if like[m] != like[name]]
        if which == "kind":
            others = [m for m in others if kinds[name] is not None and kinds[m] == kinds[name]]
        if which is None or others:
            out[name] = others[0] if which else None
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--half", default="held-out")
    parser.add_argument("--pose", choices=("upright", "free"))
    parser.add_argument("--form", choices=("exact", "sibling"))
    parser.add_argument("--preset", choices=sorted(PRESETS), default=DEFAULT)
    parser.add_argument("--pipeline", type=Path, metavar="FILE", help="JSON, instead of --preset")
    parser.add_argument("--wrong", choices=("any", "kind"), help="register to another mesh, if need be of the kind")
    parser.add_argument("--box", type=float, default=0.0, metavar="SHARE", help="how far edges of boxes are off")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--share", default="0/1", metavar="I/N")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    half = arguments.folder / arguments.half
    items = [json.loads(line) for line in (half / "items.jsonl").read_text().splitlines()]
    form = "exact" if arguments.wrong else arguments.form
    items = [i for i in items if arguments.pose in (None, i["pose"]) and form in (None, i["form"])]
    like = {m["path"]: m["like"] for m in json.loads((arguments.folder / "meshes.json").read_text())["meshes"]}
    wrong = wrong_meshes(arguments.wrong, items, like)
    items = [i for i in items if i["mesh"] in wrong][: arguments.limit]
    done = set()
    if arguments.out.exists():
        done = {json.loads(line)["id"] for line in arguments.out.read_text().splitlines()}
    pipeline = preset_named(arguments.preset) if arguments.pipeline is None else cr.Pipeline.read(arguments.pipeline)
    meshes = sorted({i["mesh"] for i in items})
    index, count = (int(n) for n in arguments.share.split("/"))
    items = [i for i in items if meshes.index(i["mesh"]) % count == index and i["id"] not in done]
    items.sort(key=lambda i: (i["mesh"], i["pose"], i["id"]))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    for (mesh, pose), group in groupby(items, key=lambda i: (i["mesh"], i["pose"])):
        posed = pipeline.posed("upright" if pose == "upright" else "any")
        with arguments.out.open("a") as file:
            for row in rows_of(list(group), arguments.folder, half, posed, wrong[mesh], Protocol(box=arguments.box)):
                file.write(json.dumps({**row, "wrong": arguments.wrong}) + "\n")


if __name__ == "__main__":
    main()
