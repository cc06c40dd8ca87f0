"""Sets of generated photographs that confidences are fitted on: sets.json."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from scripts._shared import REPOSITORY, read_json

SCENES_PER_MESH = 2.0


class PhotoSet(NamedTuple):
    """A set of generated photographs.

    Attributes:
        scenes: their number, as a fraction of --count.
        make: options of make.py.
        photographs: the set whose photographs it has; its cameras are withheld and estimated.
        model: that is fitted on it.
        share: assumed for the photographs that users have; sets without one have the rest, each
            photograph the same weight.
        grey: every n-th mesh loses its colours.
        upright: half of the objects stand upright.
        absent: the photographs do not show the mesh: no pose is right.
        misleads: kinds of misleading.py that it serves.
    """

    scenes: float = 0.0
    make: str = ""
    photographs: str | None = None
    model: str = "instance"
    share: float | None = None
    grey: int | None = None
    upright: bool = False
    absent: bool = False
    misleads: Sequence[str] = ()


LISTED = read_json(Path(__file__).with_suffix(".json"))
SETS = {name: PhotoSet(**values) for name, values in LISTED.items()}

MODELS = {
    "instance": [name for name, each in SETS.items() if each.model == "instance"],
    "category": [name for name, each in SETS.items() if each.model == "category"],
    "refinement": ["shapes"],
    "tracking": ["sequences"],
    "detection": ["shapes"],
}
"""Of each model: the sets that it is fitted on."""

KINDS = {"refinement": "refined", "tracking": "sequences", "detection": "detected"}
"""Of each model that is not of registrations: what is measured."""


def set_of(kind: str) -> PhotoSet:
    """The set of its name; what is measured of refinement and detection is so on shapes."""
    return SETS.get(kind, PhotoSet(photographs="shapes"))


def photographs_of(kind: str) -> str:
    """The set that has the photographs."""
    return set_of(kind).photographs or kind


def sets_of(models: Sequence[str], meshes: Path | None) -> list[str]:
    """Sets of the models, without those of furniture where there is none."""
    names = list(dict.fromkeys(name for model in models for name in MODELS[model]))
    if meshes is not None:
        return names
    return [name for name in names if "furniture" not in SETS[name].make]


def render_sets(
    work: Path,
    meshes: Path | None,
    count: int,
    jobs: int,
    models: Sequence[str],
) -> None:
    """Render the sets of ``models`` that ``work`` lacks; finished scenes are kept."""
    for name in dict.fromkeys(map(photographs_of, sets_of(models, meshes))):
        own = SETS[name]
        scenes = max(1, round(own.scenes * count))
        words: list[Any] = ["--out", work / name, "--count", scenes, "--jobs", jobs]
        words += ["--models", max(16, round(scenes / SCENES_PER_MESH)), *own.make.split()]
        if "furniture" in own.make:
            words += ["--meshes", meshes]
        command = [sys.executable, REPOSITORY / "scripts" / "benchmark" / "make.py", *words]
        subprocess.run([str(word) for word in command], check=True)
