"""Evaluation of a dataset: results to disk, then scores from disk."""

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path

from torch import Tensor

from ..jobs.documents import VERSIONS
from ..jobs.outputs import output_folder
from ..jobs.runner import results_digest, run_entries, thumbnail_of
from ..jobs.store import ResultStore, Row, Rows, has_pose, to_json
from ..matching import cached_bank
from ..mesh import load_mesh
from ..pipeline import DEFAULT, PRESETS, Pipeline
from ..registration import Registrar
from ..registration.confidence import two_decimals
from ..utils.checks import check_positive
from ..utils.executors import Workers
from ..utils.files import write_file
from ..version import __version__
from ..visualization.sheet import SheetEntry, write_sheet
from .benchmark import Benchmark
from .detection import copy_shown, detection_recall

__all__ = ["evaluate", "report"]

NOT_EVALUATED = ("other_class", "no_target")
"""Reasons by which datasets leave out objects that are not to be evaluated; nothing is wrong with
these."""

SHOWN_EACH = 30  # best objects on the page, and worst ones
RIGHT_DEG = 30.0  # error of the rotation below which the page calls a pose right


def evaluate(
    benchmark: Benchmark,
    out: Path,
    *,
    pipeline: Pipeline | None = None,
    limit: int | None = None,
    renderer: str = "auto",
    progress: bool = True,
    workers: Workers | None = None,
) -> Row:
    """Register the objects of a benchmark and score the results.

    ``out`` gets ``results.jsonl``, ``predictions.csv``, ``errors.csv``, ``summary.json`` and
    ``index.html``. A second call registers only what is new, or depends on files or settings that
    have changed.

    Args:
        benchmark, out: the objects, and the folder for the results.
        pipeline: by default the preset "learned".
        limit: register only this many objects, spread evenly over the dataset.
        renderer: of the views.
        progress: show a bar.
        workers: that register the objects; by default this process does.

    Returns:
        The summary, as written to ``summary.json``.

    Raises:
        InvalidInputError: a bad limit, or a folder that holds other results.

    Example:
        >>> from curvireg_torch.data import Pascal3DPlus
        >>> from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol
        >>> cars = Pascal3DPlus("data/PASCAL3D+_release1.1", categories=["car"])  # doctest: +SKIP
        >>> evaluate(Pascal3DBenchmark(cars, Protocol()), Path("out"))["acc_pi_6"]  # doctest: +SKIP
    """
    pipeline = pipeline or PRESETS[DEFAULT]
    name = next((known for known, settings in PRESETS.items() if settings is pipeline), "custom")
    if pipeline.views.pose != "paper":  # the paper's grid stays, whatever is known
        pipeline = pipeline.with_pose_prior(benchmark.protocol.pose)
    pipeline = pipeline.with_boxes(benchmark.protocol.box_is)
    if limit is not None:
        check_positive(limit, "limit")
    # all that results depend on besides their files; --limit and --categories only select objects
    settings = {
        **benchmark.settings(),
        "protocol": str(benchmark.protocol),
        "preset": name,
        "pipeline": pipeline.describe(),
        "renderer": renderer,
        "version": __version__,
        "code": results_digest(),
    }

    # Without cameras, the datasets have meshes of similar objects.
    mesh_is = "exact" if benchmark.gives_camera else "similar"
    open_registrar = partial(
        _open_registrar,
        unit=benchmark.unit,
        pipeline=pipeline,
        renderer=renderer,
        mesh_is=mesh_is,
    )
    chosen = [benchmark.entries[i] for i in benchmark.selection(limit)]
    entries = [entry for entry in chosen if not entry.error]
    files = chain.from_iterable(entry.files for entry in entries)
    source = ["{dataset} {root} {split}".format_map(settings)]
    with output_folder(out, "evaluate", inputs=files, source=source):
        store = run_entries(
            entries,
            out,
            open_registrar,
            settings=settings,
            label=benchmark.name,
            progress=progress,
            workers=workers,
        )
        store.sort([entry.key for entry in entries])
        return report(benchmark, store, settings, limit)


