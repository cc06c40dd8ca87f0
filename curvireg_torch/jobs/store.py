"""Results on disk: JSON lines that several processes append to; and these processes."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch.distributed as dist

from ..errors import InvalidInputError, OutputError
from ..utils.files import write_file

Row = dict[str, Any]
T = TypeVar("T")


def has_pose(row: Mapping[str, Any]) -> bool:
    """Whether the photograph of a row has a pose, whatever the verdict on it."""
    return row["verdict"] not in ("lost", "failed")


@dataclass(frozen=True)
class Workers:
    """This process is number ``rank`` of the ``size`` ones that share an evaluation or a list; 0
    writes the tables."""

    rank: int = 0
    size: int = 1

    def wait(self) -> None:
        """Wait for all processes."""
        if self.size > 1:
            dist.barrier()

    def part(self, items: Sequence[T]) -> Sequence[T]:
        """The items of this process: neighbours stay together."""
        n = len(items)
        return items[self.rank * n // self.size : (self.rank + 1) * n // self.size]


@contextmanager
def workers() -> Iterator[Workers]:
    """The processes that ``torchrun`` started, or this one alone."""
    if not (dist.is_available() and dist.is_torchelastic_launched()):
        yield Workers()
        return
    # Parts differ in cost, and the first process to finish waits for the last.
    dist.init_process_group("gloo", timeout=timedelta(days=7))
    try:
        yield Workers(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


STARTED = "CURVIREG_JOBS"  # environment variable of the processes that :func:`run_processes` starts


def is_one_of_several() -> bool:
    """Whether this is one of the processes that ``torchrun`` started."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def run_processes(count: int, words: Sequence[str]) -> bool:
    """Run ``curvireg WORDS`` in ``count`` processes; False if ``count`` is 1, or this is one of
    those processes."""
    if count <= 1 or is_one_of_several():
        return False
    torchrun = [
        sys.executable,
        "-m",
        "curvireg_torch.jobs.launch",
        "--standalone",
        "--nproc-per-node",
        str(count),
    ]
    environment = {"OMP_NUM_THREADS": "1", **os.environ, STARTED: str(count)}
    done = subprocess.run([*torchrun, "-m", "curvireg_torch", *words], env=environment, check=False)
    if done.returncode:
        raise InvalidInputError(
            f"--jobs: a process ended with {done.returncode}; its message is above"
        )
    return True


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


class ResultStore:
    """One row for each entry, in ``results.jsonl`` of a folder.

    A row holds the ``key`` of its entry and ``digests`` of all that it depends on. It is synced to
    disk once it is known; a last line that was cut short is ignored, and removed before the next
    row. Each of several processes appends to ``results.RANK-of-SIZE.jsonl``; readers merge all
    files. Of several rows of one entry, the last one counts.

    Args:
        folder: created with the first row.
        workers: the processes that share the store.
    """

    def __init__(self, folder: Path, workers: Workers | None = None) -> None:
        workers = workers or Workers()
        self.folder = folder
        self.path = folder / "results.jsonl"
        part = f"results.{workers.rank}-of-{workers.size}.jsonl"
        self._output = self.path if workers.size == 1 else folder / part
        self._repaired = False
        self._read_files()

    def _read_files(self) -> None:
        """Read what is on disk, rows of other processes included."""
        self._rows: dict[str, list[tuple[Row, bytes]]] = {}
        for path in self._files():
            for line in path.read_bytes().splitlines(keepends=True):
                if line.endswith(b"\n"):  # else it was cut short
                    self._add(path, line)

    def is_current(self, key: str, digests: Mapping[str, str]) -> bool:
        """Whether there is a row of ``key`` that depends on exactly what ``digests`` describes, a
        readable photograph included; it is the one that :meth:`read` returns from now on."""
        return bool(digests["photo"]) and self._choose(key, digests)

    def is_complete(self, wanted: Mapping[str, Mapping[str, str]]) -> bool:
        """Whether all processes together have written a row of each key with these digests;
        :meth:`read` returns it."""
        self._read_files()
        return all(self._choose(key, digests) for key, digests in wanted.items())

    def _choose(self, key: str, digests: Mapping[str, str]) -> bool:
        """Make a row with these digests the last one of its key."""
        rows = self._rows.get(key, [])
        rows.sort(key=lambda row: row[0] == digests)
        return bool(rows) and rows[-1][0] == digests

    def read(self, key: str) -> Row:
        """The row of ``key``; :class:`InvalidInputError` if there is none."""
        if key not in self._rows:
            raise InvalidInputError(f"{self.folder}: no result for {key}; run again")
        row: Row = json.loads(self._rows[key][-1][1])
        return row

    def append(self, row: Row) -> None:
        """Put a row on disk; numbers that are not finite become null. :class:`OutputError` if this
        fails."""
        line = _line(row)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self._repaired and self._output.is_file():  # remove a line that was cut short
                os.truncate(self._output, self._output.read_bytes().rfind(b"\n") + 1)
            self._repaired = True
            with self._output.open("ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(
                f"{self._output}: cannot be written ({error.strerror}); free space, run again"
            ) from error
        self._add(self._output, line)

    def rewrite(self, rows: Iterable[Row]) -> None:
        """Replace ``results.jsonl`` by ``rows``."""
        write_file(self.path, b"".join(map(_line, rows)))

    def merge(self) -> None:
        """Move one row of each key into ``results.jsonl``; no other process may still be
        running."""
        self.rewrite(map(self.read, self._rows))
        for path in self._files()[1:]:
            path.unlink()

    def _files(self) -> list[Path]:
        """``results.jsonl`` first."""
        return [
            path
            for path in (self.path, *sorted(self.folder.glob("results.*-of-*.jsonl")))
            if path.is_file()
        ]

    def _add(self, path: Path, line: bytes) -> None:
        try:
            row = json.loads(line)
            self._rows.setdefault(str(row["key"]), []).append((dict(row["digests"]), line))
        except (ValueError, KeyError, TypeError, RecursionError):
            message = f"{path}: not results of this command; move it away, or choose another folder"
            raise InvalidInputError(message, kind="out") from None


def _line(row: Row) -> bytes:
    return (json.dumps(finite(row), allow_nan=False) + "\n").encode()
