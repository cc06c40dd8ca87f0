"""What torch.compile costs and saves: seconds to compile each layer, and its processor time compiled and not.

    python scripts/speed/compiled_layers.py                    # some minutes on one core

Writes scripts/results/compiled_layers.json and the table of docs/guides/layers.md, after each layer, on one thread, of
batches of eight images of 128 px; the layer and the compiled layer run in turn, and the least time of each counts.
"""

import argparse
import functools
import time
from typing import Any

import torch
from torch import nn

import curvireg_torch as cr
from scripts import _shared
from scripts.speed.timing import backward, forward, least_times

BATCH = 8
SIZE = 128
OUT = _shared.RESULTS / "compiled_layers.json"
PAGE = _shared.REPOSITORY / "docs" / "guides" / "layers.md"
LAYERS: dict[str, nn.Module] = {
    "ImageGradient": cr.ImageGradient(),
    "DepthCurvilinearSaliency": cr.DepthCurvilinearSaliency(),
    "AnisotropicDiffusion, 20 steps": cr.AnisotropicDiffusion(iterations=20),
    "HOG of ImageGradient": nn.Sequential(cr.ImageGradient(), cr.HOG()),
    "MultiScaleFocusCurves": cr.MultiScaleFocusCurves(),
    "MultiScaleCurvilinearSaliency": cr.MultiScaleCurvilinearSaliency(),
}


def measure(layer: nn.Module, rounds: int, seconds: float) -> dict[str, float]:
    x = torch.rand(BATCH, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    learned = x.clone().requires_grad_()
    torch._dynamo.reset()
    compiled = torch.compile(layer, fullgraph=True)
    start = time.perf_counter()
    backward(compiled, learned)
    forward(compiled, x)
    entry = {"compile_s": round(time.perf_counter() - start, 1)}
    for name, (run, image) in {"forward": (forward, x), "both": (backward, learned)}.items():
        calls = [functools.partial(run, function, image) for function in (layer, compiled)]
        eager, fast = least_times(calls, rounds, seconds)
        entry |= {f"{name}_eager_ms": round(1e3 * eager, 3), f"{name}_compiled_ms": round(1e3 * fast, 3)}
    return entry


def table(layers: dict[str, dict[str, float]]) -> list[str]:
    rows = [["layer", "to compile", "forward", "forward and backward"]]
    for name, entry in layers.items():
        passes = (f"{entry[f'{p}_eager_ms']:.1f} -> {entry[f'{p}_compiled_ms']:.1f} ms" for p in ("forward", "both"))
        rows.append([name, f"{entry['compile_s']:.0f} s", *passes])
    return _shared.table_lines(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=8, help="rounds of which the least time counts")
    parser.add_argument("--seconds", type=float, default=0.05, help="of each measurement")
    parser.add_argument("--only", nargs="+", default=list(LAYERS), help="names of layers")
    options = parser.parse_args()
    torch.set_num_threads(1)
    layers: dict[str, dict[str, float]] = {}
    for name in options.only:
        layers[name] = measure(LAYERS[name], options.rounds, options.seconds)
        print(name, layers[name], flush=True)
        record: dict[str, Any] = {"date": _shared.today(), "processor": _shared.processor(), "torch": torch.__version__}
        _shared.write_json(OUT, {**record, "layers": layers})
        note = f"torch {torch.__version__}, {record['processor']}, one thread, {record['date']}."
        _shared.update_page(PAGE, "compiled", "\n".join([*table(layers), "", note, ""]))


if __name__ == "__main__":
    main()
