"""Calibration files of OpenCV, ROS, Kalibr, COLMAP and BOP."""

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch

from ..errors import MAX_CAMERA_BYTES, InvalidInputError, MissingFileError
from ..geometry.calibration import Camera
from ..utils.files import finite_numbers

__all__ = ["load_camera"]

_FORMATS = (
    "YAML, XML or JSON of OpenCV, camera_info of ROS, camchain of Kalibr, cameras.txt of COLMAP, camera.json of BOP"
)
_MATRIX = ("camera_matrix", "intrinsic_matrix", "intrinsics", "camera_intrinsics", "mtx", "K")
_DISTORTION = ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distortion", "dist", "D")
_MODELS = {
    **dict.fromkeys(("", "none", "pinhole", "plumb_bob", "radtan", "rational_polynomial"), "radial-tangential"),
    **dict.fromkeys(("equidistant", "fisheye"), "fisheye"),
}
_COLMAP = {  # numbers of focal lengths and of coefficients, which are the first ones of OpenCV
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "OPENCV_FISHEYE": (2, 4),
}


def load_camera(path: str | os.PathLike[str]) -> Camera:
    """Read a calibration file; of one with several cameras, ``FILE:NAME`` names one.

    Read are YAML, XML and JSON of OpenCV, ``camera_info`` YAML of ROS (plumb_bob, rational_polynomial, equidistant),
    camchains of Kalibr (pinhole with radtan, equidistant or none), ``cameras.txt`` of COLMAP (SIMPLE_PINHOLE, PINHOLE,
    SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE) and ``camera.json`` of BOP. Principal points of COLMAP, for which
    the corner of the picture is (0, 0), are converted.

    Raises:
        MissingFileError: the file does not exist.
        InvalidInputError: it is none of these, lacks a value, or describes a camera that is not supported.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "cameras.txt")
        >>> _ = file.write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1")
        >>> camera = load_camera(f"{file}:1")
        >>> camera.matrix.tolist(), camera.distortion, camera.size
        ([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]], (-0.1, 0.0, 0.0, 0.0), (480, 640))
    """
    return Calibrations().load(path)


class Calibrations:
    """Calibration files, each of which is read once, however many of its cameras are asked for."""

    def __init__(self) -> None:
        self._cameras: dict[Path, dict[str, Any]] = {}

    def load(self, path: str | os.PathLike[str]) -> Camera:
        """:func:`load_camera`."""
        file = Path(path)
        name = ""
        if not os.path.isfile(file) and ":" in str(path):  # unlike Path.is_file, whatever the name is
            front, _, name = str(path).rpartition(":")
            file = Path(front)
        if not os.path.isfile(file):
            message = "no such file; check the path of the calibration, or use --camera exif"
            raise MissingFileError(message, subject=path)
        try:
            if file not in self._cameras:
                self._cameras[file] = _cameras(file)
            return _camera(_chosen(self._cameras[file], name))
        except RecursionError:
            raise InvalidInputError("nested too deeply; write it again", subject=path) from None
        except InvalidInputError as error:
            message = f"{error}; without a calibration, use --camera exif"
            raise InvalidInputError(message, subject=path) from error


def _cameras(file: Path) -> dict[str, Any]:
    """The values of each camera in a file, by name; of a file with one camera alone, the name is empty."""
    if file.stat().st_size > MAX_CAMERA_BYTES:
        raise InvalidInputError(f"larger than {MAX_CAMERA_BYTES:,} bytes; leave images and points out")
    content = _content(file)
    parts = {"": content, **{key: value for key, value in content.items() if isinstance(value, dict)}}
    cameras = {key: value for key, value in parts.items() if _get(value, (*_MATRIX, "fx")) is not None}
    if not cameras:
        raise InvalidInputError(f"no camera matrix; expected {_FORMATS}")
    return cameras


def _content(file: Path) -> dict[str, Any]:
    """Keys and values of a file: numbers, strings, lists of these, and dicts."""
    try:
        text = file.read_text(encoding="utf-8-sig")
        if text.lstrip().startswith("{"):
            return dict(json.loads(text))
        if text.lstrip().startswith("<"):
            return _xml(text)
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"not a text file; expected {_FORMATS}") from error
    except (ValueError, RecursionError, ElementTree.ParseError) as error:
        raise InvalidInputError(f"damaged, or no calibration ({error}); write it again") from error
    return _colmap(text) if re.search(r"^\d+ [A-Z_]+ ", text, re.MULTILINE) else _yaml(text)


def _chosen(cameras: dict[str, Any], name: str) -> dict[str, Any]:
    """The values of a camera; without a name, those of the only one."""
    if not name and len(cameras) == 1:
        (name,) = cameras
    if name not in cameras:
        names = ", ".join(list(cameras)[:8]) + (", ..." if len(cameras) > 8 else "")
        advice = f"choose one as FILE:NAME from {names}" if names else "leave the name out"
        raise InvalidInputError((f"no camera {name!r}; " if name else "several cameras; ") + advice)
    values: dict[str, Any] = cameras[name]
    return values


