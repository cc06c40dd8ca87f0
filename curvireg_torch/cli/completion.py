"""``curvireg completion bash|zsh|fish``."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .options import examples


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "completion",
        help="print a script that completes this command line",
        **examples(
            "curvireg completion bash > ~/.local/share/bash-completion/completions/curvireg",
            "curvireg completion zsh > ~/.zfunc/_curvireg",
            "curvireg completion fish > ~/.config/fish/completions/curvireg.fish",
        ),
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print the script of one shell."""
    import shtab

    from . import build_parser

    parser = build_parser()
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, arguments.shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """All arguments of a parser and of its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from _actions(below)
