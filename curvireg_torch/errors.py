"""Every error that this library raises on purpose.

All derive from :class:`CurviregError`, so ``except CurviregError`` catches them together; each is also the built-in
error that a caller would expect, so ``except ValueError`` keeps working. A message is one line that names what was
wrong and what to do.
"""

__all__ = [
    "BankError",
    "CurviregError",
    "ImageError",
    "InvalidInputError",
    "MeshError",
    "MissingDependencyError",
    "MissingFileError",
    "OutputError",
    "RenderingError",
]


class CurviregError(Exception):
    """Base class of the library's errors."""


class InvalidInputError(CurviregError, ValueError):
    """An argument has the wrong shape, dtype, device, range or option name."""


class ImageError(CurviregError, ValueError):
    """A photograph cannot be read or carries no information."""


class MeshError(CurviregError, ValueError):
    """A mesh cannot be read, is empty, or has unusable vertices or faces."""


class BankError(CurviregError, ValueError):
    """A view bank file is truncated, of another version, or does not match what is asked of it."""


class MissingFileError(CurviregError, FileNotFoundError):
    """A file or folder that was named does not exist."""

    def __str__(self) -> str:  # FileNotFoundError would print its errno form
        return str(self.args[0]) if self.args else ""


class OutputError(InvalidInputError, OSError):
    """A file or folder cannot be written."""


class MissingDependencyError(CurviregError, ImportError):
    """An optional package is needed for this call."""


class RenderingError(CurviregError, RuntimeError):
    """No renderer works on this machine, or the one asked for failed."""
