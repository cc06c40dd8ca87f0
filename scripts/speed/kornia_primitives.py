"""Compare primitives of the filters with kornia's: results, and processor time of forward and
backward pass.

    python scripts/speed/kornia_primitives.py                  # eager, a minute on one core
    python scripts/speed/kornia_primitives.py --compiled       # also compiled, which takes several
    minutes

Writes scripts/results/kornia_primitives.json and the table of docs/kornia.md after each
measurement; those that are not repeated (--only, --sizes) stay. Both functions run in
turn in one process on one thread, on batches of eight images, and the least time of each counts, so
that the ratio holds on a busy machine.
"""

import argparse
import functools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kornia
import torch
from torch import Tensor

import curvireg_torch as cr
from curvireg_torch.filters import operations as ops
from curvireg_torch.geometry.crops import crop_squares, square_boxes
from curvireg_torch.terms import dilate_points
from scripts import _shared
from scripts.speed.timing import backward, forward, least_times

SIZES = (128, 256)
BATCH = 8
LARGEST_RATIO = 1.5
"""Of kornia's time to ours, up to which kornia's function is used where results agree."""

TOLERANCE = 1e-5
OUT = _shared.RESULTS / "kornia_primitives.json"
PAGE = _shared.REPOSITORY / "docs" / "kornia.md"
# side of crops, and the square that they enlarge
CROP = 128
BOX = (20.3, 14.6, 110.3, 104.6)
RADIUS = 5.12  # px of a dilation: eps of Repeatability at 256 px


@dataclass(frozen=True)
class Primitive:
    """The same operation twice. ``difference`` is not compared where they are different
    functions."""

    name: str
    ours: Callable[[Tensor], Tensor]
    kornia: Callable[[Tensor], Tensor]
    channels: int = 1
    same: bool = True
    differentiable: bool = True
    compiles: bool = True
    border: int = 0
    """Width of the border that is not compared."""

    remark: str = ""


def _gaussian(sigma: float) -> Primitive:
    side = 2 * math.ceil(4.0 * sigma) + 1

    def of_kornia(x: Tensor) -> Tensor:
        return kornia.filters.gaussian_blur2d(x, side, (sigma, sigma), "replicate")

    return Primitive(
        f"Gaussian, sigma {sigma:g}", lambda x: cr.filters.gaussian_smooth(x, sigma), of_kornia
    )


def _first(x: Tensor) -> Tensor:
    return torch.cat(ops.central_gradient(ops.replicate_pad(x, 1)), dim=1)


def _second(x: Tensor) -> Tensor:
    _, _, xx, yy, xy = ops.central_derivatives(ops.replicate_pad(x, 1))
    return torch.cat([xx, xy, yy], dim=1)


def _kornia_second(x: Tensor) -> Tensor:
    """In units of our derivatives: kornia's kernels are stencils of whole numbers."""
    raw = kornia.filters.spatial_gradient(x, "diff", 2, normalized=False)[:, 0]
    return raw * torch.tensor([1.0, 0.25, 1.0], dtype=x.dtype).view(1, 3, 1, 1)


def _kornia_gradient(x: Tensor) -> Tensor:
    smooth = kornia.filters.gaussian_blur2d(x, 9, (1.0, 1.0), "replicate")
    return kornia.filters.spatial_gradient(smooth, "diff", 1)[:, 0]


def _grey(x: Tensor) -> Tensor:
    """What was used before kornia's."""
    r, g, b = x.split(1, dim=1)
    return 0.299 * r + 0.587 * g + 0.114 * b


def _crops(x: Tensor) -> Tensor:
    square = torch.tensor([BOX], dtype=torch.float32)
    return torch.cat([crop_squares(image, square_boxes(square, 0.0), CROP) for image in x])


