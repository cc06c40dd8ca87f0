"""Compare whole layers by kornia's filters with the same by sums of shifted images.

    python scripts/speed/kornia_layers.py [--only LAYER ...]

Writes scripts/results/kornia_layers.json and the table of docs/kornia.md after each measurement;
those that are not repeated (--only) stay. Both run in turn in one process on one thread, on batches
of eight images of 256 px, and the least processor time of each counts, so that the ratio holds on a
busy machine. Largest difference: of the results, relative to the largest number.
"""

import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import kornia
import torch
from kornia.filters import spatial_gradient
from torch import Tensor, nn

import curvireg_torch as cr
from curvireg_torch.filters import operations as ops
from scripts import _shared

BATCH = 8
SIZE = 256
LIMIT = 2.5  # of kornia's time to that of shifted images, up to which kornia's function is used

OUT = _shared.RESULTS / "kornia_layers.json"
PAGE = _shared.REPOSITORY / "docs" / "kornia.md"
LAYERS: dict[str, nn.Module] = {
    "ImageGradient": cr.ImageGradient(),
    "ImageCurvilinearSaliency": cr.ImageCurvilinearSaliency(),
    "MultiScaleFocusCurves": cr.MultiScaleFocusCurves(),
    "MultiScaleCurvilinearSaliency": cr.MultiScaleCurvilinearSaliency(),
    "EdgeBlur": cr.filters.EdgeBlur(),
    "PrincipalCurvatureImage": cr.filters.PrincipalCurvatureImage(),
}
"""Those of photographs; of depth, nothing is kornia's."""


def kornia_gradient(p: Tensor) -> tuple[Tensor, Tensor]:
    """``ops.central_gradient`` by kornia."""
    found: Tensor = spatial_gradient(p, "diff", 1)
    x, y = found[..., 1:-1, 1:-1].unbind(2)  # the border has replicated neighbours
    return x, y


@contextmanager
def computed(*, by_kornia: bool, gradient: bool = False) -> Iterator[None]:
    """Within, Gaussians are kornia's or sums of shifted images, whatever the library prefers; with
    ``gradient`` first derivatives are kornia's too."""
    before = ops.prefers_shifts, ops.central_gradient
    ops.prefers_shifts = lambda *_: not by_kornia
    if gradient:
        ops.central_gradient = kornia_gradient
    try:
        yield
    finally:
        ops.prefers_shifts, ops.central_gradient = before


def least_times(
    functions: Sequence[Callable[[], object]], rounds: int, seconds: float
) -> list[float]:
    """Least processor time in s of each function; they run in turn, so that all meet the same
    conditions."""
    repeats = []
    for function in functions:
        function()
        repeats.append(max(1, int(seconds / max(mean_time(function, 1), 1e-6))))
    least = [math.inf] * len(functions)
    for _ in range(rounds):
        for k, (function, count) in enumerate(zip(functions, repeats, strict=True)):
            least[k] = min(least[k], mean_time(function, count))
    return least


def mean_time(function: Callable[[], object], count: int) -> float:
    start = time.process_time()
    for _ in range(count):
        function()
    return (time.process_time() - start) / count


def forward(layer: nn.Module, image: Tensor) -> None:
    with torch.no_grad():
        layer(image)


def backward(layer: nn.Module, image: Tensor) -> None:
    image = image.clone().requires_grad_()
    layer(image).square().sum().backward()


def image_of(size: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(BATCH, 1, size, size, generator=generator)
    return cr.filters.gaussian_smooth(image, 2.0)


def measure_layer(layer: nn.Module, size: int, rounds: int, seconds: float) -> dict[str, Any]:
    """Difference of both, and times of a forward pass and of both passes, with kornia's Gaussian
    and with its gradient too."""
    image = image_of(size)

    def chosen(run: Callable[..., Any], **how: bool) -> Any:
        with computed(**how):
            return run(layer, image)

    ours, theirs = (chosen(nn.Module.__call__, by_kornia=how) for how in (False, True))
    apart = torch.minimum((ours - theirs).abs(), (ours + theirs).abs())
    entry: dict[str, Any] = {"difference": float(apart.max() / ours.abs().max())}
    for name, run in (("forward", forward), ("both", backward)):
        for what, gradient in (("", False), (" with gradient", True)):
            calls = [
                functools.partial(chosen, run, by_kornia=False),
                functools.partial(chosen, run, by_kornia=True, gradient=gradient),
            ]
            shifts, by_kornia = least_times(calls, rounds, seconds)
            entry[name + what] = {
                "shifts_ms": round(1e3 * shifts, 3),
                "kornia_ms": round(1e3 * by_kornia, 3),
                "ratio": round(by_kornia / shifts, 2),
            }
    return entry


def table(layers: dict[str, Any]) -> list[str]:
    """Lines of the table."""
    columns = ["forward", "both", "with its gradient, forward", "both"]
    rows = [["layer", *columns, "difference"]]
    for name, entry in layers.items():
        ratios = [
            f"{entry[f'{run}{what}']['ratio']:.2f}" if f"{run}{what}" in entry else "-"
            for what in ("", " with gradient")
            for run in ("forward", "both")
        ]
        rows.append([name, *ratios, f"{entry['difference']:.0e}"])
    return _shared.table_lines(rows)


def main() -> None:
    parser = _shared.parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=LAYERS, default=list(LAYERS))
    parser.add_argument("--rounds", type=int, default=8, help="of which the least time counts")
    parser.add_argument("--seconds", type=float, default=0.03, help="of each measurement")
    parser.add_argument("--size", type=int, default=SIZE, help="of images, px")
    parser.add_argument("--note", default="", help="added to the page, such as: a busy machine")
    parser.add_argument("--out", type=Path, help="JSON file, instead of the project's and its page")
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out or OUT
    layers = _shared.read_json(out)["layers"] if out.is_file() else {}
    for name in options.only:
        layers[name] = measure_layer(LAYERS[name], options.size, options.rounds, options.seconds)
        print(name, layers[name], flush=True)
        record = {
            **_shared.stamp(),
            "layers": layers,
            "processor": _shared.processor(),
            "torch": torch.__version__,
            "kornia": kornia.__version__,
            "batch": BATCH,
            "note": options.note,
        }
        _shared.write_json(out, record)
        if out == OUT:
            versions = (
                f"kornia {record['kornia']}, torch {record['torch']}, {record['processor']}, "
                f"{record['date']}{f'; {options.note}' if options.note else ''}"
            )
            _shared.update_page(PAGE, "kornia", "\n".join([*table(layers), "", f"{versions}.", ""]))


if __name__ == "__main__":
    main()
