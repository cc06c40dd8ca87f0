"""Files that appear whole or not at all."""

import errno
import os
import secrets
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import OutputError

if TYPE_CHECKING:
    from torch import Tensor


def write_file(path: Path, content: bytes) -> None:
    """Write a file, and its folder; the name stands for the old content or for all of the new, whatever is killed when.

    Raises:
        OutputError: it cannot be written; nothing is left of it.
    """
    target = Path(os.path.realpath(path))  # what a link points to is replaced, not the link
    temporary = target.with_name(f"{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and not target.is_file():
            raise OSError(errno.EINVAL, "not a regular file")  # a folder, or a device like /dev/null
        try:
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # after a crash of the machine, too, the name never stands for an empty file
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        cure = "make room, or choose" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose"
        raise OutputError(f"{path}: cannot be written ({error.strerror}); {cure} another place") from error


def probe_folder(folder: Path, name: str) -> None:
    """Make the folder and write to it, before the work whose results go there.

    Raises:
        OutputError: names the option ``name``.
    """
    probe = folder / f".probe-{secrets.token_hex(4)}"
    try:
        write_file(probe, b"probe")
        probe.unlink()
    except OSError as error:
        reason = getattr(error.__cause__ or error, "strerror", None)
        raise OutputError(f"{name} {folder}: cannot be written to ({reason}); choose another {name}") from error


def write_tensors(path: Path, tensors: Mapping[str, "Tensor"], metadata: Mapping[str, str] | None = None) -> None:
    """:func:`write_file` of a safetensors file."""
    from safetensors.torch import save

    content = {name: x.detach().cpu().contiguous() for name, x in tensors.items()}
    write_file(path, save(content, dict(metadata or {})))


@contextmanager
def terminable() -> Iterator[None]:
    """Within, SIGTERM ends the process as Ctrl-C does: through every ``finally``, so that no half of a file stays."""
    if threading.current_thread() is not threading.main_thread():  # which alone may handle signals
        yield
        return
    previous = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
