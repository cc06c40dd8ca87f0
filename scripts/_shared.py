"""Helpers that several scripts use: records, tables, timing, the real sets and bootstrap intervals."""

import datetime
import json
import subprocess
import time
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:  # importing the evaluation takes seconds, and few scripts need it
    from curvireg_torch.evaluation import Benchmark

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "scripts" / "results"
REAL_SETS = {"pascal3d_mini": "upright", "hope": "any", "lm": "any", "dino": "any", "buddha": "any"}
"""Real datasets, each with the pose prior of its protocol."""
WRITTEN = ("scripts/results", "docs", "README.md")
"""Paths that scripts write to. A change there does not affect what a script measures."""
RESAMPLES = 2000


def benchmark(data: Path, name: str) -> "Benchmark":
    """Open one of the real sets: PASCAL3D+ sets in ``data`` (pixels counted from 0), the others in ``data/bop``."""
    from curvireg_torch.evaluation import DATASETS, Protocol

    is_pascal = name.startswith("pascal")
    spec = DATASETS["pascal3d" if is_pascal else "bop"]
    dataset = spec.open(data / name, pixel_origin=0) if is_pascal else spec.open(data / "bop" / name)
    return spec.scored(dataset, Protocol(pose=REAL_SETS[name]))


def replace_between(text: str, begin: str, end: str, body: str) -> str:
    """Return ``text`` with ``body`` in place of what stands between the two markers."""
    return f"{text[: text.index(begin) + len(begin)]}\n{body}{text[text.index(end) :]}"


def update_page(page: Path, name: str, body: str) -> None:
    """Write ``body`` between the markers ``name:begin`` and ``name:end`` of a Markdown page."""
    text = page.read_text(encoding="utf-8")
    page.write_text(replace_between(text, f"<!-- {name}:begin -->", f"<!-- {name}:end -->", body), encoding="utf-8")


def table_lines(cells: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table whose first row is the header."""
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return [lines[0], "|---" * len(cells[0]) + "|", *lines[1:]]


def write_json(path: Path, content: Any, indent: int = 2) -> None:
    """Write a record, and create its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=indent) + "\n", encoding="utf-8")


def today() -> str:
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def commit(root: Path = REPOSITORY) -> str:
    """Short hash of the checkout, with "+" if anything outside ``WRITTEN`` was changed; "unknown" without git."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", *(f":!{path}" for path in WRITTEN))
        return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def timed(call: Callable[[], object], repeats: int) -> list[float]:
    """Seconds of each run in ascending order."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return sorted(times)


def independent_units(objects: "Benchmark") -> list[int]:
    """Number of the independent unit of each object of a set.

    PASCAL3D+: all objects of one CAD are a unit. BOP: one object of a scene in one pose is a unit under all its
    lightings (the 80 instances of ``hope`` are 16 such views in five lightings each).
    """
    return _numbered([_unit(objects, k) for k in range(len(objects.items))])


def _unit(objects: "Benchmark", k: int) -> Hashable:
    item = objects.items[k]
    known = objects.dataset.annotation(item.index)
    if "scene_id" not in known:
        return item.meshes
    pose = [round(float(v), 3) for v in (*known["rotation"].flatten(), *known["translation"])]
    return known["scene_id"], known["obj_id"], *pose


def _numbered(units: Sequence[Hashable]) -> list[int]:
    numbers = {unit: i for i, unit in enumerate(dict.fromkeys(units))}
    return [numbers[unit] for unit in units]


def interval(values: ArrayLike, units: Sequence[Hashable]) -> tuple[float, float, float]:
    """Mean of (N,) values with its 95 % interval by bootstrap over units.

    Args:
        values: 0 or 1 each, or paired differences of such values.
        units: unit of each value. All members of a unit are drawn together.
    """
    values, number = np.asarray(values, float), _numbered(units)
    total, count = np.bincount(number, weights=values), np.bincount(number)
    picks = np.random.default_rng(0).integers(len(count), size=(RESAMPLES, len(count)))
    low, high = np.quantile(total[picks].sum(axis=1) / count[picks].sum(axis=1), [0.025, 0.975])
    return float(values.mean()), float(low), float(high)


def interval_of(units: Sequence[Hashable], measure: Callable[[np.ndarray], float | None]) -> tuple[float, float] | None:
    """95 % interval of ``measure(indices)`` by bootstrap over units.

    Args:
        units: unit of each of the N values.
        measure: statistic of (M,) indices, which may repeat; None where it is undefined.

    Returns:
        The interval, or None if there is only one unit or the measure is undefined in half of the resamples.
    """
    number = np.array(_numbered(units))
    members = [np.flatnonzero(number == k) for k in range(number.max() + 1)]
    if len(members) < 2:
        return None
    rng = np.random.default_rng(0)
    picks = (rng.integers(len(members), size=len(members)) for _ in range(RESAMPLES))
    values = [v for pick in picks if (v := measure(np.concatenate([members[k] for k in pick]))) is not None]
    if len(values) <= RESAMPLES / 2:
        return None
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)
