"""Predictions on disk: a folder with one small file per object and the settings that made them."""

import json
import math
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ..errors import InvalidInputError, OutputError
from ..utils.files import write_file

__all__ = ["PredictionStore", "write_text"]

Row = dict[str, Any]


def write_text(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_file(path, text.encode())


def plain(value: Any) -> Any:
    """``value`` with every number that JSON cannot write (NaN, infinity) replaced by None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any) -> str:
    return json.dumps(plain(value), indent=2, allow_nan=False) + "\n"


class PredictionStore:
    """The predictions of one evaluation, in ``folder``.

    Every object has a file of its own, written beside and renamed, so that a killed run loses the object it was at and
    nothing else, several processes may write at once, and no object is there twice. ``settings.json`` keeps what the
    predictions depend on.

    Args:
        folder: is made if it is not there.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     store = PredictionStore(Path(folder, "predictions"))
        ...     store.open({"preset": "default"})
        ...     store.write("car/1 #0", {"score": 0.5})
        ...     "car/1 #0" in store, store.read("car/1 #0")
        (True, {'score': 0.5})
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def open(self, settings: Row, *, overwrite: bool = False) -> None:
        """Start with ``settings``, or go on with them.

        Args:
            settings: plain values.
            overwrite: remove what is there and start anew.

        Raises:
            InvalidInputError: the folder holds predictions of other settings.
            OutputError: it cannot be written to.
        """
        path = self.folder / "settings.json"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be made ({error.strerror}); choose another --out") from error
        if overwrite:
            path.unlink(missing_ok=True)  # first: rows without settings are refused, should this be killed
            for row in self.folder.glob("*.json"):
                row.unlink()
        elif path.is_file():
            before = _read(path)
            if before != plain(settings):
                raise InvalidInputError(
                    f"{self.folder}: made with other settings ({_difference(before, plain(settings))}); "
                    "choose another --out, or give --overwrite to start anew"
                )
            return
        elif any(self.folder.glob("*.json")):
            raise InvalidInputError(
                f"{self.folder}: predictions of unknown settings; choose another --out or --overwrite"
            )
        write_text(path, to_json(settings))

    def __contains__(self, key: str) -> bool:
        return self._path(key).is_file()

    def write(self, key: str, row: Row) -> None:
        """Put the prediction of the object ``key`` on disk; values that are not finite become None."""
        write_text(self._path(key), json.dumps(plain(row), allow_nan=False) + "\n")

    def read(self, key: str) -> Row:
        """The prediction of the object ``key``.

        Raises:
            InvalidInputError: the file is not there or damaged.
        """
        return _read(self._path(key))

    def _path(self, key: str) -> Path:
        return self.folder / f"{quote(key, safe='')}.json"  # reversible: no two keys share a file


def _read(path: Path) -> Row:
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path}: missing or damaged ({error}); remove it and run again") from error
    if not isinstance(row, dict):
        raise InvalidInputError(f"{path}: expected a JSON object; remove it and run again")
    return row


def _difference(before: Row, now: Row) -> str:
    names = sorted(n for n in {*before, *now} if before.get(n) != now.get(n))
    return ", ".join(f"{n}: {before.get(n)!r} there, {now.get(n)!r} now" for n in names)
