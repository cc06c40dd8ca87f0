"""``curvireg evaluate pascal3d|bop|web ROOT --out DIR``."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, MissingFileError
from ..evaluation.opening import whole_number
from ..evaluation.registry import DATASETS
from ..utils.choices import DEFAULT
from ..utils.files import check_writable
from .options import add_command, add_options

PROTOCOL = (
    "cad=annotated|any: the annotated CAD model, or the best of the class; "
    "pose=upright|any: whether objects are known to stand upright; "
    "box=annotated|none|FRACTION: as annotated; detected; or each edge moved by up to FRACTION of the side (seed=N); "
    "hint=none|azimuth:DEG|pose:DEG: azimuth or rotation known to lie within DEG of a value that is off by up to DEG; "
    "views=N: N photographs of one pose together (bop; seed=N)"
)


def add_evaluate(commands: Any) -> None:
    example = "curvireg evaluate bop data/bop/lm --out out/lm"
    datasets = add_command(commands, "evaluate", example, help="register and score a dataset").add_subparsers(
        required=True, metavar="DATASET"
    )
    for name, kind in DATASETS.items():
        dataset = add_command(
            datasets,
            name,
            f"curvireg evaluate {name} {kind.example} --out out/{name}",
            f"curvireg evaluate {name} {kind.example} --jobs 2 --limit 100 --preset fast --out out/{name}-fast",
            help=kind.help,
            description="Writes DIR/summary.json, DIR/predictions.csv and DIR/index.html; the same command resumes.",
            run=run,
        )
        dataset.set_defaults(dataset=name)
        kind.add_arguments(dataset)
        add = dataset.add_argument
        protocol = f"{PROTOCOL} (default: cad=annotated pose={kind.pose} box=annotated)"
        add("--protocol", nargs="+", default=[], metavar="KEY=VALUE", help=protocol)
        add_options(dataset, "preset", "pipeline", "renderer", "progress")
        jobs = "processes that share the objects (default: 1)"
        add("--jobs", type=whole_number(1), default=1, metavar="N", help=jobs)
        add("--limit", type=whole_number(1), metavar="N", help="only N objects, spread evenly over the set")
        add("--out", type=Path, required=True, metavar="DIR", help="folder of the results; made if it does not exist")


def run(arguments: argparse.Namespace) -> None:
    """Evaluate a dataset and print the headline."""
    if not Path(arguments.root).is_dir():
        raise MissingFileError("no such folder; docs/datasets.md shows the layout", subject=arguments.root)
    from ..evaluation.datasets import evaluate
    from ..evaluation.protocol import Protocol
    from ..evaluation.store import run_processes
    from ..pipeline import Pipeline
    from ..utils.threads import one_torch_thread

    kind = DATASETS[arguments.dataset]
    protocol = Protocol.parse(arguments.protocol, pose=kind.pose)
    preset = arguments.preset or DEFAULT if arguments.pipeline is None else Pipeline.read(arguments.pipeline)
    if run_processes(arguments.jobs, arguments.argv):
        return
    dataset = kind.open(arguments.root, **kind.chosen(arguments))
    benchmark = kind.scored(dataset, protocol)
    check_writable(arguments.out, "--out")
    with one_torch_thread():
        summary = evaluate(
            benchmark,
            arguments.out,
            preset=preset,
            limit=arguments.limit,
            renderer=arguments.renderer or "auto",
            progress=arguments.progress,
        )
    if summary is None:  # another process writes it
        return
    if summary["n"] == 0:
        reasons = ", ".join(f"{count} {reason}" for reason, count in summary["skipped"].items()) or "it is empty"
        raise InvalidInputError(f"{arguments.root}: nothing was scored ({reasons}); see {arguments.out}/summary.json")
    _print_summary(summary)
    print(f"protocol: {summary['protocol']}; see {arguments.out}/summary.json")


def _print_summary(summary: Mapping[str, Any]) -> None:
    print(f"{summary['n']} objects, {summary['failed']} failed, {sum(summary['skipped'].values())} skipped")
    if "n_posed" in summary:
        print(f"{summary['reliable']} reliable, mean confidence {summary['mean_confidence']:.2f}")
        posed = summary["n_posed"]
        print(f"the true pose of {posed} is known: " + ("their scores are" if posed else "nothing to compare"))
    if summary["med_err_deg"] is not None:
        prefixes = ("acc_", "add_", "mssd_", "mspd_")
        numbers = [f"{name} {value:.3f}" for name, value in summary.items() if name.startswith(prefixes)]
        print("   ".join([*numbers, f"med_err_deg {summary['med_err_deg']:.1f}"]))
    if "detection" in summary:
        (_, n), *recalls = summary["detection"].items()
        print("   ".join(f"{name} {value:.3f}" for name, value in recalls) if n else "no box is annotated")
