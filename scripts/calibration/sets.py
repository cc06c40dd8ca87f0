"""Sets of generated photographs that confidences are fitted on."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scripts._shared import REPOSITORY

FURNITURE = ("--kind", "furniture", "--bare", "0.2")
SHAPES = ("--kind", "shapes")
PRINTED = ("--kind", "printed")
TIED = ("--kind", "tied")
CUT = ("--cut", "0.1", "0.6")
SETS: dict[str, tuple[float, tuple[str, ...]]] = {
    "furniture": (1.0, (*FURNITURE, "--cad", "exact")),
    "shapes": (1.0, (*SHAPES, "--seed", "101")),
    "packages": (0.5, (*PRINTED, "--seed", "102")),
    "shelves": (0.25, ("--kind", "shelf", "--objects", "6", "14", "--seed", "103")),
    "tied": (0.6, (*TIED, "--seed", "104")),
    "cut": (0.5, (*SHAPES, *CUT, "--seed", "105")),
    "cut_packages": (0.25, (*PRINTED, *CUT, "--seed", "106")),
    "print": (0.5, (*PRINTED, "--cad", "print", "--seed", "107")),
    "mirrored": (0.2, (*TIED, "--cad", "mirrored", "--seed", "108")),
    "wrong": (0.25, (*SHAPES, "--cad", "wrong", "--seed", "109")),
    "variant": (0.25, (*SHAPES, "--cad", "variant", "--seed", "112")),
    "furniture_similar": (1.0, (*FURNITURE, "--cad", "similar")),
    "similar": (1.0, (*SHAPES, "--cad", "similar", "--bare", "0.2", "--seed", "110")),
    "sequences": (0.1, (*SHAPES, "--frames", "30", "--seed", "111")),
}
"""Of each set: scenes, as a fraction of --count, and options of make.py."""

ESTIMATED = {
    "estimated_shapes": "shapes",
    "estimated_packages": "packages",
    "estimated_wrong": "wrong",
}
"""Sets whose camera is withheld and estimated, and those with the same photographs."""

SCENES_PER_MESH = 2.0

SHARES = {
    "tied": 0.05,
    "cut": 0.1,
    "cut_packages": 0.05,
    "print": 0.03,
    "mirrored": 0.01,
    "wrong": 0.05,
    "variant": 0.03,
    "estimated_wrong": 0.05,
}
"""Assumed shares of the photographs that users have; those of the other sets have the rest, each
the same weight."""

# sets whose photographs do not show the mesh: no pose is right
ABSENT = ("print", "mirrored", "wrong", "estimated_wrong")
# sets of which half stand upright
UPRIGHT = ("furniture", "shapes", "estimated_shapes", "furniture_similar", "similar", "sequences")
GREY = {
    "shapes": 3,
    "packages": 3,
    "shelves": 2,
    "cut": 3,
    "cut_packages": 3,
    "estimated_shapes": 3,
    "estimated_packages": 3,
}
"""Sets in which every n-th mesh loses its colours."""

MODELS = {
    "instance": (
        *("furniture", "shapes", "packages", "shelves", "tied", "cut", "cut_packages"),
        *("variant", *ABSENT),
        *("estimated_shapes", "estimated_packages"),
    ),
    "category": ("furniture_similar", "similar"),
    "refinement": ("shapes",),
    "tracking": ("sequences",),
    "detection": ("shapes",),
}
"""Of each model: the sets that it is fitted on."""

KINDS = {"refinement": "refined", "tracking": "sequences", "detection": "detected"}
"""Of each model that is not of registrations: what is measured."""


def sets_of(models: Sequence[str], meshes: Path | None) -> list[str]:
    """Sets of the models, without those of furniture where there is none."""
    names = dict.fromkeys(name for model in models for name in MODELS[model])
    if meshes is not None:
        return list(names)
    return [name for name in names if "furniture" not in SETS[photographs_of(name)][1]]


def photographs_of(name: str) -> str:
    """The set that has the photographs of a set."""
    return ESTIMATED.get(name, name)


def render_sets(
    work: Path, meshes: Path | None, count: int, jobs: int, models: Sequence[str]
) -> None:
    """Render the sets of ``models`` that ``work`` lacks; finished scenes are kept."""
    for name in dict.fromkeys(map(photographs_of, sets_of(models, meshes))):
        fraction, options = SETS[name]
        scenes = max(1, round(fraction * count))
        words: list[Any] = ["--out", work / name, "--count", scenes, "--jobs", jobs, *options]
        words += ["--meshes", meshes] if "furniture" in options else []
        words += ["--models", max(16, round(scenes / SCENES_PER_MESH))]
        command = [sys.executable, REPOSITORY / "scripts" / "benchmark" / "make.py", *words]
        subprocess.run([str(word) for word in command], check=True)
