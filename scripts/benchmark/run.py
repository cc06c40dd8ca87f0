"""Register the photographs of scripts/benchmark/make.py and store the features of every hypothesis.

    python scripts/benchmark/run.py FOLDER --out rows.jsonl [--pose upright] [--form sibling] [--limit N] [--jobs 2]

One JSON line per photograph: the errors of the hypotheses in degrees up to the object's symmetries, their features,
rotation and translation of the first (``answer``), the features of the ranking, the same of unrefined results with and
without the appearance term, the errors of the best views, the pose error with its covariance, the options and the
commit. ``exact`` photographs are registered with their camera matrix, ``sibling`` ones (another object of the kind)
without, as on PASCAL3D+; --no-camera registers all without.
An interrupted run can be resumed. --limit takes the first photographs of the list.
--box moves each edge of the boxes by up to that fraction of the side, as `curvireg evaluate --protocol box=FRACTION`.
--hint gives a range around the true pose, as `curvireg evaluate --protocol hint=azimuth:45`.
--wrong registers "exact" photographs to a mesh that they do not show: any other, or another one of the object's kind.
"""

import argparse
import hashlib
import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

import curvireg_torch as cr
from curvireg_torch.data import read_image
from curvireg_torch.evaluation.protocol import Protocol, hint_of_truth, perturbed_box
from curvireg_torch.geometry import axis_angle_from_rotation, rotation_towards
from curvireg_torch.pipeline import DEFAULT, PRESETS, preset_named
from curvireg_torch.registration.calibration import COVARIANCE_SCALE
from curvireg_torch.registration.confidence import ranking_evidence
from scripts._shared import commit

COPIED = ("id", "form", "pose", "kind", "mesh", "visible", "clutter", "bare")


def smallest_error(R: Tensor, truth: Tensor, symmetries: Tensor) -> Tensor:
    """(N,) degrees between (N, 3, 3) rotations and the nearest of ``truth`` S."""
    return symmetric_errors(R, truth, symmetries).amin(dim=1)


def symmetric_errors(R: Tensor, truth: Tensor, symmetries: Tensor) -> Tensor:
    """(N, S) degrees between (N, 3, 3) rotations and each of ``truth`` S."""
    return cr.rotation_error(R[:, None], (truth @ symmetries)[None])


def allocentric(item: dict[str, Any]) -> Tensor:
    """(3, 3) true rotation as seen by a camera that looks straight at the given box."""
    x0, y0, x1, y1 = item["box"]
    K = torch.tensor(item["K"], dtype=torch.float64)
    ray = torch.linalg.inv(K) @ torch.tensor([(x0 + x1) / 2, (y0 + y1) / 2, 1.0], dtype=torch.float64)
    return rotation_towards(ray).T @ torch.tensor(item["R"], dtype=torch.float64)


def rows_of(task: dict[str, Any]) -> list[Any]:
    """Rows of the photographs of one mesh; ``task["other_mesh"]`` is one to register to instead."""
    torch.set_num_threads(1)
    folder, half, pipeline, protocol = (
        task["folder"],
        task["half"],
        task["pipeline"],
        Protocol(box=task["box"], hint=task["hint"]),
    )
    mesh = cr.load_mesh(folder / (task["other_mesh"] or task["items"][0]["mesh"]))
    bank = cr.ViewBank.build(mesh, pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank, pipeline=pipeline)
    unrefined = {
        name: cr.Registrar(
            bank, pipeline=replace(chosen.with_pose_prior(pipeline.views.pose), search=False, contours=False)
        )
        for name, chosen in (("appearance", pipeline), ("no appearance", PRESETS["fast"]))
    }
    rows = []
    for item in task["items"]:
        image = read_image(folder / half / item["image"])
        box = perturbed_box(torch.tensor(item["box"]), protocol, str(item["id"]))[None]
        exact = item["form"] == "exact" and task["camera"]
        K = torch.tensor(item["K"], dtype=torch.float64) if exact else None
        straight = allocentric(item)
        truth = torch.tensor(item["R"], dtype=torch.float64) if exact else straight
        hint = hint_of_truth(truth, torch.eye(3, dtype=torch.float64), protocol, str(item["id"]))
        result = registrar([image], box, K, prior=hint)[0]
        row = {name: item[name] for name in COPIED} | {name: task[name] for name in ("commit", "options", "wrong")}
        row["like"] = task["like"][item["shown"]]
        if not result.ok:
            rows.append({**row, "failed": str(result.error)})
            continue
        symmetries = torch.tensor(item["symmetries"], dtype=torch.float64)
        found = torch.stack([h.rotation for h in result.hypotheses])
        views = bank.rotations[result.ranking.order[0, :20]].double()
        row["errors"] = smallest_error(found, truth, symmetries).tolist()
        row["view_errors"] = smallest_error(views, straight, symmetries).tolist()
        row["evidence"] = [dict(h.evidence) for h in result.hypotheses]
        row["ranking"] = ranking_evidence(result.ranking, bank.rotations)[0].tolist()
        row["unrefined"] = {}
        for name, views_alone in unrefined.items():
            ranked = views_alone([image], box, prior=hint)[0]
            views = torch.stack([h.rotation for h in ranked.hypotheses])
            row["unrefined"][name] = {
                "errors": smallest_error(views, straight, symmetries).tolist(),
                "evidence": [dict(h.evidence) for h in ranked.hypotheses],
                "ranking": ranking_evidence(ranked.ranking, bank.rotations)[0].tolist(),
            }
        row["confidence"] = result.confidence
        if hint is not None:
            row |= {"hint": task["hint"], "contradiction": result.prior_contradiction}
        row["corrected_box"] = None if result.corrected_box is None else result.corrected_box.tolist()
        answer = result.hypotheses[0]
        if answer.translation is not None:
            row["answer"] = [answer.rotation.tolist(), answer.translation.tolist()]
        if answer.covariance is not None and task["wrong"] is None:
            nearest = truth @ symmetries[symmetric_errors(found[:1], truth, symmetries)[0].argmin()]
            rotation_error = axis_angle_from_rotation(nearest @ answer.rotation.T)
            row["pose_error"] = [*rotation_error.tolist(), *(torch.tensor(item["t"]) - answer.translation).tolist()]
            row["distance"] = float(answer.translation.norm())
            row["covariance"] = answer.covariance.tolist()
            row["scale"] = COVARIANCE_SCALE
        rows.append(row)
    return rows


