"""Times the path from mesh to pose: build a bank, open it from disk, register one photograph.

Prints a table and writes scripts/results/bench_pipeline.json. The mesh is a sphere with dents, made in code, so that
the number of faces can be chosen. --peers compares with OpenCV's LINEMOD and other people's HOG instead, on
photographs of scripts/make_benchmark.py, and writes scripts/results/bench_peers.json and the table of
docs/performance.md.
"""

import argparse
import platform
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from _record import REPOSITORY, between, commit, timed, today, write_json

from curvireg_torch import BankSettings, Registrar, ViewBank, ViewMatcher, camera_matrix, uniform_views
from curvireg_torch.synthetic import random_pose, synthesize_photograph


def dented_sphere(faces: int) -> trimesh.Trimesh:
    rings = max(4, round((faces / 4) ** 0.5))
    mesh = trimesh.creation.uv_sphere(count=(rings, 2 * rings))
    waves = np.random.default_rng(0).normal(size=(3, 6)) * 3
    bumps = np.sin(mesh.vertices @ waves).mean(axis=1)
    mesh.vertices = mesh.vertices * (1 + 0.35 * bumps[:, None]) * [1.0, 0.7, 0.5]
    return mesh


def seconds(call, repeats: int = 3) -> float:
    """Median of a few runs."""
    return timed(call, repeats)[repeats // 2]


def ranking_times(bank: ViewBank, image: torch.Tensor, box: torch.Tensor, photographs: int = 32) -> dict[str, float]:
    """Ranking of described photographs against the bare matrix products that it consists of, turn about; minima."""
    times = {}
    for slack, name in ((0.0, "rank_32"), (0.1, "rank_32_slack")):
        matcher = ViewMatcher(bank, slack=slack)
        with torch.no_grad():
            query = matcher.query([image] * photographs, box.expand(photographs, 4))
            descriptors = query.descriptors.flatten(0, 1).contiguous()
            cells = torch.rand(len(descriptors), matcher._view_points.shape[1])
            bare, whole = [], []
            for _ in range(30):
                start = time.perf_counter()
                descriptors @ matcher._views.T, cells @ matcher._view_points.T
                middle = time.perf_counter()
                matcher.rank(query)
                bare.append(middle - start)
                whole.append(time.perf_counter() - middle)
        times |= {f"{name}_s": min(whole), f"{name}_over_products": min(whole) / min(bare)}
    return times


def compare_peers(folder: Path, photographs: int) -> None:
    from _peers import compare, table

    rows = compare(folder, photographs)
    record = {"date": today(), "commit": commit(REPOSITORY), "threads": torch.get_num_threads(), "rows": rows}
    write_json(REPOSITORY / "scripts" / "results" / "bench_peers.json", record)
    page = REPOSITORY / "docs" / "performance.md"
    text = between(page.read_text(encoding="utf-8"), "<!-- peers:begin -->", "<!-- peers:end -->", table(rows))
    page.write_text(text, encoding="utf-8")
    print(table(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=700)
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "bench_pipeline.json")
    parser.add_argument(
        "--peers", type=Path, metavar="BENCH", help="compare with others on the benchmark's photographs"
    )
    parser.add_argument("--photographs", type=int, default=100, help="of --peers (default: 100)")
    arguments = parser.parse_args()
    if arguments.peers is not None:
        compare_peers(arguments.peers, arguments.photographs)
        return

    mesh, K, size = dented_sphere(arguments.faces), camera_matrix(900.0, 900.0, 319.5, 239.5), (480, 640)
    generator = torch.Generator().manual_seed(0)
    T = random_pose(mesh, K, size, generator)
    image, box = synthesize_photograph(mesh, T, K, size, generator)
    rows = []
    for image_size in (128, 256):
        settings = BankSettings(image_size=image_size)
        views = uniform_views(arguments.views)
        bank = ViewBank.build(mesh, views, settings=settings, progress=False)
        build = seconds(lambda: ViewBank.build(mesh, views, settings=settings, progress=False))  # noqa: B023
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bank.safetensors"
            bank.save(path)
            megabytes = path.stat().st_size / 1e6
            opened = seconds(lambda: Registrar(ViewBank.load(path)))  # noqa: B023
        ranking = ranking_times(bank, image, box)
        coarse, fine = Registrar(bank, refine=False), Registrar(bank)
        rows.append(
            {
                "image_size": image_size,
                "build_s": build,
                "open_s": opened,
                "rank_s": seconds(lambda: coarse([image], box[None], K)),  # noqa: B023
                "rank_and_refine_s": seconds(lambda: fine([image], box[None], K)),  # noqa: B023
                "bank_mb": megabytes,
                **ranking,
            }
        )
        print("  ".join(f"{k} {v:.3g}" for k, v in rows[-1].items()))
    result = {
        "views": arguments.views,
        "faces": len(mesh.faces),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "machine": platform.machine(),
        "rows": rows,
    }
    write_json(arguments.out, result)


if __name__ == "__main__":
    main()
