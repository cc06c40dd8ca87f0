"""Results of a BOP scene in the challenge's own format."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ...data import BOPRow, write_bop_csv
from ...utils.choices import UNITS

__all__ = ["write_bop_results"]

_NUMBERS = ("scene_id", "im_id", "obj_id")


def write_bop_results(
    path: Path, columns: Sequence[str], rows: Iterable[tuple[Sequence[str], Mapping[str, Any]]]
) -> bool:
    """Write the poses with a translation, in mm; False and nothing for a list that does not name scene, image, object.

    Args:
        path: the file.
        columns: of the list.
        rows: cells and record of each row.
    """
    if not set(_NUMBERS) <= set(columns):
        return False
    poses: list[BOPRow] = []
    for cells, record in rows:
        given = dict(zip(columns, cells, strict=True))
        if record["status"] != "ok" or record["translation"] is None or not all(given[n].isdecimal() for n in _NUMBERS):
            continue
        scene_id, im_id, obj_id = (int(given[name]) for name in _NUMBERS)
        millimetres = UNITS[record["unit"] or "m"] / UNITS["mm"]
        poses.append(
            {
                "scene_id": scene_id,
                "im_id": im_id,
                "obj_id": obj_id,
                "score": record["confidence"],
                "R": torch.tensor(record["rotation"], dtype=torch.float64),
                "t": torch.tensor(record["translation"], dtype=torch.float64) * millimetres,
                "time": -1.0,
            }
        )
    write_bop_csv(path, poses)
    return True
