"""Measure the views per second of every renderer, and the cost of a bank.

    python scripts/speed/rendering.py [--views 16] [--out scripts/results/bench_rendering.json]

All renderers draw the same views of the same mesh in alternation, the object filling the image; the best of three
rounds counts. "trimesh" is trimesh's ray caster over all pixels. "naive pyrender" creates a renderer for each view.
"""

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import RenderingError
from curvireg_torch.geometry import opengl_from_opencv, uniform_views
from curvireg_torch.io.meshes import mesh_radius
from curvireg_torch.matching import ViewDescriber
from curvireg_torch.rendering import make_renderer
from curvireg_torch.settings import BankSettings
from scripts._shared import RESULTS, write_json

FACES = {"1k": 3, "20k": 5, "300k": 7}  # subdivisions of an icosahedron: 1280, 20480, 327680 faces


def bumpy_sphere(subdivisions: int) -> trimesh.Trimesh:
    """A bumpy ball: its views differ and have self-occlusion."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    v = mesh.vertices
    height = 1.0 + 0.15 * np.sin(5 * v[:, 0] + 1) * np.cos(4 * v[:, 1]) + 0.1 * np.sin(7 * v[:, 2])
    return trimesh.Trimesh(v * height[:, None] * [1.0, 0.8, 0.7], mesh.faces, process=False)


def by_trimesh(mesh: trimesh.Trimesh, T: torch.Tensor, K: torch.Tensor, size: tuple[int, int]) -> None:
    intersector = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)
    v, u = np.mgrid[: size[0], : size[1]]
    pixels = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3)
    for pose, camera in zip(T.numpy(), K.numpy(), strict=True):
        directions = pixels @ np.linalg.inv(camera).T @ pose[:3, :3]
        origins = np.broadcast_to(-pose[:3, :3].T @ pose[:3, 3], directions.shape)
        points, rays, _ = intersector.intersects_location(origins, directions, multiple_hits=False)
        depth = np.zeros(size[0] * size[1], np.float32)
        depth[rays] = (points @ pose[:3, :3].T + pose[:3, 3])[:, 2]


def by_naive_pyrender(mesh: trimesh.Trimesh, T: torch.Tensor, K: torch.Tensor, size: tuple[int, int]) -> None:
    import pyrender

    for pose, camera in zip(T, K.numpy(), strict=True):
        scene = pyrender.Scene()
        scene.add(pyrender.Mesh.from_trimesh(mesh))
        scene.add(
            pyrender.IntrinsicsCamera(camera[0, 0], camera[1, 1], camera[0, 2] + 0.5, camera[1, 2] + 0.5),
            pose=torch.linalg.inv(opengl_from_opencv(pose)).numpy(),
        )
        renderer = pyrender.OffscreenRenderer(*size)
        renderer.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY)
        renderer.delete()


def candidates(mesh: trimesh.Trimesh) -> dict[str, Callable[..., object]]:
    found: dict[str, Callable[..., object]] = {}
    devices = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
    for name in ("embree", "pyrender"):
        try:
            found[name] = make_renderer(mesh, name).render
        except RenderingError as error:
            print(error)
    for device in devices:
        found[f"torch {device}"] = make_renderer(mesh, "torch", device=device).render
    found["trimesh"] = lambda *views: by_trimesh(mesh, *views)
    return found


def rates(subdivisions: int, size: int, count: int) -> dict[str, float]:
    mesh = bumpy_sphere(subdivisions)
    views = uniform_views(count)
    describe = ViewDescriber(mesh, BankSettings(image_size=size))
    T, K, _ = describe.cameras(views.rotations, views.distance * mesh_radius(mesh))
    best: dict[str, float] = {}
    for repeat in range(4):  # the first round is a warm-up
        for name, render in candidates(mesh).items():
            few = max(2, count // 8) if name == "trimesh" else count
            start = time.perf_counter()
            render(T[:few], K[:few], (size, size))
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            seconds = (time.perf_counter() - start) / few
            if repeat:
                best[name] = min(best.get(name, np.inf), seconds)
    return {name: round(1.0 / seconds, 1) for name, seconds in best.items()}


def naive_rates(count: int = 4) -> dict[str, float]:
    """Rates of naive pyrender. Run it in a separate process: closing its context breaks other renderers."""
    found = {}
    for name, subdivisions in FACES.items():
        mesh = bumpy_sphere(subdivisions)
        for size in (128, 256):
            describe = ViewDescriber(mesh, BankSettings(image_size=size))
            views = uniform_views(count)
            T, K, _ = describe.cameras(views.rotations, views.distance * mesh_radius(mesh))
            start = time.perf_counter()
            by_naive_pyrender(mesh, T, K, (size, size))
            found[f"{name} faces, {size} px"] = round(count / (time.perf_counter() - start), 1)
    return found


def bank_costs() -> dict[str, float]:
    """Cost of 700 views of 20,480 faces at 256 px."""
    mesh, views = bumpy_sphere(FACES["20k"]), uniform_views(700)
    describe = ViewDescriber(mesh, BankSettings())
    distances = views.distance * mesh_radius(mesh)
    start, render_cpu = time.perf_counter(), time.process_time()
    for i in range(0, 700, 32):
        describe.depth(views.rotations[i : i + 32], distances[i : i + 32])
    rendered, render_cpu = time.perf_counter() - start, time.process_time() - render_cpu
    start, cpu = time.perf_counter(), time.process_time()
    bank = cr.ViewBank.build(mesh, views, settings=BankSettings(), progress=False)
    built, cpu = time.perf_counter() - start, time.process_time() - cpu
    with tempfile.TemporaryDirectory() as folder:
        bank.save(Path(folder) / "bank.safetensors")
        megabytes = (Path(folder) / "bank.safetensors").stat().st_size / 1e6
    return {
        "rendered_seconds": round(rendered, 2),
        "rendered_cpu_seconds": round(render_cpu, 2),
        "bank_seconds": round(built, 2),
        "bank_cpu_seconds": round(cpu, 2),
        "bank_megabytes": round(megabytes, 1),
        "peak_memory_gigabytes": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2),
    }


def in_new_process(function: Callable[[], dict[str, float]]) -> dict[str, float] | str:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(function).result()
        except Exception as error:  # no driver, or a failure of naive pyrender
            return f"{type(error).__name__}: {error}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--out", type=Path, default=RESULTS / "bench_rendering.json")
    arguments = parser.parse_args()
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    results: dict[str, object] = {
        "machine": {
            "cpu_count": os.cpu_count(),
            "torch_threads": torch.get_num_threads(),
            "load_average_at_start": round(os.getloadavg()[0], 1),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "bank_of_700_views": in_new_process(bank_costs),
        "naive_pyrender_views_per_second": in_new_process(naive_rates),
    }
    print(json.dumps(results, indent=2), flush=True)
    table = {}
    for name, subdivisions in FACES.items():
        for size in (128, 256):
            table[f"{name} faces, {size} px"] = rates(subdivisions, size, arguments.views)
            print(name, size, table[f"{name} faces, {size} px"], flush=True)
    results["views_per_second"] = table
    write_json(arguments.out, results)


if __name__ == "__main__":
    main()
