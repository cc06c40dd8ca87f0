"""The results of a list as tables: CSV, and the format of the BOP challenge."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from ...data import BOPRow, write_bop_csv
from ...utils.choices import UNITS
from ...utils.files import write_csv
from ..bop import bop_row
from ..store import Row

__all__ = ["BEST_MESH", "POSE_COLUMNS", "RESULT_COLUMNS", "write_bop_results", "write_results"]

POSE_COLUMNS = (*("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"), *("tx", "ty", "tz"))
"""Columns of a pose: the rotation row by row, and the translation."""

RESULT_COLUMNS = ("status", "message", "confidence", "reliable", *POSE_COLUMNS)
"""Columns of ``results.csv`` after those of the list."""

BEST_MESH = "found_mesh"
"""A last column, if rows have several meshes: the best of them."""

_BOP_NUMBERS = ("scene_id", "im_id", "obj_id")


def write_results(path: Path, columns: Sequence[str], rows: Iterable[Row], *, best_mesh: bool) -> None:
    """Write all rows: the cells of the list, which are their ``columns``, results, and :data:`BEST_MESH` if wanted."""
    lines = [[*columns, *RESULT_COLUMNS, BEST_MESH]]
    lines += [[*row["columns"].values(), *_result_cells(row), row.get("mesh", "")] for row in rows]
    write_csv(path, lines if best_mesh else [line[:-1] for line in lines])


def _result_cells(row: Row) -> list[str]:
    if row["status"] != "ok":
        return [row["status"], row["message"], "", "false", *[""] * 12]
    rotation = [v for line in row["rotation"] for v in line]
    translation = row["translation"] or [""] * 3
    reliable = "true" if row["reliable"] else "false"
    message = "; ".join(row["warnings"])
    return [
        "ok",
        message,
        "" if row["confidence"] is None else str(row["confidence"]),
        reliable,
        *map(str, rotation),
        *map(str, translation),
    ]


def write_bop_results(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write the poses that have a translation, in mm; nothing for a list without scene, image and object numbers."""
    if not set(_BOP_NUMBERS) <= set(columns):
        return
    poses: list[BOPRow] = []
    for row in rows:
        numbers = [row["columns"][name] for name in _BOP_NUMBERS]
        if row["status"] != "ok" or row["translation"] is None or not all(map(str.isdecimal, numbers)):
            continue
        millimetres = UNITS[row["unit"] or "m"] / UNITS["mm"]
        poses.append(bop_row([*map(int, numbers)], row["confidence"] or 0.0, row, scale=millimetres))
    write_bop_csv(path, poses)
