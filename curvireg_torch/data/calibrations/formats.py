"""The formats of calibrations: how each is recognised, and where its conventions differ from
OpenCV's.

A new format is a row of :data:`FORMATS` and a function from a :class:`Record` to a :class:`Camera`.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from ...errors import CurviregWarning, InvalidInputError
from ...geometry.calibration import Camera
from .documents import number
from .record import Record, flattened, plain

RADIAL_TANGENTIAL = "radial-tangential"
FISHEYE = "fisheye"


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


MATRIX = _names("""
    camera_matrix intrinsic_matrix intrinsics camera_intrinsics mtx K cam_K matrix intrinsic cam_intrinsic
    camera_intrinsic intrinsic_parameters calibration_matrix M K_matrix
""")  # noqa: E501
"""Keys of a camera matrix, or of fx, fy, cx, cy."""

FOCAL = (("fx", "fl_x", "focal_x", "fu"), ("fy", "fl_y", "focal_y", "fv"))
CENTRE = (("cx", "ppx", "u0", "cu"), ("cy", "ppy", "v0", "cv"))
PAIRS = (("fc", "focal_length", "focal_lengths", "focal"), ("cc", "principal_point"))
"""Keys of single numbers of a camera matrix, and of pairs of them."""

DISTORTION = _names("""
    distortion_coefficients distortion_coeffs distortion_coefs distortion_coefficient distortion_coeff
    distortion_coef dist_coeffs dist_coefs dist_coeff dist_coef distortion_parameters distortion_params
    distortion_vector dist_params distortion dist D coeffs coefs coefficients lens_distortion dist_vector kc
""")  # noqa: E501
"""Keys of coefficients in OpenCV's order, or of a dict with single ones."""

RADIAL = _names("radial_distortion radial radial_coefficients radial_distortion_coefficients")
TANGENTIAL = _names(
    "tangential_distortion tangential tangential_coefficients tangential_distortion_coefficients"
)

ORDER = _names("k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y")
"""Single coefficients, in OpenCV's order."""

SIZES = _names("resolution image_size img_size image_resolution size")
WIDTH = _names("image_width width w img_width")
HEIGHT = _names("image_height height h img_height")

MODEL_NAMES = _names("camera_model distortion_model distortion_type model_type")
"""Keys of a model's name: one that is not known is refused."""

OTHER_MODEL_NAMES = _names("model lens_model lens_type camera_type projection projection_type type")
"""Keys that may also name a product, such as "Logitech C920", which is no model."""

FISHEYE_FLAGS = _names("fisheye_model is_fisheye fisheye")

PERSPECTIVE_MODELS = _names("""
    none pinhole simplepinhole perspective frame plumbbob radtan radialtangential brown brownconrady
    rationalpolynomial opencv fullopencv simpleradial radial
""")
FISHEYE_MODELS = _names("equidistant fisheye opencvfisheye kannalabrandt kannalabrandt4")
MODELS = dict.fromkeys(PERSPECTIVE_MODELS, RADIAL_TANGENTIAL) | dict.fromkeys(
    FISHEYE_MODELS, FISHEYE
)
"""Names of models, without case and punctuation, and OpenCV's model."""

KNOWN_MODELS = (
    "none, pinhole, plumb_bob, radtan, radial-tangential, rational_polynomial, equidistant, fisheye"
)

UNSUPPORTED = _names("""
    mei omni unified eucm doublesphere fov ftheta division equirect spherical inversebrown modifiedbrown scaramuzza
    ocam cylindrical orthographic thinprism panoram
""")  # noqa: E501
"""Starts of models that are not OpenCV's."""


@dataclass(frozen=True)
class Format:
    """One kind of calibration.

    Attributes:
        name: as messages call it.
        detect: whether a dict of a file is a camera of this format.
        parse: its camera.
        others: further cameras that it describes, by names that ``FILE:NAME`` may give.
    """

    name: str
    detect: Callable[[Record], bool]
    parse: Callable[[Record], Camera]
    others: Mapping[str, Callable[[Record], Camera]] = field(default_factory=dict)


