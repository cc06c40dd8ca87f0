"""The errors that this library raises.

All derive from :class:`CurviregError`, so ``except CurviregError`` catches them together. Each also
derives from the built-in error that fits, so ``except ValueError`` works too. A message is one
line: what is wrong and what to do.

Input files are untrusted: a file beyond one of the limits below is refused with an error that names
the limit. Readers use no network, and open only the named file and, for meshes, files that it names
in its folder or a given one.
"""

from collections.abc import Sequence
from typing import Any, Self


class _SubjectError(Exception):
    """Message and subject of errors and warnings."""

    def __init__(
        self,
        message: str = "",
        *,
        subject: object = "",
        images: Sequence[int] = (),
        causes: "Sequence[CurviregError]" = (),
        kind: str = "",
    ) -> None:
        super().__init__(message)
        self.message = message
        self.subject = str(subject)
        self.images = tuple(images)
        self.causes = tuple(causes)
        self.kind = kind

    def __str__(self) -> str:
        numbers = " and ".join(f"image {number}" for number in self.images)
        reasons = "; ".join(map(str, self.causes))
        parts = (numbers, self.subject, self.message, reasons)
        return ": ".join(part for part in parts if part)

    def _copy(self, **changes: Any) -> Self:
        # Dask changes how the standard library copies errors: copies share their attributes.
        other = type(self)(self.message)
        vars(other).update(vars(self), **changes)
        return other

    def with_subject(self, subject: object) -> Self:
        """A copy about another subject, whatever it was about before."""
        return self._copy(subject=str(subject), images=())

    def of_image(self, number: int) -> Self:
        """A copy about the same subject in a photograph, by its number from 0."""
        return self._copy(images=(number,))

    def with_image_names(self, names: Sequence[str]) -> Self:
        """A copy that calls photographs by their names instead of numbers."""
        named = " and ".join(names[number] for number in self.images)
        subject = ": ".join(part for part in (named, self.subject) if part)
        causes = tuple(cause.with_image_names(names) for cause in self.causes)
        return self._copy(subject=subject, images=(), causes=causes)


class CurviregError(_SubjectError):
    """Base class of the library's errors.

    Attributes:
        message: what is wrong and what to do.
        subject: the file, photograph or option that the error is about, "" if the message names it.
            ``str(error)`` is ``"subject: message"``.
        images: numbers from 0 of the photographs, of several, that the error is about.
        causes: errors of single photographs, which together are the reason.
        kind: what would help, for programs that know how to give it, such as "camera" or "unit";
            "" for everything else. The command line adds its options.

    Example:
        >>> error = ImageError("truncated; download it again", subject="photo.jpg")
        >>> str(error), str(error.with_subject("image 3"))
        ('photo.jpg: truncated; download it again', 'image 3: truncated; download it again')
    """


class CurviregWarning(_SubjectError, UserWarning):  # noqa: N818
    """A file is usable, but perhaps not what the user means; fields as of
    :class:`CurviregError`.

    Example:
        >>> import warnings
        >>> with warnings.catch_warnings(record=True) as seen:
        ...     warnings.simplefilter("always")
        ...     warnings.warn(CurviregWarning("small", subject="the box"), stacklevel=1)
        >>> str(seen[0].message)
        'the box: small'
    """


class InvalidInputError(CurviregError, ValueError):
    """An argument has the wrong shape, dtype, device, range or option name.

    Example:
        >>> issubclass(InvalidInputError, ValueError)
        True
    """


class ImageError(CurviregError, ValueError):
    """A photograph cannot be read, or shows nothing to register.

    Example:
        >>> issubclass(ImageError, ValueError)
        True
    """


class MeshError(CurviregError, ValueError):
    """A mesh cannot be read, is empty, or has unusable vertices or faces.

    Example:
        >>> issubclass(MeshError, ValueError)
        True
    """


class BankError(CurviregError, ValueError):
    """A bank file is truncated, of another version, or does not fit the request.

    Example:
        >>> issubclass(BankError, ValueError)
        True
    """


class MissingFileError(CurviregError, FileNotFoundError):
    """A file or folder does not exist.

    Example:
        >>> issubclass(MissingFileError, FileNotFoundError)
        True
    """


