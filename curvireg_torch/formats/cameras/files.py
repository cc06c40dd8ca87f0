"""Calibration files of OpenCV, ROS, Kalibr, COLMAP, BOP and others."""

import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import MAX_CAMERA_BYTES, InvalidInputError, MissingFileError
from ...utils.aliases import Document, Fields, PathName
from ...utils.choices import listed
from ...utils.files import split_name, without_zeros
from ..documents import EXPECTED, read_document
from .kinds import FORMATS, Format
from .record import (
    CameraRecord,
    Record,
    Used,
    distortion_keys,
    distortion_keys_inside,
    flattened,
    plain,
)

_STEREO = re.compile(
    r"(left|right)?(cameramatrix|mtx|m|k|d|dist|distcoeffs|distortion|distortioncoefficients)"
    r"(left|right|\d\d?|l|r)?"
)
_MATRICES = ("cameramatrix", "mtx", "m", "k")
_DOTTED = re.compile(r"(Camera\d?)\.(\w+)")  # of ORB-SLAM
_KITTI = re.compile(r"P(_rect_)?\d\d?")
_ITEM_NAMES = ("name", "id", "file_path")  # of a camera in a list
_PAIR = {"l": "left", "r": "right"}


def read_camera(path: PathName) -> CameraRecord:
    """The camera of a calibration file; of one with several, ``FILE:NAME`` names one.

    Read are YAML, XML and JSON of OpenCV, also stereo (``M1``, ``D1``: ``FILE:1``), and ``.npz``
    with ``mtx`` and ``dist``; ``camera_info`` of ROS with ``roi`` and ``binning`` (``FILE:P`` is
    the camera of the rectified picture); camchains of Kalibr and ``sensor.yaml`` of EuRoC;
    camodocal's files; ``cameras.txt`` of COLMAP; ``camera.json`` and ``scene_camera.json``
    (``FILE:IMAGE_ID``) of BOP; ``cam_K.txt`` of 3 x 3 numbers; ``camera_data.json`` of MegaPose;
    ``transforms.json`` of nerfstudio; ORB-SLAM's files; ``camera_models.json`` of OpenSfM;
    ``calib.txt`` of KITTI (``FILE:P2``); TOML of aniposelib; XML of Metashape; ppx, ppy of
    RealSense; ``cameraIntrinsics`` of MATLAB; matrices that Open3D and ARKit write column by
    column; ``result.json``. Principal points that count from the corner of the picture (COLMAP,
    nerfstudio) are converted. Four coefficients without a model's name are read as k1, k2, p1, p2,
    with a warning.

    Raises:
        MissingFileError: the file does not exist.
        InvalidInputError: it is none of these, lacks a value, describes a camera that is not
            supported, or has a key that looks like distortion and is not read.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "cameras.txt")
        >>> _ = file.write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1")
        >>> camera = read_camera(f"{file}:1")
        >>> camera.matrix
        ((500.0, 0.0, 319.5), (0.0, 500.0, 239.5), (0.0, 0.0, 1.0))
        >>> camera.distortion, camera.size
        ((-0.1, 0.0, 0.0, 0.0), (480, 640))
    """
    return CameraFiles().read(path)


class CameraFiles:
    """Calibration files, each of which is read once, however many of its cameras are asked for."""

    def __init__(self) -> None:
        self._files: dict[Path, _Cameras] = {}

    def read(self, path: PathName) -> CameraRecord:
        """:func:`read_camera`."""
        file, name = split_name(path)
        if not os.path.isfile(file):
            message = "no such file; check the path of the calibration"
            raise MissingFileError(message, subject=path, kind="calibration")
        try:
            if file not in self._files:
                self._files[file] = _Cameras(_document(file))
            return self._files[file].camera(name)
        except RecursionError:
            raise InvalidInputError("nested too deeply; write it again", subject=path) from None
        except InvalidInputError as error:
            kind = error.kind or "calibration"
            raise InvalidInputError(str(error), subject=path, kind=kind) from error


def _document(file: Path) -> Any:
    if file.stat().st_size > MAX_CAMERA_BYTES:
        raise InvalidInputError(
            f"larger than {MAX_CAMERA_BYTES:,} bytes; leave images and points out"
        )
    return _with_stereo_pair(_with_nested_cameras(read_document(file)))


@dataclass(frozen=True, eq=False)
class _Found:
    """A dict of a document that describes a camera: where it is, the dicts around it, and its
    format."""

    path: tuple[str, ...]
    values: Document
    around: tuple[Document, ...]
    format: Format

    @property
    def names(self) -> set[str]:
        """The whole path, and its parts; numbers without zeros in front."""
        return {without_zeros(part) for part in (*self.path, "/".join(self.path))}


