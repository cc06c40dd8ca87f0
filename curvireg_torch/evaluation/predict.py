"""Poses of the objects of a dataset, from the CADs that the protocol allows."""

import time
from pathlib import Path

from torch import nn

from ..data import read_image
from ..errors import ImageError, MeshError, MissingFileError
from ..matching import cached_bank
from ..mesh import load_mesh
from ..pipeline import Pipeline
from ..registration import FailedRegistration, Registrar
from ..registration.result import detection_document
from .benchmark import Benchmark, BenchmarkItem, Row
from .protocol import perturbed_box
from .runner import OpenRegistrar

__all__ = ["register_object", "registrar_opener"]


def registrar_opener(
    benchmark: Benchmark, pipeline: Pipeline, *, renderer: str = "auto", field: nn.Module | None = None
) -> OpenRegistrar:
    """A function that opens the registrar of mesh files, or returns the error of a mesh that cannot be read."""
    protocol = benchmark.protocol
    pipeline = pipeline.with_pose_prior(protocol.pose)

    def open_registrar(meshes: tuple[Path, ...]) -> Registrar | Exception:
        try:
            loaded = [load_mesh(path, unit=benchmark.unit) for path in meshes]
        except (MeshError, MissingFileError) as error:
            return error
        banks = [cached_bank(mesh, pipeline=pipeline, renderer=renderer, progress=False) for mesh in loaded]
        return Registrar(banks, pipeline=pipeline, field=field, renderer=renderer)

    return open_registrar


def register_object(
    benchmark: Benchmark, item: BenchmarkItem, registrar: Registrar | Exception, *, bank_seconds: float
) -> Row:
    """Register one object of a dataset to its mesh, or to the best of several.

    Args:
        benchmark, item: the dataset and the protocol, and the object.
        registrar, bank_seconds: of its meshes, or why there is none; time that opening it took.

    Returns:
        :meth:`Registration.to_dict` with the name of the ``mesh``, the ``image_size`` (height, width), ``detection``
        and ``seconds`` as in docs/results.md, and ``projection``, see :class:`Hypothesis`; or ``failed`` or ``skipped``
        with the reason. Scores count ``failed`` as a miss.
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
    result = registrar([image], box, item.camera_matrix, prior=item.prior)[0]
    seconds = {"bank": bank_seconds, "register": time.perf_counter() - start}
    if isinstance(result, FailedRegistration):
        return {**size, "failed": result.error.message, "seconds": seconds}
    names = [path.name for path in item.meshes]
    row = {**size, **result.to_dict(), "mesh": names[result.model], "seconds": seconds}
    if result.detection is not None:
        row["detection"] = detection_document([result])
    return {**row, "projection": [matrix.tolist() for matrix in result.projection]}
