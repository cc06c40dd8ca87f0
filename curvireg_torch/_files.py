"""Tensors on disk."""

import os
import uuid
from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import save
from torch import Tensor


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write a safetensors file; it appears whole or not at all, whoever else writes it at the same time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        content = {name: x.detach().cpu().contiguous() for name, x in tensors.items()}
        temporary.write_bytes(save(content, dict(metadata or {})))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
