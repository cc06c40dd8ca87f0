"""Compare whole layers and commands by kornia's filters with the same by sums of shifted images.

    python scripts/speed/kornia_layers.py                      # eager: layers, a bank, photographs
    python scripts/speed/kornia_layers.py --compiled           # layers in graphs of torch.compile

Writes scripts/results/kornia_layers.json and the tables of docs/kornia.md after each measurement;
those that are not repeated (--only) stay. Both run in turn in one process on one thread, on batches
of eight images of 256 px, and the least processor time of each counts, so that the ratio holds on a
busy machine. Largest difference: of the results, relative to the largest number.
"""

import argparse
import functools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import kornia
import torch
from kornia.filters import spatial_gradient
from torch import Tensor, nn

import curvireg_torch as cr
from curvireg_torch.filters import operations as ops
from curvireg_torch.pipeline import PRESETS
from scripts import _shared
from scripts.speed.timing import backward, forward, least_times

BATCH = 8
SIZE = 256
LIMITS = {"eager": 2.5, "compiled": 1.5, "bank": 1.15, "photograph": 1.05}
"""Of kornia's time to that of shifted images, up to which kornia's function is used."""

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


def _yes(*_: object) -> bool:
    return True


def _no(*_: object) -> bool:
    return False


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
    # one object each, by which a graph is known again
    ops.prefers_shifts = _no if by_kornia else _yes
    if gradient:
        ops.central_gradient = kornia_gradient
    try:
        yield
    finally:
        ops.prefers_shifts, ops.central_gradient = before


def chosen(
    function: Callable[..., Any], by_kornia: bool, *arguments: Any, gradient: bool = False
) -> Any:
    """``function(*arguments)`` with either kind of filters."""
    with computed(by_kornia=by_kornia, gradient=gradient):
        return function(*arguments)


def difference(a: Tensor, b: Tensor) -> float:
    """Largest difference of two fields up to the sign of each vector, relative to the largest
    number."""
    apart = torch.minimum((a - b).abs(), (a + b).abs())
    return float(apart.max() / b.abs().max())


def paired(calls: list[Callable[[], object]], rounds: int, seconds: float) -> dict[str, float]:
    """Times of shifted images and kornia's, and their ratio."""
    ours, theirs = least_times(calls, rounds, seconds)
    return {
        "shifts_ms": round(1e3 * ours, 3),
        "kornia_ms": round(1e3 * theirs, 3),
        "ratio": round(theirs / ours, 2),
    }


