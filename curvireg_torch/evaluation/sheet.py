"""A page of the best and the worst results of an evaluation."""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from ..errors import CurviregError, InvalidInputError
from ..io import read_image
from ..io.meshes import load_mesh
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
        folder: of :func:`evaluate` or ``curvireg evaluate``.
        path: of the page.
        benchmark: what was evaluated; default: the whole dataset that the folder names, at its old place.
        each: number of the best objects, and of the worst.
        within_deg: poses with a smaller error are right.

    Returns:
        The number of evaluated objects.

    Raises:
        InvalidInputError: no evaluation, ``each`` below 1, or a dataset that is missing.

    Example:
        >>> contact_sheet(Path("results/mine"), Path("results/mine/index.html"))                    # doctest: +SKIP
        12
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
    ranked = sorted(zip(results, errors, strict=True), key=lambda pair: _rank(pair[0][1], pair[1]))
    right = sum(error < within_deg for error in errors)
    known = sum(not math.isnan(error) for error in errors)
    failed = sum("failed" in row for _, row in results)
    entries = [
        SheetEntry(
            number=benchmark.items.index(item) + 1,
            name=item.key,
            caption=_caption(row, error),
            kind=_kind(row, error, within_deg),
            picture=lambda item=item, row=row: _picture(benchmark, item, row),  # type: ignore[misc]
        )
        for (item, row), error in ranked
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


def _rank(row: Row, error: float) -> tuple[bool, bool, float]:
    if "failed" in row:
        return True, False, 0.0
    return False, math.isnan(error), -row["confidence"] if math.isnan(error) else error


def _caption(row: Row, error: float) -> str:
    if "failed" in row:
        return str(row["failed"])
    outcome = "pose unknown" if math.isnan(error) else f"{error:.1f} degrees off"
    return f"{outcome}, confidence {row['confidence']:.2f}"


def _kind(row: Row, error: float, within_deg: float) -> str:
    if "failed" in row:
        return "failed"
    if math.isnan(error):
        return "reliable" if row["reliable"] else "doubtful"
    return "right" if error < within_deg else "wrong"


def _picture(benchmark: Benchmark, item: BenchmarkItem, row: Row) -> bytes | None:
    """The thumbnail; None for a failed object, and if the photograph or the mesh cannot be read any more."""
    if "failed" in row:
        return None
    T, K = (torch.tensor(matrix, dtype=torch.float64) for matrix in row["projection"])
    mesh = next((path for path in item.meshes if path.name == row["mesh"]), None)
    try:
        image = read_image(item.photo, dtype=torch.uint8)
        renderer = None if mesh is None else _renderer(mesh, benchmark.unit)
    except CurviregError:
        return None
    if "localization" in row:
        box = row["localization"]["proposals"][0]["box"]
    else:
        box = perturbed_box(item.box, benchmark.protocol, item.key).tolist()
    return None if renderer is None else thumbnail(renderer, (T, K), image, box)


@lru_cache(maxsize=8)  # objects share their meshes
def _renderer(mesh: Path, unit: str) -> Any:
    return make_renderer(load_mesh(mesh, unit=unit))
