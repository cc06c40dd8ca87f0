"""Options of several commands, and how they are read."""

import argparse
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..utils.choices import DEFAULT, MESH_KINDS, PRESET_NAMES, RENDERER_NAMES, SIDE_NAMES, UNITS, UP_AXES

if TYPE_CHECKING:
    from ..evaluation.opening import RegisterOptions

PRESETS_HELP = (
    "learned: with networks, the most accurate. classical: nothing learned. fast: the best view, without search and "
    "contour fit. paper: the published method"
)

_COUNTS = {"--box": 4, "--camera": 4, "--distance": 2, "--azimuth": 2, "--elevation": 2, "--theta": 2}
NUMBER = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"


def examples(*lines: str) -> dict[str, Any]:
    """Arguments for ``add_parser`` that show these command lines below the help."""
    epilog = "\n  ".join(["examples:", *lines])
    return {"epilog": epilog, "formatter_class": argparse.RawDescriptionHelpFormatter}


def whole_number(low: int, high: int | None = None) -> Callable[[str], int]:
    """A type of options: a whole number from ``low`` to ``high``."""
    limits = f"of at least {low}" if high is None else f"from {low} to {high}"

    def read(text: str) -> int:
        number = int(text) if re.fullmatch(r"[-+]?\d{1,18}", text) else None
        if number is None or number < low or (high is not None and number > high):
            raise argparse.ArgumentTypeError(f"expected a whole number {limits}, got {text!r}")
        return number

    return read


def common_options() -> argparse.ArgumentParser:
    """Parent parser: ``--debug --quiet --renderer``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    parser.add_argument("--quiet", dest="progress", action="store_false", help="no progress bars")
    parser.add_argument("--renderer", choices=RENDERER_NAMES, default="auto", help="default: auto")
    return parser


def pipeline_options() -> argparse.ArgumentParser:
    """Parent parser: ``--preset --pipeline --device``."""
    parser = argparse.ArgumentParser(add_help=False)
    default = f"{PRESETS_HELP} (default: that of a bank, else {DEFAULT})"
    parser.add_argument("--preset", choices=PRESET_NAMES, help=default)
    parser.add_argument("--pipeline", type=Path, metavar="FILE", help="JSON of a pipeline, instead of --preset")
    parser.add_argument("--device", default="cpu", help="device of modules, bank and search (default: cpu)")
    return parser


def mesh_options() -> argparse.ArgumentParser:
    """Parent parser: ``--unit --pose --up``."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--unit",
        choices=sorted(UNITS),
        help="unit of the mesh file, and of lengths in and out (default: m; for a BOP scene mm)",
    )
    parser.add_argument(
        "--pose",
        choices=("any", "upright"),
        help="any: no assumption. upright: the mesh's up axis points up in the photograph and the object is seen "
        "from 10 degrees below to 60 above; faster, and right more often where it is true (default: any)",
    )
    parser.add_argument(
        "--up", choices=UP_AXES, help="axis of the mesh file that points up, as --up=-y; default: y for glTF, else z"
    )
    return parser


def add_mesh_is(parser: argparse.ArgumentParser) -> None:
    """Add ``--mesh-is``."""
    parser.add_argument(
        "--mesh-is",
        choices=MESH_KINDS,
        help="exact: the mesh of this very object. similar: of another one of its kind; answers are then less certain "
        "(default: exact with a camera, similar without)",
    )


def add_box_and_camera(
    parser: argparse.ArgumentParser,
    *,
    box: str = "in px of the photograph",
    camera: str = "in px; gives the translation",
    fov: bool = True,
) -> None:
    """Add ``--box`` and ``--camera`` with these help texts, and ``--fov``."""
    parser.add_argument("--box", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help=box)
    parser.add_argument("--camera", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help=camera)
    if fov:
        parser.add_argument("--fov", type=float, metavar="DEG", help="horizontal field of view in degrees")


def add_pose_prior(parser: argparse.ArgumentParser) -> None:
    """Add the options that limit the pose."""
    group = parser.add_argument_group(
        "what is known about the pose",
        "limits, angles in degrees; all that are given must hold; the result stays within them. Lists have columns of "
        "these names",
    )
    limits = ("LOW", "HIGH")
    add = group.add_argument
    add("--azimuth", type=float, nargs=2, metavar=limits, help="counted upwards; 300 60 goes through 0")
    add("--elevation", type=float, nargs=2, metavar=limits, help="-90 below to 90 above the object")
    add("--theta", type=float, nargs=2, metavar=limits, help="in-plane rotation")
    add("--side", choices=SIDE_NAMES, help="side that faces the camera, 45 degrees to either side of it")
    add("--near", type=float, nargs="+", metavar="DEG", help="AZIMUTH ELEVATION [THETA] nearby")
    add("--within", type=float, metavar="DEG", help="largest angle from --near (default: 45)")
    distance = "of the object's centre, in the mesh's unit; needs a camera"
    add("--distance", type=float, nargs=2, metavar=("NEAR", "FAR"), help=distance)
    add("--front", choices=UP_AXES, help="axis of the mesh file that points out of its front, at azimuth 0")


def register_options(
    arguments: argparse.Namespace, photos: Sequence[Path] = (), meshes: Sequence[Path] = ()
) -> "RegisterOptions":
    """The options of ``register``, ``plot`` and ``view``; an option that a command lacks has its default."""
    from dataclasses import fields

    from ..errors import InvalidInputError
    from ..evaluation.opening import RegisterOptions
    from ..evaluation.prior_options import limits_from_options, prior_from_limits
    from ..utils.checks import check_device

    names = {option.name for option in fields(RegisterOptions)} - {"photos", "meshes"}
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in vars(arguments).items()
        if name in names and value is not None
    }
    try:
        values["limits"] = limits_from_options(vars(arguments))
        prior_from_limits(values["limits"])
    except InvalidInputError as error:
        raise InvalidInputError(f"--{error}".replace("--viewpoint:", "--near:", 1)) from error
    check_device(values.get("device", "cpu"), "--device")
    guess = "exif" if getattr(arguments, "exif", False) else getattr(arguments, "fov", None)
    return RegisterOptions(photos=tuple(photos), meshes=tuple(meshes), guess=guess, **values)


def split_numbers(words: Sequence[str]) -> list[str]:
    """The command line with one word per number.

    The numbers of ``--box``, ``--camera`` and ``--distance`` may also be separated by commas or blanks.
    ``--camera exif`` becomes ``--exif``, as argparse cannot take either four numbers or one word.
    """
    out: list[str] = []
    expected = 0
    for word in words:
        option, equals, value = word.partition("=")
        if option in _COUNTS:
            expected, word = _COUNTS[option], value
            out.append(option)
            if not equals:
                continue
        parts = re.split(r"[,\s]+", word.strip(", "))
        are_numbers = len(parts) <= expected and all(re.fullmatch(NUMBER, part) for part in parts)
        expected = expected - len(parts) if are_numbers else 0
        out += map(_plain, parts) if are_numbers else [word]
    if ("--camera", "exif") in pairwise(out):
        place = out.index("--camera")
        out[place : place + 2] = ["--exif"]
    return out


def _plain(number: str) -> str:
    """A number as argparse takes it: it reads -1e3 as an option."""
    return f"{float(number):f}" if re.match("-.*[eE]", number) else number
