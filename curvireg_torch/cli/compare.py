"""``curvireg compare RUN_A RUN_B``."""

import argparse
from dataclasses import asdict
from typing import Any

from .options import add_command, add_path


def add_compare(commands: Any) -> None:
    parser = add_command(
        commands,
        "compare",
        "curvireg compare out/lm-fast out/lm",
        "curvireg compare out/lm-fast out/lm --json",
        help="compare two evaluations of one dataset, object by object",
        description="Prints each score with its 95 % interval, how often B is better than A and "
        "worse,\n"
        "the p of a sign test, and a Markdown and a LaTeX row of each run. Objects in one run "
        "only do not count.",
        run=_compare_runs,
    )
    add_path(parser, "a", "RUN_A", help="folder of 'curvireg evaluate --out'")
    add_path(parser, "b", "RUN_B", help="another one, of the same dataset")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")


def _compare_runs(arguments: argparse.Namespace) -> None:
    """Compare two evaluations."""
    from ..evaluation.compare import compare, in_words, read_run
    from ..jobs.store import to_json

    first = read_run(arguments.a)
    second = read_run(arguments.b)
    comparisons = compare(first, second)
    if not arguments.json:
        print(in_words(first, second, comparisons), end="")
        return
    scores = [asdict(each) for each in comparisons]
    print(to_json({"a": first.name, "b": second.name, "comparisons": scores}), end="")
