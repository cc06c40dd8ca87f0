"""Banks cached on disk by the content of what made them."""

import hashlib
import json
import os
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from ..errors import BankError
from ..geometry.views import ViewSphere
from ..io.meshes.mesh import as_mesh, mesh_unit
from ..io.meshes.up import mesh_up
from ..pipeline import Pipeline
from ..rendering import DepthRenderer
from ..settings import BankSettings
from ..utils.digests import code_digest
from .bank import ViewBank
from .bank_file import FORMAT_VERSION, colour_arrays

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
"""Bytes that the cache may take; the banks used longest ago go first. ``$CURVIREG_CACHE_LIMIT`` overrides it."""

_ABANDONED = 3600.0  # seconds after which a half-written file belongs to no builder any more
_HEADER_LIMIT = 1_000_000  # bytes; a bank's header takes about 2000
_VIEW_SOURCES = ("descriptors", "filters", "geometry", "models", "rendering", "terms", "matching/describe.py")
"""Sources that turn a mesh into descriptors: banks of another version of them are not found."""
_BANK = re.compile(r"bank-[0-9a-f]{32}\.safetensors")
_HALF_WRITTEN = re.compile(_BANK.pattern + r"\.[0-9a-f]{8}\.tmp")


@dataclass(frozen=True)
class CachedBank:
    """A file of the cache: ``path``, ``size`` in bytes, ``used``: seconds since the epoch of its last use."""

    path: Path
    size: int
    used: float


