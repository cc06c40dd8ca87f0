"""``curvireg schema``."""

import argparse
from pathlib import Path
from typing import Any

from .options import examples


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "schema",
        help="print the JSON schema of results",
        **examples("curvireg schema", "curvireg schema > result.schema.json"),
    )
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    parser.set_defaults(run=run)


def run(_: argparse.Namespace) -> None:
    """Print the schema of ``result.json``."""
    print(Path(__file__).parents[1].joinpath("registration", "result.schema.json").read_text(encoding="utf-8"), end="")
