"""From the letter of the paper to the default pipeline, one change at a time.

    python scripts/paper/staircase.py pascal3d=/data/pascal3d_mini lm=/data/bop/lm --out DIR
        [--limit N] [--steps STEP ...] [--jobs N] [--page PAGE]

Each set is NAME=ROOT: ROOT is a PASCAL3D+ release if it has a folder ``CAD``, else a BOP set. Steps
are cumulative; --limit takes N objects of each set, spread evenly. DIR/NAME/STEP holds what
``curvireg evaluate`` writes, which registers only what is missing: the same command again prints
the table alone. --page writes it into a page of the documentation, between its markers.
"""

import math
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import DATASETS, Benchmark, Protocol, evaluate
from curvireg_torch.evaluation.compare import read_run
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.terms import Appearance, BoxShape
from curvireg_torch.utils.executors import Workers
from scripts._shared import RIGHT_DEG, commit, markdown_table, run, update_page
from scripts.paper.measures import Estimate, bootstrap

FEWEST_CADS = 3  # for an interval


def _bank(**changes: str) -> Callable[[Pipeline, str], Pipeline]:
    return lambda pipeline, _: replace(pipeline, bank=replace(pipeline.bank, **changes))


STEPS = (
    ("the paper to the letter", lambda _, __: PRESETS["paper"]),
    (
        "views in the mesh's own axes, not the principal ones",
        lambda p, _: replace(p, views=ViewPolicy("paper")),
    ),
    ("S_rep monotone", lambda p, _: p.with_term("repeatability", mode="monotone")),
    (
        "CS along the eigenvector of the larger \\|eigenvalue\\|, not of the larger one",
        _bank(formula="paper-length"),
    ),
    ("CS = κ1 - κ2, not \\|∇Z\\| √(tr² - 4 det)", _bank(formula="geometric")),
    ("S_hog a cosine, not (D - μ)ᵀ Σ⁻¹ D", lambda p, _: p.with_term("hog", whitening="none")),
    ("focus curves by the exact blur, weighted by CS", lambda p, _: replace(p, field="focus")),
    ("perspective views", _bank(camera="perspective")),
    ("more views, at one distance", lambda p, pose: replace(p, views=ViewPolicy(pose))),
    ("no search", lambda p, _: replace(p, search=False)),
    ("shape of the box", lambda p, _: replace(p, terms=(*p.terms, BoxShape()))),
    ("box jitter", lambda p, _: replace(p, box_jitter=0.1)),
    ("learned field", lambda p, _: replace(p, field="learned")),
    ("appearance", lambda p, _: replace(p, terms=(*p.terms, Appearance()))),
    (
        "contour fit of five hypotheses: the default",
        lambda p, _: replace(p, hypotheses=5, contours=True),
    ),
)
"""Of each step: what changes, and how it turns the pipeline of the step before into its own, for a
dataset of which a pose is known."""


def pipelines(pose: str) -> Iterator[tuple[str, Pipeline]]:
    """The name of each step and its pipeline, for a dataset of which ``pose`` is known."""
    pipeline = PRESETS["paper"]
    for k, (name, change) in enumerate(STEPS):
        pipeline = change(pipeline, pose)
        yield f"{k}. {name}", pipeline


def benchmark_of(root: Path) -> Benchmark:
    """The objects of a PASCAL3D+ release or a BOP set under the usual protocol."""
    kind = DATASETS["pascal3d" if (root / "CAD").is_dir() else "bop"]
    return kind.scored(kind.open(root), Protocol(pose=kind.pose))


class Score(NamedTuple):
    """Share of the rotations within 30 degrees, number of CADs, and median error in degrees."""

    right: Estimate
    cads: int
    median: float

    def __str__(self) -> str:
        text = f"{self.right.mean:.2f}"
        if self.cads >= FEWEST_CADS:
            text += f" ({self.right.low:.2f} to {self.right.high:.2f})"
        return f"{text}, {self.median:.0f}°"


Scores = Mapping[int, Score]
"""By the number of the step."""


def climb(
    root: Path,
    out: Path,
    steps: Sequence[int] | None,
    limit: int | None,
    jobs: int,
) -> Scores:
    """Evaluate some steps on one set, or all."""
    benchmark = benchmark_of(root)
    cads = {}
    for entry, sample in zip(benchmark.entries, benchmark.samples, strict=True):
        cads[entry.key] = str(sample[benchmark.mesh])
    scores = {}
    for k, (_, pipeline) in enumerate(pipelines(benchmark.protocol.pose)):
        if steps and k not in steps:
            continue
        folder = out / f"{k}"
        workers = Workers(jobs)
        summary = evaluate(benchmark, folder, pipeline=pipeline, workers=workers, limit=limit)
        if summary["skipped"]:
            print(f"staircase: {root}: left out: {dict(summary['skipped'])}", file=sys.stderr)
        errors = []
        of_cads = []
        for key, each in read_run(folder).errors.items():
            error = each[benchmark.page_error]
            if not math.isnan(error):
                errors.append(min(error, 180.0))
                of_cads.append(cads[key])
        if errors:
            right = bootstrap([float(error < RIGHT_DEG) for error in errors], of_cads)
            scores[k] = Score(right, len(set(of_cads)), statistics.median(errors))
    return scores


def table(sets: Mapping[str, Scores]) -> str:
    """Markdown: one line for each step, one column for each set."""
    header = ["change"]
    for name, scores in sets.items():
        count = max((score.right.n for score in scores.values()), default=0)
        header.append(f"`{name}`, N {count}")
    cells = [header]
    for k, (step, _) in enumerate(pipelines("any")):
        cells.append([step, *(scores.get(k, "-") for scores in sets.values())])
    text = (
        "Share of the rotations within 30° with its 95 % interval by bootstrap of the CADs (none "
        "for one or two of them), and median error, up to symmetries where they are known; each "
        "line adds one change to the line above"
    )
    return f"{text}. Commit {commit()}.\n\n{markdown_table(cells)}"


def main(
    sets: list[str],
    *,
    out: Path,
    limit: int | None = None,
    steps: list[int] | None = None,
    jobs: int = 1,
    page: Path | None = None,
) -> None:
    scores = {}
    for word in sets:
        name, _, root = word.partition("=")
        if not root:
            raise InvalidInputError(f"expected NAME=ROOT, got {word!r}")
        scores[name] = climb(Path(root), out / name, steps, limit, jobs)
    text = table(scores)
    print(text)
    if page is not None:
        update_page(page, "staircase", text)


if __name__ == "__main__":
    run(main)
