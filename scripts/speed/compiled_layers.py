"""What torch.compile costs and saves: seconds to compile each layer, and its time compiled and not.

    python scripts/speed/compiled_layers.py                    # ten minutes on one core
    python scripts/speed/compiled_layers.py --device cuda

Adds to scripts/results/compiled_layers.json and writes the table of docs/guides/layers.md after
each layer. One thread, batches of eight images of 128 px; both run in turn, and the least time of
each counts.
"""

import argparse
import functools
import json
import os
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
    "HOG of ImageGradient": nn.Sequential(cr.ImageGradient(), cr.HOG()),
    "DepthCurvilinearSaliency": cr.DepthCurvilinearSaliency(),
    "MultiScaleFocusCurves": cr.MultiScaleFocusCurves(),
}


def measure(layer: nn.Module, device: str, rounds: int, seconds: float) -> dict[str, float]:
    x = torch.rand(BATCH, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0)).to(device)
    learned = x.clone().requires_grad_()
    layer = layer.to(device)
    torch._dynamo.reset()
    compiled = torch.compile(layer, fullgraph=True)
    start = clock(device)
    backward(compiled, learned)
    forward(compiled, x)
    entry = {"compile_s": round(clock(device) - start, 1)}
    for name, (run, image) in {"forward": (forward, x), "both": (backward, learned)}.items():
        calls = [functools.partial(run, function, image) for function in (layer, compiled)]
        eager, fast = least_times(calls, rounds, seconds, device)
        entry |= {
            f"{name}_eager_ms": round(1e3 * eager, 3),
            f"{name}_compiled_ms": round(1e3 * fast, 3),
        }
    return entry


def clock(device: str) -> float:
    """Seconds: on the CPU those of the processor, with the compilers that were started."""
    return time.perf_counter() if device != "cpu" else sum(os.times()[:4])


def table(record: dict[str, Any]) -> list[str]:
    """Lines of the table, and where each device's rows were measured."""
    rows = [["layer", "device", "to compile", "forward", "forward and backward"]]
    for device, layers in record["layers"].items():
        for name, entry in layers.items():
            passes = (
                f"{entry[f'{p}_eager_ms']:.1f} to {entry[f'{p}_compiled_ms']:.1f} ms"
                for p in ("forward", "both")
            )
            rows.append([name, device, f"{entry['compile_s']:.0f} s", *passes])
    machines = [f"{device}: {machine}." for device, machine in record["machines"].items()]
    return [*_shared.table_lines(rows), "", f"One thread. {' '.join(machines)}", ""]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--rounds", type=int, default=8, help="rounds of which the least time counts"
    )
    parser.add_argument("--seconds", type=float, default=0.05, help="of each measurement")
    parser.add_argument("--only", nargs="+", default=list(LAYERS), help="names of layers")
    options = parser.parse_args()
    torch.set_num_threads(1)
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # read at the first compilation
    record = json.loads(OUT.read_text()) if OUT.is_file() else {"machines": {}, "layers": {}}
    where = f"torch {torch.__version__}, {_shared.processor()}, {_shared.today()}"
    for name in options.only:
        entry = measure(LAYERS[name], options.device, options.rounds, options.seconds)
        record["layers"].setdefault(options.device, {})[name] = entry
        record["machines"][options.device] = where
        print(name, entry, flush=True)
        _shared.write_json(OUT, record)
        _shared.update_page(PAGE, "compiled", "\n".join(table(record)))


if __name__ == "__main__":
    main()
