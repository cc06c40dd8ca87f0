"""Time of every layer as a multiple of one ``x.clone()``, eager and compiled, and of a formulation by kornia alone.

All times of a row come from one run with the same threads; the clone is timed again beside every layer, because other
work on the machine moves both. The smallest of the repetitions counts. ``fresh`` is the floor of any layer: ones
written to a new tensor of the output's shape, whose pages the operating system hands out one by one, where a clone gets
the memory of the one before.

    python scripts/bench_filters.py [--threads 2] [--batch 64] [--size 256] [--skip-compile]
    python scripts/bench_filters.py --table

writes scripts/results/bench_filters.json, or with huge pages asked for in GLIBC_TUNABLES bench_filters_huge_pages.json,
and then the table of docs/performance.md from both; ``--table`` measures nothing.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import kornia
import torch
from torch import Tensor

from curvireg_torch import descriptors, filters
from scripts._shared import REPOSITORY, commit, replace_between, today
from scripts.paper.figures import scene, silhouette


def kornia_depth_saliency(depth: Tensor) -> Tensor:
    """Depth CS with kornia's smoothing and derivatives; the algebra as METHOD writes it."""
    near = depth.amin(dim=(1, 2, 3), keepdim=True)
    z = (depth - near) / (depth.amax(dim=(1, 2, 3), keepdim=True) - near)
    z = kornia.filters.gaussian_blur2d(z, (9, 9), (1.0, 1.0), border_type="replicate")
    zx, zy = kornia.filters.spatial_gradient(z, "diff", 1)[:, 0].split(1, dim=1)
    zxx, zxy, zyy = kornia.filters.spatial_gradient(z, "diff", 2)[:, 0].split(1, dim=1)
    m11, m12 = (1 + zy**2) * zxx - zx * zy * zxy, (1 + zy**2) * zxy - zx * zy * zyy
    m21, m22 = (1 + zx**2) * zxy - zx * zy * zxx, (1 + zx**2) * zyy - zx * zy * zxy
    root = ((m11 - m22) ** 2 + 4 * m12 * m21).clamp(min=1e-30).sqrt()
    value = torch.where(m11 + m22 >= 0, 0.5 * (m11 + m22 + root), 0.5 * (m11 + m22 - root))
    vector = torch.nn.functional.normalize(torch.cat([value - m22, m21], dim=1), dim=1)
    return (1 + zx**2 + zy**2) ** -1.5 * root * vector


def kornia_gradient(image: Tensor) -> Tensor:
    smooth = kornia.filters.gaussian_blur2d(image, (9, 9), (1.0, 1.0), border_type="replicate")
    return kornia.filters.spatial_gradient(smooth, "diff", 1)[:, 0]


def kornia_saliency(image: Tensor) -> Tensor:
    g = kornia_gradient(image)
    return g * g.norm(dim=1, keepdim=True)


def kornia_edge_blur(image: Tensor) -> Tensor:
    def saliency(x: Tensor) -> Tensor:
        return kornia.filters.spatial_gradient(x, "diff", 1)[:, 0].square().sum(dim=1, keepdim=True)

    cs, blurs = saliency(image), []
    for s in (1.0, 2.0, 3.0, 4.0):
        size = 8 * int(s) + 1
        ratio = cs / saliency(kornia.filters.gaussian_blur2d(image, (size, size), (s, s), border_type="replicate"))
        blurs.append(s / (ratio - 1).clamp(min=1e-6).sqrt())
    return torch.cat(blurs, dim=1)


clock = time.perf_counter


def smallest(function: Callable[[], object], repetitions: int) -> float:
    function()
    best = float("inf")
    for _ in range(repetitions):
        start = clock()
        function()
        best = min(best, clock() - start)
    return best


def smoothings() -> dict[str, dict[str, float]]:
    """What the smoothing under MCS costs and finds, on the five scenes of the detectors' figure.

    ``near_contour`` is the fraction of points within 2 px of the silhouette, ``contour_found`` that of
    the silhouette within 2 px of a point, with as many points as the silhouettes have on average, 1.3 % of the pixels.
    """
    photo = torch.cat([scene(i)[0] for i in range(5)])
    contour = torch.cat([silhouette(scene(i)[1]) for i in range(5)])

    def grown(mask: Tensor) -> Tensor:
        return torch.nn.functional.max_pool2d(mask.float(), 5, stride=1, padding=2) > 0

    rows = {}
    for name in ("perona-malik", "bilateral", "guided"):

        def layer(name: str = name) -> Tensor:
            return filters.multiscale_curvilinear_saliency(photo, smoothing=name)

        points = descriptors.field_points(layer(), fraction=0.013)
        rows[name] = {
            "seconds": smallest(layer, 5),
            "near_contour": round(float(grown(contour)[points].float().mean()), 3),
            "contour_found": round(float(grown(points)[contour].float().mean()), 3),
        }
        print(f"MCS over {name:13} {rows[name]}", flush=True)
    return rows


RESULTS = REPOSITORY / "scripts" / "results"
PLAIN, HUGE = RESULTS / "bench_filters.json", RESULTS / "bench_filters_huge_pages.json"
PAGE = REPOSITORY / "docs" / "performance.md"
BEGIN, END = "<!-- layers:begin -->", "<!-- layers:end -->"


