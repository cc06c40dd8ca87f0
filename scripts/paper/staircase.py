"""From the letter of the paper to the default pipeline, one change at a time.

    python scripts/paper/staircase.py pascal3d=/data/pascal3d_mini lm=/data/bop/lm --out DIR
    [--limit N] [--jobs N] [--page PAGE]

Each set is NAME=ROOT: ROOT is a PASCAL3D+ release if it has a folder ``CAD``, else a BOP set. Steps
are cumulative. DIR/NAME/STEP holds what ``curvireg evaluate`` writes, which registers only what is
missing, DIR/staircase.csv one row for each set and step. --page writes the table into a page of the
documentation, between its markers.
"""

import argparse
import csv
import math
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

from curvireg_torch.data import BOPDataset, Pascal3DPlus
from curvireg_torch.errors import CurviregError, InvalidInputError
from curvireg_torch.evaluation import (
    Benchmark,
    BOPBenchmark,
    Pascal3DBenchmark,
    Protocol,
    evaluate,
)
from curvireg_torch.evaluation.compare import read_run
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.terms import Appearance, BoxShape
from curvireg_torch.utils.executors import Workers
from curvireg_torch.utils.files import write_csv
from scripts._shared import commit, table_lines, update_page
from scripts.paper.measures import bootstrap

RIGHT_DEG = 30.0
FEWEST_CADS = 3  # for an interval
COLUMNS = ("set", "step", "change", "n", "cads", "right", "low", "high", "median", "commit")


@dataclass(frozen=True)
class Step:
    """One change: what it is, and how it turns the pipeline of the step before into its own."""

    name: str
    change: Callable[[Pipeline, str], Pipeline]


def _bank(**changes: str) -> Callable[[Pipeline, str], Pipeline]:
    return lambda pipeline, _: replace(pipeline, bank=replace(pipeline.bank, **changes))


STEPS = (
    Step("the paper to the letter", lambda _, __: PRESETS["paper"]),
    Step(
        "views in the mesh's own axes, not the principal ones",
        lambda p, _: replace(p, views=ViewPolicy("paper")),
    ),
    Step("S_rep monotone", lambda p, _: p.with_term("repeatability", mode="monotone")),
    Step(
        "CS along the eigenvector of the larger \\|eigenvalue\\|, not of the larger one",
        _bank(formula="paper-length"),
    ),
    Step("CS = κ1 - κ2, not \\|∇Z\\| √(tr² - 4 det)", _bank(formula="geometric")),
    Step("S_hog a cosine, not (D - μ)ᵀ Σ⁻¹ D", lambda p, _: p.with_term("hog", whitening="none")),
    Step("focus curves by the exact blur, weighted by CS", lambda p, _: replace(p, field="focus")),
    Step("perspective views", _bank(camera="perspective")),
    Step("more views, at one distance", lambda p, pose: replace(p, views=ViewPolicy(pose))),
    Step("no search", lambda p, _: replace(p, search=False)),
    Step("shape of the box", lambda p, _: replace(p, terms=(*p.terms, BoxShape()))),
    Step("box jitter", lambda p, _: replace(p, box_jitter=0.1)),
    Step("learned field", lambda p, _: replace(p, field="learned")),
    Step("appearance", lambda p, _: replace(p, terms=(*p.terms, Appearance()))),
    Step(
        "contour fit of five hypotheses: the default",
        lambda p, _: replace(p, hypotheses=5, contours=True),
    ),
)


def pipelines(pose: str) -> Iterator[tuple[str, Pipeline]]:
    """The name of each step and its pipeline, for a dataset of which ``pose`` is known."""
    pipeline = PRESETS["paper"]
    for k, step in enumerate(STEPS):
        pipeline = step.change(pipeline, pose)
        yield f"{k}. {step.name}", pipeline


def benchmark_of(root: Path, pixel_origin: int) -> Benchmark:
    """The objects of a PASCAL3D+ release or a BOP set under the usual protocol."""
    if (root / "CAD").is_dir():
        return Pascal3DBenchmark(
            Pascal3DPlus(root, pixel_origin=pixel_origin), Protocol(pose="upright")
        )
    return BOPBenchmark(BOPDataset(root), Protocol(pose="any"))


