"""Check a dataset tree against its layout and report defects.

    python datasets/verify.py pascal3d ROOT [--split val] [--part pascal] [--categories car sofa]
    python datasets/verify.py bop ROOT [--split test]
    python datasets/verify.py web ROOT

Exit code 0: no defects. 1: usable with defects (missing, corrupt or bad items, which the library
skips). 2: unusable.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from curvireg_torch.data import read_image
from curvireg_torch.data.bop_models import model_files
from curvireg_torch.errors import CurviregError
from curvireg_torch.evaluation.bop import read_points
from curvireg_torch.evaluation.registry import DATASETS, DatasetSpec
from curvireg_torch.mesh import load_mesh

DEFECTS = ("missing_", "corrupt_", "bad_")


def unreadable(paths: Iterable[str | Path], read: Callable[[str | Path], Any]) -> list[str]:
    """Errors of the files that cannot be read."""
    problems = []
    for path in sorted(paths):
        try:
            read(path)
        except CurviregError as error:
            problems.append(str(error))
    return problems


def report(dataset: Dataset, kind: DatasetSpec, images: bool, show: int) -> int:
    samples = [dataset.annotation(i) for i in range(len(dataset))]
    counts = Counter(kind.category.format_map(s) for s in samples)
    photographs = {s["image_path"] for s in samples}
    print(f"{len(samples)} objects in {len(photographs)} photographs")
    for name, count in sorted(counts.items()):
        print(f"  {name}: {count}")
    meshes = {s[kind.scored.mesh] for s in samples}
    scored = model_files(dataset.root / "models_eval").values()  # of a BOP set
    found = {
        **dataset.skipped_items,
        "corrupt_image": unreadable(photographs if images else (), read_image),
        "corrupt_mesh": unreadable(meshes, partial(load_mesh, unit=kind.scored.unit))
        + unreadable(scored, read_points),
    }
    skipped = {reason: items for reason, items in found.items() if items}
    for reason, items in sorted(skipped.items()):
        defect = reason.startswith(DEFECTS)
        print(f"{'defect' if defect else 'left out'}, {reason}: {len(items)}")
        for item in items[: show if defect else 0]:
            print(f"  {item}")
    if not samples:
        return 2
    return 1 if any(reason.startswith(DEFECTS) for reason in skipped) else 0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(required=True, metavar=f"{{{','.join(DATASETS)}}}")
    for name, kind in DATASETS.items():
        command = kinds.add_parser(name)
        kind.add_arguments(command)
        command.add_argument(
            "--images", action="store_true", help="also decode every photograph (slow)"
        )
        command.add_argument(
            "--show", type=int, default=5, help="number of items to list for each defect"
        )
        command.set_defaults(kind=kind)
    options = parser.parse_args(arguments)
    try:
        dataset = options.kind.open(options.root, **options.kind.chosen(options))
        return report(dataset, options.kind, options.images, options.show)
    except CurviregError as error:
        print(error, file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