def cache_folder() -> Path:
    """``$CURVIREG_CACHE``, else ``$XDG_CACHE_HOME/curvireg_torch``, else ``~/.cache/curvireg_torch``.

    Banks lie in its folder ``banks``, as ``bank-<key>.safetensors``. Nothing else is ever listed, overwritten or
    removed: a file must lie there, bear such a name, and say in its own header that it is a bank.
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
    mesh: trimesh.Trimesh,
    views: ViewSphere,
    settings: BankSettings | None = None,
    *,
    pipeline: Pipeline | None = None,
    renderer: str = "auto",
) -> str:
    """Digest in hexadecimal: mesh (colours, unit and up too), views, settings, renderer, code that describes views."""
    made = _settled(pipeline, settings).bank_key_fields(len(views))
    facts = [FORMAT_VERSION, made, mesh_unit(mesh), mesh_up(mesh), renderer]
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    digest.update(code_digest(*_VIEW_SOURCES).encode())
    digest.update(np.ascontiguousarray(mesh.vertices, np.float64).tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, np.int64).tobytes())
    for name, part in colour_arrays(mesh).items():
        digest.update(f"{name} {part.shape}".encode())
        digest.update(np.ascontiguousarray(part).tobytes())
    for field in fields(ViewSphere):
        digest.update(getattr(views, field.name).cpu().double().numpy().tobytes())
    return digest.hexdigest()[:32]


def _settled(pipeline: Pipeline | None, settings: BankSettings | None) -> Pipeline:
    pipeline = pipeline or Pipeline()
    return pipeline if settings is None else replace(pipeline, bank=settings)


def cached_bank(
    mesh: Any,
    views: ViewSphere | None = None,
    settings: BankSettings | None = None,
    *,
    pipeline: Pipeline | None = None,
    renderer: str | DepthRenderer = "auto",
    folder: Path | None = None,
    device: torch.device | str = "cpu",
    progress: bool | Callable[[str, int, int], object] = True,
    **build_options: Any,
) -> ViewBank:
    """The bank from the cache, or built and put there; a damaged file is built again, an unwritable folder a warning.

    Afterwards the cache is trimmed to its limit. Any number of processes may do this at the same time.

    Args:
        mesh: a mesh or the path of one.
        views, settings: of the bank; default those of the pipeline.
        pipeline: what the bank is made for; default ``Pipeline()``.
        renderer: of a bank that is built; its name is part of the key, and a bank of one's own renderer is not kept.
        folder: default :func:`cache_folder`.
        device, progress, build_options: of :meth:`ViewBank.build`.

    Example:
        >>> import tempfile
        >>> from curvireg_torch.geometry import sample_views
        >>> folder, views = Path(tempfile.mkdtemp()), sample_views(azimuth_step=90, elevations=[20])
        >>> settings = BankSettings(image_size=64)
        >>> bank = cached_bank(trimesh.creation.box(), views, settings, folder=folder, progress=False)
        >>> len(list_cache(folder)), clear_cache(folder)
        (1, 1)
    """
    mesh = as_mesh(mesh)
    folder = folder or cache_folder()
    pipeline = pipeline or Pipeline()
    if views is not None:
        pipeline = pipeline.with_pose_prior("given")
    views = pipeline.views.sphere(mesh_up(mesh)) if views is None else views
    pipeline = _settled(pipeline, settings)
    build_options |= {"views": views, "pipeline": pipeline, "renderer": renderer, "device": device}
    if not isinstance(renderer, str):
        return ViewBank.build(mesh, progress=progress, **build_options)
    key = bank_key(mesh, views, pipeline=pipeline, renderer=renderer)
    path = folder / "banks" / f"bank-{key}.safetensors"
    if _is_ours(path):
        try:
            bank = ViewBank.load(path, device=device)
            if bank_key(bank.mesh, bank.views, pipeline=bank.pipeline, renderer=renderer) != key:
                raise BankError(f"{path}: holds another bank than its name says")
        except BankError:  # built again, and replaced
            pass
        else:
            _touch(path)
            bank.pipeline = pipeline  # of all that share these views
            return bank
    bank = ViewBank.build(mesh, progress=progress, **build_options)
    bank.pipeline = pipeline
    bank.descriptors = bank.descriptors.half().float()  # as the file will hold them: now and later rank alike
    if os.path.lexists(path) and not _is_ours(path):
        warnings.warn(f"{path}: not a view bank, so it stays and the bank is not cached; move it away", stacklevel=2)
        return bank
    try:
        bank.save(path)
    except OSError as error:
        warnings.warn(
            f"the bank is not cached, so it will be built again: {error}, by CURVIREG_CACHE=FOLDER", stacklevel=2
        )
        return bank
    try:
        trim_cache(folder, keep=path)
    except OSError as error:  # its files may be added to, but not removed
        warnings.warn(
            f"the cache exceeds its limit: {error.filename} cannot be removed ({error.strerror})", stacklevel=2
        )
    return bank


def list_cache(folder: Path | None = None) -> list[CachedBank]:
    """The banks of the cache, last used first."""
    banks = []
    for path in _our_files(folder or cache_folder(), _BANK):
        try:
            status = path.stat()
        except FileNotFoundError:  # another process removed it
            continue
        banks.append(CachedBank(path, status.st_size, status.st_mtime))
    return sorted(banks, key=lambda bank: bank.used, reverse=True)


def clear_cache(folder: Path | None = None) -> int:
    """Remove every bank of the cache, and what killed builders left; returns how many banks there were."""
    folder = folder or cache_folder()
    banks = list_cache(folder)
    for path in [*(bank.path for bank in banks), *_our_files(folder, _HALF_WRITTEN)]:
        path.unlink(missing_ok=True)
    return len(banks)


def trim_cache(folder: Path | None = None, *, limit: int | None = None, keep: Path | None = None) -> int:
    """Remove the banks used longest ago until the cache fits its limit; returns how many went.

    Args:
        folder: default :func:`cache_folder`.
        limit: bytes; default ``$CURVIREG_CACHE_LIMIT``, else :data:`CACHE_LIMIT`.
        keep: a bank that stays, whatever its size.
    """
    folder = folder or cache_folder()
    if limit is None:
        given = os.environ.get("CURVIREG_CACHE_LIMIT", "")
        limit = int(given) if given.isdecimal() else CACHE_LIMIT
    for path in _our_files(folder, _HALF_WRITTEN):
        try:
            if time.time() - path.stat().st_mtime > _ABANDONED:
                path.unlink(missing_ok=True)
        except FileNotFoundError:
            continue
    removed, total = 0, 0
    for bank in list_cache(folder):
        total += bank.size
        if total > limit and bank.path != keep:
            bank.path.unlink(missing_ok=True)
            total -= bank.size
            removed += 1
    return removed


def _our_files(folder: Path, name: re.Pattern[str]) -> Iterator[Path]:
    banks = folder / "banks"
    try:
        names = os.listdir(banks)
    except OSError:  # not there yet, or not for us
        names = []
    return (banks / found for found in names if name.fullmatch(found) and _is_ours(banks / found))


def _is_ours(path: Path) -> bool:
    """The header of this safetensors file, whole or cut short behind it, names this library; or the file is empty."""
    try:
        with path.open("rb") as file:
            size = file.read(8)
            header = file.read(min(int.from_bytes(size, "little"), _HEADER_LIMIT))
        return not size or str(json.loads(header)["__metadata__"]["format"]).startswith("curvireg_torch.")
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _touch(path: Path) -> None:
    try:
        os.utime(path)
    except OSError:  # a cache that may only be read
        return
