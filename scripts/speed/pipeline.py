"""Time the path from mesh to pose: build a bank, open it from disk, rank and register photographs.

    python scripts/speed/pipeline.py                    # scripts/results/bench_pipeline.json, docs/performance.md
    python scripts/speed/pipeline.py --device cuda      # scripts/results/bench_pipeline_cuda.json, with the GPU's name
    python scripts/speed/pipeline.py --renderers        # views per second of every renderer, printed as JSON

The pipeline is the default one. The mesh is a dented sphere with a chosen number of faces. Renderers draw the same
views in alternation, the object filling the image, and the best of three rounds counts.
"""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from curvireg_torch import Pipeline, Registrar, ViewBank, ViewMatcher, camera_matrix
from curvireg_torch.errors import RenderingError
from curvireg_torch.geometry import uniform_views
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.rendering import make_renderer
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.synthetic import random_pose, synthesize_photograph
from scripts._shared import REPOSITORY, RESULTS, commit, processor, timed, today, update_page, write_json


def dented_sphere(faces: int) -> trimesh.Trimesh:
    rings = max(4, round((faces / 4) ** 0.5))
    mesh = trimesh.creation.uv_sphere(count=(rings, 2 * rings))
    waves = np.random.default_rng(0).normal(size=(3, 6)) * 3
    bumps = np.sin(mesh.vertices @ waves).mean(axis=1)
    mesh.vertices = mesh.vertices * (1 + 0.35 * bumps[:, None]) * [1.0, 0.7, 0.5]
    return mesh


def seconds(call: Callable[[], object], repeats: int = 3) -> float:
    """Median of the runs."""
    return statistics.median(timed(call, repeats))


def over_products(matcher: ViewMatcher, images: list[torch.Tensor], boxes: torch.Tensor) -> float:
    """Time of ranking by S_hog S_rep S_box over that of its matrix products alone; minima of alternating runs."""
    hog, points = matcher.get_submodule("_terms.hog"), matcher.get_submodule("_terms.repeatability")
    with torch.no_grad():
        query = matcher.query(images, boxes)
        descriptors = query.descriptors.flatten(0, 1).contiguous()
        near = points.near.float()
        cells = torch.rand(len(descriptors), near.shape[1], device=descriptors.device)
        bare, whole = [], []
        for _ in range(10):
            bare += timed(lambda: (descriptors @ hog.views.T, cells @ near.T), 1)
            whole += timed(lambda: matcher.rank(query), 1)
    return min(whole) / min(bare)


def pipeline_times(mesh: trimesh.Trimesh, pipeline: Pipeline, photographs: int, device: str) -> dict[str, float]:
    """Seconds of each step; devices other than the CPU use the torch renderer."""
    renderer = "auto" if device == "cpu" else "torch"

    def build() -> ViewBank:
        return ViewBank.build(mesh, pipeline=pipeline, renderer=renderer, device=device, progress=False)

    def registrar_of(bank: ViewBank, **options: Any) -> Registrar:
        return Registrar(bank, renderer=renderer, device=device, **options)

    K, size = camera_matrix(900.0, 900.0, 319.5, 239.5), (480, 640)
    generator = torch.Generator().manual_seed(0)
    poses = [random_pose(mesh, K, size, generator) for _ in range(photographs)]
    scenes = [synthesize_photograph(mesh, T, K, size, generator) for T in poses]
    images, boxes = [image for image, _ in scenes], torch.stack([box for _, box in scenes])
    bank = build()
    times = {"build": seconds(build)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bank.safetensors"
        bank.save(path)
        times["megabytes"] = path.stat().st_size / 1e6
        times["open"] = seconds(lambda: registrar_of(ViewBank.load(path)))
    ranked = registrar_of(bank, pipeline=replace(bank.pipeline, search=False, contours=False))
    whole = registrar_of(bank)
    one = images[:1], boxes[:1], K
    for name, registrar in (("rank", ranked), ("register", whole)):
        registrar(*one)  # warm-up
        times[name] = seconds(lambda: registrar(*one))  # noqa: B023
    times["register_many_each"] = seconds(lambda: whole(images, boxes, K), 1) / photographs
    three = [term for term in pipeline.terms if term.name != "appearance"]
    matcher = ViewMatcher(bank, pipeline=replace(pipeline, terms=tuple(three)), renderer=renderer)
    times["rank_over_products"] = over_products(matcher, images, boxes)
    return times


def renderers_of(mesh: trimesh.Trimesh) -> dict[str, Callable[..., object]]:
    found: dict[str, Callable[..., object]] = {}
    for name, device in (("embree", "cpu"), ("pyrender", "cpu"), ("torch", "cpu"), ("torch", "cuda")):
        try:
            if device == "cpu" or torch.cuda.is_available():
                found[f"{name} {device}"] = make_renderer(mesh, name, device=device).render
        except RenderingError as error:
            print(error)
    return found


def views_per_second(faces: int, size: int, count: int = 16) -> dict[str, float]:
    """Rate of each renderer at ``size`` px, with the exact number of faces."""
    mesh, views = dented_sphere(faces), uniform_views(count)
    describe = ViewDescriber(mesh, BankSettings(image_size=size))
    T, K, _ = describe.cameras(views.rotations, views.distance * mesh_radius(mesh))
    best: dict[str, float] = {}
    for repeat in range(4):  # the first round is a warm-up
        for name, render in renderers_of(mesh).items():
            start = time.perf_counter()
            render(T, K, (size, size))
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if repeat:
                best[name] = min(best.get(name, np.inf), time.perf_counter() - start)
    return {"faces": len(mesh.faces), "size": size} | {name: round(count / spent, 1) for name, spent in best.items()}


def pipeline_table(record: dict[str, Any]) -> str:
    t, n = record["times"], record["photographs"]
    rows = [
        (f"bank of {record['views']} views ({t['megabytes']:.0f} MB on disk)", t["build"]),
        ("open it from disk", t["open"]),
        ("rank a photograph", t["rank"]),
        ("register it", t["register"]),
        (f"{n} photographs in one call, each", t["register_many_each"]),
    ]
    lines = ["| step | seconds |", "|---|---|", *(f"| {what} | {value:.2f} |" for what, value in rows)]
    products = (
        f"Ranking by the first three terms takes {t['rank_over_products']:.1f} times the bare matrix products in it."
    )
    stamp = f"{record['threads']} threads, {record['faces']} faces, {record['date']}, commit {record['commit']}."
    return "\n".join([*lines, "", products, stamp, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="of modules, bank, search and the views' renderer"
    )
    parser.add_argument("--photographs", type=int, default=32)
    parser.add_argument("--renderers", action="store_true", help="measure only the renderers")
    arguments = parser.parse_args()
    if arguments.renderers:
        for faces, size in product((640, 10_240, 163_840), (128, 256)):
            print(json.dumps(views_per_second(faces, size)), flush=True)
        return
    mesh, photographs, device = dented_sphere(arguments.faces), arguments.photographs, arguments.device
    record = {
        "date": today(),
        "commit": commit(),
        "views": len(Pipeline().views.sphere("z")),
        "faces": len(mesh.faces),
        "photographs": photographs,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "machine": processor() if device == "cpu" else torch.cuda.get_device_name(device),
        "times": pipeline_times(mesh, Pipeline(), photographs, device),
    }
    print(pipeline_table(record))
    if device != "cpu":
        write_json(RESULTS / "bench_pipeline_cuda.json", record)
        return
    write_json(RESULTS / "bench_pipeline.json", record)
    update_page(REPOSITORY / "docs" / "performance.md", "pipeline", pipeline_table(record))


if __name__ == "__main__":
    main()
