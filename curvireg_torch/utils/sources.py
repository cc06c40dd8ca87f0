"""Digests of the package's own code, by which stored results and banks are known to be current."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
CODE = (".py", ".json", ".safetensors")  # code, constants and weights

_RELATIVE_IMPORT = re.compile(r"^[ ]*from[ ]+(\.+)([\w.]*)[ ]+import\b", re.MULTILINE)


@cache
def package_digest(*, without: tuple[str, ...] = ()) -> str:
    """16 hexadecimal digits of the whole package, except the files and folders ``without``.

    Raises:
        FileNotFoundError: one of ``without`` does not exist.
    """
    excluded = set[Path]()
    for name in without:
        excluded |= _files_in(_existing(PACKAGE / name))
    return _digest(_files_in(PACKAGE) - excluded)


@cache
def import_digest(source: str) -> str:
    """16 hexadecimal digits of a file of the package and of all that it imports, see
    :func:`imported_files`."""
    return _digest(imported_files(source))


def imported_files(source: str) -> set[Path]:
    """A file of the package, ``"matching/bank.py"``, and all files of the package that it imports,
    directly or through others, with the constants and weights beside them.

    Of a package whose names are imported lazily, ``from ..features import HOG``, all files count.

    Raises:
        FileNotFoundError: no such file.
    """
    files = set[Path]()
    waiting = {_existing(PACKAGE / source)}
    while waiting:
        file = waiting.pop()
        files.add(file)
        files |= {path for path in file.parent.glob("*") if path.suffix in CODE[1:]}
        waiting |= set(_imports(file)) - files
    return files


def _imports(file: Path) -> Iterator[Path]:
    """The files of the package that a file imports itself."""
    for dots, name in _RELATIVE_IMPORT.findall(file.read_text(encoding="utf-8")):
        folder = file.parents[len(dots) - 1]
        target = folder.joinpath(*filter(None, name.split(".")))
        if target.is_dir():
            yield from target.rglob("*.py")
        else:
            yield _existing(target.with_suffix(".py"))


def _existing(path: Path) -> Path:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such part of the package")
    return path


def _files_in(path: Path) -> set[Path]:
    """A file, or the files of code in a folder and below it."""
    inside = [path] if path.is_file() else path.rglob("*")
    return {file for file in inside if file.suffix in CODE}


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for file in sorted(files):
        digest.update(file.relative_to(PACKAGE).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()
