"""The one rule for files that commands write.

No input is ever written or removed, and a command replaces only what it wrote itself: the file
``.curvireg.json`` in the folder of the results says which command wrote what. Anything else in the
way of a result is an error that names it, before any work. One run at a time writes into a folder.
What an earlier run left goes before the work begins, but for the rows that are resumed: a run that
fails leaves no result of another photograph.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, OutputError
from ..formats.exports import ros, trackers
from ..utils.aliases import Document
from ..utils.files import check_writable, read_json, write_file
from .store import THUMBNAILS, to_json

try:
    import fcntl
except ImportError:  # no locks on Windows
    fcntl = None  # type: ignore[assignment]

MARKER = ".curvireg.json"
MARK = b"curvireg"  # in each bank and picture

FOR_TOOLS = (*ros.FILES, *trackers.M3T_FILES, *trackers.VISP_FILES)
ONE_RESULT = ("result.json", "overlay.png", "pose.glb", *FOR_TOOLS)
RESUMED = ("results.jsonl", THUMBNAILS)
ROWS = (*RESUMED, "index.html")
FILES: dict[str, tuple[str, ...]] = {
    "register": ONE_RESULT,
    "demo": (*ONE_RESULT, "mesh.ply", "photo.png"),
    "register several": (*ROWS, "results.csv"),
    "evaluate": (*ROWS, "summary.json", "predictions.csv", "errors.csv", "curvireg-*_*-*.csv"),
    "follow": ("results.csv", "overlay.mp4"),
    "inspect": ("inspect.json", "inspect.html"),
}
"""Names, or patterns of names, that each command may write into the folder of its results."""


def _refused(path: Path, text: str) -> InvalidInputError:
    """The error about a file in the way, whose ``text`` ends before the advice."""
    return InvalidInputError(f"{text}choose another folder", subject=path, kind="out")


@contextmanager
def output_folder(
    folder: Path,
    command: str,
    *,
    inputs: Iterable[Path] = (),
    source: Sequence[str] = (),
) -> Iterator[None]:
    """Context in which ``command`` may write its files into ``folder``, which is created, and goes
    again if nothing was written.

    Args:
        folder: of the results.
        command: a key of ``FILES``.
        inputs: files that the command reads.
        source: what the results are of, for results that several runs share: a later run must name
            all of it again, since it keeps no other rows.

    Raises:
        InvalidInputError: a file in the way that is an input, or that this command did not write;
            results of another source; or another run that writes here.
        OutputError: the folder cannot be written to.
    """
    names = FILES[command]
    in_the_way = _existing(folder, names)
    _check_inputs(in_the_way, inputs)
    written = _read(folder)
    for path in in_the_way:
        _check_owner(path, command, written)
    is_new = not folder.exists()
    check_writable(folder)
    with _locked(folder):
        before = _read(folder).get(command, {})
        _check_source(folder, before, source, _existing(folder, names))
        kept = list(source or before.get("source", ()))
        _mark(folder, command, names, kept)
        for path in _existing(folder, names):
            if path.name not in RESUMED:
                path.unlink()
        try:
            yield
        finally:
            written_now = [path.name for path in _existing(folder, names)]
            with suppress(OutputError):  # an error of the command itself counts more
                _mark(folder, command, written_now, kept)
            if is_new and not written_now:
                _remove_unused(folder)


def _remove_unused(folder: Path) -> None:
    """Remove a folder that holds a marker alone."""
    if [path.name for path in folder.iterdir()] == [MARKER]:
        (folder / MARKER).unlink()
        folder.rmdir()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Context in which no other run writes into a folder; the lock ends with the process, however
    that ends."""
    with ExitStack() as stack:
        if fcntl is not None:
            place = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, place)
            try:
                fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise _refused(
                    folder, "another run is writing its results here; wait for it, or "
                ) from None
            except OSError:  # some network file systems lock no folders
                pass
        yield


def _check_source(
    folder: Path, before: Document, source: Sequence[str], in_the_way: Sequence[Path]
) -> None:
    """Refuse a run whose results would replace those of another source, or of a run of it that was
    stopped."""
    lost = [name for name in before.get("source", ()) if name not in source]
    if not (lost and source):
        return
    if in_the_way:
        raise _refused(in_the_way[0], f"holds results of {lost[0]}, which would be lost; ")
    if before["files"]:
        raise _refused(folder, f"a run of {lost[0]} was stopped here; remove {MARKER} in it, or ")


def check_output_file(path: Path, inputs: Iterable[Path]) -> None:
    """Refuse to write a file that is an input, or that exists without ``MARK``, by which this
    program's own are known.

    The folder is checked too, so that no work is lost.
    """
    if path.exists():
        _check_inputs([path], inputs)
        if not path.is_file() or MARK not in path.read_bytes():
            raise _refused(path, "exists, and this command did not write it; ")
    check_writable(path.parent)


def _existing(folder: Path, names: Iterable[str]) -> list[Path]:
    """Files of these names or patterns, broken links included."""
    if not folder.is_dir():
        return []
    present = sorted(path.name for path in folder.iterdir())
    return [folder / name for name in present if any(fnmatch(name, pattern) for pattern in names)]


def _check_inputs(outputs: Sequence[Path], inputs: Iterable[Path]) -> None:
    """Refuse outputs that are inputs, under whatever name."""
    identities = {_identity(path) for path in outputs}
    if not identities:
        return
    for path in inputs:
        if path.exists() and _identity(path) in identities:
            raise _refused(path, "an input of this command, which would overwrite it; ")


def _identity(path: Path) -> object:
    try:
        status = path.stat()
    except OSError:  # a link to nothing
        return str(path)
    return status.st_dev, status.st_ino


def _check_owner(path: Path, command: str, written: Document) -> None:
    """Refuse a file that ``command`` did not write."""
    owners = [
        name
        for name, run in written.items()
        if any(fnmatch(path.name, pattern) for pattern in run["files"])
    ]
    if not owners:
        raise _refused(path, "not written by this command; move it away, or ")
    if command not in owners:
        raise _refused(path, f"a result of 'curvireg {owners[0]}'; ")


def _read(folder: Path) -> dict[str, Any]:
    """What each command wrote into the folder."""
    path = folder / MARKER
    if not path.exists():
        return {}
    content = read_json(path, dict, "docs/results.md")
    runs = content.get("commands")
    if not isinstance(runs, dict) or not all(map(_is_run, runs.values())):
        raise _refused(path, "not of this program; ")
    return runs


def _is_run(run: object) -> bool:
    if not isinstance(run, dict):
        return False
    texts = [run.get("files"), run.get("source", [])]
    return all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in texts
    )


def _mark(folder: Path, command: str, files: Sequence[str], source: Sequence[str]) -> None:
    """Note that ``command`` wrote ``files``, or is about to; they are no other command's."""
    before = _read(folder)
    runs = {
        name: {**run, "files": [file for file in run["files"] if file not in files]}
        for name, run in before.items()
    }
    runs[command] = {"files": list(files), "source": list(source)}
    if runs != before:
        write_file(folder / MARKER, to_json({"schema": 1, "commands": runs}).encode())
