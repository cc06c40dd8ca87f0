"""Two evaluations of one dataset, compared object by object."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from ..errors import InvalidInputError, MissingFileError
from ..utils.files import read_csv, read_json, without_apostrophe
from .registry import DATASETS

Array = NDArray[np.float64]
Interval = tuple[float, float]

CONFIDENCE = 0.95
RESAMPLES = 2000  # of the bootstrap
DRAWN_AT_ONCE = 500_000  # objects of resamples, which bounds the memory
SEED = 0
ADVICE = "the same 'curvireg evaluate' again writes it without registering anything"
README = "docs/evaluation.md"


@dataclass(frozen=True)
class Run:
    """One evaluation: its folder, its settings, and the errors of each object by name."""

    name: str
    dataset: str
    settings: Mapping[str, Any]
    errors: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Comparison:
    """One score of two runs A and B over the ``n`` objects that both have.

    Attributes:
        score: its key in ``summary.json``.
        a, b: its values.
        a_interval, b_interval: 95 % intervals: Wilson's of a fraction, else by bootstrap over the
            objects.
        difference: b - a, and its paired bootstrap interval.
        wins, losses: objects at which B is better than A, and worse; the others are ties.
        p: of the two-sided sign test.
    """

    score: str
    n: int
    a: float
    b: float
    a_interval: Interval
    b_interval: Interval
    difference: float
    difference_interval: Interval
    wins: int
    losses: int
    p: float


def read_run(folder: Path) -> Run:
    """Read what ``curvireg evaluate --out`` wrote into a folder.

    Raises:
        MissingFileError: no ``summary.json`` or ``errors.csv``.
        InvalidInputError: files that are damaged, or not of an evaluation.
    """
    summary = read_json(_existing(folder / "summary.json"), dict, README)
    settings = summary.get("settings")
    if not isinstance(settings, dict) or settings.get("dataset") not in DATASETS:
        raise InvalidInputError("not of an evaluation", subject=folder / "summary.json")
    path = _existing(folder / "errors.csv")
    header, *rows = read_csv(path) or [[]]
    try:
        errors = {without_apostrophe(row[0]): _numbers(header[2:], row[2:]) for row in rows}
    except (ValueError, IndexError) as error:
        raise InvalidInputError(f"damaged ({error}); {ADVICE}", subject=path) from error
    return Run(
        str(folder), settings["dataset"], {**settings, "protocol": summary.get("protocol")}, errors
    )


def _existing(path: Path) -> Path:
    """The path of a file of a run; :class:`MissingFileError` if there is none."""
    if not path.is_file():
        raise MissingFileError(f"no such file; {ADVICE}", subject=path)
    return path


def _numbers(names: Sequence[str], cells: Sequence[str]) -> dict[str, float]:
    return {name: float(cell or "nan") for name, cell in zip(names, cells, strict=True)}


def compare(a: Run, b: Run) -> list[Comparison]:
    """Compare the scores of two runs over the objects that both have.

    Raises:
        InvalidInputError: runs of different datasets, or without an object in common.
    """
    for name in ("dataset", "root", "split"):
        if a.settings.get(name) != b.settings.get(name):
            raise InvalidInputError(
                f"compare: the {name} of one run is {a.settings.get(name)}, that of the other "
                f"{b.settings.get(name)}; give two runs of the same dataset"
            )
    keys = [key for key in a.errors if key in b.errors]
    if not keys:
        raise InvalidInputError(
            "compare: the runs have no object in common; give two runs of the same objects"
        )
    comparisons = []
    measures = DATASETS[a.dataset].scored.measures
    for score, (error, thresholds) in measures.items():
        first, second = (
            np.mean([errors < threshold for threshold in thresholds], axis=0)
            for errors in _paired(a, b, keys, error)
        )
        comparisons.append(
            _compared(score, first, second, np.mean, is_fraction=len(thresholds) == 1)
        )
    medians = dict.fromkeys(
        error for error, _ in measures.values() if error in ("error_deg", "rotation")
    )
    for error in medians:
        pair = _paired(a, b, keys, error)
        comparisons.append(_compared("med_err_deg", *pair, np.median, lower_is_better=True))
    return comparisons


def _paired(a: Run, b: Run, keys: Sequence[str], error: str) -> tuple[Array, Array]:
    """The errors (N,) of both runs, of objects whose truth is known."""
    try:
        both = np.array([[run.errors[key][error] for key in keys] for run in (a, b)])
    except KeyError:
        raise InvalidInputError(
            f"compare: no column {error} in errors.csv of both runs; {ADVICE}"
        ) from None
    known = ~np.isnan(both).any(axis=0)
    return both[0, known], both[1, known]


def _compared(
    score: str,
    a: Array,
    b: Array,
    summarise: Callable[..., Any],
    *,
    is_fraction: bool = False,
    lower_is_better: bool = False,
) -> Comparison:
    """Compare values (N,) of the same objects."""
    better = a > b if lower_is_better else b > a
    worse = a < b if lower_is_better else b < a
    wins = int(better.sum())
    losses = int(worse.sum())
    p = float(binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0
    if len(a) == 0:
        unknown = (math.nan, math.nan)
        return Comparison(
            score, 0, math.nan, math.nan, unknown, unknown, math.nan, unknown, 0, 0, p
        )
    rng = np.random.default_rng(SEED)
    at_once = max(1, DRAWN_AT_ONCE // len(a))
    summaries = []
    with np.errstate(invalid="ignore"):  # a miss has an infinite error, and a median may be one
        for start in range(0, RESAMPLES, at_once):
            shape = (min(at_once, RESAMPLES - start), len(a))
            chosen = rng.integers(0, len(a), shape)
            summaries.append([summarise(values[chosen], axis=1) for values in (a, b)])
        first, second = np.concatenate(summaries, axis=1)
        value_a = float(summarise(a))
        value_b = float(summarise(b))
        difference = float(_differences(value_a, value_b))
        differences = _differences(first, second)
    return Comparison(
        score=score,
        n=len(a),
        a=value_a,
        b=value_b,
        a_interval=_wilson(a) if is_fraction else _quantiles(first),
        b_interval=_wilson(b) if is_fraction else _quantiles(second),
        difference=difference,
        difference_interval=_quantiles(differences),
        wins=wins,
        losses=losses,
        p=p,
    )


def _differences(a: Any, b: Any) -> Array:
    """b - a; 0 where both are infinite."""
    return np.where(a == b, 0.0, np.subtract(b, a))


def _quantiles(values: Array) -> Interval:
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(values, [tail, 1.0 - tail], method="nearest")
    return float(low), float(high)


def _wilson(successes: Array) -> Interval:
    interval = binomtest(int(successes.sum()), len(successes)).proportion_ci(
        CONFIDENCE, method="wilson"
    )
    return float(interval.low), float(interval.high)


def in_words(a: Run, b: Run, comparisons: Sequence[Comparison]) -> str:
    """The comparison as text: each score, then a Markdown and a LaTeX row of each run."""
    only = [len(run.errors.keys() - other.errors.keys()) for run, other in ((a, b), (b, a))]
    common = len(a.errors.keys() & b.errors.keys())
    lines = [f"A {a.name}: {_how(a, b)}", f"B {b.name}: {_how(b, a)}"]
    lines.append(
        f"{common} objects in both; {only[0]} only in A and {only[1]} only in B do not count"
    )
    lines.append("")
    first = [_value(each.a, each.a_interval, _digits(each)) for each in comparisons]
    second = [_value(each.b, each.b_interval, _digits(each)) for each in comparisons]
    for each, in_a, in_b in zip(comparisons, first, second, strict=True):
        difference = _value(each.difference, each.difference_interval, f"+{_digits(each)}")
        signs = f"B wins {each.wins}, loses {each.losses}, p {each.p:.2g}"
        lines.append(f"{each.score}: A {in_a}   B {in_b}   B - A {difference}   {signs}")
    header = ["run", "N", *(each.score for each in comparisons)]
    count = str(max(each.n for each in comparisons))
    rows = [[Path(run.name).name, count, *values] for run, values in ((a, first), (b, second))]
    table = [header, ["---"] * len(header), *rows]
    lines += ["", "Markdown:", *(f"| {' | '.join(row)} |" for row in table)]
    lines += ["", "LaTeX:", *map(_latex, [header, *rows])]
    return "\n".join(lines) + "\n"


def _how(run: Run, other: Run) -> str:
    """Preset and protocol of a run, and those of its settings that another run has not."""
    theirs = _named(other.settings)
    own = [
        f"{name}={value}"
        for name, value in _named(run.settings).items()
        if name not in ("preset", "protocol") and (name, value) not in theirs.items()
    ]
    preset, protocol = (run.settings.get(name) for name in ("preset", "protocol"))
    return ", ".join([f"preset {preset}", str(protocol), *own])


def _named(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name; those within others as in ``pipeline.box_jitter``."""
    named: dict[str, Any] = {}
    for name, value in settings.items():
        inner = _named(value) if isinstance(value, dict) else {}
        named |= {f"{name}.{key}": each for key, each in inner.items()} or {name: value}
    return named


def _digits(comparison: Comparison) -> str:
    """Format of a score: fractions, or degrees."""
    return ".2f" if comparison.score.endswith("err_deg") else ".3f"


def _value(value: float, interval: Interval, digits: str) -> str:
    low, high = (format(end, digits) for end in interval)
    return f"{value:{digits}} [{low}, {high}]"


def _latex(cells: Sequence[str]) -> str:
    escaped = [re.sub(r"[_%&]", r"\\\g<0>", cell) for cell in cells]
    return f"{' & '.join(escaped)} \\\\"
