"""Poses of the objects of a dataset, from the CADs that the protocol allows."""

import time
from collections.abc import Sequence
from pathlib import Path

from torch import nn

from ..errors import ImageError, MeshError, MissingFileError
from ..io import read_image
from ..io.meshes import load_mesh
from ..matching import Ranking, ViewBank, ViewMatcher, cached_bank
from ..pipeline import Pipeline
from ..registration import FailedRegistration, Registrar
from ..registration.document import localization_document
from ..terms import QueryFeatures
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import perturbed_box
from .runner import run_items
from .store import ResultStore
from .workers import Workers

__all__ = ["FusedMatcher", "predict", "register_object"]


def predict(
    benchmark: Benchmark,
    items: Sequence[BenchmarkItem],
    store: ResultStore,
    pipeline: Pipeline,
    *,
    settings: Row,
    workers: Workers,
    renderer: str = "auto",
    field: nn.Module | None = None,
    progress: bool = True,
) -> None:
    """Register the objects that ``store`` does not hold yet, see :func:`~curvireg_torch.evaluation.runner.run_items`.

    A photograph or mesh that cannot be read, or an unknown box, gives a row ``skipped``; an object that the method
    refuses gives a row ``failed``, which scores count as a miss. Any other error is a defect and ends the run.
    """
    protocol = benchmark.protocol
    pipeline = pipeline.with_pose_prior(protocol.pose)

    def open_registrar(meshes: tuple[Path, ...]) -> Registrar | Exception:
        try:
            loaded = [load_mesh(path, unit=benchmark.unit) for path in meshes]
        except (MeshError, MissingFileError) as error:
            return error
        banks = [cached_bank(mesh, pipeline=pipeline, renderer=renderer, progress=False) for mesh in loaded]
        matcher = FusedMatcher if protocol.cad == "fused" else ViewMatcher
        return Registrar(matcher(ViewBank.join(banks), pipeline=pipeline, field=field), renderer=renderer)

    def register(item: BenchmarkItem, registrar: Registrar | Exception, seconds: float, _: Row) -> Row:
        return register_object(benchmark, item, registrar, bank_seconds=seconds)

    run_items(
        items,
        store,
        open_registrar,
        register,
        settings=settings,
        workers=workers,
        label=benchmark.name,
        progress=progress,
    )


def register_object(
    benchmark: Benchmark, item: BenchmarkItem, registrar: Registrar | Exception, *, bank_seconds: float
) -> Row:
    """Register one object of a dataset to its mesh, or to the best of several.

    Args:
        benchmark: the dataset and the protocol.
        item: the object.
        registrar: of its meshes, or why there is none.
        bank_seconds: time that opening the registrar took.

    Returns:
        :meth:`Registration.to_dict` with the name of the ``mesh``, the ``image_size`` (height, width), ``localization``
        and ``seconds`` as in docs/results.md, and ``projection``, see :class:`Hypothesis`; or ``failed`` or ``skipped``
        with the reason.
    """
    protocol = benchmark.protocol
    if protocol.box is not None and not bool(item.box.isfinite().all()):
        return {"skipped": "unknown_box"}
    try:
        image = read_image(item.photo)
    except (ImageError, MissingFileError) as error:
        return {"skipped": "unreadable_image", "reason": str(error)}
    if isinstance(registrar, Exception):
        return {"skipped": "unreadable_mesh", "reason": str(registrar)}
    size: Row = {"image_size": list(image.shape[1:])}
    start = time.perf_counter()
    box = None if protocol.box is None else perturbed_box(item.box, protocol, item.key)[None]
    result = registrar([image], box, item.camera_matrix)[0]
    seconds = {"bank": bank_seconds, "register": time.perf_counter() - start}
    if isinstance(result, FailedRegistration):
        return {**size, "failed": result.error.message, "seconds": seconds}
    row = {**size, **result.to_dict(), "mesh": item.meshes[result.model].name, "seconds": seconds}
    for pose, hypothesis in zip(row["top"], result.hypotheses, strict=True):
        pose["mesh"] = item.meshes[hypothesis.model].name
    if result.localization is not None:
        row["localization"] = localization_document([result])
    return {**row, "projection": [matrix.tolist() for matrix in result.projection]}


class FusedMatcher(ViewMatcher):
    """Averages the scores of each view over the models of a bank, which all have the same views.

    The mean is given to the model that scores best in that view; the others get 0.
    """

    def rank(self, query: QueryFeatures) -> Ranking:
        ranking = super().rank(query)
        scores = ranking.scores.unflatten(1, (len(self.bank.meshes), -1))
        best = scores == scores.amax(dim=1, keepdim=True)
        first = best & (best.cumsum(dim=1) == 1)
        mean = (scores.mean(dim=1, keepdim=True) * first).flatten(1)
        return Ranking(mean, mean.argsort(dim=1, descending=True, stable=True), ranking.terms)
