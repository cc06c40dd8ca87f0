"""``curvireg evaluate pascal3d|bop ROOT --out DIR``."""

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._choices import DEFAULT, PRESET_NAMES
from ..errors import InvalidInputError

if TYPE_CHECKING:
    from .benchmark import Benchmark

__all__ = ["add_datasets", "add_parser", "run"]

PROTOCOL = (
    "cad=annotated|any|fused: the annotated CAD, the best of the class, or one vote of all of the class; "
    "pose=upright|any: whether objects are known to stand upright; "
    "box=annotated|SHARE: each edge moved by up to SHARE of the side (seed=N)"
)


def add_parser(commands: Any, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add ``evaluate`` to the subparsers ``commands``; parsed arguments get ``run``, to be called with them.

    Args:
        commands: what ``ArgumentParser.add_subparsers`` returned.
        parents: parsers with at least ``--quiet`` and ``--renderer``.
    """
    parser = commands.add_parser("evaluate", help="register and score a dataset")
    add_datasets(parser.add_subparsers(required=True, metavar="DATASET"), parents)


def add_datasets(datasets: Any, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add ``pascal3d`` and ``bop`` to the subparsers ``datasets``; ``parents`` as for :func:`add_parser`."""
    description = "Writes DIR/summary.json, DIR/predictions.csv and, as it goes, DIR/predictions; run again to go on."
    pascal = datasets.add_parser("pascal3d", parents=parents, description=description, help="viewpoints on PASCAL3D+")
    pascal.add_argument("root", type=Path, metavar="ROOT", help="folder with Annotations, Images and CAD")
    pascal.add_argument("--split", default="val", help="name of the image lists (default: val)")
    pascal.add_argument("--categories", nargs="+", metavar="CLASS", help="default: all")
    pascal.add_argument("--part", choices=("pascal", "imagenet"), default="pascal", help="default: pascal")
    pascal.add_argument(
        "--pixel-origin",
        type=int,
        choices=(0, 1),
        default=1,
        help="number of the first pixel (default: 1, the release)",
    )
    pascal.set_defaults(benchmark=_pascal3d)
    bop = datasets.add_parser("bop", parents=parents, description=description, help="6D poses on a BOP set")
    bop.add_argument("root", type=Path, metavar="ROOT", help="folder with models and the split's folder")
    bop.add_argument("--split", default="test", help="folder of the scenes (default: test)")
    bop.set_defaults(benchmark=_bop)
    for parser, default in ((pascal, "upright"), (bop, "any")):
        parser.add_argument(
            "--protocol",
            nargs="+",
            default=[],
            metavar="KEY=VALUE",
            help=f"{PROTOCOL} (default: cad=annotated pose={default} box=annotated)",
        )
        parser.add_argument("--preset", choices=sorted(PRESET_NAMES), default=DEFAULT, help=f"default: {DEFAULT}")
        parser.add_argument("--pipeline", type=Path, metavar="FILE", help="JSON of a pipeline, instead of --preset")
        parser.add_argument(
            "--jobs", type=int, default=1, metavar="N", help="processes that share the objects (default: 1)"
        )
        parser.add_argument("--limit", type=int, metavar="N", help="only N objects, spread evenly over the set")
        parser.add_argument("--overwrite", action="store_true", help="start anew in a folder with other predictions")
        parser.add_argument("--out", type=Path, required=True, metavar="DIR")
        parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Evaluate what ``curvireg evaluate`` was asked to, and print the headline.

    Raises:
        CurviregError: the dataset is not there, an option is out of range, or the folder holds other results.
    """
    if arguments.jobs > 1 and "TORCHELASTIC_RUN_ID" not in os.environ:
        _run_jobs(arguments.jobs)
        return
    from ..pipeline import Pipeline
    from .loops import evaluate

    summary = evaluate(
        arguments.benchmark(arguments),
        arguments.out,
        preset=arguments.preset if arguments.pipeline is None else Pipeline.read(arguments.pipeline),
        limit=arguments.limit,
        renderer=arguments.renderer,
        overwrite=arguments.overwrite,
        progress=not arguments.quiet,
    )
    if summary is None:
        return
    if summary["n"] == 0:
        told = ", ".join(f"{count} {reason}" for reason, count in summary["skipped"].items()) or "it is empty"
        raise InvalidInputError(f"{arguments.root}: nothing was scored ({told}); see {arguments.out}/summary.json")
    shares = [name for name in summary if name.startswith(("acc_", "add_", "mssd_", "mspd_"))]
    print(f"{summary['n']} objects, {summary['failed']} failed, {sum(summary['skipped'].values())} skipped")
    print("   ".join([*(f"{n} {summary[n]:.3f}" for n in shares), f"med_err_deg {summary['med_err_deg']:.1f}"]))
    print(f"protocol: {summary['protocol']}; see {arguments.out}/summary.json")


def _run_jobs(count: int) -> None:
    """This same command again, in processes that ``torchrun`` starts."""
    words = sys.argv[1:]
    words = words[words.index("evaluate") + 1 :] if "evaluate" in words else words
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    done = subprocess.run([*torchrun, "-m", "curvireg_torch.evaluation", *words], env=environment, check=False)
    if done.returncode:
        raise InvalidInputError(f"evaluate: a process ended with {done.returncode}; what it says stands above")


def _pascal3d(arguments: argparse.Namespace) -> "Benchmark":
    from ..data import Pascal3DPlus
    from .pascal3d import Pascal3DBenchmark
    from .protocol import Protocol

    dataset = Pascal3DPlus(
        arguments.root,
        arguments.split,
        categories=arguments.categories,
        part=arguments.part,
        pixel_origin=arguments.pixel_origin,
    )
    return Pascal3DBenchmark(dataset, Protocol.parse(arguments.protocol))


def _bop(arguments: argparse.Namespace) -> "Benchmark":
    from ..data import BOPDataset
    from .bop import BOPBenchmark
    from .protocol import Protocol

    return BOPBenchmark(BOPDataset(arguments.root, arguments.split), Protocol.parse(arguments.protocol, pose="any"))
