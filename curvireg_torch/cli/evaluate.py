"""``curvireg evaluate pascal3d|bop|web ROOT --out DIR``."""

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from ..evaluation.registry import DATASETS, DatasetSpec
from ..utils.choices import DEFAULT, PRESET_NAMES
from .examples import examples

__all__ = ["add_datasets", "add_parser", "run"]

PROTOCOL = (
    "cad=annotated|any|fused: the annotated CAD, the best of the class, or one vote of all of the class; "
    "pose=upright|any: whether objects are known to stand upright; "
    "box=annotated|none|SHARE: as annotated; looked for; or each edge moved by up to SHARE of the side (seed=N)"
)


def add_parser(commands: Any, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add ``evaluate`` to the subparsers ``commands``; parsed arguments get ``run``, to be called with them.

    Args:
        commands: what ``ArgumentParser.add_subparsers`` returned.
        parents: parsers with at least ``--quiet`` and ``--renderer``.
    """
    parser = commands.add_parser(
        "evaluate", help="register and score a dataset", **examples("curvireg evaluate bop data/bop/lm --out out/lm")
    )
    add_datasets(parser.add_subparsers(required=True, metavar="DATASET"), parents)


def add_datasets(datasets: Any, parents: Sequence[argparse.ArgumentParser]) -> None:
    """Add the kinds of datasets to the subparsers ``datasets``; ``parents`` as for :func:`add_parser`."""
    description = "Writes DIR/summary.json, DIR/predictions.csv and, as it goes, DIR/predictions; run again to go on."
    for name, kind in DATASETS.items():
        shown = examples(
            f"curvireg evaluate {name} {kind.example} --out out/{name}",
            f"curvireg evaluate {name} {kind.example} --jobs 2 --limit 100 --preset fast --out out/{name}-fast",
        )
        parser = datasets.add_parser(name, parents=parents, description=description, help=kind.help, **shown)
        kind.add_arguments(parser)
        parser.add_argument(
            "--protocol",
            nargs="+",
            default=[],
            metavar="KEY=VALUE",
            help=f"{PROTOCOL} (default: cad=annotated pose={kind.pose} box=annotated)",
        )
        parser.add_argument("--preset", choices=sorted(PRESET_NAMES), default=DEFAULT, help=f"default: {DEFAULT}")
        parser.add_argument("--pipeline", type=Path, metavar="FILE", help="JSON of a pipeline, instead of --preset")
        parser.add_argument(
            "--jobs", type=int, default=1, metavar="N", help="processes that share the objects (default: 1)"
        )
        parser.add_argument("--limit", type=int, metavar="N", help="only N objects, spread evenly over the set")
        parser.add_argument("--overwrite", action="store_true", help="start anew in a folder with other predictions")
        parser.add_argument("--out", type=Path, required=True, metavar="DIR")
        parser.set_defaults(run=run, kind=kind)


def run(arguments: argparse.Namespace) -> None:
    """Evaluate what ``curvireg evaluate`` was asked to, and print the headline.

    Raises:
        CurviregError: the dataset is not there, an option is out of range, or the folder holds other results.
    """
    if arguments.jobs > 1 and "TORCHELASTIC_RUN_ID" not in os.environ:
        _run_jobs(arguments.jobs)
        return
    from ..evaluation.loops import evaluate
    from ..evaluation.protocol import Protocol
    from ..pipeline import Pipeline

    kind: DatasetSpec = arguments.kind
    dataset = kind.open(arguments.root, **kind.chosen(arguments))
    summary = evaluate(
        kind.scored(dataset, Protocol.parse(arguments.protocol, pose=kind.pose)),
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
    if "n_posed" in summary:
        print(f"{summary['reliable']} reliable, mean confidence {summary['mean_confidence']:.2f}")
        print(
            f"the pose of {summary['n_posed']} is known: "
            + ("of these" if summary["n_posed"] else "nothing to compare")
        )
    if summary["med_err_deg"] is not None:
        print("   ".join([*(f"{n} {summary[n]:.3f}" for n in shares), f"med_err_deg {summary['med_err_deg']:.1f}"]))
    if "localisation" in summary:
        n, *shares = summary["localisation"].items()
        print("   ".join(f"{name} {value:.3f}" for name, value in shares if n[1]) or "no box is annotated")
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
