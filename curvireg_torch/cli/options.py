"""Commands and their arguments, from the declarations in
:mod:`curvireg_torch.jobs.options`."""

import argparse
import re
import sys
from collections.abc import Mapping, Sequence, Set
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError
from ..jobs.options import (
    FIELD_OF_VIEW,
    PRIOR_OPTIONS,
    Numbers,
    RegisterOptions,
    check_camera,
    limits_from_options,
    prior_from_limits,
    whole_number,
)
from ..utils.aliases import Fields
from ..utils.files import as_stored

FIELDS = {
    option.name: dict(option.metadata) for option in fields(RegisterOptions) if option.metadata
}
DECLARED: dict[str, Fields] = {**FIELDS, "guess": FIELD_OF_VIEW, **PRIOR_OPTIONS}
METHOD = ("preset", "pipeline", "renderer", "device", "progress")
MESH = ("unit", "link", "textures", "pose", "up")
BOXES = ("box_format", "boxes")
PHOTOGRAPH = ("box", "box_is", "mask", "camera", "guess", *MESH, "mesh_is", *METHOD)
"""Options of several commands, by the names of their fields."""
TRACKERS = ("m3t", "visp")  # formats of a start pose that take the mesh too


class Parser(argparse.ArgumentParser):
    """A parser that takes no abbreviations, and whose help and version do not get lost."""

    def __init__(self, **how: Any) -> None:
        super().__init__(
            allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **how
        )

    def _print_message(self, message: str, file: Any = None) -> None:
        # argparse itself says nothing if a message cannot be written
        file = file or sys.stderr
        if message and file is not None:
            file.write(message)


def add_command(commands: Any, name: str, *examples: str, **how: Any) -> Any:
    """Add a command, with examples below its help, ``--debug``, and what it ``run``s."""
    run = how.pop("run", None)
    parser = commands.add_parser(name, epilog="\n  ".join(["examples:", *examples]), **how)
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    if run is not None:
        parser.set_defaults(run=run)
    return parser


def stored_path(text: str) -> Path:
    """The path that is meant by a word of the command line, see :func:`.as_stored`."""
    return as_stored(Path(text))


def add_path(parser: Any, name: str, metavar: str, **how: Any) -> None:
    """Add an argument that is a path."""
    parser.add_argument(name, type=stored_path, metavar=metavar, **how)


def add_options(parser: Any, *names: str, **help_texts: str) -> None:
    """Add options of a registration; ``help_texts`` replace those of their declarations."""
    for name in names:
        how = {**DECLARED[name], **({"help": help_texts[name]} if name in help_texts else {})}
        kind = how.get("type")
        flag = how.pop("flag", f"--{name.replace('_', '-')}")
        if isinstance(kind, Numbers):
            how["metavar"] = re.sub(r"[][]", "", kind.names)
        elif kind is Path:
            how = {"metavar": "FILE", **how, "type": stored_path}
        parser.add_argument(flag, dest=name, **how)


def add_limits(parser: Any) -> None:
    """Add the options that limit the pose."""
    text = (
        "limits, angles in degrees; all that are given must hold; the result stays within them. "
        "Lists have columns of"
    )
    add_options(
        parser.add_argument_group("what is known about the pose", f"{text} these names"),
        *PRIOR_OPTIONS,
    )


def add_workers(parser: Any, what: str) -> None:
    """Add the options that share ``what`` among processes."""
    jobs = f"processes {what} (default: 1)"
    parser.add_argument("--jobs", type=whole_number(1), default=1, metavar="N", help=jobs)
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help=f"of a Dask cluster, whose workers are used {what}, instead of --jobs; they read "
        "files by the same paths",
    )


def register_options(
    arguments: argparse.Namespace, photos: Sequence[Path] = (), meshes: Sequence[Path] = ()
) -> RegisterOptions:
    """The options of a command; those that it lacks have their defaults. The files that they name
    are read: a mistake in one is found before any work."""
    from ..utils.checks import check_device

    given = {
        name: value for name in FIELDS if (value := getattr(arguments, name, None)) is not None
    }
    camera = given.get("camera", getattr(arguments, "guess", None))
    if isinstance(camera, str) and camera != "exif":
        from ..data import load_camera

        camera = load_camera(camera)
    given["camera"] = camera
    try:
        limits = limits_from_options(vars(arguments))
        prior_from_limits(limits)
        check_camera(camera)
    except InvalidInputError as error:
        raise InvalidInputError(f"--{error}") from error
    check_device(given.get("device", "cpu"), "--device")
    options = RegisterOptions(
        photos=tuple(photos),
        meshes=tuple(meshes),
        limits=limits,
        unit_is_given="unit" in given,
        **given,
    )
    options.open_files()
    return options


