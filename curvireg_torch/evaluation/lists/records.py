"""Results of many photographs on disk: a line of JSON for each as soon as it is known, a table of all in the end."""

import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ...errors import InvalidInputError, OutputError
from ...utils.files import write_file
from ..store import plain

__all__ = ["FOUND_MESH", "RESULT_COLUMNS", "Records"]

Record = dict[str, Any]

RESULT_COLUMNS = (
    *("status", "message", "confidence", "reliable"),
    *("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"),
    *("tx", "ty", "tz"),
)
"""What ``results.csv`` says of a photograph, behind the columns of the list."""

FOUND_MESH = "found_mesh"
"""Behind those, where a photograph may show one of several meshes: which of them."""


class Records:
    """``results.jsonl`` and ``results.csv`` of a folder.

    Lines are appended and synced one by one: whatever is killed when, the lines before stay. A last line that was cut
    short is dropped when the file is opened again. Lines are found again by ``record["digests"]["request"]``.

    Args:
        folder: is made if it is not there.

    Raises:
        InvalidInputError: its ``results.jsonl`` is something else.

    Example:
        >>> import tempfile
        >>> records = Records(Path(tempfile.mkdtemp()))
        >>> records.append({"status": "failed", "message": "dark", "digests": {"request": "1", "photo": "a"}})
        >>> records.photo_digest("1"), records.read("1")["message"], records.photo_digest("2")
        ('a', 'dark', None)
    """

    def __init__(self, folder: Path) -> None:
        self.path, self.table = folder / "results.jsonl", folder / "results.csv"
        self._places: dict[str, tuple[int, str]] = {}  # where the line begins, and the photograph's digest
        place = 0
        for line in _lines(self.path):
            if not line.endswith(b"\n"):
                os.truncate(self.path, place)  # the last one, cut short
                break
            try:
                digests = json.loads(line)["digests"]
                self._places[digests["request"]] = place, digests["photo"]
            except (ValueError, KeyError, TypeError, RecursionError):
                raise InvalidInputError(
                    f"{self.path}: not results of this command; choose another --out, or move it away"
                ) from None
            place += len(line)

    def photo_digest(self, request: str) -> str | None:
        """Of the photograph with which this request was answered; None where it was not."""
        return self._places.get(request, (0, None))[1]

    def read(self, request: str) -> Record:
        """The record of a request."""
        with self.path.open("rb") as file:
            file.seek(self._places[request][0])
            record: Record = json.loads(file.readline())
        return record

    def append(self, record: Record) -> None:
        """Put a record on disk; numbers that are not finite become null.

        Raises:
            OutputError: it cannot be written.
        """
        digests = record["digests"]
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                place = file.tell()
                file.write(_line(record))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written ({error.strerror}); make room and run again") from error
        self._places[digests["request"]] = place, digests["photo"]

    def finish(
        self, columns: Sequence[str], rows: Iterable[tuple[Sequence[str], Record]], *, which: bool = False
    ) -> None:
        """Write ``results.jsonl`` anew, one line for each row in their order, and then ``results.csv``.

        Args:
            columns: names of the list's columns.
            rows: the list's cells and the record of each row.
            which: add the column :data:`FOUND_MESH`.
        """
        table, lines = io.StringIO(newline=""), []
        writer = csv.writer(table, lineterminator="\n")
        several = [FOUND_MESH] if which else []
        writer.writerow([*columns, *RESULT_COLUMNS, *several])
        for number, (cells, record) in enumerate(rows, start=1):
            found = [record.get("mesh", "")] if which else []
            writer.writerow([*cells, *_result_cells(record), *found])
            head = {"row": number, "columns": dict(zip(columns, cells, strict=True))}
            lines.append(_line({**head, **record, **head}))
        write_file(self.path, b"".join(lines))
        write_file(self.table, table.getvalue().encode())


def _lines(path: Path) -> Iterator[bytes]:
    if path.is_file():
        with path.open("rb") as file:
            yield from file


def _line(record: Record) -> bytes:
    return (json.dumps(plain(record), allow_nan=False) + "\n").encode()


def _result_cells(record: Record) -> list[str]:
    if record["status"] != "ok":
        return [record["status"], record["message"], "", "false", *[""] * 12]
    rotation = [v for row in record["rotation"] for v in row]
    translation = record["translation"] or [""] * 3
    reliable = "true" if record["reliable"] else "false"
    return ["ok", "", str(record["confidence"]), reliable, *map(str, rotation), *map(str, translation)]
