"""What boxes of the visible part cost, and what is gained where the registrar is told so.

    python scripts/calibration/visible_boxes.py /data/shelves [--jobs 2]

FOLDER is made by scripts/benchmark/make.py. Objects of which something hides a part are registered
in the box of the whole object, and in that of their visible part, with and without ``box_is``
"visible"; fully visible ones in their box, with and without it. Half of the meshes lose their
colours. Rows are kept in FOLDER/visible_boxes.jsonl, meshes with most photographs first; an
interrupted run can be resumed. The table is written to scripts/results/visible_boxes.json.
"""

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Sequence
from copy import copy
from pathlib import Path

import torch
from scipy.stats import binomtest

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from scripts._shared import RESULTS, commit, today, write_json
from scripts.calibration.measure import Row, errors_of, measured, mesh_of, symmetries_of

# Fractions of an object that are visible
HIDDEN = (0.4, 0.8)
FULL = (0.99, 1.01)
GROUPS = {".4 to .6": (0.4, 0.6), ".6 to .8": (0.6, 0.8), ".4 to .8": HIDDEN, "all": FULL}
# name: kind of the given box, what the registrar is told, and the objects
WAYS = {
    "whole": ("box", "whole", (HIDDEN, FULL)),
    "visible, not told": ("box_visible", "whole", (HIDDEN,)),
    "visible, told": ("box_visible", "visible", (HIDDEN,)),
    "whole, told visible": ("box", "visible", (FULL,)),
}
PAIRS = (
    ("visible, told", "visible, not told"),
    ("visible, told", "whole"),
    ("whole, told visible", "whole"),
)
WITHIN = (15.0, 30.0)  # degrees


def is_within(row: Row, limits: Sequence[float]) -> bool:
    low, high = limits
    return low <= float(row["visib_fract"]) < high


def measure(task: tuple[Path, list[int]]) -> list[Row]:
    """Rows of one mesh's photographs."""
    folder, indices = task
    torch.set_num_threads(1)
    data = BOPDataset(folder)
    samples = [data[i] for i in indices]
    mesh = mesh_of(samples[0]["model_path"], grey=samples[0]["obj_id"] % 2 == 0)
    registrar = cr.Registrar(mesh)
    symmetries = symmetries_of(samples[0], registrar)
    images = [sample["image"] for sample in samples]
    cameras = torch.stack([sample["camera_matrix"].double() for sample in samples])
    rows: list[Row] = [{"visib_fract": float(sample["visib_fract"])} for sample in samples]
    registrar(images[:1], samples[0]["box"][None], cameras[:1])  # what is computed once
    for way, (box, box_is, groups) in WAYS.items():
        some = [k for k, row in enumerate(rows) if any(is_within(row, one) for one in groups)]
        if not some:
            continue
        told = copy(registrar)
        told.pipeline = registrar.pipeline.with_boxes(box_is)
        boxes = torch.stack([samples[k][box] for k in some]).float()
        begun = time.process_time()
        results = told([images[k] for k in some], boxes, cameras[some])
        seconds = (time.process_time() - begun) / len(some)
        for k, result in zip(some, results, strict=True):
            error = 180.0
            reliable = False
            if result.ok:
                error = float(errors_of(result.rotation[None], samples[k], symmetries)[0])
                reliable = bool(result.reliable)
            rows[k][way] = {"error": error, "reliable": reliable, "seconds": seconds}
    return rows


def table_of(rows: Sequence[Row]) -> Row:
    """Counts and fractions of each way, and sign tests of those told against those not told."""
    table: Row = {"objects": len(rows)}
    for way in WAYS:
        found = [row[way] for row in rows if way in row]
        if not found:
            continue
        sure = [one for one in found if one["reliable"]]
        line: Row = {
            f"within {degrees:g}": sum(one["error"] < degrees for one in found) / len(rows)
            for degrees in WITHIN
        }
        line |= {"reliable": len(sure)}
        line |= {"reliable and wrong": sum(one["error"] >= WITHIN[-1] for one in sure)}
        line |= {"seconds": sum(one["seconds"] for one in found) / len(rows)}
        table[way] = line
    for told, before in PAIRS:
        for degrees in WITHIN if {told, before} <= table.keys() else ():
            right = [[row[way]["error"] < degrees for way in (told, before)] for row in rows]
            won = sum(a and not b for a, b in right)
            lost = sum(b and not a for a, b in right)
            p = float(binomtest(won, won + lost).pvalue) if won + lost else 1.0
            table[told] |= {f"won, lost, p within {degrees:g}, beside {before}": [won, lost, p]}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER")
    parser.add_argument("--full", type=int, default=4, help="of n fully visible ones, one is taken")
    parser.add_argument("--meshes", type=int, help="of each folder; default: all")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    rows = []
    for folder in options.folders:
        data = BOPDataset(folder)
        of_mesh = defaultdict(list)
        for i in range(len(data)):
            known = data.annotation(i)
            is_taken = is_within(known, FULL) and i % options.full == 0
            if is_within(known, HIDDEN) or is_taken:
                of_mesh[int(known["obj_id"])].append(i)
        many_first = sorted(of_mesh.items(), key=lambda item: (-len(item[1]), item[0]))
        chosen = many_first[: options.meshes]
        tasks = [([obj_id, few], (folder, few)) for obj_id, few in chosen]
        kept = folder / "visible_boxes.jsonl"
        rows += measured(kept, tasks, measure, options.jobs, folder.name)
    record: Row = {"date": today(), "commit": commit(), "folders": len(options.folders)}
    for name, limits in GROUPS.items():
        if some := [row for row in rows if is_within(row, limits)]:
            record[name] = table_of(some)
    print(json.dumps(record, indent=2))
    write_json(RESULTS / "visible_boxes.json", record)


if __name__ == "__main__":
    main()