def _kornia_crops(x: Tensor) -> Tensor:
    """Its boxes are the centres of the outermost samples."""
    half = 0.5 * (BOX[2] - BOX[0]) / CROP
    left = BOX[0] + half
    top = BOX[1] + half
    right = BOX[2] - half
    bottom = BOX[3] - half
    corners = torch.tensor([[left, top], [right, top], [right, bottom], [left, bottom]])
    boxes = corners.expand(len(x), 4, 2)
    return kornia.geometry.transform.crop_and_resize(x, boxes, (CROP, CROP))


def _points(x: Tensor) -> Tensor:
    return x[:, 0] > 0.99


def _kornia_dilation(x: Tensor) -> Tensor:
    offsets = torch.arange(-int(RADIUS), int(RADIUS) + 1)
    disc = (offsets[:, None] ** 2 + offsets**2 <= RADIUS**2).float()
    return kornia.morphology.dilation(_points(x)[:, None].float(), disc)[:, 0] > 0.5


PRIMITIVES = (
    *(_gaussian(sigma) for sigma in (1.0, 2.0, 4.0)),
    Primitive(
        "first derivatives", _first, lambda x: kornia.filters.spatial_gradient(x, "diff", 1)[:, 0]
    ),
    Primitive("second derivatives", _second, _kornia_second),
    Primitive(
        "gradient of the smoothed image",
        cr.image_gradient,
        _kornia_gradient,
        border=1,
        remark="ours pads before it smooths; equal but for the outermost pixel",
    ),
    Primitive(
        "grey levels",
        _grey,
        kornia.color.rgb_to_grayscale,
        channels=3,
        remark="ours: a sum of three products",
    ),
    Primitive(
        "crops, enlarged",
        _crops,
        _kornia_crops,
        border=1,
        compiles=False,
        remark="shrunk ones differ: kornia's have no antialiasing",
    ),
    Primitive(
        "dilation by a disc",
        lambda x: dilate_points(_points(x), RADIUS).float(),
        lambda x: _kornia_dilation(x).float(),
        differentiable=False,
        compiles=False,
        remark="ours is OpenCV's",
    ),
    Primitive(
        "edge-preserving smoothing",
        lambda x: cr.anisotropic_diffusion(x, iterations=20),
        lambda x: kornia.filters.bilateral_blur(x, 9, 0.1, (2.0, 2.0), "replicate"),
        same=False,
        remark="diffusion in 20 steps; kornia has a bilateral filter instead",
    ),
    Primitive(
        "half-size picture",
        lambda x: torch.nn.functional.avg_pool2d(x, 2),
        lambda x: kornia.geometry.transform.pyrdown(x, "replicate"),
        same=False,
        remark="means of 2 x 2 px by torch; kornia blurs and resamples",
    ),
)
"""A median filter is missing because no filter here needs one."""


def difference_of(primitive: Primitive, x: Tensor) -> float:
    """Largest absolute difference of the results, without the border."""
    a, b = (forward(function, x) for function in (primitive.ours, primitive.kornia))
    inner = slice(primitive.border, -primitive.border or None)
    return float((a - b)[..., inner, inner].abs().max())


def measure(
    primitive: Primitive, size: int, *, compiled: bool, rounds: int, seconds: float
) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(BATCH, primitive.channels, size, size, generator=generator)
    entry: dict[str, Any] = {"primitive": primitive.name, "size": size, "same": primitive.same}
    if primitive.same:
        entry["difference"] = difference_of(primitive, x)
    learned = x.clone().requires_grad_()
    for mode in ("eager", "compiled") if compiled and primitive.compiles else ("eager",):
        both = primitive.ours, primitive.kornia
        if mode == "compiled":
            torch._dynamo.reset()
            both = torch.compile(primitive.ours), torch.compile(primitive.kornia)
        passes = {"forward": (forward, x)}
        if primitive.differentiable:
            passes["forward and backward"] = (backward, learned)
        for name, (run, image) in passes.items():
            calls = [functools.partial(run, function, image) for function in both]
            ours, theirs = least_times(calls, rounds, seconds)
            times = {"ours_ms": round(1e3 * ours, 4), "kornia_ms": round(1e3 * theirs, 4)}
            entry.setdefault(mode, {})[name] = {**times, "ratio": round(theirs / ours, 2)}
    return entry


