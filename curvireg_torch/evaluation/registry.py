"""The kinds of datasets, one row each, for ``evaluate``, the paper's experiments and ``datasets/verify.py``.

Nothing heavy is imported before a dataset is opened, so that the command line's help answers at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any

from ..utils.registry import Registry

if TYPE_CHECKING:
    from .benchmark import Benchmark

__all__ = ["DATASETS", "DatasetSpec"]


@dataclass(frozen=True)
class DatasetSpec:
    """A kind of dataset.

    Attributes:
        dataset, benchmark: names of the classes, in :mod:`curvireg_torch.data` and :mod:`curvireg_torch.evaluation`.
        help, root, example: for the command line: what it is, what ROOT must hold, and a ROOT.
        pose: default of the protocol's ``pose``.
        category, mesh: of a sample: a format of its group's name, and the key of its mesh.
        options: of the dataset's class, each as ``ArgumentParser.add_argument`` takes it.
        whole: options with which only whole objects are left, as far as the class has such options.
    """

    dataset: str
    benchmark: str
    help: str
    root: str
    example: str
    pose: str = "any"
    category: str = "{category}"
    mesh: str = "mesh_path"
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    whole: Mapping[str, Any] = field(default_factory=dict)

    def add_arguments(self, parser: Any) -> None:
        """ROOT and the options."""
        parser.add_argument("root", metavar="ROOT", help=self.root)
        for name, how in self.options.items():
            parser.add_argument(f"--{name.replace('_', '-')}", **how)

    def chosen(self, arguments: Any) -> dict[str, Any]:
        """Those of the parsed ``arguments`` that are options of the dataset."""
        return {name: getattr(arguments, name) for name in self.options}

    def open(self, root: str | PathLike[str], **options: Any) -> Any:
        """The dataset.

        Raises:
            CurviregError: it is not there, or an option is out of range.
        """
        return getattr(import_module("curvireg_torch.data"), self.dataset)(root, **options)

    @property
    def scored(self) -> "type[Benchmark]":
        """The benchmark's class."""
        found: type[Benchmark] = getattr(import_module("curvireg_torch.evaluation"), self.benchmark)
        return found


DATASETS: Registry[DatasetSpec] = Registry(
    "dataset",
    {
        "pascal3d": DatasetSpec(
            dataset="Pascal3DPlus",
            benchmark="Pascal3DBenchmark",
            help="viewpoints on PASCAL3D+",
            root="folder with Annotations, Images and CAD",
            example="data/PASCAL3D+_release1.1",
            pose="upright",
            mesh="cad_path",
            options={
                "split": {"default": "val", "help": "name of the image lists (default: val)"},
                "categories": {"nargs": "+", "metavar": "CLASS", "help": "default: all"},
                "part": {"choices": ("pascal", "imagenet"), "default": "pascal", "help": "default: pascal"},
                "pixel_origin": {
                    "type": int,
                    "choices": (0, 1),
                    "default": 1,
                    "help": "number of the first pixel (default: 1, the release)",
                },
            },
            whole={"occluded": False, "truncated": False},
        ),
        "bop": DatasetSpec(
            dataset="BOPDataset",
            benchmark="BOPBenchmark",
            help="6D poses on a BOP set",
            root="folder with models and the split's folder",
            example="data/bop/lm",
            category="object {obj_id}",
            mesh="model_path",
            options={"split": {"default": "test", "help": "folder of the scenes (default: test)"}},
        ),
        "web": DatasetSpec(
            dataset="WebCollection",
            benchmark="WebBenchmark",
            help="viewpoints on a collection of your own",
            root="folder with one folder per object",
            example="data/web",
        ),
    },
)
"""Datasets by the name that the command line uses."""
