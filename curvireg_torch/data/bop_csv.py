"""Results files of the BOP challenge: one line per pose estimate."""

import csv
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypedDict

import torch
from torch import Tensor

from ..errors import InvalidInputError, MissingFileError
from ..utils.checks import check_tensor
from ..utils.files import write_csv
from ..utils.json_files import check_table_size, finite_numbers

_HEADER = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]


class BOPRow(TypedDict):
    """A pose estimate: R (3, 3) and t (3,), mm, take model points into the OpenCV camera; time in seconds or -1."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    R: Tensor
    t: Tensor
    time: float


def write_bop_csv(path: str | os.PathLike[str], rows: Iterable[BOPRow]) -> None:
    """Write pose estimates in the format of the BOP challenge, atomically and with all digits.

    Columns: scene_id, im_id, obj_id, score, R (9 numbers, row by row, separated by spaces), t (3 numbers, mm), time
    (seconds for the whole image, so equal for all its rows; -1 if unknown).

    Raises:
        InvalidInputError: a row lacks a key, is not finite, or disagrees on an image's time.
        MissingFileError: the folder does not exist.
        OutputError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> row = BOPRow(scene_id=1, im_id=2, obj_id=3, score=0.5, R=torch.eye(3), t=torch.zeros(3), time=-1.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_bop_csv(Path(folder, "results.csv"), [row])
        ...     read_bop_csv(Path(folder, "results.csv"))[0]["score"]
        0.5
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise MissingFileError("no such folder; create it before writing results", subject=path.parent)
    times: dict[tuple[int, int], float] = {}
    write_csv(path, [_HEADER, *(_cells(row, f"row {number}", times) for number, row in enumerate(rows))])


def _cells(row: BOPRow, name: str, times: dict[tuple[int, int], float]) -> list[str]:
    if set(row) != set(_HEADER):
        raise InvalidInputError(f"expected the keys {', '.join(_HEADER)}, got {', '.join(row)}", subject=name)
    check_tensor(row["R"], f"{name} R", (3, 3))
    check_tensor(row["t"], f"{name} t", (3,))
    ids = [row["scene_id"], row["im_id"], row["obj_id"]]
    R, t = row["R"].flatten().tolist(), row["t"].tolist()
    if any(isinstance(i, bool) or not isinstance(i, int) or i < 0 for i in ids):
        raise InvalidInputError(f"expected integer ids >= 0, got {ids}", subject=name)
    numbers = finite_numbers([row["score"], *R, *t, row["time"]], 14)
    if numbers is None:
        raise InvalidInputError("score, R, t and time must be finite numbers", subject=name)
    _check_time(row, times, name)
    texts = [repr(v) for v in numbers]
    return [*map(str, ids), texts[0], " ".join(texts[1:10]), " ".join(texts[10:13]), texts[13]]


def _check_time(row: BOPRow, times: dict[tuple[int, int], float], name: str) -> None:
    first = times.setdefault((row["scene_id"], row["im_id"]), row["time"])
    if first != row["time"]:
        raise InvalidInputError(
            f"time {row['time']}, but an earlier row of this image has {first}; BOP requires one", subject=name
        )


def read_bop_csv(path: str | os.PathLike[str]) -> list[BOPRow]:
    """Read a results file of the BOP challenge; R and t are float64.

    Raises:
        MissingFileError: the file does not exist.
        InvalidInputError: another header, or a line with a wrong number of values or one that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError("no such file; write_bop_csv writes one", subject=path)
    check_table_size(path)
    rows: list[BOPRow] = []
    times: dict[tuple[int, int], float] = {}
    try:
        with open(path, newline="", encoding="utf-8") as file:
            lines: Any = csv.reader(file)
            if next(lines, None) != _HEADER:
                raise InvalidInputError(f"expected the header {','.join(_HEADER)}", subject=path)
            for cells in lines:
                if cells:
                    rows.append(_row(cells, f"{path}, line {lines.line_num}"))
                    _check_time(rows[-1], times, f"{path}, line {lines.line_num}")
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"not a csv file ({error})", subject=path) from error
    return rows


def _row(cells: list[str], name: str) -> BOPRow:
    if len(cells) != len(_HEADER):
        raise InvalidInputError(f"expected {len(_HEADER)} columns, got {len(cells)}", subject=name)
    try:
        scene_id, im_id, obj_id = (int(c) for c in cells[:3])
        score, time = float(cells[3]), float(cells[6])
        R, t = ([float(v) for v in cell.split()] for cell in cells[4:6])
    except ValueError as error:
        raise InvalidInputError(str(error), subject=name) from error
    if len(R) != 9 or len(t) != 3 or not all(map(math.isfinite, (score, time, *R, *t))):
        raise InvalidInputError(f"expected 9 finite numbers in R and 3 in t, got {len(R)} and {len(t)}", subject=name)
    pose = torch.tensor([*R, *t], dtype=torch.float64)
    rotation, position = pose[:9].view(3, 3), pose[9:]
    return BOPRow(scene_id=scene_id, im_id=im_id, obj_id=obj_id, score=score, R=rotation, t=position, time=time)
