"""A cache of banks on disk, found again by a digest of everything they depend on."""

import json
import os
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from ..errors import BankError
from ..geometry.viewpoint import ViewSphere
from ..mesh.mesh import as_mesh, mesh_unit
from ..mesh.up import mesh_up
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..utils.files import code_digest, tensor_digest, text_digest
from .bank import FORMAT_VERSION, ViewBank, colour_arrays

__all__ = [
    "CACHE_LIMIT",
    "CachedBank",
    "bank_key",
    "cache_folder",
    "cached_bank",
    "clear_cache",
    "list_cache",
    "trim_cache",
]

CACHE_LIMIT = 2_000_000_000
"""Size limit of the cache in bytes; least recently used banks are removed. ``$CURVIREG_CACHE_LIMIT`` overrides it."""

_ABANDONED = 3600.0  # seconds after which an incomplete file is taken for the remains of a killed process
_HEADER_LIMIT = 1_000_000  # bytes; a bank's header takes about 2000
_BANK = re.compile(r"bank-[0-9a-f]{32}\.safetensors")
_INCOMPLETE = re.compile(_BANK.pattern + r"\.[0-9a-f]{8}\.tmp")

_SOURCES = (
    "features",
    "filters",
    "geometry",
    "mesh",
    "rendering",
    "terms",
    "pipeline.py",
    "matching/describe.py",
)
"""Code that turns a mesh into described views: a bank that another version of it built is not found."""


@dataclass(frozen=True)
class CachedBank:
    """A file of the cache: ``path``, ``size`` in bytes, and ``used``, the time of its last use in seconds."""

    path: Path
    size: int
    used: float


def cache_folder() -> Path:
    """``$CURVIREG_CACHE``, else ``$XDG_CACHE_HOME/curvireg_torch``, else ``~/.cache/curvireg_torch``.

    Banks are stored in its folder ``banks`` as ``bank-<key>.safetensors``. Only files in that folder that have such a
    name and the header of a bank are ever listed, overwritten or removed.
    """
    if folder := os.environ.get("CURVIREG_CACHE"):
        return Path(folder)
    if folder := os.environ.get("XDG_CACHE_HOME"):
        return Path(folder) / "curvireg_torch"
    try:
        return Path.home() / ".cache" / "curvireg_torch"
    except RuntimeError:  # a user without a home
        return Path(tempfile.gettempdir()) / "curvireg_torch"


def bank_key(
    mesh: trimesh.Trimesh, views: ViewSphere, *, pipeline: Pipeline | None = None, renderer: str = "auto"
) -> str:
    """32 hexadecimal digits: digest of mesh (with colours, unit and up axis), views, settings, renderer and code."""
    settings = (pipeline or Pipeline()).bank_key_fields(len(views))
    arrays = {"vertices": np.array(mesh.vertices, np.float64), "faces": np.array(mesh.faces, np.int64)}
    tensors = {name: torch.from_numpy(np.array(x)) for name, x in {**arrays, **colour_arrays(mesh)}.items()}
    tensors |= {f"views.{field.name}": getattr(views, field.name).double() for field in fields(ViewSphere)}
    facts = [FORMAT_VERSION, settings, mesh_unit(mesh), mesh_up(mesh), renderer]
    digests = [code_digest(*_SOURCES), tensor_digest(tensors, size=16)]
    return text_digest(json.dumps([facts, digests], sort_keys=True), size=16)