def climb(name: str, root: Path, options: argparse.Namespace) -> None:
    """Evaluate the steps of one set, and record them."""
    benchmark = benchmark_of(root, options.pixel_origin)
    entries = zip(benchmark.entries, benchmark.samples, strict=True)
    cads = {entry.key: str(sample[benchmark.mesh]) for entry, sample in entries}
    for k, (step, pipeline) in enumerate(pipelines(benchmark.protocol.pose)):
        if k not in (options.steps or [k]):
            continue
        folder = options.out / name / f"{k}"
        how = {"limit": options.limit, "progress": not options.quiet}
        summary = evaluate(
            benchmark, folder, pipeline=pipeline, workers=Workers(options.jobs), **how
        )
        if summary["skipped"]:
            print(f"staircase: {name}: left out: {dict(summary['skipped'])}", file=sys.stderr)
        found = {key: each[benchmark.page_error] for key, each in read_run(folder).errors.items()}
        known = {key: min(error, 180.0) for key, error in found.items() if not math.isnan(error)}
        if known:
            row = [name, k, step, *scores(known, cads), commit()]
            record(row, options.out / "staircase.csv")


def scores(errors: dict[str, float], cads: dict[str, str]) -> list[float]:
    """Numbers of objects and CADs, share within 30 degrees and its interval, and median error."""
    groups = [cads[key] for key in errors]
    right = bootstrap([float(error < RIGHT_DEG) for error in errors.values()], groups)
    share = [right.mean, right.low, right.high]
    return [right.n, len(set(groups)), *share, statistics.median(errors.values())]


def record(row: list[Any], path: Path) -> None:
    """Write a row in the place of that of the same set and step."""
    kept = [list(each.values()) for each in read(path)]
    kept = [each for each in kept if each[:2] != [row[0], str(row[1])]]
    rows = sorted([*kept, row], key=lambda each: (each[0], int(each[1])))
    write_csv(path, [COLUMNS, *rows])


def read(path: Path) -> list[dict[str, str]]:
    """The rows that are known."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def table(rows: list[dict[str, str]]) -> str:
    """Markdown: one line for each step, one column for each set; share within 30 degrees and median
    error."""
    names = list(dict.fromkeys(row["set"] for row in rows))
    known = {(row["set"], int(row["step"])): row for row in rows}
    counts = {name: max(int(row["n"]) for row in rows if row["set"] == name) for name in names}
    cells = [["change", *(f"`{name}`, N {counts[name]}" for name in names)]]
    for k, (step, _) in enumerate(pipelines("any")):
        found = [known.get((name, k)) for name in names]
        cells.append([step, *("-" if row is None else cell_of(row) for row in found)])
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    text = (
        "Share of the rotations within 30° with its 95 % interval by bootstrap of the CADs (none "
        "for one or two of them), and median error, up to symmetries where they are known; each "
        "line adds one change to the line above"
    )
    return "\n".join([f"{text}. Commit {commits}.", "", *table_lines(cells), ""])


def cell_of(row: dict[str, str]) -> str:
    """Share, interval and median; intervals of fewer than ``FEWEST_CADS`` mean nothing."""
    right, low, high = (float(row[name]) for name in ("right", "low", "high"))
    interval = f" ({low:.2f} to {high:.2f})" if int(row["cads"]) >= FEWEST_CADS else ""
    return f"{right:.2f}{interval}, {float(row['median']):.0f}°"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="*", metavar="NAME=ROOT")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--limit", type=int, metavar="N", help="N objects of each set, spread evenly"
    )
    parser.add_argument("--steps", type=int, nargs="+", help="numbers of steps (default: all)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")
    parser.add_argument(
        "--pixel-origin", type=int, choices=(0, 1), default=1, help="of PASCAL3D+ (default: 1)"
    )
    parser.add_argument("--page", type=Path, help="page of the documentation that gets the table")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    options = parser.parse_args()
    try:
        for word in options.sets:
            name, _, root = word.partition("=")
            if not root:
                raise InvalidInputError(f"expected NAME=ROOT, got {word!r}")
            climb(name, Path(root), options)
    except CurviregError as error:
        print(f"staircase: error: {error}", file=sys.stderr)
        return 2
    print(text := table(read(options.out / "staircase.csv")))
    if options.page is not None:
        update_page(options.page, "staircase", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