def write_table() -> None:
    """The table of docs/performance.md, of the two files and of nothing else."""
    plain, huge = (json.loads(path.read_text(encoding="utf-8")) for path in (PLAIN, HUGE))

    def cell(row: dict[str, float], kind: str) -> str:
        return f"{1e3 * row[f'{kind}_s']:.1f} ({row[f'{kind}_clones']:.0f})" if f"{kind}_s" in row else ""

    head = ["", "eager", "compiled", "kornia", "fresh", "huge pages: eager", "compiled", "fresh"]
    lines = [head, ["---"] * len(head)]
    for name, row in plain["layers"].items():
        other = huge["layers"][name]
        cells = [cell(row, kind) for kind in ("eager", "compiled", "kornia", "fresh")]
        lines.append([name, *cells, *(cell(other, kind) for kind in ("eager", "compiled", "fresh"))])
    notes = []
    for title, kept in (("Without", plain), ("With", huge)):
        clones = [1e3 * row["clone_s"] for row in kept["layers"].values()]
        notes.append(
            f"{title} huge pages: {kept['date']}, commit {kept['commit']}, torch {kept['torch']}, {kept['threads']} "
            f"threads; a clone took {min(clones):.2f} to {max(clones):.2f} ms."
        )
    body = "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n\n" + "\n".join(notes)
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_between(text, BEGIN, END, body + "\n"), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--cpu-time", action="store_true", help="for a busy machine: processor time, with --threads 1")
    parser.add_argument("--skip-compile", action="store_true")
    parser.add_argument("--only", nargs="*")
    parser.add_argument(
        "--out", type=Path, default=HUGE if "hugetlb" in os.environ.get("GLIBC_TUNABLES", "") else PLAIN
    )
    parser.add_argument("--table", action="store_true", help="only write the table again")
    options = parser.parse_args()
    if options.table:
        write_table()
        return
    torch.set_num_threads(options.threads)
    if options.cpu_time:
        if options.threads != 1:
            raise SystemExit("processor time adds up over threads: give --threads 1 with --cpu-time")
        global clock
        clock = time.process_time
    x = torch.rand(options.batch, 1, options.size, options.size, generator=torch.Generator().manual_seed(0)) + 0.5
    field = filters.image_gradient(x)
    layers: dict[str, tuple[Callable[[Tensor], Tensor], Tensor, Callable[[Tensor], Tensor] | None]] = {
        "depth CS": (filters.depth_curvilinear_saliency, x, kornia_depth_saliency),
        "ASG": (filters.average_shading_gradient, x, None),
        "HFN": (filters.hessian_frobenius_norm, x, None),
        "apparent ridges": (filters.apparent_ridges, x, None),
        "image gradient": (filters.image_gradient, x, kornia_gradient),
        "image CS": (filters.image_curvilinear_saliency, x, kornia_saliency),
        "diffusion, 5 steps": (lambda x: filters.anisotropic_diffusion(x, iterations=5), x, None),
        "MCS": (filters.multiscale_curvilinear_saliency, x, None),
        "MCS guided": (lambda x: filters.multiscale_curvilinear_saliency(x, smoothing="guided"), x, None),
        "edge blur": (filters.edge_blur, x, kornia_edge_blur),
        "MFC": (filters.multiscale_focus_curves, x, None),
        "PCI": (filters.principal_curvature_image, x, None),
        "HOG": (descriptors.hog, field, None),
    }
    rows = {}
    with torch.inference_mode():
        for name, (layer, data, by_kornia) in layers.items():
            if options.only and name not in options.only:
                continue

            def clone() -> float:
                return smallest(x.clone, 20)

            before = clone()
            row = {"eager_s": smallest(lambda f=layer, d=data: f(d), options.repetitions)}
            if by_kornia is not None:
                row["kornia_s"] = smallest(lambda f=by_kornia, d=data: f(d), options.repetitions)
            if not options.skip_compile:
                torch._dynamo.reset()
                compiled = torch.compile(layer, fullgraph=True)
                row["compiled_s"] = smallest(lambda f=compiled, d=data: f(d), options.repetitions)
            shape = layer(data).shape
            row["fresh_s"] = smallest(lambda s=shape: torch.ones(s), options.repetitions)
            row["clone_s"] = min(before, clone())
            for kind in ("eager", "kornia", "compiled", "fresh"):
                if f"{kind}_s" in row:
                    row[f"{kind}_clones"] = round(row[f"{kind}_s"] / row["clone_s"], 1)
            if "kornia_s" in row:
                row["eager_over_kornia"] = round(row["eager_s"] / row["kornia_s"], 2)
            rows[name] = row
            shown = ", ".join(f"{k} {v}" for k, v in row.items() if not k.endswith("_s"))
            print(f"{name:20} clone {1e3 * row['clone_s']:.2f} ms; {shown}", flush=True)
    result = {
        "input": [*x.shape],
        "dtype": "float32",
        "threads": options.threads,
        "clock": "processor time" if options.cpu_time else "wall",
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "machine": platform.machine(),
        "environment": {k: v for k, v in os.environ.items() if k.startswith(("GLIBC_TUNABLES", "MALLOC_"))},
        "date": today(),
        "commit": commit(),
        "load_average_at_end": os.getloadavg()[0],
        "layers": rows,
        "mcs_smoothing": smoothings(),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    if options.out in (PLAIN, HUGE) and not options.only:
        write_table()


if __name__ == "__main__":
    main()
