"""Evaluations in tests: short calls, and what they wrote."""

from curvireg_torch.evaluation import evaluate
from curvireg_torch.evaluation.store import ResultStore

__all__ = ["rows_of", "run", "without_seconds"]


def run(benchmark, out, **options):
    return evaluate(benchmark, out, progress=False, **options)


def rows_of(benchmark, out):
    store = ResultStore(out)
    return {item.key: store.read(item.key) for item in benchmark.items if item.key in store}


def without_seconds(rows):
    dropped = ("seconds", "revision")
    return {key: {name: v for name, v in row.items() if name not in dropped} for key, row in rows.items()}
