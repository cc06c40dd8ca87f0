"""Evaluations in tests: short calls, and what they wrote."""

from curvireg_torch.evaluation import evaluate
from tests._support.lists import lines

__all__ = ["rows_of", "run", "without_seconds"]


def run(benchmark, out, **options):
    return evaluate(benchmark, out, progress=False, **options)


def rows_of(benchmark, out):
    rows = {row["key"]: row for row in lines(out)}
    return {entry.key: rows[entry.key] for entry in benchmark.entries if entry.key in rows}


def without_seconds(rows):
    return {key: {name: v for name, v in row.items() if name != "seconds"} for key, row in rows.items()}
