"""A cache of banks on disk, found again by a digest of everything they depend on."""

import json
import os
import re
import time
import warnings
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..errors import BankError, OutputError
from ..geometry.viewpoint import ViewSphere
from ..mesh import as_mesh
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..utils.aliases import Progress
from ..utils.files import cache_folder, tensor_digest, text_digest
from ..utils.likes import MeshLike
from ..utils.sources import package_digest
from .bank import FORMAT_VERSION, ViewBank, colour_arrays, views_of

#: Size limit of the cache in bytes; least recently used banks are removed. $CURVIREG_CACHE_LIMIT
#: overrides it.
CACHE_LIMIT = 2_000_000_000
# Age from which an incomplete file counts as the remains of a killed process
ABANDONED_SECONDS = 3600.0
NOT_IN_BANKS = (
    "cli",
    "viewer",
    "inspection",
    "evaluation",
    "jobs",
    "visualization",
    "registration",
    "fitting",
)
"""Parts of the package above this one: a bank that another version of the rest built is not
found."""


class CachedBank(NamedTuple):
    """A file of the cache: ``path``, ``size`` in bytes, and ``used``, the time of its last use in
    seconds.

    Example:
        >>> CachedBank(Path("bank.safetensors"), 1000, 0.0).size
        1000
    """

    path: Path
    size: int
    used: float


def bank_key(
    mesh: MeshLike,
    views: ViewSphere,
    *,
    pipeline: Pipeline | None = None,
    renderer: str = "auto",
) -> str:
    """32 hexadecimal digits: digest of mesh (with colours and up axis), views, settings, renderer
    and code. Views look the same in every unit of length, so the unit is no part of it.

    Example:
        >>> import curvireg_torch as cr
        >>> mesh = cr.synthetic.example_mesh()
        >>> views = cr.sample_views(azimuth_step=90, elevations=[0])
        >>> key = bank_key(mesh, views)
        >>> len(key), key == bank_key(mesh, views, pipeline=cr.Pipeline(hypotheses=1))
        (32, True)
    """
    mesh = as_mesh(mesh)
    pipeline = pipeline or Pipeline()
    settings = {
        **asdict(pipeline.bank),
        "appearance": pipeline.stored_appearance(len(views)) is not None,
    }
    arrays = {
        "vertices": np.array(mesh.vertices, np.float64),
        "faces": np.array(mesh.faces, np.int64),
    }
    tensors = {
        name: torch.from_numpy(np.array(x)) for name, x in {**arrays, **colour_arrays(mesh)}.items()
    }
    tensors |= {f"views.{name}": x.double() for name, x in views.columns().items()}
    facts = [FORMAT_VERSION, settings, mesh.up, renderer]
    digests = [package_digest(without=NOT_IN_BANKS), tensor_digest(tensors, size=16)]
    return text_digest(json.dumps([facts, digests], sort_keys=True), size=16)


