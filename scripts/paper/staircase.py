"""From the letter of the paper to the default pipeline, one change at a time.

    python scripts/paper/staircase.py pascal3d=/data/pascal3d_mini lm=/data/bop/lm --out DIR
    [--limit N] [--jobs N] [--page PAGE]

Each set is NAME=ROOT: ROOT is a PASCAL3D+ release if it has a folder ``CAD``, else a BOP set. Steps
are cumulative, each has the results of ``curvireg evaluate``, and a second call does only what is
missing: DIR/NAME holds one file for each mesh, DIR/staircase.csv one row for each set and step. All
steps of a mesh are measured together, so that it is opened once. --page writes the table into a
page of the documentation, between its markers.
"""

import argparse
import csv
import json
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
# with an installed wheel, scripts is not a package that Python finds
sys.path.insert(0, str(REPOSITORY))

from curvireg_torch.data import BOPDataset, Pascal3DPlus
from curvireg_torch.errors import CurviregError, InvalidInputError
from curvireg_torch.evaluation import Benchmark, BOPBenchmark, Pascal3DBenchmark, Protocol
from curvireg_torch.evaluation.benchmark import true_rotations
from curvireg_torch.jobs.documents import line_document
from curvireg_torch.jobs.entry import Observation, observe
from curvireg_torch.jobs.photograph import register_observation
from curvireg_torch.jobs.runner import results_digest
from curvireg_torch.matching import ViewBank, ViewDescriber, ViewMatcher
from curvireg_torch.mesh import load_mesh
from curvireg_torch.pipeline import PRESETS, Pipeline, ViewPolicy
from curvireg_torch.registration import Registrar
from curvireg_torch.terms import Appearance, BoxShape
from curvireg_torch.utils.files import file_digest, text_digest, write_csv
from curvireg_torch.utils.threads import map_on_threads
from scripts._shared import commit, table_lines, update_page
from scripts.paper.measures import bootstrap
from scripts.paper.parts import Part, complete
from scripts.paper.parts import read as read_part

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


def chosen_objects(benchmark: Benchmark, limit: int | None) -> list[list[int]]:
    """Indices of ``limit`` objects of known pose, spread evenly, those of one mesh together."""
    known = true_rotations(benchmark.samples).isfinite().flatten(1).all(dim=1)
    groups = defaultdict[Any, list[int]](list)
    for i in benchmark.selection(limit):
        if known[i] and not benchmark.entries[i].error:
            groups[benchmark.entries[i].meshes].append(i)
    return list(groups.values())


class Climber:
    """One mesh on the staircase, with those of its photographs that can be read.

    What steps have in common is computed once: mesh, contours, and the views, which :data:`STEPS`
    change five times only.
    """

    def __init__(
        self, benchmark: Benchmark, chosen: list[int], every: Sequence[Pipeline] = ()
    ) -> None:
        """``every`` pipeline that is measured: views hold what any of them needs."""
        self.benchmark = benchmark
        self.every = every
        self.mesh = load_mesh(benchmark.entries[chosen[0]].meshes[0], unit=benchmark.unit)
        self.samples = []
        self.photographs = []
        for i in chosen:
            entry = benchmark.entries[i]
            with suppress(CurviregError, OSError):  # a photograph that cannot be read
                self.photographs.append(observe(entry, entry.read()))
                self.samples.append(benchmark.samples[i])
        self.bank: ViewBank | None = None
        self.describer: ViewDescriber | None = None

    def errors(self, pipeline: Pipeline) -> list[float]:
        """Rotation errors of a pipeline in degrees, up to symmetries where they are known; 180
        where it finds no pose."""
        registrar = self._registrar(pipeline)

        def row(observation: Observation) -> dict[str, Any]:
            try:
                return line_document(register_observation(observation, registrar).document)
            except CurviregError:
                return {}

        rows = map_on_threads(row, self.photographs)
        errors = self.benchmark.errors(self.samples, rows)[self.benchmark.page_error]
        return errors.clamp(max=180.0).tolist()

    def _registrar(self, pipeline: Pipeline) -> Registrar:
        bank = self._bank(pipeline)
        matcher = map_on_threads(lambda bank: ViewMatcher(bank, pipeline=pipeline), [bank])[0]
        if self.describer is None:
            self.describer = matcher.describer
            _ = self.describer.contours
        matcher.describer = self.describer.with_settings(bank.settings)
        # as in :func:`curvireg_torch.evaluation.evaluate`
        mesh_is = "exact" if self.benchmark.gives_camera else "similar"
        return Registrar(matcher, mesh_is=mesh_is)

    def _bank(self, pipeline: Pipeline) -> ViewBank:
        """The views of the step before, if a pipeline has the same."""
        views = pipeline.views, pipeline.bank
        if self.bank is None or (self.bank.pipeline.views, self.bank.pipeline.bank) != views:
            same = [one for one in self.every if (one.views, one.bank) == views]
            needy = [one for one in same if one.stored_appearance(1) is not None]
            built = next(iter(needy), pipeline)
            self.bank = ViewBank.build(self.mesh, pipeline=built, progress=False)
            # as files of the cache have them
            self.bank.descriptors = self.bank.descriptors.half().float()
        return self.bank


