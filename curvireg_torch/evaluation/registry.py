"""Datasets by name, for ``evaluate``, ``scripts/paper`` and ``datasets/verify.py``.

Nothing heavy is imported before a dataset is opened, so that the command line's help is fast.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pkgutil import resolve_name
from typing import Any

__all__ = ["DATASETS", "DatasetSpec"]


@dataclass(frozen=True)
class DatasetSpec:
    """A dataset, its benchmark, and what the command line says about it."""

    dataset: str  # "package.module:attribute" of an ObjectDataset
    benchmark: str  # the same of its Benchmark
    help: str
    root: str  # what ROOT must contain
    example: str  # of ROOT
    pose: str = "any"  # default of the protocol's pose
    category: str = "{category}"  # format of the name of a sample's group
    # of the class, as add_argument takes them
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # options for objects neither occluded nor truncated
    whole: Mapping[str, Any] = field(default_factory=dict)

    def add_arguments(self, parser: Any) -> None:
        """Add ROOT and the options to a parser."""
        parser.add_argument("root", metavar="ROOT", help=self.root)
        for name, how in self.options.items():
            parser.add_argument(f"--{name.replace('_', '-')}", **how)

    def chosen(self, arguments: Any) -> dict[str, Any]:
        """The parsed ``arguments`` that are options of the dataset."""
        return {name: getattr(arguments, name) for name in self.options}

    def open(self, root: str | PathLike[str], **options: Any) -> Any:
        """Open the dataset; :class:`CurviregError` if it does not exist, or an option is out of
        range."""
        return resolve_name(self.dataset)(root, **options)

    @property
    def scored(self) -> Any:
        """The benchmark's class."""
        return resolve_name(self.benchmark)


DATASETS: dict[str, DatasetSpec] = {
    "pascal3d": DatasetSpec(
        dataset="curvireg_torch.data:Pascal3DPlus",
        benchmark="curvireg_torch.evaluation:Pascal3DBenchmark",
        help="viewpoints on PASCAL3D+",
        root="folder with Annotations, Images and CAD",
        example="data/PASCAL3D+_release1.1",
        pose="upright",
        options={
            "split": {"default": "val", "help": "name of the image lists (default: val)"},
            "categories": {"nargs": "+", "metavar": "CLASS", "help": "default: all"},
            "part": {
                "choices": ("pascal", "imagenet"),
                "default": "pascal",
                "help": "default: pascal",
            },
            "pixel_origin": {
                "type": int,
                "choices": (0, 1),
                "default": 1,
                "help": "of the first pixel (default: 1)",
            },
        },
        whole={"occluded": False, "truncated": False},
    ),
    "bop": DatasetSpec(
        dataset="curvireg_torch.data:BOPDataset",
        benchmark="curvireg_torch.evaluation:BOPBenchmark",
        help="6D poses on a BOP set",
        root="folder with models and the split's folder",
        example="data/bop/lm",
        category="object {obj_id}",
        options={
            "split": {"default": "test", "help": "folder of the scenes (default: test)"},
            "models": {"default": "models", "help": "folder of the meshes (default: models)"},
        },
    ),
    "web": DatasetSpec(
        dataset="curvireg_torch.data:PoseFolder",
        benchmark="curvireg_torch.evaluation:PoseFolderBenchmark",
        help="viewpoints on photographs of your own",
        root="folder with one folder per object",
        example="data/web",
    ),
}
"""Datasets by the name that the command line uses."""
