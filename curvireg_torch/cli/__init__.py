"""The command ``curvireg``.

Each command has a function ``add_*`` that adds it to the subparsers, and one that runs it, which
raises :class:`CurviregError` for unusable input. Heavy modules, and those that import them at their
top (``registering``, ``following``, ``printing``), are imported there, so that help and mistakes in
options appear at once.
"""

import argparse
import errno
import io
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from ..errors import CurviregError, CurviregWarning
from ..jobs.options import with_advice
from ..utils.files import terminable
from ..version import __version__
from . import commands, follow, register
from .options import CONFLICTS, Parser, conflict, given_options, join_numbers, stored_path

__all__ = ["build_parser", "main", "parse"]

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of writing alone. The commands' messages name their files: one without is of standard
output."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; without any, print the help.

    Returns:
        The exit code: 0; 2 for input that cannot be used; 130 after Ctrl-C; 141 when the reader of
        a pipe has gone.
    """
    try:
        try:
            if isinstance(sys.stdout, io.TextIOWrapper):  # a file's name may be no text
                sys.stdout.reconfigure(errors="backslashreplace")
            words = sys.argv[1:] if argv is None else argv
            if not words:
                build_parser().print_help()
                return 0
            return _run(parse(words))
        except KeyboardInterrupt:
            print("curvireg: interrupted", file=sys.stderr)
            return 130
        finally:
            print(end="", flush=True)  # a closed pipe shows here and not at interpreter exit
    except BrokenPipeError:
        _discard_output()
        return 128 + 13  # as shells report SIGPIPE
    except OSError as error:  # those of files are in the messages of their commands
        if not _discard_output() and error.errno not in FULL:
            raise
        print(
            f"curvireg: error: standard output: cannot be written ({error.strerror}); make room, "
            f"or send it elsewhere",
            file=sys.stderr,
        )
        return 2


def _is_of_output(error: Exception) -> bool:
    """Whether a full disk refused what was printed: larger texts than its buffer holds fail at
    once."""
    return isinstance(error, OSError) and error.errno in FULL and error.filename is None


def _discard_output() -> bool:
    """Send what standard output and error still hold, and cannot write, to nothing; whether there
    is such."""
    found = False
    for stream in (sys.stdout, sys.stderr):
        try:
            print(end="", file=stream, flush=True)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            found = True
    return found


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The options of a command line; a mistake in them ends the process with code 2."""
    parser = build_parser()
    arguments, rest = parser.parse_known_args(join_numbers(argv))
    if hasattr(arguments, "paths") and not any(word.startswith("-") for word in rest):
        # argparse does not collect positionals that follow an option
        arguments.paths += map(stored_path, rest)
    elif rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if hasattr(arguments, "paths") and (problem := register.complete(arguments)):
        parser.error(f"register: {problem}")
    if problem := conflict(CONFLICTS, given_options(arguments)):
        parser.error(problem)
    return arguments


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; parsed arguments hold ``run``, the function to be called with
    them."""
    parser = Parser(prog="curvireg", description="Pose of a known 3D object from one photograph.")
    parser.add_argument("--version", action="version", version=f"curvireg_torch {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in (register.add_register, follow.add_follow, *commands.COMMANDS):
        add(subparsers)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    with warnings.catch_warnings(), terminable():
        if not arguments.debug:
            warnings.showwarning = _show_warning
            # of videos it cannot read, our message is enough
            os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        try:
            return arguments.run(arguments) or 0
        except (CurviregError, OSError) as error:
            if arguments.debug or isinstance(error, BrokenPipeError) or _is_of_output(error):
                raise
            if isinstance(error, CurviregError):
                text = with_advice(error)
            else:
                text = f"{error}; check that it exists and can be read"
            print(f"curvireg: error: {text}", file=sys.stderr)
            return 2


def _show_warning(message: Any, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning of ours; those of libraries, such as numpy's about division by zero, are for
    --debug."""
    if category is UserWarning or issubclass(category, CurviregWarning):
        print(f"curvireg: warning: {message}", file=sys.stderr)
