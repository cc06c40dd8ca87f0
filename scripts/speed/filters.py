"""Time of every layer, and of each building block in our code and in kornia's.

    python scripts/speed/filters.py [--threads 1] [--batch 16] [--size 256] [--no-compile] [--out FILE]
    python scripts/speed/filters.py --table      # only writes the tables of docs/performance.md again

writes scripts/results/filters.json and the tables. All times come from one run with processor time (one thread) or wall
time (several); the smallest of the repetitions counts, and ours and kornia's are measured in turn.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import kornia
import torch
from kornia.filters import box_blur, filter2d, gaussian_blur2d, guided_blur, spatial_gradient
from torch import Tensor

from curvireg_torch import features, filters
from curvireg_torch.detectors.edges import sobel_gradient
from curvireg_torch.filters import blocks
from curvireg_torch.filters.derivatives import central_derivatives, central_gradient, replicate_pad, smooth
from curvireg_torch.filters.inputs import to_grey
from scripts._shared import REPOSITORY, RESULTS, commit, processor, table_lines, today, update_page, write_json
from scripts.paper.figures import scene, silhouette

PAGE = REPOSITORY / "docs" / "performance.md"
Function = Callable[[Tensor], Tensor]


def _neighbour_differences(x: Tensor) -> Tensor:
    p = replicate_pad(x, 1)
    return torch.cat([p[..., 1:-1, 2:] - x, p[..., 2:, 1:-1] - x], dim=1)


def _kornia_neighbour_differences(x: Tensor) -> Tensor:
    row = torch.tensor([[[0.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 0.0]]], dtype=x.dtype)
    return torch.cat([filter2d(x, row, "replicate"), filter2d(x, row.mT, "replicate")], dim=1)


def _kornia_derivatives(x: Tensor) -> Tensor:
    xx, xy, yy = spatial_gradient(x, "diff", 2, normalized=False)[:, 0].split(1, dim=1)
    return torch.cat([spatial_gradient(x, "diff", 1)[:, 0], xx, yy, xy / 4.0], dim=1)


BLOCKS: dict[str, tuple[Function, Function]] = {
    "grey levels": (to_grey, kornia.color.rgb_to_grayscale),
    "Gaussian blur, 1 px": (
        lambda x: filters.gaussian_smooth(x, 1.0),
        lambda x: gaussian_blur2d(x, (9, 9), (1.0, 1.0), border_type="replicate"),
    ),
    "Gaussian blur, 4 px": (
        lambda x: filters.gaussian_smooth(x, 4.0),
        lambda x: gaussian_blur2d(x, (33, 33), (4.0, 4.0), border_type="replicate"),
    ),
    "gradient": (
        lambda x: torch.cat(central_gradient(replicate_pad(x, 1)), dim=1),
        lambda x: spatial_gradient(x, "diff", 1)[:, 0],
    ),
    "gradient and Hessian": (
        lambda x: torch.cat(central_derivatives(smooth(x, 0.0)), dim=1),
        _kornia_derivatives,
    ),
    "Sobel": (
        sobel_gradient,
        lambda x: spatial_gradient(x, "sobel", 1)[:, 0],
    ),
    "differences of neighbours": (_neighbour_differences, _kornia_neighbour_differences),
    "box mean, 5 px": (
        lambda x: torch.nn.functional.avg_pool2d(replicate_pad(x, 2), 5, stride=1),
        lambda x: box_blur(x, (5, 5), border_type="replicate"),
    ),
    "guided filter, 2 px": (
        lambda x: filters.guided_smooth(x, sigma=2.0, kappa=0.1),
        lambda x: guided_blur(x, x, 5, 0.1**2, border_type="replicate"),
    ),
}
"""Ours and kornia's function for each building block."""


BLOCK_SIZES = [2**k for k in range(14, 23)]

LAYERS: dict[str, Function] = {
    "depth CS": filters.depth_curvilinear_saliency,
    "ASG": filters.average_shading_gradient,
    "HFN": filters.hessian_frobenius_norm,
    "apparent ridges": filters.apparent_ridges,
    "image gradient": filters.image_gradient,
    "image CS": filters.image_curvilinear_saliency,
    "diffusion, 5 steps": lambda x: filters.anisotropic_diffusion(x, iterations=5),
    "MCS": filters.multiscale_curvilinear_saliency,
    "MCS guided": lambda x: filters.multiscale_curvilinear_saliency(x, smoothing="guided"),
    "edge blur": filters.edge_blur,
    "MFC": filters.multiscale_focus_curves,
    "PCI": filters.principal_curvature_image,
    "HOG of a gradient": lambda x: features.hog(filters.image_gradient(x)),
}