def cached_bank(
    mesh: Any,
    views: ViewSphere | None = None,
    *,
    pipeline: Pipeline | None = None,
    renderer: str | DepthRenderer = "auto",
    folder: Path | None = None,
    device: torch.device | str = "cpu",
    progress: bool | Callable[[str, int, int], object] = True,
) -> ViewBank:
    """The bank from the cache, or a new one that is stored there. Concurrent processes are safe.

    A damaged file is built again. A folder that cannot be written causes a warning. Afterwards the cache is trimmed to
    its limit.

    Args:
        mesh, views, pipeline, device, progress: see :meth:`ViewBank.build`.
        renderer: for a new bank; its name is part of the key. With a custom renderer the cache is not used.
        folder: default :func:`cache_folder`.

    Example:
        >>> import tempfile
        >>> from curvireg_torch.geometry import sample_views
        >>> folder, views = Path(tempfile.mkdtemp()), sample_views(azimuth_step=90, elevations=[20])
        >>> bank = cached_bank(trimesh.creation.box(), views, folder=folder, progress=False)
        >>> len(list_cache(folder)), clear_cache(folder)
        (1, 1)
    """
    mesh, folder, pipeline = as_mesh(mesh), folder or cache_folder(), pipeline or Pipeline()
    if views is None:
        views = pipeline.views.sphere(mesh_up(mesh))
    else:
        pipeline = pipeline.with_pose_prior("given")

    def build() -> ViewBank:
        return ViewBank.build(mesh, views, pipeline=pipeline, renderer=renderer, device=device, progress=progress)

    if not isinstance(renderer, str):
        return build()
    key = bank_key(mesh, views, pipeline=pipeline, renderer=renderer)
    path = folder / "banks" / f"bank-{key}.safetensors"
    if _is_bank(path):
        try:
            bank = ViewBank.load(path, device=device)
            if bank_key(bank.mesh, bank.views, pipeline=bank.pipeline, renderer=renderer) != key:
                raise BankError(f"{path}: holds another bank than its name says")
        except BankError:  # build it again and replace the file
            pass
        else:
            with suppress(OSError):  # a read-only cache
                os.utime(path)
            bank.pipeline = pipeline  # pipelines that differ in ranking or search share a bank
            return bank
    bank = build()
    bank.pipeline = pipeline
    bank.descriptors = bank.descriptors.half().float()  # as the file stores them, so that both rank alike
    if os.path.lexists(path) and not _is_bank(path):
        warnings.warn(f"{path}: not a view bank, so it stays and the bank is not cached; move it away", stacklevel=2)
        return bank
    try:
        bank.save(path)
    except OSError as error:
        warning = f"the bank is not cached, so it will be built again: {error}, by CURVIREG_CACHE=FOLDER"
        warnings.warn(warning, stacklevel=2)
        return bank
    try:
        trim_cache(folder, keep=path)
    except OSError as error:  # files may be added to the folder, but not removed
        warning = f"the cache exceeds its limit: {error.filename} cannot be removed ({error.strerror})"
        warnings.warn(warning, stacklevel=2)
    return bank


def list_cache(folder: Path | None = None) -> list[CachedBank]:
    """The banks of the cache, most recently used first."""
    banks = []
    for path in _files(folder or cache_folder(), _BANK):
        with suppress(FileNotFoundError):  # removed by another process
            status = path.stat()
            banks.append(CachedBank(path, status.st_size, status.st_mtime))
    return sorted(banks, key=lambda bank: bank.used, reverse=True)


def clear_cache(folder: Path | None = None) -> int:
    """Remove every bank of the cache and incomplete files of killed processes; returns the number of banks."""
    folder = folder or cache_folder()
    banks = list_cache(folder)
    for path in [*(bank.path for bank in banks), *_files(folder, _INCOMPLETE)]:
        path.unlink(missing_ok=True)
    return len(banks)


def trim_cache(folder: Path | None = None, *, keep: Path | None = None) -> int:
    """Remove the least recently used banks, but not ``keep``, until the limit is met; returns how many were removed."""
    folder, given = folder or cache_folder(), os.environ.get("CURVIREG_CACHE_LIMIT", "")
    limit = int(given) if given.isdecimal() else CACHE_LIMIT
    for path in _files(folder, _INCOMPLETE):
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > _ABANDONED:
                path.unlink()
    removed, total = 0, 0
    for bank in list_cache(folder):
        total += bank.size
        if total > limit and bank.path != keep:
            bank.path.unlink(missing_ok=True)
            total -= bank.size
            removed += 1
    return removed


def _files(folder: Path, name: re.Pattern[str]) -> Iterator[Path]:
    banks = folder / "banks"
    try:
        names = os.listdir(banks)
    except OSError:  # the folder does not exist yet, or cannot be read
        names = []
    return (banks / found for found in names if name.fullmatch(found) and _is_bank(banks / found))


def _is_bank(path: Path) -> bool:
    """Whether this safetensors header names this library. An empty file, which a killed process may leave, counts."""
    try:
        with path.open("rb") as file:
            size = file.read(8)
            header = file.read(min(int.from_bytes(size, "little"), _HEADER_LIMIT))
        return not size or str(json.loads(header)["__metadata__"]["format"]).startswith("curvireg_torch.")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False
