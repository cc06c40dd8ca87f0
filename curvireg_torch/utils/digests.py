"""Digests by which results and banks are found again: of files, of tensors and of this package's own code."""

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

_PACKAGE = Path(__file__).parents[1]


def text_digest(text: str, *, size: int = 8) -> str:
    """``2 * size`` hexadecimal digits of a text."""
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()


def file_digest(path: Path) -> str:
    """16 hexadecimal digits of a file's content; "" if it cannot be read or is not a regular file."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=8)).hexdigest()
    except OSError:
        return ""


def tensor_digest(tensors: Mapping[str, "Tensor"], *, size: int = 8) -> str:
    """``2 * size`` hexadecimal digits of named tensors: names, dtypes, shapes and values."""
    import torch

    digest = hashlib.blake2b(digest_size=size)
    for name, x in sorted(tensors.items()):
        digest.update(f"{name} {x.dtype} {tuple(x.shape)}".encode())
        digest.update(x.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()


@cache
def code_digest(*parts: str) -> str:
    """16 hexadecimal digits of ``parts`` of the package: folders with their code, weights and constants, and files."""
    digest = hashlib.blake2b(digest_size=8)
    for part in parts:
        path = _PACKAGE / part
        inside = sorted(p for p in path.rglob("*") if p.suffix in (".py", ".json", ".safetensors"))
        for source in inside if path.is_dir() else [path]:
            digest.update(source.read_bytes())
    return digest.hexdigest()
