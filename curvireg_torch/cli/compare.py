"""``curvireg compare RUN_A RUN_B``."""

import argparse
from pathlib import Path
from typing import Any

from .options import add_command


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
    parser.add_argument("a", type=Path, metavar="RUN_A", help="folder of 'curvireg evaluate --out'")
    parser.add_argument("b", type=Path, metavar="RUN_B", help="another one, of the same dataset")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")


def _compare_runs(arguments: argparse.Namespace) -> None:
    """Compare two evaluations."""
    from ..evaluation.compare import compare, in_words, read_run, to_document

    first = read_run(arguments.a)
    second = read_run(arguments.b)
    comparisons = compare(first, second)
    show = to_document if arguments.json else in_words
    print(show(first, second, comparisons), end="")
