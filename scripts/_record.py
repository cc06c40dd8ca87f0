"""What scripts share: the checkout, day and commit of a record, tables between markers, timing, the real sets."""

import datetime
import json
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # versions.py runs where nothing is installed yet
    from curvireg_torch.evaluation import Benchmark

REPOSITORY = Path(__file__).resolve().parents[1]
SETS = {"pascal3d_mini": "upright", "hope": "any", "lm": "any", "dino": "any", "buddha": "any"}
"""The real sets, and the protocol's pose."""
WRITTEN = ("scripts/results", "docs", "README.md")
"""What scripts write; nothing that they measure depends on it."""


def benchmark(data: Path, name: str) -> "Benchmark":
    """One of the real sets: pascal3d_* in ``data``, pixels counted from 0; others in its folder bop."""
    from curvireg_torch.evaluation import DATASETS, Protocol

    mini = name.startswith("pascal")
    kind = DATASETS["pascal3d" if mini else "bop"]
    dataset = kind.open(data / name, pixel_origin=0) if mini else kind.open(data / "bop" / name)
    return kind.scored(dataset, Protocol(pose=SETS[name]))


def between(text: str, begin: str, end: str, body: str) -> str:
    """``text`` with ``body`` between the two markers."""
    return f"{text[: text.index(begin) + len(begin)]}\n{body}{text[text.index(end) :]}"


def table_lines(cells: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table, the first row its head."""
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return [lines[0], "|---" * len(cells[0]) + "|", *lines[1:]]


def write_json(path: Path, content: Any, indent: int = 2) -> None:
    """A record and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=indent) + "\n", encoding="utf-8")


def today() -> str:
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def commit(root: Path, *, but: Sequence[str] = WRITTEN) -> str:
    """Short hash of the checkout, "+" where anything ``but`` these paths was changed, "unknown" outside of one."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + (
            "+" if git("status", "--porcelain", "--untracked-files=no", "--", ".", *(f":!{p}" for p in but)) else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def timed(call: Callable[[], object], repeats: int) -> list[float]:
    """Seconds of each run, the fastest first."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return sorted(times)
