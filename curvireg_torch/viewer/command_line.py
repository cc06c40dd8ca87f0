"""The command line that gives the same result as the page."""

import math
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from ..evaluation.opening import RegisterOptions

__all__ = ["command_line"]

OPTIONS = ("unit", "up", "pose", "preset", "pipeline", "renderer", "device")
_DEFAULTS = {option.name: option.default for option in fields(RegisterOptions)}


def command_line(options: RegisterOptions, names: Mapping[Path, str]) -> str:
    """``curvireg register`` with these options.

    Args:
        options: with at most one photograph and one mesh.
        names: what the user calls the files.

    Example:
        >>> photo = Path("upload-1")
        >>> command_line(RegisterOptions(photos=(photo,), guess=60.0, unit="mm"), {photo: "a.jpg"})
        'curvireg register a.jpg MESH --fov 60 --unit mm --out result'
    """
    words = ["curvireg", "register"]
    words += [names[path] for path in options.photos] or ["PHOTO"]
    words += [names[path] for path in options.meshes] or ["MESH"]
    if options.box is not None:
        words += ["--box", *map(_number, options.box)]
    if options.camera is not None:
        words += ["--camera", *map(_number, options.camera)]
    if isinstance(options.guess, float):
        words += ["--fov", _number(options.guess)]
    elif options.guess is not None:
        words += ["--camera", options.guess]
    for name in OPTIONS:
        value = getattr(options, name)
        if value != _DEFAULTS[name]:
            words += [f"--{name}={value}"] if str(value).startswith("-") else [f"--{name}", str(value)]
    return shlex.join([*words, "--out", "result"])


def _number(value: float) -> str:
    return repr(int(value)) if math.isfinite(value) and value == int(value) else repr(float(value))
