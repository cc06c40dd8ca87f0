"""Atomic writes of files."""

import csv
import errno
import io
import os
import secrets
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import OutputError

if TYPE_CHECKING:
    from torch import Tensor


def write_file(path: Path, content: bytes) -> None:
    """Write a file and create its folder; at any moment ``path`` holds the old content or all of the new.

    Raises:
        OutputError: the file cannot be written; no temporary file remains.
    """
    target = Path(os.path.realpath(path))  # replace the target of a link, not the link
    temporary = target.with_name(f"{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and not target.is_file():
            raise OSError(errno.EINVAL, "not a regular file")  # a folder, or a device like /dev/null
        try:
            with temporary.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # else a crash of the machine may leave an empty file
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        advice = "make room, or choose" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose"
        raise OutputError(f"cannot be written ({error.strerror}); {advice} another place", subject=path) from error


def write_csv(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """:func:`write_file` of rows of comma-separated cells; an apostrophe precedes what a spreadsheet would compute."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(map(_inert, row) for row in rows)
    write_file(path, text.getvalue().encode())


def _inert(cell: object) -> object:
    """The cell, as a text that no spreadsheet takes for a formula; numbers are none."""
    if not isinstance(cell, str) or not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        numbers = [float(word) for word in cell.split()]  # a vector is one cell of BOP's tables
    except ValueError:
        numbers = []
    return cell if numbers else f"'{cell}"


def check_writable(folder: Path, name: str) -> None:
    """Create a folder, or raise :class:`OutputError` that names option ``name``, before work whose results go there."""
    probe = folder / f".probe-{secrets.token_hex(4)}"
    try:
        write_file(probe, b"probe")
        probe.unlink()
    except OSError as error:
        reason = getattr(error.__cause__ or error, "strerror", None)
        raise OutputError(
            f"cannot be written to ({reason}); choose another {name}", subject=f"{name} {folder}"
        ) from error


def write_tensors(path: Path, tensors: Mapping[str, "Tensor"], metadata: Mapping[str, str] | None = None) -> None:
    """:func:`write_file` of a safetensors file."""
    from safetensors.torch import save

    content = {name: x.detach().cpu().contiguous() for name, x in tensors.items()}
    write_file(path, save(content, dict(metadata or {})))


@contextmanager
def terminable() -> Iterator[None]:
    """Context in which SIGTERM ends the process as Ctrl-C does: every ``finally`` runs, and no partial file remains."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    previous = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
