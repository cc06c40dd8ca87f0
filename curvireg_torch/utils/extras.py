"""Packages that are optional, and the extras of curvireg_torch that install them."""

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

from ..errors import MissingDependencyError

EXTRAS = {
    "cascadio": "cad",
    "collada": "cad",
    "distributed": "cluster",
    "matplotlib": "plot",
    "nicegui": "viewer",
    "pi_heif": "heic",
    "pxr": "usd",
}
"""The extra of each package that is imported where it is needed."""

PACKAGE_OF_SUFFIX = {
    ".dae": "collada",
    **dict.fromkeys((".heic", ".heif"), "pi_heif"),
    **dict.fromkeys((".iges", ".igs", ".step", ".stp"), "cascadio"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "pxr"),
}
"""The package that reads files of a suffix, in lower case."""


def is_installed(package: str) -> bool:
    """Whether a package can be imported; it is not imported."""
    try:
        return find_spec(package) is not None
    except ValueError:  # of one that was imported without a specification
        return False


def install_command(extras: Iterable[str]) -> str:
    """The commands that install extras, of the package and in a checkout.

    Example:
        >>> install_command(["heic", "cad"])
        "pip install 'curvireg_torch[cad,heic]', in a checkout pip install -e '.[cad,heic]'"
    """
    names = ",".join(sorted(set(extras)))
    return f"pip install 'curvireg_torch[{names}]', in a checkout pip install -e '.[{names}]'"


def check_extras(files: Iterable[Path] = (), packages: Iterable[str] = ()) -> None:
    """Refuse files whose readers are not installed, and missing packages, all in one message."""
    wanted = [(str(file), package) for file in files if (package := _package_of(file))]
    wanted += [("this command", package) for package in packages]
    missing = [(user, package) for user, package in wanted if not is_installed(package)]
    if not missing:
        return
    needs = [f"{user} needs {package}" for user, package in missing]
    command = install_command(EXTRAS[package] for _, package in missing)
    raise MissingDependencyError(f"{', '.join(needs)}: {command}")


def _package_of(file: Path) -> str | None:
    """The optional package that reads a file; None if none is needed, as of a HEIC that holds a
    JPEG."""
    package = PACKAGE_OF_SUFFIX.get(file.suffix.lower())
    if package != "pi_heif" or not file.is_file():
        return package
    with file.open("rb") as stream:
        return package if stream.read(8)[4:] == b"ftyp" else None
