"""A page of the best and the worst results of an evaluation."""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from ..data import read_image
from ..errors import CurviregError, InvalidInputError
from ..mesh import load_mesh
from ..rendering import make_renderer
from ..visualization.sheet import SheetEntry, thumbnail, write_sheet
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import Protocol, perturbed_box
from .registry import DATASETS
from .store import ResultStore

__all__ = ["contact_sheet"]


def contact_sheet(
    folder: Path, path: Path, *, benchmark: Benchmark | None = None, each: int = 30, within_deg: float = 30.0
) -> int:
    """Write an HTML page of the best and the worst objects of an evaluation: photographs with the projected contours.

    Objects are ordered by error; then those of unknown pose, by confidence; then those that failed.

    Args:
        folder, path: of :func:`evaluate`, and of the page.
        benchmark: what was evaluated; default: the whole dataset that the folder names, at its old place.
        each: number of the best objects, and of the worst.
        within_deg: poses with a smaller error are right.

    Returns:
        The number of evaluated objects.

    Raises:
        InvalidInputError: no evaluation, ``each`` below 1, or a dataset that is missing.
    """
    if each < 1:
        raise InvalidInputError(f"each: expected at least 1, got {each}")
    store = ResultStore(folder)
    benchmark = benchmark or _open_benchmark(store)
    stored = [item for item in benchmark.items if item.key in store]
    results = [(item, row) for item in stored if "skipped" not in (row := store.read(item.key))]
    if not results:
        raise InvalidInputError(f"{folder}: no object was evaluated; run curvireg evaluate first")
    errors = benchmark.rotation_errors([item for item, _ in results], [row for _, row in results]).tolist()
    shown = [_outcome(row, error, within_deg) for (_, row), error in zip(results, errors, strict=True)]
    ranked = sorted(zip(results, shown, strict=True), key=lambda pair: pair[1][2])
    right = sum(error < within_deg for error in errors)
    known = sum(not math.isnan(error) for error in errors)
    failed = sum("failed" in row for _, row in results)
    entries = [
        SheetEntry(
            number=benchmark.items.index(item) + 1,
            name=item.key,
            caption=caption,
            kind=kind,
            picture=lambda item=item, row=row: _picture(benchmark, item, row),  # type: ignore[misc]
        )
        for (item, row), (kind, caption, _) in ranked
    ]
    title = f"{len(entries)} objects: {right} of {known} within {within_deg:g} degrees, {failed} failed"
    write_sheet(path, title, entries, table="predictions.csv", each=each)
    return len(entries)


def _open_benchmark(store: ResultStore) -> Benchmark:
    """The benchmark that the settings of an evaluation name."""
    settings = store.settings()
    try:
        kind = DATASETS[settings["dataset"]]
        options = {name: settings[name] for name in kind.options if name in settings}
        dataset = kind.open(settings["root"], **options)
        benchmark: Benchmark = kind.scored(dataset, Protocol.parse(settings["protocol"].split(), pose=kind.pose))
        return benchmark
    except (KeyError, TypeError, AttributeError, InvalidInputError) as error:
        raise InvalidInputError(f"{store.settings_path}: not settings of an evaluation ({error!r})") from error


def _outcome(row: Row, error: float, within_deg: float) -> tuple[str, str, tuple[int, float]]:
    """Kind, caption and sort key of a result."""
    if "failed" in row:
        return "failed", str(row["failed"]), (2, 0.0)
    number = row["confidence"]
    confidence = "not calibrated" if number is None else f"confidence {number:.2f}"
    if math.isnan(error):
        return "reliable" if row["reliable"] else "doubtful", f"pose unknown, {confidence}", (1, -(number or 0.0))
    return "right" if error < within_deg else "wrong", f"{error:.1f} degrees off, {confidence}", (0, error)


def _picture(benchmark: Benchmark, item: BenchmarkItem, row: Row) -> bytes | None:
    """The thumbnail; None for a failed object, and if a file cannot be read any more."""
    if "failed" in row:
        return None
    T, K = (torch.tensor(matrix, dtype=torch.float64) for matrix in row["projection"])
    try:
        renderer = _renderer(next(path for path in item.meshes if path.name == row["mesh"]), benchmark.unit)
        image = read_image(item.photo, dtype=torch.uint8)
    except (CurviregError, StopIteration):
        return None
    if "detection" in row:
        box = row["detection"]["proposals"][0]["box"]
    else:
        box = perturbed_box(item.box, benchmark.protocol, item.key).tolist()
    return thumbnail(renderer, (T, K), image, box)


@lru_cache(maxsize=8)  # objects share their meshes
def _renderer(mesh: Path, unit: str) -> Any:
    return make_renderer(load_mesh(mesh, unit=unit))