def camera_from(
    matrix: Sequence[float],
    distortion: Sequence[float] = (),
    model: str = RADIAL_TANGENTIAL,
    size: Any = None,
) -> Camera:
    """The camera with fx, fy, cx, cy or a matrix row by row, or column by column, and a size of (H,
    W)."""
    rows = matrix_rows(matrix)
    return Camera(torch.tensor(rows, dtype=torch.float64), tuple(distortion), model, size)


def matrix_rows(numbers: Sequence[float]) -> list[list[float]]:
    """The 3 x 3 matrix of 4 numbers fx, fy, cx, cy; or of a 3 x 3, 3 x 4 or 4 x 4 matrix, row by
    row, or, as Open3D and ARKit write it, column by column: there cx and cy stand in the last
    row."""
    count = len(numbers)
    if count == 4:
        fx, fy, cx, cy = numbers
        return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    if count not in (9, 12, 16):
        raise InvalidInputError(
            f"camera matrix: expected 9 numbers, or fx, fy, cx, cy, got {count}"
        )
    width = 3 if count == 9 else 4
    rows = [list(numbers[start : start + width]) for start in range(0, count, width)]
    beyond = [row[3] for row in rows[:3] if width == 4] + rows[3][:3] if count == 16 else []
    beyond = [row[3] for row in rows] if count == 12 else beyond
    if any(beyond):
        raise InvalidInputError(
            "camera matrix: expected 3 x 3 numbers, got a projection that also moves the camera"
        )
    rows = [row[:3] for row in rows[:3]]
    by_column = any(rows[2][:2]) and not (rows[0][2] or rows[1][2])
    return [list(column) for column in zip(*rows, strict=True)] if by_column else rows


def read_matrix(record: Record) -> list[float]:
    """The numbers of the camera matrix, as :func:`matrix_rows` takes them."""
    if numbers := record.numbers(*MATRIX):
        return numbers
    singles = [record.numbers(*names) for names in (*FOCAL, *CENTRE)]
    if not any(singles):
        singles = [record.numbers(*names) for names in PAIRS]
    return [value for numbers in singles for value in numbers]


def read_model(record: Record) -> str | None:
    """OpenCV's model, or None if the record names none."""
    flags = record.get(*FISHEYE_FLAGS)
    if flags is not None and flags not in (0, False):
        return FISHEYE
    named = [model_of(text) for text in record.words(*MODEL_NAMES) if text]
    for text in record.words(*OTHER_MODEL_NAMES):
        name = plain(text).removeprefix("distortion")
        if name in MODELS or name.startswith(UNSUPPORTED):
            named.append(model_of(text))
    if not named:
        return None if flags is None else RADIAL_TANGENTIAL
    return FISHEYE if FISHEYE in named else RADIAL_TANGENTIAL


def model_of(text: str) -> str:
    """OpenCV's model of another tool's name."""
    name = plain(text).removeprefix("distortion")
    if name not in MODELS:
        raise InvalidInputError(
            f"camera model {text!r:.40} is not supported; choose from {KNOWN_MODELS}"
        )
    return MODELS[name]


def read_distortion(record: Record, model: str | None) -> list[float]:
    """The coefficients in OpenCV's order; of a list, of single keys, or of keys in a dict."""
    if (inside := record.inside(*DISTORTION)) is not None and inside.get("data") is None:
        return single_coefficients(inside, model)
    if numbers := record.numbers(*DISTORTION):
        return padded(numbers) if len(numbers) < 3 else numbers
    return single_coefficients(record, model)


