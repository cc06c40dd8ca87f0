"""The two loops in a row: predictions to disk, then scores from disk."""

import platform
from collections import Counter
from pathlib import Path

import torch
from torch import nn

from ..pipeline import DEFAULT, PRESETS, Pipeline, preset_named
from ..utils.checks import check_positive
from ..utils.digests import code_digest
from ..version import __version__
from .benchmark import Benchmark, Row
from .localisation import localisation
from .predict import predict
from .store import PredictionStore, to_json, write_text
from .workers import workers

__all__ = ["evaluate", "score"]

POSE_SOURCES = (
    *("data", "descriptors", "filters", "geometry", "io", "matching", "models", "registration", "rendering", "terms"),
    *("utils", "errors.py", "limits.py", "pipeline.py", "settings.py"),
)
"""Parts of the package that poses depend on."""

NOT_ASKED_FOR = ("other_class", "no_target")
"""What datasets leave out because it is none of the objects to be evaluated, not because something is wrong with it."""


def evaluate(
    benchmark: Benchmark,
    out: Path,
    *,
    preset: str | Pipeline = DEFAULT,
    limit: int | None = None,
    renderer: str = "auto",
    field: nn.Module | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Row | None:
    """Register the objects of a benchmark and score them.

    ``out`` gets ``predictions/`` (one file per object), ``predictions.csv`` and ``summary.json``. Run again, it goes on
    where it was; under ``torchrun`` every process takes a share of the objects.

    Args:
        benchmark: the objects.
        out: folder for the results, made if it is not there.
        preset: name of a pipeline, or a pipeline of one's own.
        limit: register only so many objects, spread evenly over the dataset.
        renderer: of the views.
        field: photograph filter of one's own, instead of the pipeline's.
        overwrite: start anew in a folder that holds other predictions.
        progress: show a bar.

    Returns:
        The summary, as written to ``summary.json``; None in all processes but the first.

    Raises:
        InvalidInputError: an unknown preset, a bad limit, or a folder that holds predictions of other settings.

    Example:
        >>> from curvireg_torch.data import Pascal3DPlus
        >>> from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol
        >>> cars = Pascal3DPlus("data/PASCAL3D+_release1.1", categories=["car"])            # doctest: +SKIP
        >>> evaluate(Pascal3DBenchmark(cars, Protocol()), Path("out"))["acc_pi_6"]          # doctest: +SKIP
    """
    chosen = preset_named(preset) if isinstance(preset, str) else preset
    chosen = chosen if field is None else chosen.with_field(field)
    name = next((known for known, settings in PRESETS.items() if settings is chosen), "own")
    if limit is not None:
        check_positive(limit, "limit")
    store = PredictionStore(out / "predictions")
    selection = benchmark.selection(limit)
    with workers() as group:
        if group.rank == 0:
            store.open(_settings(benchmark, name, chosen, renderer), overwrite=overwrite)
        group.wait()
        ordered = sorted(selection, key=lambda item: (item.meshes, item.index))
        n = len(ordered)
        share = ordered[group.rank * n // group.size : (group.rank + 1) * n // group.size]
        predict(benchmark, share, store, chosen, renderer=renderer, field=field, progress=progress and group.rank == 0)
        group.wait()
        return score(benchmark, out, limit=limit) if group.rank == 0 else None


def score(benchmark: Benchmark, out: Path, *, limit: int | None = None) -> Row:
    """The second loop: ``predictions.csv`` and ``summary.json`` from the predictions in ``out``; renders nothing.

    Args:
        benchmark, out, limit: as for :func:`evaluate`.

    Returns:
        The summary.

    Raises:
        InvalidInputError: a prediction is missing or damaged.
    """
    store = PredictionStore(out / "predictions")
    everything = [(item, store.read(item.key)) for item in benchmark.selection(limit)]
    skipped = Counter({k: n for k, n in benchmark.dataset.skipped.items() if k not in NOT_ASKED_FOR})
    skipped.update(row["skipped"] for _, row in everything if "skipped" in row)
    scored = [(item, row) for item, row in everything if "skipped" not in row]
    items, rows = [item for item, _ in scored], [row for _, row in scored]
    seconds = {name: sum(row["seconds"][name] for row in rows) for name in ("bank", "register")}
    settings = store.read("settings")
    settings["root"] = Path(settings["root"]).name  # summaries are shared; where data lies is nobody's business
    summary = {
        **benchmark.summary(items, rows),
        **({"localisation": localisation(items, rows)} if benchmark.protocol.box is None else {}),
        "failed": sum("failed" in row for row in rows),
        "skipped": dict(sorted(skipped.items())),
        "protocol": settings["protocol"],
        "limit": limit,
        "settings": settings,
        "versions": {"curvireg_torch": __version__, "python": platform.python_version(), "torch": torch.__version__},
        "seconds": {**seconds, "register_each": seconds["register"] / len(rows) if rows else None},
    }
    benchmark.write_predictions(out / "predictions.csv", items, rows)
    write_text(out / "summary.json", to_json(summary))
    return summary


def _settings(benchmark: Benchmark, name: str, pipeline: Pipeline, renderer: str) -> Row:
    """All that a prediction depends on besides its own files; --limit and --categories say which ones are wanted."""
    return {
        **benchmark.settings(),
        "protocol": str(benchmark.protocol),
        "preset": name,
        "pipeline": pipeline.with_pose_prior(benchmark.protocol.pose).describe(),
        "renderer": renderer,
        "version": __version__,
        "code": code_digest(*POSE_SOURCES),
    }