def image_of(size: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(BATCH, 1, size, size, generator=generator)
    return cr.filters.gaussian_smooth(image, 2.0)


def measure_layer(
    layer: nn.Module, size: int, *, compiled: bool, rounds: int, seconds: float
) -> dict[str, Any]:
    image = image_of(size)
    torch._dynamo.reset()
    module = torch.compile(layer, fullgraph=True) if compiled else layer
    functions = [functools.partial(chosen, module, by_kornia) for by_kornia in (False, True)]
    found = [forward(function, image) for function in functions]
    entry: dict[str, Any] = {"difference": difference(found[1], found[0])}
    for name, run, x in (
        ("forward", forward, image),
        ("both", backward, image.clone().requires_grad_()),
    ):
        calls = [functools.partial(run, function, x) for function in functions]
        entry[name] = paired(calls, rounds, seconds)
        if not compiled:
            all_kornia = functools.partial(chosen, module, True, gradient=True)
            calls = [calls[0], functools.partial(run, all_kornia, x)]
            entry[f"{name} with gradient"] = paired(calls, rounds, seconds)
    return entry


def measure_photograph(preset: str, rounds: int) -> dict[str, Any]:
    """A new photograph of an object whose bank is there."""
    scene = cr.synthetic.demo_scene()
    pipeline = PRESETS[preset].with_pose_prior("upright")
    bank = cr.ViewBank.build(scene.mesh, pipeline=pipeline, progress=False)
    registrar = cr.Registrar(bank)
    register = functools.partial(registrar, [scene.image], scene.box[None], scene.camera_matrix)
    calls = [functools.partial(chosen, register, by_kornia) for by_kornia in (False, True)]
    poses = [call()[0].rotation for call in calls]
    apart = float(cr.rotation_error(poses[0].double(), poses[1].double()))
    return {"kind": "photograph", "degrees": round(apart, 5), "times": paired(calls, rounds, 0.0)}


def measure_bank(preset: str, rounds: int) -> dict[str, Any]:
    """The views of an upright object."""
    pipeline = PRESETS[preset].with_pose_prior("upright")
    build = functools.partial(cr.ViewBank.build, pipeline=pipeline, progress=False)
    mesh = cr.synthetic.example_mesh()
    calls = [functools.partial(chosen, build, by_kornia, mesh) for by_kornia in (False, True)]
    ours, theirs = (call().descriptors for call in calls)
    apart = float((ours - theirs).abs().max())
    return {"kind": "bank", "difference": apart, "times": paired(calls, rounds, 0.0)}


def table(record: dict[str, Any]) -> list[str]:
    """Lines of the tables: layers, then commands."""
    columns = ["forward", "both", "with its gradient, forward", "both", "compiled, forward", "both"]
    rows = [["layer", *columns, "difference"]]
    for name in LAYERS:
        eager = record["eager"].get(name, {})
        graph = record["compiled"].get(name, {})
        ratios = [
            f"{entry[f'{run}{what}']['ratio']:.2f}" if f"{run}{what}" in entry else "-"
            for entry, what in ((eager, ""), (eager, " with gradient"), (graph, ""))
            for run in ("forward", "both")
        ]
        shown = f"{eager['difference']:.0e}" if eager else "-"
        rows.append([name, *ratios, shown])
    if not record["commands"]:
        return _shared.table_lines(rows)
    commands = [["command", "shifted images", "kornia", "ratio"]]
    for name, entry in record["commands"].items():
        times = entry["times"]
        seconds = (f"{times[f'{kind}_ms'] / 1e3:.2f} s" for kind in ("shifts", "kornia"))
        commands.append([name, *seconds, f"{times['ratio']:.2f}"])
    return [*_shared.table_lines(rows), "", *_shared.table_lines(commands)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--compiled", action="store_true", help="layers in graphs, no commands")
    parser.add_argument("--only", nargs="+", help="names of layers and commands")
    parser.add_argument("--rounds", type=int, default=8, help="of which the least time counts")
    parser.add_argument("--seconds", type=float, default=0.03, help="of each measurement")
    parser.add_argument("--size", type=int, default=SIZE, help="of images, px")
    parser.add_argument("--note", default="", help="added to the page, such as: a busy machine")
    parser.add_argument("--out", type=Path, help="JSON file, instead of the project's and its page")
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out or OUT
    record: dict[str, Any] = {"eager": {}, "compiled": {}, "commands": {}}
    if out.is_file():
        record = json.loads(out.read_text(encoding="utf-8"))
    how = {"rounds": options.rounds, "seconds": options.seconds}
    kind = "compiled" if options.compiled else "eager"
    measures: dict[str, tuple[str, Callable[[], dict[str, Any]]]] = {
        name: (
            kind,
            functools.partial(measure_layer, layer, options.size, compiled=options.compiled, **how),
        )
        for name, layer in LAYERS.items()
    }
    if not options.compiled:
        for preset in ("learned", "classical"):
            measures[f"new photograph, `{preset}`"] = (
                "commands",
                functools.partial(measure_photograph, preset, options.rounds),
            )
        measures["bank of an upright object"] = (
            "commands",
            functools.partial(measure_bank, "learned", options.rounds),
        )
    for name, (place, measure) in measures.items():
        if options.only is None or name in options.only:
            record[place][name] = measure()
            print(name, record[place][name], flush=True)
            write(out, record, options.note)


def write(out: Path, record: dict[str, Any], note: str) -> None:
    """Write the record and, if it is the project's, the tables of its page."""
    record |= {
        "date": _shared.today(),
        "commit": _shared.commit(),
        "processor": _shared.processor(),
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "batch": BATCH,
        "note": note,
    }
    _shared.write_json(out, record)
    if out == OUT:
        versions = (
            f"kornia {record['kornia']}, torch {record['torch']}, {record['processor']}, "
            f"{record['date']}{f'; {note}' if note else ''}"
        )
        _shared.update_page(PAGE, "kornia", "\n".join([*table(record), "", f"{versions}.", ""]))


if __name__ == "__main__":
    main()
