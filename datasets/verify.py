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

from torch.utils.data import Dataset

from curvireg_torch.data import read_image
from curvireg_torch.errors import CurviregError
from curvireg_torch.evaluation.registry import DATASETS, DatasetSpec

DEFECTS = ("missing_", "corrupt_", "bad_")


def unreadable(dataset: Dataset) -> list[str]:
    """Errors of the photographs that cannot be decoded."""
    problems = []
    for path in sorted({dataset.annotation(i)["image_path"] for i in range(len(dataset))}):
        try:
            read_image(path)
        except CurviregError as error:
            problems.append(str(error))
    return problems


def report(dataset: Dataset, kind: DatasetSpec, images: bool, show: int) -> int:
    samples = [dataset.annotation(i) for i in range(len(dataset))]
    counts = Counter(kind.category.format_map(s) for s in samples)
    print(f"{len(samples)} objects in {len({s['image_path'] for s in samples})} photographs")
    for name, count in sorted(counts.items()):
        print(f"  {name}: {count}")
    skipped = dict(dataset.skipped_items)
    if images:
        skipped |= {"corrupt_image": found} if (found := unreadable(dataset)) else {}
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
