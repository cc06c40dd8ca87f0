"""MATLAB 5 annotation files, read by SciPy in a process of its own: a damaged one can end it, or
take all memory."""

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from ..errors import MAX_MAT_BYTES, WorkerError
from ..utils.programs import run_program

MatStruct = dict[str, "MatValue"]
MatValue = list[MatStruct] | list[float] | str | None
"""A struct array, real numbers in MATLAB's column order, a text, or None for any other type."""

FILES_OF_A_PROCESS = 1000
_PROGRAM = Path(__file__).with_name("mat_values.py")


def read_mats(paths: Sequence[Path], variable: str) -> Iterator[MatValue]:
    """The value of ``variable`` in each file; None if it is damaged, of another version than 5 to
    7.2, of more than ``MAX_MAT_BYTES``, or has no such variable.

    Raises:
        WorkerError: SciPy does not start in a process of its own.
    """
    names = list(map(str, paths))
    with tempfile.TemporaryDirectory() as folder:
        asked = Path(folder, "asked.json")
        found = Path(folder, "found.jsonl")
        while names:
            some = names[:FILES_OF_A_PROCESS]
            asked.write_text(json.dumps([variable, MAX_MAT_BYTES, *some]))
            found.unlink(missing_ok=True)
            with suppress(ValueError):  # too long, or too much memory
                run_program(
                    _PROGRAM,
                    [str(asked), str(found)],
                    name="SciPy",
                    advice="",
                )
            if not found.exists():  # else each file would count as damaged
                raise WorkerError(
                    "SciPy, which reads MATLAB files in a process of its own, does not start there"
                )
            lines = found.read_bytes().splitlines(keepends=True)
            values = [json.loads(line) for line in lines if line.endswith(b"\n")]
            if not values:  # the first one ended the process; another is tried again as the first
                values.append(None)
            yield from values
            del names[: len(values)]


def objects_of(record: MatValue) -> list[MatStruct] | None:
    """The annotated objects of a file's ``record``; None if it is no such record."""
    first = record[0] if isinstance(record, list) and record else None
    objects = first.get("objects") if isinstance(first, dict) else None
    if not isinstance(objects, list):
        return None
    structs = [entry for entry in objects if isinstance(entry, dict)]
    return structs if len(structs) == len(objects) else None
