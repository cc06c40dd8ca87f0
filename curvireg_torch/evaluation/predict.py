"""The first loop: every object's pose, to disk."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path

from torch import Tensor, nn
from tqdm import tqdm

from ..errors import ImageError, InvalidInputError, MeshError, MissingFileError
from ..geometry.crops import whole_image_box
from ..io import read_image
from ..io.meshes import load_mesh
from ..io.meshes.files import mesh_digest
from ..matching import ViewBank, ViewMatcher, cached_bank
from ..pipeline import Pipeline
from ..registration import Registrar
from ..registration.inputs import ImageItem as Photograph
from ..utils.digests import file_digest
from .benchmark import Benchmark, BenchmarkItem, Row
from .estimate import FusedMatcher, estimate_poses
from .protocol import Protocol, perturbed_box
from .store import PredictionStore

__all__ = ["predict"]

BATCH = 8
"""Objects of one mesh that are registered together."""


def predict(
    benchmark: Benchmark,
    items: Sequence[BenchmarkItem],
    store: PredictionStore,
    pipeline: Pipeline,
    *,
    renderer: str = "auto",
    field: nn.Module | None = None,
    progress: bool = True,
) -> None:
    """Register those of ``items`` that ``store`` does not hold yet, holds as skipped, or holds of other files.

    Objects of one mesh follow each other, so that a bank is made once and only those in use are in memory, and are
    registered side by side on torch's threads. More cores: more processes (``--jobs``, ``torchrun``).

    A photograph or mesh that cannot be read, or an unknown box, gives a row ``skipped``; an object that the method
    refuses gives a row ``failed``, which scores count as a miss. Any other error is a defect and ends the loop.
    """
    workshop = _Workshop(benchmark, pipeline, renderer, field)
    digests = input_digests(benchmark, items)
    todo = [item for item in items if not _is_done(store, item, digests[item.key])]
    with tqdm(
        total=len(items), initial=len(items) - len(todo), desc=benchmark.name, unit="object", disable=not progress
    ) as bar:
        for _, group in groupby(todo, key=lambda item: (item.meshes, item.camera_matrix is None)):
            alike = list(group)
            for start in range(0, len(alike), BATCH):
                batch = alike[start : start + BATCH]
                for item, row in zip(batch, workshop.rows(batch), strict=True):
                    store.write(item.key, {**row, "inputs": digests[item.key]})
                    bar.update()


def input_digests(benchmark: Benchmark, items: Sequence[BenchmarkItem]) -> dict[str, dict[str, str]]:
    """By the items' keys: what each prediction rests on, in short texts that differ where it does.

    Photographs and meshes, with all the files that a mesh consists of, are told by digests of their content; box and
    camera matrix by their numbers, to the last digit.
    """
    photograph_digest, digest_of_mesh = cache(file_digest), cache(mesh_digest)  # objects share photographs and meshes
    return {
        item.key: {
            "photograph": photograph_digest(Path(benchmark.dataset.annotation(item.index)["image_path"])),
            "meshes": " ".join(map(digest_of_mesh, item.meshes)),
            "box": _digits(item.box),
            "camera": "" if item.camera_matrix is None else _digits(item.camera_matrix),
        }
        for item in items
    }


def _digits(numbers: Tensor) -> str:
    return " ".join(map(repr, numbers.flatten().tolist()))


def _is_done(store: PredictionStore, item: BenchmarkItem, digests: dict[str, str]) -> bool:
    if item.key not in store:
        return False
    row = store.read(item.key)
    return "skipped" not in row and row.get("inputs") == digests


@dataclass
class _Workshop:
    """Turns items into rows; keeps the registrar of the meshes in use."""

    benchmark: Benchmark
    pipeline: Pipeline
    renderer: str
    field: nn.Module | None
    meshes: tuple[Path, ...] = ()
    registrar: Registrar | None = None

    def rows(self, items: Sequence[BenchmarkItem]) -> list[Row]:
        """Rows of items of the same meshes."""
        protocol = self.benchmark.protocol
        rows: dict[str, Row] = {}
        photographs: dict[str, Photograph] = {}
        for item in items:
            if protocol.box is not None and not bool(item.box.isfinite().all()):
                rows[item.key] = {"skipped": "unknown_box"}
                continue
            try:
                image = read_image(self.benchmark.dataset.annotation(item.index)["image_path"])
            except (ImageError, MissingFileError) as error:
                rows[item.key] = {"skipped": "unreadable_image", "reason": str(error)}
                continue
            try:
                box = whole_image_box(image) if protocol.box is None else perturbed_box(item.box, protocol, item.key)
                photographs[item.key] = Photograph(image, box, item.camera_matrix)
            except InvalidInputError as error:
                size = list(image.shape[1:])
                rows[item.key] = {"image_size": size, "failed": str(error), "seconds": {"bank": 0.0, "register": 0.0}}
        start = time.perf_counter()
        try:
            registrar = self._registrar(items[0].meshes, protocol) if photographs else None
        except (MeshError, MissingFileError) as error:
            skipped: Row = {"skipped": "unreadable_mesh", "reason": str(error)}
            return [rows.get(item.key, skipped) for item in items]
        ready = time.perf_counter()
        if registrar is not None:
            found = estimate_poses(registrar, list(photographs.values()), boxes=protocol.box is not None)
            each = {"bank": ready - start, "register": time.perf_counter() - ready}
            seconds = {name: value / len(found) for name, value in each.items()}
            for (key, photograph), row in zip(photographs.items(), found, strict=True):
                if "mesh" in row:
                    row["mesh"] = self.meshes[row["mesh"]].name
                    for rival in row["rivals"]:
                        rival["mesh"] = self.meshes[rival["mesh"]].name
                rows[key] = {"image_size": list(photograph.image.shape[1:]), **row, "seconds": seconds}
        return [rows[item.key] for item in items]

    def _registrar(self, meshes: tuple[Path, ...], protocol: Protocol) -> Registrar:
        if self.registrar is None or meshes != self.meshes:
            self.meshes, self.registrar = (), None  # the memory goes before more is asked for
            pipeline = self.pipeline.with_pose_prior(protocol.pose)
            banks = [
                cached_bank(
                    load_mesh(path, unit=self.benchmark.unit), pipeline=pipeline, renderer=self.renderer, progress=False
                )
                for path in meshes
            ]
            make = FusedMatcher if protocol.cad == "fused" else ViewMatcher
            matcher = make(ViewBank.join(banks), pipeline=pipeline, field=self.field)
            self.registrar = Registrar(matcher, renderer=self.renderer)
            self.meshes = meshes
        return self.registrar
