"""Atomic writes of files, bounded reads of tables, and digests by which results and banks are found
again."""

import csv
import errno
import hashlib
import io
import json
import math
import os
import re
import secrets
import signal
import sys
import tempfile
import threading
import unicodedata
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any

from ..errors import MAX_TABLE_BYTES, InvalidInputError, MissingFileError, OutputError
from .aliases import PathName

if TYPE_CHECKING:
    from torch import Tensor

MAX_NAME = 60  # characters of the name of an uploaded file
FindFile = Callable[[str], Path]
"""Where a file lies that another file names. ``folder.joinpath`` follows any name, :func:`only_in`
none out of a folder."""


def write_file(path: Path, content: bytes) -> None:
    """Write a file and create its folder; at any moment ``path`` holds the old content or all of
    the new.

    Raises:
        OutputError: the file cannot be written; no temporary file remains.
    """
    target = Path(os.path.realpath(path))  # replace the target of a link, not the link
    temporary = target.with_name(f"{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and not target.is_file():
            # a folder, or a device like /dev/null
            raise OSError(errno.EINVAL, "not a regular file")
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
        raise OutputError(
            f"cannot be written ({error.strerror}); {advice} another place", subject=path
        ) from error


def write_csv(path: Path, rows: Iterable[Sequence[object]]) -> None:
    """:func:`write_file` of rows of comma-separated cells; an apostrophe precedes what a
    spreadsheet would compute."""
    write_file(path, _csv(rows))


def _csv(rows: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(map(_inert, row) for row in rows)
    return text.getvalue().encode(errors="backslashreplace")  # file names may be no UTF-8


class CsvFile:
    """A CSV file that grows: each row is on disk once it is known. It begins, anew, with the first
    row.

    Cells are written as by :func:`write_csv`.

    Raises:
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        self.path = path
        self._header: Sequence[str] | None = header

    def add(self, row: Sequence[object]) -> None:
        """Write one row."""
        content = _csv([row] if self._header is None else [self._header, row])
        try:
            with self.path.open("ab" if self._header is None else "wb") as file:
                file.write(content)
        except OSError as error:
            raise OutputError(
                f"cannot be written ({error.strerror}); make room", subject=self.path
            ) from error
        self._header = None


def _inert(cell: object) -> object:
    """The cell, as a text that no spreadsheet takes for a formula; numbers are none."""
    if not isinstance(cell, str) or not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        numbers = [float(word) for word in cell.split()]  # a vector is one cell of BOP's tables
    except ValueError:
        numbers = []
    return cell if numbers else f"'{cell}"


def without_apostrophe(cell: str) -> str:
    """A cell as it was before :func:`write_csv` put an apostrophe in front.

    Example:
        >>> without_apostrophe("'-cup/0"), without_apostrophe("'tis")
        ('-cup/0', "'tis")
    """
    return cell[1:] if _inert(cell[1:]) == cell else cell


def check_writable(folder: Path) -> None:
    """Create a folder, or raise :class:`OutputError`, before work whose results go there."""
    probe = folder / f".probe-{secrets.token_hex(4)}"
    try:
        write_file(probe, b"probe")
        probe.unlink()
    except OSError as error:
        reason = getattr(error.__cause__ or error, "strerror", None)
        raise OutputError(
            f"cannot be written to ({reason}); choose another folder", subject=folder, kind="out"
        ) from error


def cache_folder() -> Path:
    """``$CURVIREG_CACHE``, else ``$XDG_CACHE_HOME/curvireg_torch``, else
    ``~/.cache/curvireg_torch``. Of banks, only files named ``bank-<32 digits>.safetensors`` or
    ``views-<32 digits>.safetensors`` (features of a bank's views) in its folder ``banks`` are ever
    listed, overwritten or removed; its folder ``weights`` holds one file of 3 MB.

    Example:
        >>> cache_folder().is_absolute()
        True
    """
    if folder := os.environ.get("CURVIREG_CACHE"):
        return Path(folder)
    if folder := os.environ.get("XDG_CACHE_HOME"):
        return Path(folder) / "curvireg_torch"
    try:
        return Path.home() / ".cache" / "curvireg_torch"
    except RuntimeError:  # a user without a home
        return Path(tempfile.gettempdir()) / "curvireg_torch"


def write_tensors(
    path: Path, tensors: Mapping[str, "Tensor"], metadata: Mapping[str, str] | None = None
) -> None:
    """:func:`write_file` of a safetensors file."""
    from safetensors.torch import save

    content = {name: x.detach().cpu().contiguous() for name, x in tensors.items()}
    write_file(path, save(content, dict(metadata or {})))


def keep_tensors(
    path: Path, tensors: Mapping[str, "Tensor"], metadata: Mapping[str, str] | None = None
) -> None:
    """Write what can be computed again to a cache, with its checksum; a read-only or full cache
    keeps nothing."""
    with suppress(OutputError):
        write_tensors(path, tensors, {**(metadata or {}), "checksum": tensor_checksum(tensors)})


def kept_tensors(path: Path) -> tuple[dict[str, "Tensor"], dict[str, str]] | None:
    """Tensors and metadata of :func:`keep_tensors`; None if they are missing or damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError):
        return None
    if metadata.pop("checksum", None) != tensor_checksum(tensors):
        return None
    return tensors, metadata


def terminable() -> AbstractContextManager[None]:
    """Context in which SIGTERM, and SIGHUP of a terminal that closes, end the process as Ctrl-C
    does: every ``finally`` runs, and no partial file remains."""
    return signals_handled([signal.SIGTERM, *hangup_signals()], _exit_after)


@contextmanager
def signals_handled(
    numbers: Iterable[int], handler: Callable[[int, Any], object]
) -> Iterator[None]:
    """Context in which signals call ``handler``; in the main thread, as others cannot handle
    signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def hangup_signals() -> list[int]:
    """SIGHUP, where the system has it and nohup does not ignore it."""
    hangup = getattr(signal, "SIGHUP", None)
    return [] if hangup is None or signal.getsignal(hangup) is signal.SIG_IGN else [hangup]


def _exit_after(number: int, _: object) -> None:
    sys.exit(128 + number)


def read_json(path: Path, kind: type[Any] | tuple[type[Any], ...], readme: str) -> Any:
    """The content of a JSON file whose top level must be a ``kind`` (dict or list)."""
    if not path.is_file():
        raise MissingFileError(f"no such file; {readme} shows the layout", subject=path)
    check_table_size(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(
            f"damaged, or not JSON ({error}); {readme} shows the layout", subject=path
        ) from error
    if not isinstance(content, kind):
        expected = "a list" if kind is list else "an object"
        raise InvalidInputError(
            f"expected {expected} of JSON; {readme} shows the layout", subject=path
        )
    return content


def split_name(path: PathName) -> tuple[Path, str]:
    """The file and the name of ``FILE:NAME``; a file or folder that exists has no name."""
    file = Path(path)
    text = str(path)
    while not os.path.exists(file) and ":" in str(file):  # unlike Path.exists, whatever the name is
        file = Path(str(file).rpartition(":")[0])
    if not os.path.exists(file):
        return Path(path), ""
    return file, text[len(str(file)) + 1 :]


def without_zeros(name: str) -> str:
    """A number without zeros in front; any other name as it is.

    Example:
        >>> without_zeros("000012"), without_zeros("a01")
        ('12', 'a01')
    """
    return str(int(name)) if name.isdecimal() and len(name) < 20 else name


def read_csv(path: Path) -> list[list[str]]:
    """The rows of a CSV file in UTF-8 that are not blank.

    Columns are separated by commas, or by semicolons or tabs, as spreadsheets write them; then
    numbers may have decimal commas, which are read as points.
    """
    check_table_size(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        if named := _SEPARATOR_LINE.match(text):
            text = text[named.end() :]
        first = next(filter(str.strip, text.splitlines()), "")
        separator = named[1] if named else max(",;\t", key=first.count)
        table = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=separator)
        rows = [cells for cells in table if any(map(str.strip, cells))]
        if separator == ",":
            return rows
        are_numbers = _DECIMAL_COMMAS.fullmatch
        return [[c.replace(",", ".") if are_numbers(c) else c for c in cells] for cells in rows]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            f"not CSV in UTF-8 ({error}); save it as CSV in UTF-8", subject=path
        ) from error


_SEPARATOR_LINE = re.compile(r"sep=([,;\t])\r?\n")  # the first one, of Excel
_DECIMAL_COMMAS = re.compile(r"\s*[-+]?\d+(?:,\d+)?(?:[eE][-+]?\d+)?(?:\s+[-+]?\d+(?:,\d+)?)*\s*")

_FOREIGN = {
    re.compile(rb"version https://git-lfs"): "a pointer of Git LFS, not the file; run git lfs pull",
    re.compile(rb"\x1f\x8b"): "packed by gzip; unpack it",
    re.compile(rb"\s*<(!doctype\s+)?html", re.IGNORECASE): "a web page; fetch the file itself",
}
"""Starts of files that a download leaves in the place of another, and what to do."""


def foreign_content(start: bytes) -> str | None:
    """What a file is that cannot be what its name says, and what to do, by its first bytes.

    Example:
        >>> foreign_content(b"<!DOCTYPE html><html>")
        'a web page; fetch the file itself'
    """
    return next((text for form, text in _FOREIGN.items() if form.match(start)), None)


def file_name(text: str) -> str:
    """The name of an uploaded file, without folders and control characters.

    Example:
        >>> file_name("../../etc/passwd"), file_name("C:\\\\photos\\\\a.png"), file_name("..")
        ('passwd', 'a.png', 'file')
    """
    last = text.replace("\\", "/").rpartition("/")[2]
    name = "".join(c for c in last if c.isprintable()).strip(" .")
    return name[-MAX_NAME:] or "file"


def found_in(folder: Path) -> FindFile:
    """A :data:`FindFile` of any name in ``folder``; one with backslashes, as Windows writes them,
    is read as there.

    Example:
        >>> found_in(Path("lists"))("shots\\\\0.png").as_posix()
        'lists/shots/0.png'
    """

    def find(name: str) -> Path:
        path = folder / name
        is_posix = "\\" not in name or os.path.exists(path)
        return as_stored(path if is_posix else folder.joinpath(*PureWindowsPath(name).parts))

    return find


def as_stored(path: Path) -> Path:
    """The path of the file that is meant, where its accents are stored in another form: keyboards
    type them composed (NFC), while macOS stored them decomposed (NFD); systems take these for two
    names. A path without such a file stays as it is."""
    if str(path).isascii() or os.path.lexists(path):
        return path
    found = Path(path.anchor)
    for part in path.relative_to(path.anchor).parts:
        if not os.path.lexists(found / part):
            wanted = unicodedata.normalize("NFC", part)
            try:
                names = sorted(os.listdir(found))
            except OSError:
                return path
            same = [name for name in names if unicodedata.normalize("NFC", name) == wanted]
            if not same:
                return path
            part = same[0]
        found = found / part
    return found


def only_in(folder: Path) -> FindFile:
    """A :data:`FindFile` for lists and rigs from strangers: whatever folder a name has, the file
    with its :func:`file_name` in ``folder`` is meant.

    Example:
        >>> only_in(Path("uploads"))("../../etc/passwd").as_posix()
        'uploads/passwd'
    """
    return lambda name: folder / file_name(name)


def check_table_size(path: Path) -> None:
    """Refuse a table that is a folder, or too large to be read as a whole."""
    if path.is_dir():
        raise InvalidInputError("a folder where a file is expected; name the file", subject=path)
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise InvalidInputError(
            f"larger than {MAX_TABLE_BYTES:,} bytes; split the set", subject=path
        )


def finite_numbers(values: object, count: int) -> tuple[float, ...] | None:
    """``values`` as floats if they are ``count`` finite numbers, else None."""
    if not isinstance(values, Iterable) or isinstance(values, str | dict):
        return None
    numbers = list(values)
    if len(numbers) != count or any(
        isinstance(v, bool) or not isinstance(v, int | float) for v in numbers
    ):
        return None
    try:
        floats = tuple(float(v) for v in numbers)
    except OverflowError:
        return None
    return floats if all(map(math.isfinite, floats)) else None


def text_digest(text: str, *, size: int = 8) -> str:
    """``2 * size`` hexadecimal digits of a text."""
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()


def file_digest(path: Path) -> str:
    """16 hexadecimal digits of a file's content; "" if it cannot be read or is not a regular
    file."""
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=8)).hexdigest()
    except OSError:
        return ""


def tensor_digest(tensors: Mapping[str, "Tensor"], *, size: int = 8) -> str:
    """``2 * size`` hexadecimal digits of named tensors: names, dtypes, shapes and values."""
    digest = hashlib.blake2b(digest_size=size)
    for part in _parts_of(tensors):
        digest.update(part)
    return digest.hexdigest()


def tensor_checksum(tensors: Mapping[str, "Tensor"]) -> str:
    """8 hexadecimal digits that show damage of what :func:`tensor_digest` is of, in a fifth of its
    time; other tensors may have the same ones."""
    checksum = 0
    for part in _parts_of(tensors):
        checksum = zlib.crc32(part, checksum)
    return f"{checksum:08x}"


def _parts_of(tensors: Mapping[str, "Tensor"]) -> Iterator[bytes | memoryview]:
    """What digests of named tensors are of, in the order of names."""
    import torch

    for name, x in sorted(tensors.items()):
        yield f"{name} {x.dtype} {tuple(x.shape)}".encode()
        yield x.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data
