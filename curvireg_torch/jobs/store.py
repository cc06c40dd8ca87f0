"""Results on disk: JSON lines, one row for each entry."""

import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, OutputError
from ..utils.files import write_file

THUMBNAILS = "thumbnails"
_DIGEST = re.compile("[0-9a-f]{16}")

Row = dict[str, Any]
Rows = Sequence[Row]


def has_pose(row: Mapping[str, Any]) -> bool:
    """Whether the photograph of a row has a pose, whatever the verdict on it."""
    return row["verdict"] not in ("lost", "failed")


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


def thumbnail_path(folder: Path, digests: Mapping[str, str]) -> Path:
    """Where the picture of a result in a folder is."""
    return folder / THUMBNAILS / f"{digests['request']}.jpg"


class ResultStore:
    """One row for each entry, in ``results.jsonl`` of a folder.

    A row holds the ``key`` of its entry and ``digests`` of all that it depends on. It is synced to
    disk once it is known; a last line that was cut short is ignored, and removed before the next
    row. Of several rows of one entry, the last one counts.

    Args:
        folder: created with the first row.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / "results.jsonl"
        self._repaired = False
        self._rows: dict[str, tuple[Row, bytes]] = {}
        lines = self.path.read_bytes().splitlines(keepends=True) if self.path.is_file() else []
        for line in lines:
            if line.endswith(b"\n"):  # else it was cut short
                self._add(line)

    def __len__(self) -> int:
        return len(self._rows)

    def is_current(self, key: str, request: str, photo: Callable[[], str]) -> bool:
        """Whether the row of ``key`` depends on exactly this request and photograph. ``photo`` is
        called for its digest where all else is the same; "" is that of an unreadable one."""
        if key not in self._rows:
            return False
        digests = self._rows[key][0]
        is_same = bool(digests.get("photo")) and digests.get("request") == request
        return is_same and digests["photo"] == photo()

    def read(self, key: str) -> Row:
        """The row of ``key``; :class:`InvalidInputError` if there is none."""
        if key not in self._rows:
            raise InvalidInputError(f"{self.folder}: no result for {key}; run again")
        row: Row = json.loads(self._rows[key][1])
        return row

    def photos(self) -> list[str]:
        """The photographs of rows of finished runs, as their lists named them."""
        columns = [json.loads(line).get("columns", {}) for _, line in self._rows.values()]
        cells = [cell for row in columns for cell in row.items()]
        return [photo.strip() for column, photo in cells if column.strip().lower() == "photo"]

    def append(self, row: Row) -> None:
        """Put a row on disk; numbers that are not finite become null. :class:`OutputError` if this
        fails."""
        line = _line(row)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self._repaired and self.path.is_file():  # remove a line that was cut short
                os.truncate(self.path, self.path.read_bytes().rfind(b"\n") + 1)
            self._repaired = True
            with self.path.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(
                f"{self.path}: cannot be written ({error.strerror}); free space, run again"
            ) from error
        self._add(line)

    def rewrite(self, rows: Iterable[Row]) -> None:
        """Replace ``results.jsonl`` by ``rows``; thumbnails that belong to none of them go."""
        lines = []
        kept = set()
        for row in rows:
            lines.append(_line(row))
            kept.add(thumbnail_path(self.folder, row["digests"]))
        write_file(self.path, b"".join(lines))
        for path in (self.folder / THUMBNAILS).glob("*.jpg"):
            if _DIGEST.fullmatch(path.stem) and path not in kept:
                with suppress(OSError):
                    path.unlink()

    def sort(self, keys: Sequence[str]) -> None:
        """Write one row of each key: first of these keys in their order, then of others."""
        self.rewrite(map(self.read, dict.fromkeys((*keys, *self._rows))))

    def _add(self, line: bytes) -> None:
        try:
            row = json.loads(line)
            self._rows[str(row["key"])] = dict(row["digests"]), line
        except (ValueError, KeyError, TypeError, RecursionError):
            message = (
                f"{self.path}: not results of this command; move it away, or choose another folder"
            )
            raise InvalidInputError(message, kind="out") from None


def _line(row: Row) -> bytes:
    return (json.dumps(finite(row), allow_nan=False) + "\n").encode()