class LostObjectError(CurviregError, ValueError):
    """The object is not found in a photograph without a box, or not near the pose that a refinement
    started from.

    Attributes:
        detection: the :class:`.Detection` of the most likely place, with all proposals, in a
            photograph without a box.

    Example:
        >>> issubclass(LostObjectError, ValueError)
        True
    """

    detection: Any = None


class OutputError(InvalidInputError, OSError):
    """A file or folder cannot be written.

    Example:
        >>> issubclass(OutputError, OSError)
        True
    """


class MissingDependencyError(CurviregError, ImportError):
    """An optional package is required for this call.

    Example:
        >>> issubclass(MissingDependencyError, ImportError)
        True
    """


class WorkerError(CurviregError, RuntimeError):
    """A process that registers photographs or reads files did not start, or ended too early.

    Example:
        >>> issubclass(WorkerError, RuntimeError)
        True
    """


class RenderingError(CurviregError, RuntimeError):
    """No renderer works on this machine, or the selected one failed.

    Example:
        >>> issubclass(RenderingError, RuntimeError)
        True
    """


MAX_IMAGE_BYTES = 1 << 28  #: Bytes of an image file
#: Width times height in the header, before anything is decoded: Pillow's limit
MAX_IMAGE_PIXELS = 89_478_485
#: Scans of a progressive JPEG. Encoders write about ten, and each takes as long to decode as the
#: whole picture.
MAX_IMAGE_SCANS = 64
MAX_BOX_COORDINATE = 1e6  #: Distance of a box's corner from the origin, px; no image is that wide
MAX_MESH_BYTES = 1 << 29  #: Bytes of a mesh file, and of all the buffers of a glTF file together
MAX_MESH_FACES = 10_000_000  #: Triangles of a mesh; every copy of a part counts
#: Lines of a text file with polygons; each takes some 50 bytes more than its text
MAX_MESH_LINES = 50_000_000
#: Distance of a vertex from the origin along an axis, in the file's unit; squares and products stay
#: finite
MAX_MESH_COORDINATE = 1e12
#: Longest side of a mesh's box, in the file's unit; of smaller ones single precision computes no
#: views
MIN_MESH_EXTENT = 1e-6
#: Nodes with a mesh in a glTF scene; parts, materials and libraries of an OBJ file; files that a
#: mesh names
MAX_MESH_PARTS = 10_000
MAX_CAD_BYTES = 1 << 27  #: Bytes of a STEP, IGES or Collada file
MAX_CAD_SECONDS = 300  #: Time in which OpenCASCADE must have made triangles of a STEP or IGES file
#: Memory of the process in which OpenCASCADE, OpenUSD or SciPy reads a file, in bytes
MAX_CAD_MEMORY = 4 << 30
#: Elements of an XML file, as Collada and URDF are; each takes up to 300 bytes
MAX_XML_ELEMENTS = 5_000_000
MAX_TEXTURE_PIXELS = 1 << 28  #: Pixels of all textures of a mesh together: 16 of 4096 x 4096
#: Sum of squared corners of all concave faces, which bounds the time of their division: a million
#: quads, or five faces of 2000 corners
MAX_POLYGON_WORK = 20_000_000
#: Bytes of a JSON or CSV file, 32 MiB; rows of a CSV of poses take up to 60 times as much memory
MAX_TABLE_BYTES = 1 << 25
MAX_LIST_COLUMNS = 1000  #: Columns of a list of photographs; each row has a text for each
MAX_RIG_VIEWS = 10_000  #: Photographs of a rig
MAX_CAMERA_BYTES = 1 << 22  #: Bytes of a calibration file
MAX_MAT_BYTES = 1 << 20  #: Bytes of a MATLAB annotation file
#: Triangles that the viewer sends to the browser, 96 bytes each; for larger meshes it shows a
#: notice
MAX_VIEWER_FACES = 300_000
MAX_VIEWER_PHOTOGRAPHS = 20  #: Photographs that the viewer holds in memory
#: Bytes of the uploaded files of the viewer, those on their way included
MAX_VIEWER_BYTES = 1 << 30
MAX_ARCHIVE_FILES = 1000  #: Files in a zip archive with a mesh and its parts
