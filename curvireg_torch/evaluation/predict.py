"""The first loop: every object's pose, to disk."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import nn
from tqdm import tqdm

from ..data import read_image
from ..errors import ImageError, InvalidInputError, MeshError, MissingFileError
from ..geometry import load_mesh
from ..matching import cached_bank
from ..presets import Preset
from ..registration import Registrar
from .benchmark import Benchmark, Item, Row
from .estimate import estimate_pose
from .protocol import Protocol, perturbed_box
from .store import PredictionStore

__all__ = ["predict"]


def predict(
    benchmark: Benchmark,
    items: Sequence[Item],
    store: PredictionStore,
    preset: Preset,
    *,
    renderer: str = "auto",
    progress: bool = True,
) -> None:
    """Register those of ``items`` that ``store`` does not hold yet.

    Objects of one mesh follow each other, so that a bank is made once and only those in use are in memory. Each
    photograph is registered alone and on one thread: a prediction depends neither on its neighbours, nor on what was
    done before a restart, nor on the number of cores. More cores: more processes (``torchrun``).

    A photograph or mesh that cannot be read, or an unknown box, gives a row ``skipped``; an object that the method
    refuses gives a row ``failed``, which scores count as a miss. Any other error is a defect and ends the loop.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        workshop = _Workshop(benchmark, preset, renderer)
        todo = [item for item in items if item.key not in store]
        with tqdm(
            total=len(items), initial=len(items) - len(todo), desc=benchmark.name, unit="object", disable=not progress
        ) as bar:
            for item in todo:
                store.write(item.key, workshop.row(item))
                bar.update()
    finally:
        torch.set_num_threads(threads)


@dataclass
class _Workshop:
    """Turns items into rows; keeps the registrars of the meshes in use."""

    benchmark: Benchmark
    preset: Preset
    renderer: str
    meshes: tuple[Path, ...] = ()
    registrars: tuple[Registrar, ...] = ()

    @cached_property
    def field(self) -> nn.Module:
        return self.preset.photograph_filter()

    def row(self, item: Item) -> Row:
        protocol = self.benchmark.protocol
        if not bool(item.box.isfinite().all()):
            return {"skipped": "unknown_box"}
        try:
            image = read_image(self.benchmark.dataset.annotation(item.index)["image_path"])
        except (ImageError, MissingFileError) as error:
            return {"skipped": "unreadable_image", "reason": str(error)}
        start = time.perf_counter()
        try:
            self._fetch(item.meshes, protocol)
        except (MeshError, MissingFileError) as error:
            return {"skipped": "unreadable_mesh", "reason": str(error)}
        ready = time.perf_counter()
        box = perturbed_box(item.box, protocol, item.key)
        row: Row = {"image_size": list(image.shape[1:])}
        try:
            row |= estimate_pose(self.registrars, image, box, item.camera_matrix, fused=protocol.cad == "fused")
            row["mesh"] = self.meshes[row["mesh"]].name
        except (ImageError, InvalidInputError) as error:
            row |= {"failed": str(error)}
        return row | {"seconds": {"bank": ready - start, "register": time.perf_counter() - ready}}

    def _fetch(self, meshes: tuple[Path, ...], protocol: Protocol) -> None:
        if meshes != self.meshes:
            self.meshes, self.registrars = (), ()  # the memory goes before more is asked for
            self.registrars = tuple(self._registrar(path, protocol) for path in meshes)
            self.meshes = meshes

    def _registrar(self, path: Path, protocol: Protocol) -> Registrar:
        mesh, views = load_mesh(path, unit=self.benchmark.unit), self.preset.views(protocol.pose)
        bank = cached_bank(mesh, views, self.preset.bank, renderer=self.renderer, progress=False)
        refine = self.preset.refine and protocol.cad != "fused"
        return self.preset.registrar(bank, field=self.field, refine=refine, renderer=self.renderer)