class _Cameras:
    """The cameras of a document."""

    def __init__(self, document: Any) -> None:
        self.found = list(_found(document, (), ()))
        if not self.found:
            raise InvalidInputError(f"no camera matrix; expected {EXPECTED}")
        self.identities = {id(camera.values) for camera in self.found}
        self.outside = list(distortion_keys(document, self.identities))
        self.by_name: dict[str, list[_Found]] = {}
        for camera in self.found:
            for name in camera.names:
                self.by_name.setdefault(name, []).append(camera)
        self.inside = Counter(id(values) for camera in self.found for values in camera.around)

    def camera(self, name: str) -> CameraRecord:
        """The camera with a name; without one, the only camera. Its distortion is all read, or the
        file refused."""
        chosen, parse = self._chosen(name)
        inherits = chosen.format.inherits
        around = [values for values in chosen.around if inherits or self.inside[id(values)] == 1]
        used: Used = set()
        camera: CameraRecord = parse(Record(chosen.values, used, around))
        inside = distortion_keys_inside(chosen.values, self.identities)
        unread = [key for place, key in (*inside, *self.outside) if (place, key) not in used]
        if unread:
            keys = listed(map(repr, dict.fromkeys(unread)), 4)
            raise InvalidInputError(
                f"{keys}: looks like distortion, but is not read; write the coefficients as "
                "distortion_coefficients: [k1, k2, p1, p2, k3], or remove the key"
            )
        return camera

    def _chosen(self, name: str) -> tuple[_Found, Any]:
        """The camera with a name, and the function that reads it."""
        if len(self.found) == 1 and name in self.found[0].format.others:
            return self.found[0], self.found[0].format.others[name]
        named = self.by_name.get(without_zeros(name), []) if name else self.found
        if named and all(camera.values == named[0].values for camera in named):
            return named[0], named[0].format.parse
        last = [camera.path[-1] if camera.path else "" for camera in self.found]
        unique = len(set(last)) == len(last)
        names = last if unique else ["/".join(camera.path) for camera in self.found]
        choice = listed(filter(None, names))
        advice = f"choose one as FILE:NAME from {choice}" if choice else "leave the name out"
        raise InvalidInputError((f"no camera {name!r}; " if name else "several cameras; ") + advice)


def _found(value: Any, path: tuple[str, ...], around: tuple[Document, ...]) -> Iterator[_Found]:
    """The cameras in a document, each before those inside it."""
    if isinstance(value, list):
        for index, item in enumerate(value):
            fields = item if isinstance(item, dict) else {}
            name = next((fields[key] for key in _ITEM_NAMES if key in fields), index)
            yield from _found(item, (*path, str(name)), around)
    if not isinstance(value, dict):
        return
    record = Record(value, set())
    kinds = (kind for kind in FORMATS if record.matches(kind.keys) and kind.also(record))
    kind = next(kinds, None)
    if kind is not None:
        yield _Found(path, value, around, kind)
    for key, inside in value.items():
        yield from _found(inside, (*path, key), (value, *around))


def _with_nested_cameras(document: Any) -> Any:
    """The keys ``Camera.fx`` of ORB-SLAM and the lines ``P2`` of KITTI as cameras with these names;
    other documents as they are. What ORB-SLAM says of ``Camera`` counts for ``Camera1`` too."""
    if not isinstance(document, dict):
        return document
    cameras: dict[str, Fields] = {}
    rest = {}
    for key, value in document.items():
        if match := _DOTTED.fullmatch(key):
            cameras.setdefault(match[1], {})[match[2]] = value
        elif _KITTI.fullmatch(key) and isinstance(value, str) and len(flattened(value)) == 12:
            cameras[key] = {"kitti": value}
        else:
            rest[key] = value
    if any(name[6:].isdecimal() for name in cameras if name.startswith("Camera")):
        common = cameras.pop("Camera", {})
        cameras = {name: {**common, **camera} for name, camera in cameras.items()}
    return {**rest, **cameras}


def _with_stereo_pair(document: Any) -> Any:
    """M1, D1, M2, D2 of a stereo calibration as two cameras "1" and "2"; other documents as they
    are."""
    inside = document
    while isinstance(inside, dict) and len(inside) == 1:  # the root of XML
        (inside,) = inside.values()
    if not isinstance(inside, dict):
        return document
    pairs: dict[str, Fields] = {}
    rest = {}
    for key, value in inside.items():
        match = _STEREO.fullmatch(plain(key))
        side = (match[1] or match[3]) if match else None
        is_single = match is not None and match[2] in ("k", "d") and len(flattened(value)) < 2
        if match is None or side is None or is_single:
            rest[key] = value
        else:
            kind = "camera_matrix" if match[2] in _MATRICES else "distortion"
            pairs.setdefault(_PAIR.get(side, side), {})[kind] = value
    has_matrices = all("camera_matrix" in camera for camera in pairs.values())
    return {**rest, **pairs} if pairs and has_matrices else document
