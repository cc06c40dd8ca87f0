"""Evaluation of a dataset: results to disk, then scores from disk."""

import platform
from collections import Counter
from pathlib import Path

import torch
from torch import nn

from ..pipeline import DEFAULT, PRESETS, Pipeline, preset_named
from ..utils.checks import check_positive
from ..utils.files import code_digest, write_file
from ..version import __version__
from .benchmark import Benchmark, Row
from .predict import register_object, registrar_opener
from .runner import POSE_SOURCES, run_items
from .scores import detection_recall
from .store import ResultStore, to_json

__all__ = ["evaluate", "score"]

NOT_EVALUATED = ("other_class", "no_target")
"""Reasons by which datasets leave out objects that are not to be evaluated; nothing is wrong with these."""


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
    """Register the objects of a benchmark and score the results.

    ``out`` gets ``results.jsonl`` and ``settings.json`` (see :class:`~curvireg_torch.evaluation.store.ResultStore`),
    ``predictions.csv`` and ``summary.json``. A second call continues where the first one stopped. Under ``torchrun``,
    or in a job array that sets ``RANK`` and ``WORLD_SIZE``, each process registers a part of the objects.

    Args:
        benchmark, out: the objects, and the folder for the results.
        preset: name of a pipeline, or a pipeline.
        limit: register only this many objects, spread evenly over the dataset.
        renderer: of the views.
        field: photograph filter that replaces that of the pipeline.
        overwrite: delete results of other settings and start again.
        progress: show a bar.

    Returns:
        The summary, as written to ``summary.json``; None in processes that do not write it.

    Raises:
        InvalidInputError: an unknown preset, a bad limit, or a folder that holds results of other settings.

    Example:
        >>> from curvireg_torch.data import Pascal3DPlus
        >>> from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol
        >>> cars = Pascal3DPlus("data/PASCAL3D+_release1.1", categories=["car"])            # doctest: +SKIP
        >>> evaluate(Pascal3DBenchmark(cars, Protocol()), Path("out"))["acc_pi_6"]          # doctest: +SKIP
    """
    pipeline = preset_named(preset) if isinstance(preset, str) else preset
    pipeline = pipeline if field is None else pipeline.with_field(field)
    name = next((known for known, settings in PRESETS.items() if settings is pipeline), "custom")
    if limit is not None:
        check_positive(limit, "limit")
    settings = _settings(benchmark, name, pipeline, renderer)
    store = run_items(
        benchmark.selection(limit),
        out,
        registrar_opener(benchmark, pipeline, renderer=renderer, field=field),
        lambda item, registrar, seconds, _: register_object(benchmark, item, registrar, bank_seconds=seconds),
        settings=settings,
        prepare=lambda store: store.open(settings, overwrite=overwrite),
        label=benchmark.name,
        progress=progress,
    )
    return None if store is None else score(benchmark, out, limit=limit)


def score(benchmark: Benchmark, out: Path, *, limit: int | None = None) -> Row:
    """Write ``predictions.csv`` and ``summary.json`` from the results in ``out``, and return the summary.

    Raises:
        InvalidInputError: a result is missing or damaged.
    """
    store = ResultStore(out)
    pairs = [(item, store.read(item.key)) for item in benchmark.selection(limit)]
    skipped = Counter({k: n for k, n in benchmark.dataset.skipped.items() if k not in NOT_EVALUATED})
    skipped.update(row["skipped"] for _, row in pairs if "skipped" in row)
    items = [item for item, row in pairs if "skipped" not in row]
    rows = [row for _, row in pairs if "skipped" not in row]
    seconds = {name: sum(row["seconds"][name] for row in rows) for name in ("bank", "register")}
    settings = store.settings()
    settings["root"] = Path(settings["root"]).name  # a summary is shared: no paths
    summary = {
        **benchmark.summary(items, rows),
        **({"detection": detection_recall(items, rows)} if benchmark.protocol.box is None else {}),
        "failed": sum("failed" in row for row in rows),
        "skipped": dict(sorted(skipped.items())),
        "protocol": settings["protocol"],
        "limit": limit,
        "settings": settings,
        "versions": {"curvireg_torch": __version__, "python": platform.python_version(), "torch": torch.__version__},
        "seconds": {**seconds, "register_each": seconds["register"] / len(rows) if rows else None},
    }
    benchmark.write_predictions(out / "predictions.csv", items, rows)
    write_file(out / "summary.json", to_json(summary).encode())
    return summary


def _settings(benchmark: Benchmark, name: str, pipeline: Pipeline, renderer: str) -> Row:
    """All that results depend on besides their own files; --limit and --categories only select objects."""
    return {
        **benchmark.settings(),
        "protocol": str(benchmark.protocol),
        "preset": name,
        "pipeline": pipeline.with_pose_prior(benchmark.protocol.pose).describe(),
        "renderer": renderer,
        "version": __version__,
        "code": code_digest(*POSE_SOURCES),
    }
