"""Digests of the package's own code, by which stored results and banks are known to be current."""

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
CODE = (".py", ".json", ".safetensors")  # code, constants and weights


@cache
def package_digest(*, without: tuple[str, ...]) -> str:
    """16 hexadecimal digits of the whole package, except the files and folders ``without``.

    Raises:
        FileNotFoundError: one of ``without`` does not exist.
    """
    digest = hashlib.blake2b(digest_size=8)
    excluded = {PACKAGE / name for name in without}
    for path in excluded:
        path.stat()  # it exists
    for file in sorted(PACKAGE.rglob("*")):
        if file.suffix in CODE and excluded.isdisjoint((file, *file.parents)):
            digest.update(file.relative_to(PACKAGE).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()
