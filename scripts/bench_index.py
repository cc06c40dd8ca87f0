"""When a FAISS index beats looking at every view: seconds and recall of both, by the number of views.

    python scripts/bench_index.py BANKS [--out scripts/results/bench_index.json]

BANKS is a folder of view banks (the cache, for instance), all with the same settings. The queries are photographs made
in code of the demo's mesh, whose own bank is not among them: recall is that of a search among models that resemble.
"""

import argparse
import json
import time
from pathlib import Path

import torch
from _record import timed, write_json
from safetensors import safe_open
from torch.nn.functional import normalize

import curvireg_torch as cr
from curvireg_torch.matching import ViewBank, ViewIndex
from curvireg_torch.pipeline import preset_named
from curvireg_torch.synthetic import example_mesh, random_pose, synthesize_photograph

TOP = (1, 10, 100)


def photographs(count: int) -> torch.Tensor:
    """(count, D) descriptors."""
    mesh, size = example_mesh(), (240, 320)
    K = cr.camera_matrix(400.0, 400.0, 159.5, 119.5, dtype=torch.float64)
    views = cr.sample_views(azimuth_step=90, elevations=[20])
    matcher = cr.ViewMatcher(ViewBank.build(mesh, views, settings=preset_named("classical").bank, progress=False))
    generator, shots = torch.Generator().manual_seed(0), []
    for _ in range(count):
        shots.append(synthesize_photograph(mesh, random_pose(mesh, K, size, generator), K, size, generator))
    with torch.no_grad():
        return matcher.query([s[0] for s in shots], torch.stack([s[1] for s in shots])).descriptors[:, 0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("banks", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[700, 2800, 11200, 44800])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "bench_index.json")
    arguments = parser.parse_args()
    parts = []
    for path in sorted(arguments.banks.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            found = file.get_tensor("descriptors")
        if not parts or found.shape[1] == parts[0].shape[1]:
            parts.append(found)
    everything = torch.cat(parts)
    everything = everything[torch.randperm(len(everything), generator=torch.Generator().manual_seed(0))]
    queries = photographs(32)
    rows = []
    for size in arguments.sizes:
        if size > len(everything):
            continue
        views = normalize(everything[:size].float(), dim=1)
        q = normalize(queries, dim=1)
        truth = (q @ views.T).topk(max(TOP), dim=1).indices
        row = {
            "views": size,
            "brute_1_s": timed(lambda: (q[:1] @ views.T).topk(100), 7)[0],  # noqa: B023
            "brute_32_s": timed(lambda: (q @ views.T).topk(100), 7)[0],  # noqa: B023
        }
        start = time.perf_counter()
        index = ViewIndex(views)
        row["train_s"] = time.perf_counter() - start
        for probes in (4, 16, 64):
            index._index.nprobe = probes
            row[f"probes_{probes}"] = {
                "1_s": timed(lambda: index.search(q[:1], 100), 7)[0],  # noqa: B023
                "32_s": timed(lambda: index.search(q, 100), 7)[0],  # noqa: B023
                # Of the best k of brute force, how many are among the 100 found.
                **{f"recall_{k}": recall(index.search(q, 100)[1], truth[:, :k]) for k in TOP},
            }
        rows.append(row)
        print(json.dumps(row), flush=True)
        result = {"threads": torch.get_num_threads(), "torch": torch.__version__, "rows": rows}
        write_json(arguments.out, result)


def recall(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float((truth[:, :, None] == found[:, None]).any(dim=2).float().mean())


if __name__ == "__main__":
    main()
