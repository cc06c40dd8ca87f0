"""A page of an evaluation's photographs, with the poses that were found."""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from ..errors import CurviregError, InvalidInputError
from ..io import read_image
from ..io.meshes import load_mesh
from ..rendering import make_renderer
from ..visualization.sheet import Shown, thumbnail, write_sheet
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import Protocol, perturbed_box
from .registry import DATASETS
from .store import PredictionStore

__all__ = ["contact_sheet"]


def contact_sheet(
    folder: Path, path: Path, *, benchmark: Benchmark | None = None, each: int = 30, within_deg: float = 30.0
) -> int:
    """Write an HTML page of the best and the worst objects of an evaluation: photographs and the contours found.

    Ordered by the error; where no pose is known by the confidence, behind those; failed ones last.

    Args:
        folder: of :func:`evaluate` or ``curvireg evaluate``.
        path: of the page.
        benchmark: what was evaluated; default: the whole dataset that the folder names, which must be where it was.
        each: how many of the best, and of the worst.
        within_deg: an error below it is right.

    Returns:
        How many of its objects were evaluated.

    Raises:
        InvalidInputError: no evaluation, ``each`` below 1, or a dataset that is not there any more.

    Example:
        >>> contact_sheet(Path("results/mine"), Path("results/mine/index.html"))                    # doctest: +SKIP
        12
    """
    if each < 1:
        raise InvalidInputError(f"each: expected at least 1, got {each}")
    store = PredictionStore(folder / "predictions")
    benchmark = benchmark or _opened(store)
    there = [item for item in benchmark.items if item.key in store]
    found = [(item, row) for item in there if "skipped" not in (row := store.read(item.key))]
    if not found:
        raise InvalidInputError(f"{folder}: no object was evaluated; run curvireg evaluate first")
    errors = benchmark.rotation_errors([item for item, _ in found], [row for _, row in found]).tolist()
    ranked = sorted(zip(found, errors, strict=True), key=lambda one: _rank(one[0][1], one[1]))
    right = sum(error < within_deg for error in errors)
    known = sum(not math.isnan(error) for error in errors)
    failed = sum("failed" in row for _, row in found)
    rows = [
        Shown(
            number=benchmark.items.index(item) + 1,
            name=item.key,
            said=_said(row, error),
            kind=_kind(row, error, within_deg),
            picture=lambda item=item, row=row: _picture(benchmark, item, row),  # type: ignore[misc]
        )
        for (item, row), error in ranked
    ]
    title = f"{len(rows)} objects: {right} of {known} within {within_deg:g} degrees, {failed} failed"
    write_sheet(path, title, rows, table="predictions.csv", each=each)
    return len(rows)


def _opened(store: PredictionStore) -> Benchmark:
    """The benchmark that an evaluation's settings name."""
    settings = store.read("settings")
    try:
        kind = DATASETS[settings["dataset"]]
        options = {name: settings[name] for name in kind.options if name in settings}
        dataset = kind.open(settings["root"], **options)
        found: Benchmark = kind.scored(dataset, Protocol.parse(settings["protocol"].split(), pose=kind.pose))
        return found
    except (KeyError, TypeError, AttributeError, InvalidInputError) as error:
        raise InvalidInputError(f"{store.folder}/settings.json: not an evaluation's ({error!r})") from error


def _rank(row: Row, error: float) -> tuple[bool, bool, float]:
    if "failed" in row:
        return True, False, 0.0
    return False, math.isnan(error), -row["confidence"] if math.isnan(error) else error


def _said(row: Row, error: float) -> str:
    if "failed" in row:
        return str(row["failed"])
    told = "pose unknown" if math.isnan(error) else f"{error:.1f} degrees off"
    return f"{told}, confidence {row['confidence']:.2f}"


def _kind(row: Row, error: float, within_deg: float) -> str:
    if "failed" in row:
        return "failed"
    if math.isnan(error):
        return "reliable" if row["reliable"] else "doubtful"
    return "right" if error < within_deg else "wrong"


def _picture(benchmark: Benchmark, item: BenchmarkItem, row: Row) -> bytes | None:
    """The thumbnail; None of what failed, has no picture any more, or was evaluated before ``projection`` was kept."""
    if "seen_by" not in row:
        return None
    T, K = (torch.tensor(matrix, dtype=torch.float64) for matrix in row["seen_by"])
    mesh = next((path for path in item.meshes if path.name == row["mesh"]), None)
    try:
        image = read_image(benchmark.dataset.annotation(item.index)["image_path"], dtype=torch.uint8)
        renderer = None if mesh is None else _renderer(mesh, benchmark.unit)
    except CurviregError:
        return None
    given = perturbed_box(item.box, benchmark.protocol, item.key).tolist()
    box = row["localization"]["boxes"][0] if "localization" in row else given
    return None if renderer is None else thumbnail(renderer, (T, K), image, box)


@lru_cache(maxsize=8)  # objects share their meshes
def _renderer(mesh: Path, unit: str) -> Any:
    return make_renderer(load_mesh(mesh, unit=unit))