def _open_registrar(
    meshes: tuple[Path, ...], *, unit: str, pipeline: Pipeline, renderer: str, mesh_is: str
) -> Registrar:
    loaded = [load_mesh(path, unit=unit) for path in meshes]
    banks = [
        cached_bank(mesh, pipeline=pipeline, renderer=renderer, progress=False) for mesh in loaded
    ]
    return Registrar(banks, pipeline=pipeline, renderer=renderer, mesh_is=mesh_is)


def report(
    benchmark: Benchmark, store: ResultStore, settings: Row, limit: int | None = None
) -> Row:
    """Write ``predictions.csv``, ``index.html`` and ``summary.json`` from results; returns the
    summary."""
    located = benchmark.protocol.box is None and benchmark.protocol.views == 1
    skipped = Counter(
        {k: n for k, n in benchmark.dataset.skipped.items() if k not in NOT_EVALUATED}
    )
    scored: list[int] = []
    rows: list[Row] = []
    for i in benchmark.selection(limit):
        entry = benchmark.entries[i]
        row = {"skipped": entry.error} if entry.error else store.read(entry.key)
        if "skipped" in row:
            skipped[row["skipped"]] += 1
        else:
            scored.append(i)
            rows.append(row)
    samples = [benchmark.samples[i] for i in scored]
    detection = {}
    if located:
        copies = benchmark.copies(samples)
        detection = {"detection": detection_recall(copies, rows)}
        samples = [copy_shown(group, row) for group, row in zip(copies, rows, strict=True)]
    errors = benchmark.errors(samples, rows)
    seconds = {name: sum(row["seconds"][name] for row in rows) for name in ("bank", "register")}
    settings = {**settings, "root": Path(settings["root"]).name}  # a summary is shared: no paths
    summary = {
        **benchmark.summary(samples, rows, errors),
        **detection,
        "failed": sum(not has_pose(row) for row in rows),
        "skipped": dict(sorted(skipped.items())),
        "protocol": settings["protocol"],
        "limit": limit,
        "settings": settings,
        "versions": VERSIONS,
        "seconds": {**seconds, "register_each": seconds["register"] / len(rows) if rows else None},
    }
    for name in filter(None, ("predictions.csv", benchmark.results_name(settings))):
        benchmark.write_predictions(store.folder / name, samples, rows, errors)
    keys = [benchmark.entries[i].key for i in scored]
    benchmark.write_errors(store.folder / "errors.csv", keys, samples, errors)
    _write_page(benchmark, store.folder, scored, rows, errors[benchmark.page_error])
    write_file(store.folder / "summary.json", to_json(summary).encode())
    return summary


def _write_page(
    benchmark: Benchmark, out: Path, scored: Sequence[int], rows: Rows, errors: Tensor
) -> None:
    """The best and the worst objects: by error; then those of unknown pose, by confidence; then
    those that failed."""
    shown = []
    for i, row, error in zip(scored, rows, errors.tolist(), strict=True):
        number = row.get("confidence")
        confidence = "not calibrated" if number is None else f"confidence {two_decimals(number)}"
        if not has_pose(row):
            kind = row["verdict"]
            caption = row["message"]
            rank = (2.0, 0.0)
        elif math.isnan(error):
            kind = row["verdict"]
            caption = f"pose unknown, {confidence}"
            rank = 1.0, -(number or 0.0)
        else:
            kind = "right" if error < RIGHT_DEG else "wrong"
            caption = f"{error:.1f} degrees off, {confidence}"
            rank = 0.0, error
        name = benchmark.entries[i].key
        shown.append(SheetEntry(i + 1, name, caption, kind, thumbnail_of(out, row), rank))
    known = [error for error in errors.tolist() if not math.isnan(error)]
    right = sum(error < RIGHT_DEG for error in known)
    failed = sum(not has_pose(row) for row in rows)
    title = (
        f"{len(rows)} objects: {right} of {len(known)} within {RIGHT_DEG:g} degrees, {failed} "
        f"failed"
    )
    write_sheet(out / "index.html", title, shown, table="predictions.csv", each=SHOWN_EACH)
