"""The results of a list as tables: CSV, and the format of the BOP challenge."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch

from ...data import BOPRow, write_bop_csv
from ...utils.choices import UNITS
from ...utils.files import write_file
from ..store import Row

__all__ = ["BEST_MESH", "RESULT_COLUMNS", "write_bop_results", "write_results"]

RESULT_COLUMNS = (
    *("status", "message", "confidence", "reliable"),
    *("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"),
    *("tx", "ty", "tz"),
)
"""Columns of ``results.csv`` after those of the list."""

BEST_MESH = "found_mesh"
"""A last column, if rows have several meshes: the best of them."""

_BOP_NUMBERS = ("scene_id", "im_id", "obj_id")


def write_results(path: Path, columns: Sequence[str], rows: Iterable[Row], *, best_mesh: bool) -> None:
    """Write the table of all rows.

    Args:
        path: of the table.
        columns: of the list.
        rows: results, with the cells of the list as ``columns``.
        best_mesh: add the column :data:`BEST_MESH`.
    """
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([*columns, *RESULT_COLUMNS, *[BEST_MESH][: int(best_mesh)]])
    for row in rows:
        writer.writerow([*row["columns"].values(), *_result_cells(row), *[row.get("mesh", "")][: int(best_mesh)]])
    write_file(path, table.getvalue().encode())


def _result_cells(row: Row) -> list[str]:
    if row["status"] != "ok":
        return [row["status"], row["message"], "", "false", *[""] * 12]
    rotation = [v for line in row["rotation"] for v in line]
    translation = row["translation"] or [""] * 3
    reliable = "true" if row["reliable"] else "false"
    return ["ok", "", str(row["confidence"]), reliable, *map(str, rotation), *map(str, translation)]


def write_bop_results(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write the poses that have a translation, in mm; nothing for a list without scene, image and object numbers.

    Args:
        path, columns, rows: as for :func:`write_results`.
    """
    if not set(_BOP_NUMBERS) <= set(columns):
        return
    poses: list[BOPRow] = []
    for row in rows:
        numbers = [row["columns"][name] for name in _BOP_NUMBERS]
        if row["status"] != "ok" or row["translation"] is None or not all(map(str.isdecimal, numbers)):
            continue
        scene_id, im_id, obj_id = map(int, numbers)
        millimetres = UNITS[row["unit"] or "m"] / UNITS["mm"]
        poses.append(
            {
                "scene_id": scene_id,
                "im_id": im_id,
                "obj_id": obj_id,
                "score": row["confidence"],
                "R": torch.tensor(row["rotation"], dtype=torch.float64),
                "t": torch.tensor(row["translation"], dtype=torch.float64) * millimetres,
                "time": -1.0,
            }
        )
    write_bop_csv(path, poses)
