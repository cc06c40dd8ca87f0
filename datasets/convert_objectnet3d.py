"""Arrange ObjectNet3D like PASCAL3D+, so that Pascal3DPlus(..., part="imagenet") can read it.

    python datasets/convert_objectnet3d.py OBJECTNET3D OUT [--splits train val]

ObjectNet3D has one folder for all annotations and one for all photographs; PASCAL3D+ has one per
class. Files are hard- linked if the file system allows it, and copied otherwise; the source is not
changed. An image of several classes appears under each of them.

Input in OBJECTNET3D: Annotations/<id>.mat, Images/<id>.JPEG, Image_sets/<split>.txt,
CAD/off/<class>/<NN>.off or CAD/<class>/<NN>.off.
Exit code 0: all ids of the lists were found. 1: some are missing. 2: not an ObjectNet3D tree.
"""

import argparse
import os
import shutil
import sys
from collections import Counter
from pathlib import Path

from curvireg_torch.data._base import is_plain_name
from curvireg_torch.data.mat_files import MatStruct, objects_of, read_mats


def place(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def classes_of(objects: list[MatStruct]) -> set[str]:
    names = {entry.get("class") for entry in objects if not isinstance(entry.get("class"), list)}
    return {name for name in names if isinstance(name, str) and is_plain_name(name)}


def convert_split(root: Path, out: Path, split: str) -> Counter[str]:
    """Convert one split; returns the numbers of placed images and of missing or corrupt files."""
    counts: Counter[str] = Counter()
    lists: dict[str, list[str]] = {}
    found = []
    for image_id in (root / "Image_sets" / f"{split}.txt").read_text(encoding="utf-8").split():
        annotation = root / "Annotations" / f"{image_id}.mat"
        image = root / "Images" / f"{image_id}.JPEG"
        if not is_plain_name(image_id) or not annotation.is_file():
            counts["missing_annotation"] += 1
        elif not image.is_file():
            counts["missing_image"] += 1
        else:
            found.append((image_id, annotation, image))
    records = read_mats([annotation for _, annotation, _ in found], "record")
    for (image_id, annotation, image), record in zip(found, records, strict=True):
        objects = objects_of(record)
        if objects is None:
            counts["corrupt_annotation"] += 1
            continue
        for name in sorted(classes_of(objects)):
            place(annotation, out / "Annotations" / f"{name}_imagenet" / annotation.name)
            place(image, out / "Images" / f"{name}_imagenet" / image.name)
            lists.setdefault(name, []).append(image_id)
        counts["placed"] += 1
    (out / "Image_sets").mkdir(parents=True, exist_ok=True)
    for name, ids in lists.items():
        (out / "Image_sets" / f"{name}_imagenet_{split}.txt").write_text("\n".join(ids) + "\n")
    return counts


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, metavar="OBJECTNET3D")
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--splits", nargs="+", default=["train", "val"])
    options = parser.parse_args(arguments)
    cads = options.root / "CAD" / "off"
    if not cads.is_dir():
        cads = options.root / "CAD"
    needed = [cads, *(options.root / "Image_sets" / f"{split}.txt" for split in options.splits)]
    if absent := [str(path) for path in needed if not path.exists()]:
        print(
            f"not an ObjectNet3D tree: no {', '.join(absent)}; see datasets/objectnet3d/README.md",
            file=sys.stderr,
        )
        return 2
    total: Counter[str] = Counter()
    for split in options.splits:
        counts = convert_split(options.root, options.out, split)
        print(
            f"{split}: "
            + ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        )
        total += counts
    for cad in sorted(cads.glob("*/*.off")):
        place(cad, options.out / "CAD" / cad.parent.name / cad.name)
    return 1 if set(total) - {"placed"} else 0


if __name__ == "__main__":
    sys.exit(main())