def _camera(values: dict[str, Any]) -> Camera:
    matrix = _numbers(values, *_MATRIX) or [n for name in ("fx", "fy", "cx", "cy") for n in _numbers(values, name)]
    if len(matrix) == 4:
        fx, fy, cx, cy = matrix
        matrix = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    if len(matrix) != 9:
        raise InvalidInputError(f"camera matrix: expected 9 numbers, or fx, fy, cx, cy, got {len(matrix)}")
    models = [str(_get(values, (name,)) or "") for name in ("camera_model", "distortion_model")]
    models += ["fisheye"] if _get(values, ("fisheye_model",)) == 1 else []
    if unknown := [model for model in models if model.lower() not in _MODELS]:
        known = ", ".join(filter(None, _MODELS))
        raise InvalidInputError(f"camera model {unknown[0]!r} is not supported; choose from {known}")
    size = _numbers(values, "resolution", "image_size")
    size = size or _numbers(values, "image_width", "width") + _numbers(values, "image_height", "height")
    if len(size) not in (0, 2) or any(side != int(side) for side in size):
        raise InvalidInputError(f"size of the image: expected width and height in px, got {size}")
    return Camera(
        torch.tensor(matrix, dtype=torch.float64).view(3, 3),
        _numbers(values, *_DISTORTION),
        "fisheye" if any(_MODELS[model.lower()] == "fisheye" for model in models) else "radial-tangential",
        (int(size[1]), int(size[0])) if size else None,
    )


def _get(values: dict[str, Any], names: Sequence[str]) -> Any:
    """The value of the first key that is one of the names, whatever its case and underscores."""
    plain = {key.lower().replace("_", ""): value for key, value in values.items()}
    return next((plain[key] for name in names if (key := name.lower().replace("_", "")) in plain), None)


def _numbers(values: dict[str, Any], *names: str) -> list[float]:
    """The finite numbers of the first of some keys, of a matrix row by row; none without such a key."""
    flat = _flat(_get(values, names))
    numbers = finite_numbers(flat, len(flat))
    if numbers is None:
        raise InvalidInputError(f"{names[0]}: expected finite numbers, got {flat!r:.80}")
    return list(numbers)


def _flat(value: Any) -> list[Any]:
    while isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list):
        return [number for item in value for number in _flat(item)]
    return [] if value is None else [value]


def _colmap(text: str) -> dict[str, Any]:
    """Cameras by their number, with principal points that count from the centre of the first pixel."""
    cameras = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        focals, count = _COLMAP.get(words[1] if len(words) > 1 else "", (0, 0))
        if not focals or len(words) != 6 + focals + count:
            models = ", ".join(f"{model} ({2 + sum(counts)})" for model, counts in _COLMAP.items())
            raise InvalidInputError(
                f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS..., MODEL (and number of PARAMS) one of "
                f"{models}, got {line!r:.60}"
            )
        width, height, *numbers = _numbers({f"line {number}": list(map(_number, words[2:]))}, f"line {number}")
        cx, cy, *distortion = numbers[focals:]
        cameras[words[0]] = {
            "intrinsics": [numbers[0], numbers[focals - 1], cx - 0.5, cy - 0.5],
            "distortion": [*distortion, 0.0, 0.0, 0.0][:4] if distortion else [],
            "distortion_model": "fisheye" if words[1] == "OPENCV_FISHEYE" else "",
            "resolution": [width, height],
        }
    return cameras


def _xml(text: str) -> dict[str, Any]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InvalidInputError("defines entities, which are not read; write it with cv2.FileStorage")

    def value(element: ElementTree.Element) -> Any:
        if len(element):
            return {child.tag: value(child) for child in element}
        words = [_number(word) for word in (element.text or "").split()]
        return words[0] if len(words) == 1 else words

    root = value(ElementTree.fromstring(text))
    return root if isinstance(root, dict) else {}


def _yaml(text: str) -> dict[str, Any]:
    """The part of YAML that calibrations are written in: nested keys, and lists of scalars; the first document.

    Items of a list below its key become ``"data"`` of it, and what is nested in an item is left out.
    """
    text = re.sub(r"(?m)^%.*|(?:^|[ \t])#.*", "", text)
    text = next((part for part in re.split(r"(?m)^(?:---|\.\.\.)", text) if part.strip()), "")
    lists = r"\"[^\"\n]*\"|\[(?:[^\[\]]|\[[^\[\]]*\])*\]"  # and strings, in which brackets are no lists
    text = re.sub(lists, lambda match: " ".join(match[0].split()), text)
    root: dict[str, Any] = {}
    parents: list[tuple[float, dict[str, Any]]] = [(-1.0, root)]
    for line in filter(str.strip, text.splitlines()):
        indent, line = float(len(line) - len(line.lstrip())), line.strip()
        item = line == "-" or line.startswith("- ")
        indent += 0.5 * item  # items may stand as far left as their key
        while parents[-1][0] >= indent:
            parents.pop()
        nested: dict[str, Any] = {}
        if item:
            parents[-1][1].setdefault("data", []).append(_scalar(line[1:]))
        else:
            key, colon, content = line.partition(":")
            if not colon or content[:1].strip():
                raise InvalidInputError(f"a line that is not 'key: value'; expected {_FORMATS}")
            content = re.sub(r"^\s*!\S*", "", content).strip()
            parents[-1][1][key.strip("\"' ")] = _scalar(content) if content else nested
        parents.append((indent, nested))
    return root


def _scalar(text: str) -> Any:
    """A number, a string, or a list of these, of YAML."""
    text = text.strip()
    if not text.startswith("["):
        return _number(text)
    if not text.endswith("]"):
        raise InvalidInputError("a list without its ']'")
    return [_number(word.strip("[] ")) for word in text.split(",") if word.strip("[] ")]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")
