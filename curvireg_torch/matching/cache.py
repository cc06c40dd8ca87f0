"""Banks cached on disk by the content of what made them."""

import hashlib
import json
import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from ..errors import BankError
from ..geometry.mesh import as_mesh
from ..geometry.views import ViewSphere
from .bank import FORMAT_VERSION, ViewBank
from .describe import BankSettings

__all__ = ["bank_key", "cache_folder", "cached_bank"]


def cache_folder() -> Path:
    """``$CURVIREG_CACHE``, else ``$XDG_CACHE_HOME/curvireg_torch``, else ``~/.cache/curvireg_torch``."""
    if folder := os.environ.get("CURVIREG_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "curvireg_torch"


def bank_key(mesh: trimesh.Trimesh, views: ViewSphere, settings: BankSettings) -> str:
    """Hexadecimal digest of vertices, faces, unit, views, settings and format version."""
    digest = hashlib.sha256(json.dumps([FORMAT_VERSION, asdict(settings), mesh.units], sort_keys=True).encode())
    digest.update(np.ascontiguousarray(mesh.vertices, np.float64).tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, np.int64).tobytes())
    for field in fields(ViewSphere):
        digest.update(getattr(views, field.name).cpu().double().numpy().tobytes())
    return digest.hexdigest()[:32]


def cached_bank(
    mesh: Any,
    views: ViewSphere,
    settings: BankSettings,
    *,
    folder: Path | None = None,
    device: torch.device | str = "cpu",
    progress: bool = True,
    **build_options: Any,
) -> ViewBank:
    """The bank from the cache, or built and put there; a damaged file is built again, an unwritable folder no error."""
    mesh = as_mesh(mesh)
    path = (folder or cache_folder()) / f"{bank_key(mesh, views, settings)}.safetensors"
    if path.is_file():
        try:
            return ViewBank.load(path, device=device)
        except BankError:
            path.unlink(missing_ok=True)
    bank = ViewBank.build(mesh, views, settings=settings, progress=progress, device=device, **build_options)
    try:
        bank.save(path)
    except OSError:
        return bank
    return bank
