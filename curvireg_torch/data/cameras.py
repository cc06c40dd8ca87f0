"""Calibration files as cameras of the library."""

from dataclasses import asdict

from ..errors import InvalidInputError
from ..formats.cameras import CameraFiles
from ..geometry.calibration import Camera
from ..utils.aliases import PathName


def load_camera(path: PathName) -> Camera:
    """The camera of a calibration file, ``FILE`` or ``FILE:NAME``; ``read_camera`` names the
    formats.

    Raises:
        MissingFileError: the file does not exist.
        InvalidInputError: it is of no such format, or describes a camera that is not supported.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> file = Path(tempfile.mkdtemp(), "cameras.txt")
        >>> _ = file.write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1")
        >>> camera = load_camera(f"{file}:1")
        >>> camera.matrix.tolist()
        [[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]
        >>> camera.distortion, camera.size
        ((-0.1, 0.0, 0.0, 0.0), (480, 640))
    """
    return Calibrations().load(path)


class Calibrations(CameraFiles):
    """:class:`.CameraFiles` of which cameras of the library are made."""

    def load(self, path: PathName) -> Camera:
        """:func:`load_camera`."""
        record = self.read(path)
        try:
            return Camera(**asdict(record))
        except InvalidInputError as error:
            raise InvalidInputError(str(error), subject=path, kind="calibration") from error