def cached_bank(
    mesh: MeshLike,
    views: ViewSphere | None = None,
    *,
    pipeline: Pipeline | None = None,
    renderer: str | DepthRenderer = "auto",
    folder: Path | None = None,
    device: torch.device | str = "cpu",
    progress: bool | Progress = True,
) -> ViewBank:
    """The bank from the cache, or a new one that is stored there, whereupon the cache is trimmed to
    its limit. Concurrent processes are safe. A damaged file is built again. A folder that cannot be
    written causes a warning.

    Args:
        mesh, views, pipeline, device, progress: see :meth:`ViewBank.build`.
        renderer: for a new bank; its name is part of the key. With a custom renderer the cache is
            not used.
        folder: default :func:`cache_folder`.

    Example:
        >>> import tempfile, trimesh
        >>> folder = Path(tempfile.mkdtemp())
        >>> bank = cached_bank(trimesh.creation.box(), Pipeline().views.sphere()[:2],
        ...     folder=folder, progress=False)
        >>> len(list_cache(folder)), clear_cache(folder)
        (1, 1)
    """
    mesh = as_mesh(mesh)
    folder = folder or cache_folder()
    pipeline = pipeline or Pipeline()
    if views is None:
        views = views_of(mesh, pipeline.views)
    else:
        pipeline = pipeline.with_pose_prior("given")

    def build() -> ViewBank:
        return ViewBank.build(
            mesh, views, pipeline=pipeline, renderer=renderer, device=device, progress=progress
        )

    if not isinstance(renderer, str):
        return build()
    key = bank_key(mesh, views, pipeline=pipeline, renderer=renderer)
    path = folder / "banks" / f"bank-{key}.safetensors"
    bank = None
    with suppress(BankError, FileNotFoundError):  # damaged, or not there: build it
        bank = ViewBank.load(path, device=device)
        if bank_key(bank.mesh, bank.views, pipeline=bank.pipeline, renderer=renderer) != key:
            bank = None
    is_new = bank is None
    if bank is None:
        bank = build()
        # as the file stores them, so that both rank alike
        bank.descriptors = bank.descriptors.half().float()
    else:
        with suppress(OSError):  # a read-only cache
            os.utime(path)
        # the file may have been stored in another unit, or of another file of this surface
        mesh.measures.update(bank.mesh.measures)
        bank.mesh = mesh
    bank.pipeline = pipeline  # pipelines that differ in ranking or search share a bank
    views_file = path.with_name(path.name.replace("bank-", "views-"))
    bank.described_views_file = views_file if bank.device.type == "cpu" else None
    if is_new:
        _store(bank, path)
    return bank


def _store(bank: ViewBank, path: Path) -> None:
    """Write a bank into the cache, and trim this; a warning tells what is impossible."""
    try:
        bank.save(path)
        _trim(path.parents[1], keep=path)
    except OutputError as error:
        warning = (
            f"the bank is not cached, so it will be built again: {error}, by CURVIREG_CACHE=FOLDER"
        )
        warnings.warn(warning, stacklevel=3)
    except OSError as error:  # files may be added to the folder, but not removed
        warning = (
            f"the cache exceeds its limit: {error.filename} cannot be removed ({error.strerror})"
        )
        warnings.warn(warning, stacklevel=3)


def list_cache(folder: Path | None = None) -> list[CachedBank]:
    """The banks of the cache, most recently used first.

    Example:
        >>> all(bank.path.suffix == ".safetensors" for bank in list_cache())
        True
    """
    return [file for file in _files(folder or cache_folder()) if _is_bank(file)]


def clear_cache(folder: Path | None = None) -> int:
    """Remove every bank of the cache, the features of its views, and incomplete files of killed
    processes; returns the number of banks."""
    files = _files(folder or cache_folder())
    for file in files:
        file.path.unlink(missing_ok=True)
    return sum(map(_is_bank, files))


def _is_bank(file: CachedBank) -> bool:
    return file.path.name.startswith("bank-") and file.path.suffix != ".tmp"


def _trim(folder: Path, *, keep: Path) -> None:
    """Remove the least recently used banks, but not ``keep``, until the limit is met, and abandoned
    files."""
    given = os.environ.get("CURVIREG_CACHE_LIMIT", "")
    limit = int(given) if given.isdecimal() else CACHE_LIMIT
    total = 0
    for file in _files(folder):
        total += file.size
        incomplete = file.path.suffix == ".tmp"
        if (
            (time.time() - file.used > ABANDONED_SECONDS)
            if incomplete
            else (total > limit and file.path != keep)
        ):
            file.path.unlink(missing_ok=True)
            total -= file.size


def _files(folder: Path) -> list[CachedBank]:
    """Banks, features of their views, and incomplete files, most recently used first."""
    found = []
    with suppress(OSError):  # the folder does not exist yet, or cannot be read
        for path in (folder / "banks").iterdir():
            if re.fullmatch(
                r"(bank|views)-[0-9a-f]{32}\.safetensors(\.[0-9a-f]{8}\.tmp)?", path.name
            ):
                with suppress(FileNotFoundError):  # removed by another process
                    found.append(CachedBank(path, path.stat().st_size, path.stat().st_mtime))
    return sorted(found, key=lambda file: file.used, reverse=True)
