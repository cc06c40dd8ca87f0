"""Results on disk: JSON lines that several processes append to, and the settings that produced them."""

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True)
class _Location:
    """Where a row is on disk, and whether it is valid."""

    path: Path
    offset: int
    digests: Row
    revision: int
    final: bool


class ResultStore:
    """One row for each item, in ``results.jsonl`` of a folder.

    A row holds the ``key`` of its item and ``digests`` of all that it depends on. It is synced to disk once it is
    known; a last line that was cut short is ignored, and removed before the next row. Each of several processes appends
    to ``results.RANK-of-SIZE.jsonl``; readers merge all files. The latest of several rows of one item counts.

    Args:
        folder: created with the first row.
        workers: the processes that share the store.

    Raises:
        InvalidInputError: ``results.jsonl`` holds something else.

    Example:
        >>> import tempfile
        >>> store = ResultStore(Path(tempfile.mkdtemp()))
        >>> store.append({"key": "car/1", "digests": {"request": "a", "photo": "b"}, "score": 0.5})
        >>> "car/1" in store, store.is_current("car/1", {"request": "a", "photo": "b"}), store.read("car/1")["score"]
        (True, True, 0.5)
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
        if overwrite and self._in_job_array:
            raise InvalidInputError("--overwrite: not in a job array, where it would delete the results of other jobs")
        if overwrite:
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
        elif self._locations:
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
        self._locations: dict[str, _Location] = {}
        for path in self._files():
            offset = 0
            with path.open("rb") as file:
                for line in file:
                    if not line.endswith(b"\n"):
                        break  # cut short
                    self._add(path, offset, line)
                    offset += len(line)

    def __contains__(self, key: str) -> bool:
        return key in self._locations

    def is_complete(self, keys: Iterable[str]) -> bool:
        """Whether all processes together have written a row of each key."""
        self.refresh()
        return all(key in self for key in keys)

    def is_current(self, key: str, digests: Mapping[str, str]) -> bool:
        """Whether the row of ``key`` is final and depends on exactly what ``digests`` describes."""
        found = self._locations.get(key)
        return found is not None and found.final and bool(digests["photo"]) and found.digests == digests

    def read(self, key: str) -> Row:
        """The latest row of ``key``; :class:`InvalidInputError` if there is none."""
        for _ in range(2):
            if key in self._locations:
                found = self._locations[key]
                with found.path.open("rb") as file:
                    file.seek(found.offset)
                    line = file.readline()
                if (row := _parsed(line)) is not None and row["key"] == key:
                    return row
            self.refresh()  # another process has rewritten the file
        raise InvalidInputError(f"{self.folder}: no result for {key}; run again")

    def append(self, row: Row) -> None:
        """Put a row on disk; numbers that are not finite become null. :class:`OutputError` if this fails."""
        before = self._locations.get(row["key"])
        line = _line(row if before is None else {**row, "revision": before.revision + 1})
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
        """Move the latest rows of all processes, none of which may still be running, into ``results.jsonl``."""
        parts = [path for path in self._files() if path != self.path]
        if parts or any(found.revision for found in self._locations.values()):
            rows = [{k: v for k, v in self.read(key).items() if k != "revision"} for key in self._locations]
            write_file(self.path, b"".join(map(_line, rows)))
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
        revision, before = row.get("revision", 0), self._locations.get(row["key"])
        if before is None or revision >= before.revision:
            self._locations[row["key"]] = _Location(path, offset, row["digests"], revision, "skipped" not in row)


def _parsed(line: bytes) -> Row | None:
    try:
        row = json.loads(line)
        return row if isinstance(row["key"], str) and isinstance(row["digests"], dict) else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
