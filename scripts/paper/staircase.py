"""From the letter of the paper to the default pipeline, one change at a time.

    python scripts/paper/staircase.py pascal3d=/data/pascal3d_mini lm=/data/bop/lm --out DIR
    [--limit N] [--page PAGE]

Each set is NAME=ROOT: ROOT is a PASCAL3D+ release if it has a folder ``CAD``, else a BOP set. Steps
are cumulative, each is evaluated as ``curvireg evaluate`` does, and a second call does only what is
missing: DIR/NAME/STEP holds the results, DIR/staircase.csv one row for each set and step that is
done. --page writes the table into a page of the documentation, between its markers.
"""

import argparse
import csv
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

import torch

from curvireg_torch.data import BOPDataset, Pascal3DPlus
from curvireg_torch.errors import CurviregError, InvalidInputError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, evaluate
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.terms import Appearance, BoxShape
from curvireg_torch.utils.files import write_csv
from scripts._shared import commit, table_lines, update_page
from scripts.paper.measures import Estimate, bootstrap

RIGHT_DEG = 30.0
COLUMNS = ("set", "step", "change", "n", "right", "low", "high", "median", "commit")


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
    for step in STEPS:
        pipeline = step.change(pipeline, pose)
        yield step.name, pipeline


def benchmark_of(root: Path, pixel_origin: int) -> Pascal3DBenchmark | BOPBenchmark:
    """The objects of a PASCAL3D+ release or a BOP set under the usual protocol."""
    if (root / "CAD").is_dir():
        return Pascal3DBenchmark(
            Pascal3DPlus(root, pixel_origin=pixel_origin), Protocol(pose="upright")
        )
    return BOPBenchmark(BOPDataset(root), Protocol(pose="any"))


def measure(benchmark: Pascal3DBenchmark | BOPBenchmark, folder: Path) -> tuple[Estimate, float]:
    """Share of the objects within 30 degrees with its interval by CAD, and the median error, of
    stored results."""
    with (folder / "results.jsonl").open(encoding="utf-8") as file:
        known = {row["key"]: row for row in map(json.loads, file)}
    found = [i for i, entry in enumerate(benchmark.entries) if entry.key in known]
    samples = [benchmark.samples[i] for i in found]
    rows = [known[benchmark.entries[i].key] for i in found]
    errors = next(iter(benchmark.errors(samples, rows).values()))
    cads = [str(sample[benchmark.mesh]) for sample in samples]
    right = bootstrap([float(error < RIGHT_DEG) for error in errors], cads)
    return right, float(errors.nan_to_num(torch.inf).quantile(0.5))


def climb(name: str, root: Path, options: argparse.Namespace) -> None:
    """Evaluate the steps of one set, and record each when it is known."""
    out = options.out
    benchmark = benchmark_of(root, options.pixel_origin)
    for k, (change, pipeline) in enumerate(pipelines(benchmark.protocol.pose)):
        if k not in options.steps:
            continue
        folder = out / name / f"{k:02d}"
        evaluate(
            benchmark, folder, pipeline=pipeline, limit=options.limit, progress=not options.quiet
        )
        right, median = measure(benchmark, folder)
        row = [name, k, change, right.n, right.mean, right.low, right.high, median, commit()]
        kept = [old for old in read(out) if (old["set"], old["step"]) != (name, str(k))]
        ordered = sorted(
            [*(list(old.values()) for old in kept), row], key=lambda r: (str(r[0]), int(r[1]))
        )
        write_csv(out / "staircase.csv", [COLUMNS, *ordered])


def read(out: Path) -> list[dict[str, str]]:
    """The rows that are known."""
    path = out / "staircase.csv"
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
    for k, step in enumerate(STEPS):
        line = [f"{k}. {step.name}"]
        for name in names:
            row = known.get((name, k))
            line.append(
                "-" if row is None else f"{float(row['right']):.2f}, {float(row['median']):.0f}°"
            )
        cells.append(line)
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    text = (
        "Share of the rotations within 30° and median error; each line adds one change to the "
        "line above."
    )
    return "\n".join([f"{text} Commit {commits}.", "", *table_lines(cells), ""])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="*", metavar="NAME=ROOT")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--limit", type=int, metavar="N", help="N objects of each set, spread evenly"
    )
    parser.add_argument(
        "--steps", type=int, nargs="+", default=list(range(len(STEPS))), help="default: all"
    )
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
    print(text := table(read(options.out)))
    if options.page is not None:
        update_page(options.page, "staircase", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