def input_files(arguments: argparse.Namespace, *more: Path) -> list[Path]:
    """The files that a command's options name, and ``more``."""
    named = [getattr(arguments, name, None) for name in ("list", "views", *FIELDS)]
    camera = getattr(arguments, "camera", None)
    paths = [
        *(str(path) for path in named if isinstance(path, Path)),
        *([camera] if isinstance(camera, str) else []),
    ]
    named_parts = [path.rpartition(":")[0] for path in paths]  # of FILE:NAME
    return [*more, *map(Path, filter(None, [*paths, *named_parts]))]


CONFLICTS = {
    "preset pipeline": "expected one of --preset and --pipeline",
    "camera guess": "expected one of --camera FX FY CX CY, --camera FILE, --camera exif, --fov DEG",
    "box boxes": "expected one of --box and --boxes",
    "boxes mask": "expected one of --boxes and --mask",
    "boxes start": "--start is the pose, so that no box is needed; leave --boxes out",
    "boxes list": "the list holds boxes; leave --boxes out",
    "box start": "--start is the pose, so that no box is needed; leave --box out",
    "box_format boxes|views": "--box-format: of --box or the boxes of a list; leave it out",
    "box_format !box !list": "--box-format: of --box or the boxes of a list; give them too",
    "scheduler jobs": "expected one of --jobs and --scheduler",
    "gpu jobs": "--jobs: processes are for the CPU; a GPU registers photographs together",
    "front !limits !list": "--front limits nothing by itself; give --azimuth, for instance",
}
"""Options of any command that conflict, see :func:`conflict`, and what is said about them."""


def given_options(arguments: argparse.Namespace) -> set[str]:
    """The names of the options that are given, and what follows from them: ``limits`` of the pose
    beside ``front``, and ``gpu``."""
    options = vars(arguments)
    given = {
        name for name, value in options.items() if value not in (None, []) and value is not False
    }
    given -= {name for name in ("jobs", "every") if options.get(name) == 1}
    if not given.isdisjoint(PRIOR_OPTIONS.keys() - {"front"}):
        given.add("limits")
    if options.get("device") not in (None, "cpu"):
        given.add("gpu")
    return given


def conflict(rules: Mapping[str, str], given: Set[str]) -> str | None:
    """What the first rule says that holds, None if none does. A rule is a line of names, of which
    all must be given: of ``a|b`` one of them, and ``!a`` must not be.

    Example:
        >>> conflict({"box|mask start": "leave one out", "need !strict": "give it"}, {"need"})
        'give it'
    """
    for names, message in rules.items():
        if all(
            name[1:] not in given if name[0] == "!" else not given.isdisjoint(name.split("|"))
            for name in names.split()
        ):
            return message
    return None


_COUNTS = {"--camera": 4} | {
    how.get("flag", f"--{name}"): how["type"].most
    for name, how in DECLARED.items()
    if isinstance(how.get("type"), Numbers)
}
"""Numbers that an option takes at most."""


def join_numbers(words: Sequence[str]) -> list[str]:
    """The command line with one word for each option of numbers, "--box=1,2,3,4", for
    ``--box 1 2 3 4`` too.

    Example:
        >>> join_numbers(["a.jpg", "--box", "1,", "-2", "3", "4", "--near=5", "6", "b.stl",
        ...     "--camera", "exif"])
        ['a.jpg', '--box=1,-2,3,4', '--near=5,6', 'b.stl', '--camera', 'exif']
    """
    joined = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        numbers = _numbers(value) if equals else []
        if option not in _COUNTS or numbers is None:
            joined.append(word)
            continue
        while rest and (more := _numbers(rest[0])) and len(numbers) + len(more) <= _COUNTS[option]:
            numbers += more
            del rest[0]
        joined.append(f"{option}={','.join(numbers)}" if numbers else word)
    return joined


def _numbers(word: str) -> list[str] | None:
    """The numbers in a word; None if there is anything else."""
    parts = re.split(r"[,\s]+", word.strip(", "))
    try:
        return parts if all(float(part) is not None for part in parts) else None
    except ValueError:
        return None


def numbers_among(paths: Sequence[Path]) -> list[str]:
    """Paths that are numbers, which an option has left over."""
    return [str(path) for path in paths if len(_numbers(str(path)) or ()) == 1]