def register_benchmark(
    folder: Path,
    out: Path,
    *,
    half: str = "held-out",
    pose: str | None = None,
    form: str | None = None,
    wrong: str | None = None,
    limit: int | None = None,
    box: float = 0.0,
    hint: str = "none",
    camera: bool = True,
    pipeline: cr.Pipeline | None = None,
    jobs: int = 1,
) -> list[dict[str, Any]]:
    """Register the photographs that ``out`` does not contain yet; returns the rows of all. See main for the options."""
    items = [json.loads(line) for line in (folder / half / "items.jsonl").read_text().splitlines()]
    form = "exact" if wrong else form
    items = [i for i in items if pose in (None, i["pose"]) and form in (None, i["form"])]
    like = {m["path"]: m["like"] for m in json.loads((folder / "meshes.json").read_text())["meshes"]}
    meshes = wrong_meshes(wrong, items, like)
    items = [i for i in items if i["mesh"] in meshes][:limit]
    wanted = {i["id"] for i in items}
    out.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    options = {"box": box, "hint": hint, "camera": camera}
    if any(row.get("options", options) != options for row in done):
        raise SystemExit(f"{out} holds registrations with other options than {options}; give another file")
    rows = [row for row in done if row["id"] in wanted]
    known = {row["id"] for row in rows}
    # The order is independent of the names, so that an interrupted run is a fair sample.
    todo = [i for i in items if i["id"] not in known]
    todo.sort(key=lambda i: (hashlib.md5(i["mesh"].encode()).hexdigest(), i["pose"], i["id"]))
    pipeline = preset_named(DEFAULT) if pipeline is None else pipeline
    tasks = [
        {
            "folder": folder,
            "half": half,
            "items": list(group),
            "other_mesh": meshes[mesh],
            "wrong": wrong,
            "commit": commit(),
            "options": options,
            "like": like,
            "box": box,
            "hint": hint,
            "camera": camera,
            "pipeline": pipeline.with_pose_prior("upright" if stands == "upright" else "any"),
        }
        for (mesh, stands), group in groupby(todo, key=lambda i: (i["mesh"], i["pose"]))
    ]
    with (
        ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool,
        out.open("a") as file,
        tqdm(total=len(items), initial=len(rows), desc=out.stem, unit="photograph") as bar,
    ):
        for future in as_completed([pool.submit(rows_of, task) for task in tasks]):
            for row in future.result():
                rows.append(row)
                file.write(json.dumps(row) + "\n")
                bar.update()
            file.flush()
    return rows


def wrong_meshes(which: str | None, items: list[Any], like: dict[str, str]) -> dict[str, str | None]:
    """Mesh to register to in place of each: None, the next one, or the next one of its kind if there is one.

    ``like`` names the original of each mesh; copies of one original do not count as wrong.
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
    parser.add_argument("--wrong", choices=("any", "kind"), help="register to another mesh, any or of the same kind")
    parser.add_argument("--box", type=float, default=0.0, metavar="FRACTION", help="error of the boxes")
    parser.add_argument("--hint", default="none", metavar="KIND:DEGREES", help="azimuth:45 or pose:30")
    parser.add_argument("--no-camera", dest="camera", action="store_false", help="register all without camera matrix")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = vars(parser.parse_args())
    preset, file = options.pop("preset"), options.pop("pipeline")
    pipeline = preset_named(preset) if file is None else cr.Pipeline.read(file)
    rows = register_benchmark(options.pop("folder"), options.pop("out"), pipeline=pipeline, **options)
    print(f"{len(rows)} photographs, {sum('failed' in row for row in rows)} failed")


if __name__ == "__main__":
    main()