def single_coefficients(record: Record, model: str | None) -> list[float]:
    """The coefficients of keys k1, k2, ..., or of one list of radial and one of tangential ones."""
    radial = record.numbers(*RADIAL)
    tangential = record.numbers(*TANGENTIAL)
    if radial or tangential:
        if model == FISHEYE:
            return (
                [*radial, *tangential]
                if not any(tangential) and len(radial) == 4
                else [*radial, *tangential, 0.0]
            )
        first = [*radial, 0.0, 0.0][:2]
        rest = radial[2:]
        return padded([*first, *(tangential or (0.0, 0.0)), *rest])
    singles = {name: record.number(name) for name in ORDER}
    if all(value is None for value in singles.values()):
        return []
    if model == FISHEYE:
        if any(singles[name] for name in ORDER if name not in ("k1", "k2", "k3", "k4")):
            raise InvalidInputError(
                "distortion: a fisheye has k1, k2, k3, k4 alone; check the camera's model"
            )
        return [singles[name] or 0.0 for name in ("k1", "k2", "k3", "k4")]
    return padded([singles[name] or 0.0 for name in ORDER])


def padded(coefficients: Sequence[float]) -> list[float]:
    """The coefficients, without zeros at the end, up to one of the numbers that OpenCV has."""
    values = list(coefficients)
    while values and values[-1] == 0.0:
        values.pop()
    count = next(count for count in (0, 4, 5, 8, 12, 14, len(values)) if count >= len(values))
    return [*values, *[0.0] * (count - len(values))]


def read_size(record: Record) -> list[float]:
    """The numbers of the picture's size: width, height, or in the order of the file."""
    if (inside := record.inside(*SIZES)) is not None and inside.get("data") is None:
        return inside.numbers(*WIDTH) + inside.numbers(*HEIGHT)
    return record.numbers(*SIZES) or record.numbers(*WIDTH) + record.numbers(*HEIGHT)


def checked_size(size: Sequence[float]) -> tuple[int, int] | None:
    """(H, W) of width and height."""
    if len(size) not in (0, 2) or any(side != int(side) for side in size):
        raise InvalidInputError(
            f"size of the image: expected width and height in px, got {list(size)}"
        )
    return (int(size[1]), int(size[0])) if size else None


def plain_camera(record: Record) -> Camera:
    """A camera with OpenCV's conventions, and a size of width, height."""
    model = read_model(record)
    matrix = read_matrix(record)
    distortion = read_distortion(record, model)
    if model is None and len(distortion) == 4 and flattened(record.get(*DISTORTION)):
        warnings.warn(
            CurviregWarning(
                "4 coefficients of a lens without a model are read as k1, k2, p1, p2; "
                "write distortion_model: fisheye, or plumb_bob, beside them"
            ),
            stacklevel=2,
        )
    size = checked_size(read_size(record))
    return camera_from(matrix, distortion, model or RADIAL_TANGENTIAL, size)


def is_plain(record: Record) -> bool:
    counts = [
        len(flattened(value)) for key, value in record.values.items() if plain(key) in _PLAIN_MATRIX
    ]
    pairs = [
        len(flattened(value)) == 2
        for key, value in record.values.items()
        if plain(key) in _PLAIN_PAIRS
    ]
    return any(counts) or record.has(*FOCAL[0]) or sum(pairs) == 2


_PLAIN_MATRIX = {plain(name) for name in MATRIX}
_PLAIN_PAIRS = {plain(name) for names in PAIRS for name in names}


def _unknown_order(record: Record) -> Camera:
    """MegaPose writes height, width and others width, height: the principal point lies near the
    centre."""
    camera = plain_camera(record)
    if camera.size is None:
        return camera
    cx, cy = (float(value) for value in camera.matrix[:2, 2])

    def distance(size: tuple[int, int]) -> float:
        H, W = size
        return abs(cx / W - 0.5) + abs(cy / H - 0.5)

    first, second = camera.size
    return replace(camera, size=min((camera.size, (second, first)), key=distance))


def _has_pair_of_sides(record: Record) -> bool:
    sides = [value for key, value in record.values.items() if plain(key) in _PLAIN_SIZES]
    matrices = [
        len(flattened(value)) for key, value in record.values.items() if plain(key) in _PLAIN_MATRIX
    ]
    return 9 in matrices and any(isinstance(side, list) for side in sides)


_PLAIN_SIZES = {plain(name) for name in SIZES}


