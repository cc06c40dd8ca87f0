"""Results on disk: JSON lines that several processes append to, and the settings that produced them."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InvalidInputError, OutputError
from ..utils.files import write_file
from .workers import Workers

__all__ = ["ResultStore", "Row", "to_json"]

Row = dict[str, Any]


def finite(value: Any) -> Any:
    """``value`` with None for NaN and infinity, which JSON cannot write."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any) -> str:
    """Indented JSON; numbers that are not finite become null."""
    return json.dumps(finite(value), indent=2, allow_nan=False) + "\n"


def _line(row: Row) -> bytes:
    return (json.dumps(finite(row), allow_nan=False) + "\n").encode()


class _Location(NamedTuple):
    """Where a row is on disk, and what it depends on."""

    path: Path
    offset: int
    digests: Row


class ResultStore:
    """One row for each entry, in ``results.jsonl`` of a folder.

    A row holds the ``key`` of its entry and ``digests`` of all that it depends on. It is synced to disk once it is
    known; a last line that was cut short is ignored, and removed before the next row. Each of several processes appends
    to ``results.RANK-of-SIZE.jsonl``; readers merge all files. Of several rows of one entry, the last one counts.

    Args:
        folder: created with the first row.
        workers: the processes that share the store.

    Raises:
        InvalidInputError: ``results.jsonl`` holds something else.

    Example:
        >>> import tempfile
        >>> store = ResultStore(Path(tempfile.mkdtemp()))
        >>> store.append({"key": "car/1", "digests": {"request": "a", "photo": "b"}, "score": 0.5})
        >>> store.is_current("car/1", {"request": "a", "photo": "b"}), store.read("car/1")["score"]
        (True, 0.5)
    """

    def __init__(self, folder: Path, workers: Workers | None = None) -> None:
        workers = workers or Workers()
        self.folder, self.path, self.settings_path = folder, folder / "results.jsonl", folder / "settings.json"
        part = folder / f"results.{workers.rank}-of-{workers.size}.jsonl"
        self._output = part if workers.size > 1 else self.path
        self._in_job_array = workers.size > 1 and not workers.joined
        self._repaired = False
        self.refresh()

    def open(self, settings: Row, *, overwrite: bool = False) -> None:
        """Bind the store to ``settings`` of plain values, or continue with the same ones; ``overwrite`` deletes rows.

        Raises:
            InvalidInputError: the folder holds results of other settings, or ``overwrite`` in a job array.
            OutputError: it cannot be written to.
        """
        if overwrite:
            if self._in_job_array:
                raise InvalidInputError("--overwrite: not in a job array, where it would delete results of other jobs")
            self.settings_path.unlink(missing_ok=True)  # first: rows without settings are refused after a kill
            for path in self._files():
                path.unlink()
            self.refresh()
        elif self.settings_path.is_file():
            before, now = self.settings(), finite(settings)
            changed = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
            if changed:
                changes = ", ".join(f"{name}: {before.get(name)!r} there, {now.get(name)!r} now" for name in changed)
                raise InvalidInputError(
                    f"{self.folder}: holds results of other settings ({changes}); "
                    "choose another --out, or give --overwrite to start again"
                )
            return
        elif self._rows:
            raise InvalidInputError(
                f"{self.folder}: holds results of unknown settings; choose another --out or --overwrite"
            )
        write_file(self.settings_path, to_json(settings).encode())

    def settings(self) -> Row:
        """The settings that :meth:`open` wrote.

        Raises:
            InvalidInputError: the file is missing or damaged.
        """
        try:
            return dict(json.loads(self.settings_path.read_text(encoding="utf-8")).items())
        except (OSError, ValueError, AttributeError) as error:
            message = f"{self.settings_path}: missing or damaged ({error}); run curvireg evaluate first"
            raise InvalidInputError(message) from error

    def refresh(self) -> None:
        """Read again what is on disk, rows of other processes included."""
        self._rows: dict[str, list[_Location]] = {}
        for path in self._files():
            offset = 0
            with path.open("rb") as file:
                for line in file:
                    if not line.endswith(b"\n"):
                        break  # cut short
                    self._add(path, offset, line)
                    offset += len(line)

    def is_current(self, key: str, digests: Mapping[str, str]) -> bool:
        """Whether there is a row of ``key`` that depends on exactly what ``digests`` describes, a readable photograph
        included; it is the one that :meth:`read` returns from now on."""
        return bool(digests["photo"]) and self._choose(key, digests)

    def is_complete(self, wanted: Mapping[str, Mapping[str, str]]) -> bool:
        """Whether all processes together have written a row of each key with these digests; :meth:`read` returns it."""
        self.refresh()
        found = [self._choose(key, digests) for key, digests in wanted.items()]
        return all(found)

    def _choose(self, key: str, digests: Mapping[str, str]) -> bool:
        rows = self._rows.get(key, [])
        same = [row for row in rows if row.digests == digests]
        if same:
            self._rows[key] = [*(row for row in rows if row.digests != digests), *same]
        return bool(same)

    def read(self, key: str) -> Row:
        """The row of ``key``; :class:`InvalidInputError` if there is none."""
        for _ in range(2):
            if key in self._rows:
                path, offset, digests = self._rows[key][-1]
                with path.open("rb") as file:
                    file.seek(offset)
                    row = _parsed(file.readline())
                if row is not None and row["key"] == key and row["digests"] == digests:
                    return row
            self.refresh()  # another process has rewritten the file
        raise InvalidInputError(f"{self.folder}: no result for {key}; run again")

    def append(self, row: Row) -> None:
        """Put a row on disk; numbers that are not finite become null. :class:`OutputError` if this fails."""
        line = _line(row)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self._repaired and self._output.is_file():  # remove a line that was cut short
                os.truncate(self._output, self._output.read_bytes().rfind(b"\n") + 1)
            self._repaired = True
            with self._output.open("ab") as file:
                offset = file.tell()
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(f"{self._output}: cannot be written ({error.strerror}); free space, run again") from error
        self._add(self._output, offset, line)

    def rewrite(self, rows: Iterable[Row]) -> None:
        """Replace ``results.jsonl`` by ``rows``."""
        write_file(self.path, b"".join(map(_line, rows)))
        self.refresh()

    def merge(self) -> None:
        """Move one row of each key into ``results.jsonl``; no other process may still be running."""
        parts = [path for path in self._files() if path != self.path]
        if parts or any(len(rows) > 1 for rows in self._rows.values()):
            write_file(self.path, b"".join(_line(self.read(key)) for key in list(self._rows)))
            for path in parts:
                path.unlink()
            self.refresh()

    def _files(self) -> list[Path]:
        """``results.jsonl`` first."""
        return [path for path in (self.path, *sorted(self.folder.glob("results.*-of-*.jsonl"))) if path.is_file()]

    def _add(self, path: Path, offset: int, line: bytes) -> None:
        row = _parsed(line)
        if row is None:
            raise InvalidInputError(f"{path}: not results of this command; choose another --out, or move it away")
        self._rows.setdefault(row["key"], []).append(_Location(path, offset, row["digests"]))


def _parsed(line: bytes) -> Row | None:
    try:
        row = json.loads(line)
        return row if isinstance(row["key"], str) and isinstance(row["digests"], dict) else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