def largest_ratio(entries: Sequence[dict[str, Any]]) -> float:
    """Of all sizes, modes and passes of a primitive."""
    modes = [entry[mode] for entry in entries for mode in ("eager", "compiled") if mode in entry]
    return max(values["ratio"] for mode in modes for values in mode.values())


def decision(entries: Sequence[dict[str, Any]]) -> str:
    """Whose function is used, by the rule that the page states."""
    if not all(entry["same"] for entry in entries):
        return "ours: another function"
    agrees = all(entry["difference"] < TOLERANCE for entry in entries)
    return "kornia's" if agrees and largest_ratio(entries) <= LARGEST_RATIO else "ours"


def table(entries: Sequence[dict[str, Any]]) -> list[str]:
    """Lines of the Markdown table."""
    columns = [f"{size} px, {name}" for size in SIZES for name in ("forward", "both")]
    rows = [["primitive", *columns, "difference", "used"]]
    for primitive in PRIMITIVES:
        mine = [entry for entry in entries if entry["primitive"] == primitive.name]
        if not mine:
            continue
        cells = [
            ratios_of(entry, name) for entry in mine for name in ("forward", "forward and backward")
        ]
        difference = max((entry["difference"] for entry in mine if entry["same"]), default=None)
        remark = f" ({primitive.remark})" if primitive.remark else ""
        shown = "-" if difference is None else f"{difference:.0e}"
        rows.append([primitive.name, *cells, shown, decision(mine) + remark])
    return _shared.table_lines(rows)


def ratios_of(entry: dict[str, Any], name: str) -> str:
    """Ratio of a pass, eager and, if it was measured, compiled."""
    measured = [
        entry[mode][name]["ratio"] for mode in ("eager", "compiled") if name in entry.get(mode, {})
    ]
    return " / ".join(f"{ratio:.2f}" for ratio in measured) or "-"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--compiled", action="store_true", help="measure compiled functions as well"
    )
    parser.add_argument(
        "--rounds", type=int, default=15, help="rounds of which the least time counts"
    )
    parser.add_argument("--seconds", type=float, default=0.03, help="of each measurement")
    parser.add_argument(
        "--only", nargs="+", default=[p.name for p in PRIMITIVES], help="names of primitives"
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="of images, px")
    parser.add_argument(
        "--out", type=Path, help="JSON file, instead of record and page of the project"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out or OUT
    entries = json.loads(out.read_text())["entries"] if out.is_file() else []
    for primitive in PRIMITIVES:
        for size in options.sizes if primitive.name in options.only else ():
            how = {
                "compiled": options.compiled,
                "rounds": options.rounds,
                "seconds": options.seconds,
            }
            entry = measure(primitive, size, **how)
            print(entry, flush=True)
            entries = with_entry(entries, entry)
            write(out, entries)


def with_entry(entries: Sequence[dict[str, Any]], entry: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries in the order of the table, with a new one in the place of the one before."""
    names = [primitive.name for primitive in PRIMITIVES]
    others = [one for one in entries if place(one) != place(entry)]
    return sorted([*others, entry], key=lambda one: (names.index(one["primitive"]), one["size"]))


def place(entry: dict[str, Any]) -> tuple[str, int]:
    """What an entry is of."""
    return entry["primitive"], entry["size"]


def write(out: Path, entries: Sequence[dict[str, Any]]) -> None:
    """Write the record and, if it is the project's, the table of its page."""
    record = {
        "date": _shared.today(),
        "commit": _shared.commit(),
        "processor": _shared.processor(),
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "batch": BATCH,
        "entries": entries,
    }
    _shared.write_json(out, record)
    if out == OUT:
        versions = (
            f"kornia {record['kornia']}, torch {record['torch']}, {record['processor']}, "
            f"{record['date']}"
        )
        _shared.update_page(PAGE, "kornia", "\n".join([*table(entries), "", f"{versions}.", ""]))


if __name__ == "__main__":
    main()