def _own_result(record: Record) -> Camera:
    """The object "camera" of result.json: its size is height, width. A focal length that was
    estimated remains as uncertain as it was."""
    camera = plain_camera(record)
    if camera.size is not None:
        camera = replace(camera, size=(camera.size[1], camera.size[0]))
    deviations = record.numbers("focal_deviation")
    if not deviations:
        return camera
    # the metadata that an "exif" refers to are another photograph's
    source = "estimated" if record.get("source") == "estimated" else "given"
    return replace(camera, focal_deviation=deviations[0], source=source)


def _ros(record: Record) -> Camera:
    return _region(record, plain_camera(record))


def _ros_rectified(record: Record) -> Camera:
    """The camera of ``image_rect``: the left 3 x 3 of the projection matrix, without distortion."""
    numbers = record.numbers("P", "projection_matrix")
    if len(numbers) != 12:
        raise InvalidInputError(f"projection matrix: expected 12 numbers, got {len(numbers)}")
    plain_camera(record)  # reads, and so checks, the rest
    rows = [value for start in (0, 4, 8) for value in numbers[start : start + 3]]
    return _region(record, camera_from(rows, size=checked_size(read_size(record))))


def _region(record: Record, camera: Camera) -> Camera:
    """The camera of the pixels that a message's ``roi`` and ``binning`` leave; its matrix is that
    of all pixels."""
    roi = record.inside("roi") or Record({}, record.used)
    names = ("x_offset", "y_offset", "width", "height")
    left, top, width, height = (roi.number(name) or 0.0 for name in names)
    steps = [max(1.0, record.number(name) or 1.0) for name in ("binning_x", "binning_y")]
    if (left, top, width, height, *steps) == (0.0, 0.0, 0.0, 0.0, 1.0, 1.0):
        return camera
    H, W = camera.size or (0, 0)
    width = width or W - left
    height = height or H - top
    move = torch.eye(3, dtype=torch.float64)
    for axis, (step, offset) in enumerate(zip(steps, (left, top), strict=True)):
        move[axis, axis] = 1.0 / step
        # a pixel covers the ``step`` ones from its first edge on
        move[axis, 2] = (0.5 - offset) / step - 0.5
    size = (int(height // steps[1]), int(width // steps[0]))
    return replace(camera, matrix=move @ camera.matrix, size=size if min(size) > 0 else None)


def _nerfstudio(record: Record) -> Camera:
    """Of nerfstudio and instant-ngp: pixels count from the picture's corner, as COLMAP's."""
    model = read_model(record)
    width = record.number("w")
    height = record.number("h")
    if (fx := record.number("fl_x")) is None:
        raise InvalidInputError("no fl_x; without it, give the field of view", kind="view")
    fy = record.number("fl_y") or fx
    cx = record.number("cx")
    cy = record.number("cy")
    if cx is None or cy is None:
        raise InvalidInputError("no cx and cy beside fl_x; add the principal point, in px")
    if model != FISHEYE and record.number("k4"):
        raise InvalidInputError(
            "distortion: k4 of nerfstudio is not OpenCV's; calibrate without it"
        )
    distortion = single_coefficients(record, model)
    size = checked_size([side for side in (width, height) if side is not None])
    return camera_from([fx, fy, cx - 0.5, cy - 0.5], distortion, model or RADIAL_TANGENTIAL, size)


# numbers of focal lengths and of coefficients, which are the first ones of OpenCV, and the model
COLMAP = {
    "SIMPLE_PINHOLE": (1, 0, RADIAL_TANGENTIAL),
    "PINHOLE": (2, 0, RADIAL_TANGENTIAL),
    "SIMPLE_RADIAL": (1, 1, RADIAL_TANGENTIAL),
    "RADIAL": (1, 2, RADIAL_TANGENTIAL),
    "OPENCV": (2, 4, RADIAL_TANGENTIAL),
    "FULL_OPENCV": (2, 8, RADIAL_TANGENTIAL),
    "OPENCV_FISHEYE": (2, 4, FISHEYE),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, FISHEYE),
    "RADIAL_FISHEYE": (1, 2, FISHEYE),
}


def _colmap(record: Record) -> Camera:
    """A line of ``cameras.txt``: the corner of the picture is (0, 0)."""
    words = record.values["colmap"]
    line = f"line {record.values['line']}"
    focals, count, model = COLMAP.get(words[1] if len(words) > 1 else "", (0, 0, ""))
    if not focals or len(words) != 6 + focals + count:
        models = ", ".join(
            f"{name} ({2 + focals + count})" for name, (focals, count, _) in COLMAP.items()
        )
        raise InvalidInputError(
            f"{line}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS..., MODEL (and number of "
            f"PARAMS) one of {models}"
        )
    numbers = Record({line: [number(word) for word in words[2:]]}, record.used).numbers(line)
    width, height, *values = numbers
    cx, cy, *distortion = values[focals:]
    if distortion:
        distortion = [*distortion, 0.0, 0.0, 0.0][: max(4, count)]
    matrix = [values[0], values[focals - 1], cx - 0.5, cy - 0.5]
    return camera_from(matrix, distortion, model, checked_size([width, height]))


def _metashape(record: Record) -> Camera:
    """Of Agisoft Metashape: cx and cy count from the picture's centre, p1 and p2 change places, k4
    is a power of r."""
    size = read_size(record)
    if len(size) != 2:
        raise InvalidInputError("no width and height beside f; export the calibration again")
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    values = {name: record.number(name) or 0.0 for name in names}
    model = read_model(record) or RADIAL_TANGENTIAL
    unread = [name for name in ("b2", "p3", "p4") if values[name]]
    unread += ["k4"] if values["k4"] and model != FISHEYE else []
    unread += [name for name in ("p1", "p2") if values[name] and model == FISHEYE]
    if unread:
        message = (
            f"{', '.join(unread)} of Metashape have no counterpart in OpenCV; optimise the "
            f"cameras without them"
        )
        raise InvalidInputError(f"distortion: {message}")
    cx, cy = (side / 2 + values[name] - 0.5 for side, name in zip(size, ("cx", "cy"), strict=True))
    radial = [values[name] for name in ("k1", "k2", "k3", "k4")]
    lens = (
        radial if model == FISHEYE else padded([*radial[:2], values["p2"], values["p1"], radial[2]])
    )
    return camera_from(
        [values["f"] + values["b1"], values["f"], cx, cy], lens, model, checked_size(size)
    )


def _kannala_brandt(record: Record) -> Camera:
    """Of camodocal: k2 to k5 are OpenCV's k1 to k4 of a fisheye."""
    matrix = [value for name in ("mu", "mv", "u0", "v0") for value in record.numbers(name)]
    distortion = [value for name in ("k2", "k3", "k4", "k5") for value in record.numbers(name)]
    record.words(*MODEL_NAMES)
    return camera_from(matrix, distortion, FISHEYE, checked_size(read_size(record)))


def _mei(record: Record) -> Camera:
    record.words(*MODEL_NAMES)
    raise InvalidInputError(f"camera model 'MEI' is not supported; choose from {KNOWN_MODELS}")


FORMATS = (
    Format("COLMAP", lambda record: "colmap" in record.values, _colmap),
    Format(
        "nerfstudio", lambda record: record.has("fl_x") or record.has("camera_angle_x"), _nerfstudio
    ),
    Format(
        "camodocal, Kannala-Brandt",
        lambda record: record.has("mu") and record.has("mv"),
        _kannala_brandt,
    ),
    Format("camodocal, MEI", lambda record: record.has("gamma1"), _mei),
    Format("Metashape", lambda record: record.has("f") and not record.has("fx"), _metashape),
    Format(
        "ROS",
        lambda record: (
            is_plain(record) and record.has("P", "projection_matrix", "binning_x", "roi")
        ),
        _ros,
        {"P": _ros_rectified},
    ),
    Format(
        "result.json",
        lambda record: record.has("matrix") and record.has("distortion", "size"),
        _own_result,
    ),
    Format("MegaPose", _has_pair_of_sides, _unknown_order),
    Format("OpenCV", is_plain, plain_camera),
)
"""The first that detects a dict reads it."""