def measure(root: Path, pixel_origin: int, chosen: list[int], steps: list[int]) -> dict[str, Any]:
    """Errors of some objects of one mesh after each of some steps."""
    benchmark = benchmark_of(root, pixel_origin)
    every = [pipeline for _, pipeline in pipelines(benchmark.protocol.pose)]
    start = time.process_time()
    errors: dict[str, list[float]] = {str(k): [] for k in steps}
    seconds: dict[str, float] = {}
    result = {"errors": errors, "seconds": seconds, "commit": commit()}
    try:
        climber = Climber(benchmark, chosen, every)
    except (CurviregError, OSError):
        return {**result, "cads": [], "unreadable": len(chosen)}
    for k in steps:
        errors[str(k)] = climber.errors(every[k])
        seconds[str(k)] = time.process_time() - start
        start = time.process_time()
    cads = [str(sample[benchmark.mesh]) for sample in climber.samples]
    return {**result, "cads": cads, "unreadable": len(chosen) - len(cads)}


def climb(name: str, root: Path, options: argparse.Namespace) -> None:
    """Measure the steps of one set, and record them when all of its meshes are done."""
    benchmark = benchmark_of(root, options.pixel_origin)
    groups = chosen_objects(benchmark, options.limit)
    steps = dict(enumerate(pipelines(benchmark.protocol.pose)))
    chosen = [k for k in options.steps or steps if k in steps]
    settings = [steps[k][1].describe() for k in chosen]
    code = [results_digest(), file_digest(Path(__file__))]
    jobs = []
    for group in groups:
        entries = [benchmark.entries[i] for i in group]
        files = [entries[0].meshes[0], *(entry.photo for entry in entries)]
        requests = [repr(entry.request()) for entry in entries]
        digests = [file_digest(path) for path in files]
        request = json.dumps([code, settings, requests, digests])
        path = options.out / name / f"{text_digest(request)}.json"
        given = (root, options.pixel_origin, group, chosen)
        jobs.append(Part(path, given, len(group)))
    # In a fixed random order: the part that an interrupted run has measured is a fair one.
    jobs.sort(key=lambda job: job.path.name)
    if options.partial:
        jobs = [job for job in jobs if job.path.exists()]
    complete(jobs, measure, label=name, jobs=options.jobs, quiet=options.quiet)
    names = {k: steps[k][0] for k in chosen}
    record(name, names, [read_part(job) for job in jobs], options.out / "staircase.csv")


def record(name: str, steps: dict[int, str], records: list[dict[str, Any]], path: Path) -> None:
    """Write the rows of a set from the records of its meshes."""
    cads = [cad for one in records for cad in one["cads"]]
    commits = " ".join(sorted({one["commit"] for one in records}))
    if unreadable := sum(one["unreadable"] for one in records):
        message = "objects left out, whose photograph or mesh cannot be read"
        print(f"staircase: {name}: {unreadable} {message}", file=sys.stderr)
    rows = []
    for k, step in steps.items() if cads else ():
        errors = [error for one in records for error in one["errors"][str(k)]]
        right = bootstrap([float(error < RIGHT_DEG) for error in errors], cads)
        numbers = [
            right.n,
            len(set(cads)),
            right.mean,
            right.low,
            right.high,
            statistics.median(errors),
        ]
        rows.append([name, k, step, *numbers, commits])
    measured = {(name, str(row[1])) for row in rows}
    kept = [row for row in read(path) if (row["set"], row["step"]) not in measured]
    every = sorted([*(list(row.values()) for row in kept), *rows], key=lambda r: (r[0], int(r[1])))
    write_csv(path, [COLUMNS, *every])


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
        "--partial", action="store_true", help="rows of what is measured so far; measures nothing"
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
    print(text := table(read(options.out / "staircase.csv")))
    if options.page is not None:
        update_page(options.page, "staircase", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