def fastest(calls: dict[str, Callable[[], object]], repetitions: int) -> dict[str, float]:
    """Smallest time of each call in ms; the calls run in turn, so that other work affects all of them."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    best = dict.fromkeys(calls, float("inf"))
    for call in calls.values():
        call()
    for _ in range(repetitions):
        for name, call in calls.items():
            start = clock()
            call()
            best[name] = min(best[name], 1e3 * (clock() - start))
    return best


def block_times(x: Tensor, repetitions: int) -> dict[str, dict[str, float]]:
    """Times of both implementations, their ratio, and the largest difference of their results off the border."""
    colour, rows = x.expand(-1, 3, -1, -1).contiguous(), {}
    for name, (ours, theirs) in BLOCKS.items():
        data = colour if name == "grey levels" else x
        inner = (..., slice(20, -20), slice(20, -20))
        difference = float((ours(data)[inner] - theirs(data)[inner]).abs().max())
        row = fastest({"ours_ms": lambda: ours(data), "kornia_ms": lambda: theirs(data)}, repetitions)  # noqa: B023
        rows[name] = {**row, "kornia_over_ours": row["kornia_ms"] / row["ours_ms"], "max_difference": difference}
    return rows


def layer_times(x: Tensor, repetitions: int, *, compiled: bool) -> dict[str, dict[str, float]]:
    rows = {}
    for name, layer in LAYERS.items():
        calls: dict[str, Callable[[], object]] = {"eager_ms": lambda f=layer: f(x), "clone_ms": x.clone}
        if compiled:
            torch._dynamo.reset()
            graph = torch.compile(layer, fullgraph=True)
            calls["compiled_ms"] = lambda f=graph: f(x)
        rows[name] = fastest(calls, repetitions)
    return rows


def mcs_smoothing(repetitions: int) -> dict[str, dict[str, float]]:
    """Cost and accuracy of the smoothings under MCS on the five scenes of the detector figure.

    ``near_contour`` is the fraction of the points within 2 px of the silhouette, ``contour_found`` the fraction of the
    silhouette within 2 px of a point. 1.3 % of the pixels become points, as many as silhouettes have on average.
    """
    photo = torch.cat([scene(i)[0] for i in range(5)])
    contour = torch.cat([silhouette(scene(i)[1]) for i in range(5)])

    def dilate(mask: Tensor) -> Tensor:
        return torch.nn.functional.max_pool2d(mask.float(), 5, stride=1, padding=2) > 0

    rows = {}
    for name in ("perona-malik", "bilateral", "guided"):

        def layer(name: str = name) -> Tensor:
            return filters.multiscale_curvilinear_saliency(photo, smoothing=name)

        points = features.field_points(layer(), fraction=0.013)
        rows[name] = {
            **fastest({"ms": layer}, repetitions),
            "near_contour": float(dilate(contour)[points].float().mean()),
            "contour_found": float(dilate(points)[contour].float().mean()),
        }
    return rows


def block_size_times(size: int, repetitions: int) -> dict[str, float]:
    """Milliseconds of depth CS on 64 images, by the pixels that are computed at a time (``filters.blocks.BLOCK``)."""
    x, used = torch.rand(64, 1, size, size, generator=torch.Generator().manual_seed(0)) + 0.5, blocks.BLOCK

    def layer(pixels: int) -> None:
        blocks.BLOCK = pixels
        filters.depth_curvilinear_saliency(x)

    try:
        return fastest({str(pixels): lambda n=pixels: layer(n) for pixels in BLOCK_SIZES}, repetitions)
    finally:
        blocks.BLOCK = used


def write_tables(record: dict, page: Path = PAGE) -> None:
    """Write the tables of the page from a record."""
    lines = table_lines(
        [
            ["building block", "ours, ms", "kornia, ms", "kornia / ours", "largest difference"],
            *(
                [
                    name,
                    f"{row['ours_ms']:.2f}",
                    f"{row['kornia_ms']:.2f}",
                    f"{row['kornia_over_ours']:.1f}",
                    f"{row['max_difference']:.0e}",
                ]
                for name, row in record["blocks"].items()
            ),
        ]
    )
    layers = [
        [name, f"{row['eager_ms']:.1f}", f"{row['compiled_ms']:.1f}" if "compiled_ms" in row else ""]
        for name, row in record["layers"].items()
    ]
    note = (
        f"{' x '.join(map(str, record['input']))} float32, {record['threads']} thread(s), {record['clock']} time, "
        f"torch {record['torch']}, kornia {record['kornia']}, "
        f"{record.get('processor', 'processor not recorded')}, {record['date']}, commit {record['commit']}."
    )
    tables = [*lines, "", *table_lines([["layer", "eager, ms", "compiled, ms"], *layers]), ""]
    if sizes := record.get("block_sizes"):  # not in older records
        times = ["depth CS of 64 images, ms", *(f"{ms:.0f}" for ms in sizes.values())]
        tables += [*table_lines([["pixels at a time", *sizes], times]), ""]
    tables += [note, ""]
    update_page(page, "layers", "\n".join(tables))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS / "filters.json")
    parser.add_argument("--table", action="store_true", help="only write the tables again")
    options = parser.parse_args(arguments)
    if not options.table:
        torch.set_num_threads(options.threads)
        generator = torch.Generator().manual_seed(0)
        x = torch.rand(options.batch, 1, options.size, options.size, generator=generator) + 0.5
        with torch.inference_mode():
            record = {
                "input": [*x.shape],
                "threads": options.threads,
                "clock": "processor" if options.threads == 1 else "wall",
                "torch": torch.__version__,
                "kornia": kornia.__version__,
                "date": today(),
                "commit": commit(),
                "processor": processor(),
                "load_average": os.getloadavg()[0],
                "blocks": block_times(x, options.repetitions),
                "layers": layer_times(x, options.repetitions, compiled=not options.no_compile),
                "block_sizes": block_size_times(options.size, options.repetitions),
                "mcs_smoothing": mcs_smoothing(options.repetitions),
            }
        write_json(options.out, record)
    if options.out == RESULTS / "filters.json":
        write_tables(json.loads(options.out.read_text(encoding="utf-8")))


if __name__ == "__main__":
    main()
