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
    """``curvireg register`` with these options; ``names`` are what the user calls the files.

    Example:
        >>> photo = Path("upload-1")
        >>> command_line(RegisterOptions(photos=(photo,), guess=60.0, unit="mm"), {photo: "a.jpg"})
        'curvireg register a.jpg MESH --fov 60 --unit mm --out result'
    """
    words = ["curvireg", "register"]
    for paths, placeholder in ((options.photos, "PHOTO"), (options.meshes, "MESH")):
        words += [names[path] for path in paths] or [placeholder]
    for name, numbers in (("--box", options.box), ("--camera", options.camera)):
        words += [] if numbers is None else [name, *map(_number, numbers)]
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
