"""The errors that this library raises.

All derive from :class:`CurviregError`, so ``except CurviregError`` catches them together. Each also derives from the
built-in error that fits, so ``except ValueError`` works too. A message is one line: what is wrong and what to do.
"""

from typing import Self

__all__ = [
    "BankError",
    "CurviregError",
    "CurviregWarning",
    "ImageError",
    "InvalidInputError",
    "LostObjectError",
    "MeshError",
    "MissingDependencyError",
    "MissingFileError",
    "OutputError",
    "RenderingError",
]


class _SubjectError(Exception):
    """Message and subject of errors and warnings."""

    def __init__(self, message: str = "", *, subject: object = "") -> None:
        super().__init__(message)
        self.message, self.subject = message, str(subject)

    def __str__(self) -> str:
        return f"{self.subject}: {self.message}" if self.subject else self.message

    def with_subject(self, subject: object) -> Self:
        """A copy about another subject."""
        return type(self)(self.message, subject=subject)


class CurviregError(_SubjectError):
    """Base class of the library's errors.

    Attributes:
        message: what is wrong and what to do.
        subject: the file, photograph or option that the error is about, "" if the message names it. ``str(error)`` is
            ``"subject: message"``.

    Example:
        >>> error = ImageError("truncated; download it again", subject="photo.jpg")
        >>> str(error), str(error.with_subject("image 3"))
        ('photo.jpg: truncated; download it again', 'image 3: truncated; download it again')
    """


class CurviregWarning(_SubjectError, UserWarning):  # noqa: N818
    """A file is usable, but perhaps not what the user means; fields as of :class:`CurviregError`."""


class InvalidInputError(CurviregError, ValueError):
    """An argument has the wrong shape, dtype, device, range or option name."""


class ImageError(CurviregError, ValueError):
    """A photograph cannot be read, or shows nothing to register."""


class MeshError(CurviregError, ValueError):
    """A mesh cannot be read, is empty, or has unusable vertices or faces."""


class BankError(CurviregError, ValueError):
    """A bank file is truncated, of another version, or does not fit the request."""


class MissingFileError(CurviregError, FileNotFoundError):
    """A file or folder does not exist."""


class LostObjectError(CurviregError, ValueError):
    """The object is not near the pose that a refinement started from."""


class OutputError(InvalidInputError, OSError):
    """A file or folder cannot be written."""


class MissingDependencyError(CurviregError, ImportError):
    """An optional package is required for this call."""


class RenderingError(CurviregError, RuntimeError):
    """No renderer works on this machine, or the selected one failed."""
