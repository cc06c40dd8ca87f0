"""The formats of calibrations: how each is recognised, and where its conventions differ from
OpenCV's.

A new format is a row of :data:`FORMATS` and a function from a :class:`Record` to a :class:`Camera`.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...errors import CurviregWarning, InvalidInputError
from ...utils.aliases import Size
from ..documents import number
from .record import CameraRecord, Record, flattened, plain

RADIAL_TANGENTIAL = "radial-tangential"
FISHEYE = "fisheye"
CAMERA_MODELS = (RADIAL_TANGENTIAL, FISHEYE)


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

ONE_FOCAL = "f"
"""Key of the focal length of square pixels."""

DISTORTION = _names("""
    distortion_coefficients distortion_coeffs distortion_coefs distortion_coefficient distortion_coeff
    distortion_coef dist_coeffs dist_coefs dist_coeff dist_coef distortion_parameters distortion_params
    distortion_vector dist_params distortion distortions dist D coeffs coefs coefficients lens_distortion dist_vector kc
""")  # noqa: E501
"""Keys of coefficients in OpenCV's order, or of a dict with single ones."""

RADIAL = _names("radial_distortion radial radial_coefficients radial_distortion_coefficients")
TANGENTIAL = _names(
    "tangential_distortion tangential tangential_coefficients tangential_distortion_coefficients"
)

ORDER = _names("k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y")
"""Single coefficients, in OpenCV's order."""

SIZES = _names("""
    resolution image_size img_size image_resolution size image_shape img_shape image_dimensions imsize frame_size
    dim img_dim intrinsic_matrix_reference_dimensions
""")  # noqa: E501
WIDTH = _names("image_width width w img_width")
HEIGHT = _names("image_height height h img_height")

MODEL_NAMES = _names("camera_model distortion_model distortion_type model_type")
"""Keys of a model's name: one that is not known is refused."""

OTHER_MODEL_NAMES = _names("model lens_model lens_type camera_type projection projection_type type")
"""Keys that may also name a product, such as "Logitech C920", which is no model."""

FISHEYE_FLAGS = _names("fisheye_model is_fisheye fisheye")
FLAGS = dict.fromkeys(_names("1 1.0 true yes on"), True)
FLAGS |= dict.fromkeys(_names("0 0.0 false no off"), False)

PERSPECTIVE_MODELS = _names("""
    none pinhole simplepinhole perspective frame plumbbob radtan radialtangential brown brownconrady
    rationalpolynomial opencv fullopencv simpleradial radial
""")
FISHEYE_MODELS = _names(
    "equidistant fisheye opencvfisheye kannalabrandt kannalabrandt4 kannalabrandt8 kb4"
)
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

UNSUPPORTED_OF_BASALT = _names("ds ucm")
"""Whole names of such models."""

PINHOLE_OF_ZEROS = _names("inversebrown modifiedbrown")
"""Starts of models of which a camera without distortion is a pinhole, as RealSense writes it."""

REALSENSE_MODELS = _names("none modifiedbrown inversebrown ftheta brown kannalabrandt4")
"""Models of librealsense by their numbers."""

DEPTHAI_MODELS = _names("perspective fisheye equirectangular division")
"""The same of DepthAI."""


NEAR_CENTRE = 0.1  # distance of a principal point from the centre, as a fraction of the sides
MAX_FRACTION = 4.0  # of focal lengths and principal points in fractions of the picture


@dataclass(frozen=True)
class Format:
    """One kind of calibration.

    Attributes:
        keys: of a dict of a file that is a camera of this format, see :meth:`Record.matches`.
        parse: its camera.
        others: further cameras that it describes, by names that ``FILE:NAME`` may give.
        inherits: whether what the dicts around it say counts for each of several cameras in them.
        also: what else such a dict must be.
    """

    keys: str
    parse: Callable[[Record], CameraRecord]
    others: Mapping[str, Callable[[Record], CameraRecord]] = field(default_factory=dict)
    inherits: bool = False
    also: Callable[[Record], bool] = lambda _: True


def _camera_from(
    matrix: Sequence[float],
    distortion: Sequence[float] = (),
    model: str = RADIAL_TANGENTIAL,
    size: Any = None,
) -> CameraRecord:
    """The camera with fx, fy, cx, cy or a matrix row by row, or column by column, and a size of (H,
    W)."""
    rows = _matrix_rows(matrix)
    if 0.0 < rows[0][0] < MAX_FRACTION and max(rows[0][2], rows[1][2]) < MAX_FRACTION:
        raise InvalidInputError(
            "camera matrix: in fractions of the picture, not in px; multiply fx and cx by its "
            "width, fy and cy by its height"
        )
    return CameraRecord(tuple(map(tuple, rows)), tuple(distortion), model, size)


def _matrix_rows(numbers: Sequence[float]) -> list[list[float]]:
    """The 3 x 3 matrix of 4 numbers fx, fy, cx, cy; or of a 3 x 3, 3 x 4 or 4 x 4 matrix, row by
    row, or, as Open3D and ARKit write it, column by column: there cx and cy stand in the last
    row."""
    count = len(numbers)
    if count and not any(numbers):
        raise InvalidInputError(
            "camera matrix: zeros, as ROS writes for a camera that is not calibrated; calibrate it"
        )
    if count == 4:
        fx, fy, cx, cy = numbers
        return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    if count not in (9, 12, 16):
        raise InvalidInputError(
            f"camera matrix: expected 9 numbers, or fx, fy, cx, cy, got {count}"
        )
    K = np.reshape(numbers, (-1, 3 if count == 9 else 4))
    if K[:3, 3:].any() or K[3:, :3].any():
        raise InvalidInputError(
            "camera matrix: expected 3 x 3 numbers, got a projection that also moves the camera"
        )
    K = K[:3, :3]
    return (K.T if K[2, :2].any() else K).tolist()


def _read_matrix(record: Record) -> list[float]:
    """The numbers of the camera matrix, as :func:`_matrix_rows` takes them."""
    if numbers := record.numbers(*MATRIX):
        return numbers
    singles = {names[0]: record.numbers(*names) for names in (*FOCAL, *CENTRE)}
    if not any(singles.values()):
        return [value for names in PAIRS for value in record.numbers(*names)]
    for names in FOCAL:
        singles[names[0]] = singles[names[0]] or record.numbers(ONE_FOCAL)
    missing = [name for name, numbers in singles.items() if not numbers]
    if missing:
        raise InvalidInputError(
            f"camera matrix: expected 9 numbers, or fx, fy, cx, cy, got {4 - len(missing)} of "
            f"these; add {', '.join(missing)}, in px"
        )
    return [value for numbers in singles.values() for value in numbers]


def _read_model(record: Record) -> str | None:
    """OpenCV's model, or None if the record names none."""
    flag = record.get(*FISHEYE_FLAGS)
    is_fisheye = FLAGS.get(str(flag).lower())
    if flag is not None and is_fisheye is None:
        raise InvalidInputError(f"{FISHEYE_FLAGS[-1]}: expected yes or no, got {flag!r:.40}")
    if is_fisheye:
        return FISHEYE
    named = [_model_of(text) for text in record.words(*MODEL_NAMES) if text]
    for text in _other_models(record):
        name = _plain_model(text)
        is_pinhole = name.startswith(PINHOLE_OF_ZEROS) and not any(
            flattened(record.get(*DISTORTION))
        )
        if is_pinhole:
            named.append(RADIAL_TANGENTIAL)
        elif name in (*MODELS, *UNSUPPORTED_OF_BASALT) or name.startswith(UNSUPPORTED):
            named.append(_model_of(text))
    if not named:
        return None if flag is None else RADIAL_TANGENTIAL
    return FISHEYE if FISHEYE in named else RADIAL_TANGENTIAL


def _other_models(record: Record) -> list[str]:
    """What may be the names of models; the numbers of librealsense and DepthAI as names."""
    names = record.words(*OTHER_MODEL_NAMES)
    for key, models, coefficients in (
        ("model", REALSENSE_MODELS, "coeffs"),
        ("camera_type", DEPTHAI_MODELS, "distortion_coeff"),
    ):
        index = record.get(key)  # a float in YAML and XML
        if (
            record.has(coefficients)
            and isinstance(index, int | float)
            and index in range(len(models))
        ):
            names.append(models[int(index)])
    return names


def _plain_model(text: str) -> str:
    """A model's name without case, punctuation, and what librealsense writes in front."""
    return plain(text).removeprefix("rs2").removeprefix("distortion")


def _model_of(text: str) -> str:
    """OpenCV's model of another tool's name."""
    name = _plain_model(text)
    if name not in MODELS:
        raise _unsupported(text)
    return MODELS[name]


def _unsupported(name: object, known: str = KNOWN_MODELS) -> InvalidInputError:
    return InvalidInputError(f"camera model {name!r:.40} is not supported; choose from {known}")


def _read_distortion(record: Record, model: str | None) -> list[float]:
    """The coefficients in OpenCV's order; of a list, of single keys, or of keys in a dict."""
    if (inside := record.inside(*DISTORTION)) is not None and inside.get("data") is None:
        return _single_coefficients(inside, model)
    if numbers := record.numbers(*DISTORTION):
        if model == FISHEYE and len(numbers) > 4 and not any(numbers[4:]):
            return numbers[:4]  # librealsense has room for five, DepthAI for 14
        return padded(numbers) if len(numbers) < 3 else numbers
    return _single_coefficients(record, model)


def _single_coefficients(record: Record, model: str | None) -> list[float]:
    """The coefficients of keys k1, k2, ..., or of one list of radial and one of tangential ones."""
    radial = record.numbers(*RADIAL)
    tangential = record.numbers(*TANGENTIAL)
    if radial or tangential:
        if model == FISHEYE:
            return [*radial, *tangential, *([] if len(radial) == 4 else [0.0])]
        first = [*radial, 0.0, 0.0][:2]
        rest = radial[2:]
        return padded([*first, *(tangential or (0.0, 0.0)), *rest])
    singles = {name: record.number(name) for name in ORDER}
    if all(value is None for value in singles.values()):
        return []
    has_others = any(singles[name] is not None for name in ("p1", "p2", "k5"))
    if model is None and singles["k4"] and not has_others:
        raise InvalidInputError(
            "distortion: k1 to k4 without p1 and p2 may be those of a fisheye; write "
            "distortion_model: fisheye, or rational_polynomial, beside them"
        )
    if model != FISHEYE:
        return padded([value or 0.0 for value in singles.values()])
    fisheye = [singles.pop(name) or 0.0 for name in ("k1", "k2", "k3", "k4")]
    if any(singles.values()):
        raise InvalidInputError(
            "distortion: a fisheye has k1, k2, k3, k4 alone; check the camera's model"
        )
    return fisheye


def padded(coefficients: Sequence[float]) -> list[float]:
    """The coefficients, without zeros at the end, up to one of the numbers that OpenCV has."""
    last = max((k for k, value in enumerate(coefficients, start=1) if value), default=0)
    count = next(count for count in (0, 4, 5, 8, 12, 14, last) if count >= last)
    return [*coefficients[:last], *[0.0] * (count - last)]


def _read_size(record: Record) -> list[float]:
    """The numbers of the picture's size: width, height, or in the order of the file."""
    inside = record.inside(*SIZES)
    if inside is not None and inside.has(*WIDTH):
        return inside.numbers(*WIDTH) + inside.numbers(*HEIGHT)
    sides = record.numbers(*SIZES)
    if len(sides) == 3 and sides[2] in (1.0, 3.0, 4.0):
        return sides[:2]  # the shape of an array with its channels
    return sides or record.numbers(*WIDTH) + record.numbers(*HEIGHT)


def _checked_size(size: Sequence[float]) -> Size | None:
    """(H, W) of width and height."""
    if len(size) not in (0, 2) or any(side != int(side) for side in size):
        raise InvalidInputError(
            f"size of the image: expected width and height in px, got {list(size)}"
        )
    return (int(size[1]), int(size[0])) if size else None


def _plain_camera(record: Record) -> CameraRecord:
    """A camera with OpenCV's conventions, and a size of width, height."""
    model = _read_model(record)
    matrix = _read_matrix(record)
    distortion = _read_distortion(record, model)
    if model is None and len(flattened(record.get(*DISTORTION))) == 4:
        warnings.warn(
            CurviregWarning(
                "4 coefficients of a lens without a model are read as k1, k2, p1, p2; "
                "write distortion_model: fisheye, or plumb_bob, beside them"
            ),
            stacklevel=2,
        )
    size = _checked_size(_read_size(record))
    return _camera_from(matrix, distortion, model or RADIAL_TANGENTIAL, size)


def _is_plain(record: Record) -> bool:
    has_one_focal = record.has(ONE_FOCAL) and record.has(*CENTRE[0])
    has_pairs = record.lengths(*PAIRS[0], *PAIRS[1]).count(2) == 2
    return any(record.lengths(*MATRIX)) or record.has(*FOCAL[0]) or has_one_focal or has_pairs


def _unknown_order(record: Record) -> CameraRecord:
    """MegaPose writes height, width and others width, height: the former is taken where the
    principal point lies near the centre of such a picture, and nearer than of the latter."""
    camera = _plain_camera(record)
    if camera.size is None:
        return camera
    cx, cy = (row[2] for row in camera.matrix[:2])

    def distance(size: Size) -> float:
        return abs(cx / size[1] - 0.5) + abs(cy / size[0] - 0.5)

    turned = camera.size[::-1]
    is_turned = distance(turned) < min(NEAR_CENTRE, distance(camera.size))
    return replace(camera, size=turned) if is_turned else camera


def _has_pair_of_sides(record: Record) -> bool:
    has_matrix = 9 in record.lengths(*MATRIX) or record.has(*FOCAL[0])
    return has_matrix and isinstance(record.get(*SIZES), list)


def _is_matlab(record: Record) -> bool:
    """By the case of its names, which others write with underscores."""
    return {"ImageSize", "FocalLength", "PrincipalPoint"} <= record.values.keys()


def _matlab(record: Record) -> CameraRecord:
    """The properties of a ``cameraIntrinsics``: pixels count from 1, and the size is rows,
    columns."""
    camera = _plain_camera(record)
    columns, rows, last = camera.matrix
    matrix = ((*columns[:2], columns[2] - 1.0), (*rows[:2], rows[2] - 1.0), last)
    return replace(camera, matrix=matrix, size=camera.size and camera.size[::-1])


def _is_own_result(record: Record) -> bool:
    return record.get("model") in CAMERA_MODELS and not record.has(*WIDTH)


def _own_result(record: Record) -> CameraRecord:
    """The object "camera" of result.json: its size is height, width. A focal length that was
    estimated remains as uncertain as it was."""
    camera = _plain_camera(record)
    camera = replace(camera, size=camera.size and camera.size[::-1])
    deviations = record.numbers("focal_deviation")
    if not deviations:
        return camera
    # the metadata that an "exif" refers to are another photograph's
    source = "estimated" if record.get("source") == "estimated" else "given"
    return replace(camera, focal_deviation=deviations[0], source=source)


def _ros(record: Record) -> CameraRecord:
    return _region(record, _plain_camera(record))


def _ros_rectified(record: Record) -> CameraRecord:
    """The camera of ``image_rect``: the left 3 x 3 of the projection matrix, without distortion."""
    numbers = record.numbers("P", "projection_matrix")
    if len(numbers) != 12:
        raise InvalidInputError(f"projection matrix: expected 12 numbers, got {len(numbers)}")
    size = _plain_camera(record).size  # reads, and so checks, the rest
    return _region(record, _camera_from(_left_part(numbers), size=size))


def _left_part(projection: Sequence[float]) -> list[float]:
    """The left 3 x 3 of a projection matrix of 3 x 4, whose last column moves the camera."""
    return [value for start in (0, 4, 8) for value in projection[start : start + 3]]


def _region(record: Record, camera: CameraRecord) -> CameraRecord:
    """The camera of the pixels that a message's ``roi`` and ``binning`` leave; its matrix is that
    of all pixels."""
    roi = record.inside("roi") or Record({}, record.used)
    names = ("x_offset", "y_offset", "width", "height")
    left, top, width, height = (roi.number(name) or 0.0 for name in names)
    steps = [max(1.0, record.number(name) or 1.0) for name in ("binning_x", "binning_y")]
    rows = [
        # a pixel covers the ``step`` ones from its first edge on
        (a / step, b / step, (c - offset + (1.0 - step) / 2) / step)
        for (a, b, c), step, offset in zip(camera.matrix, steps, (left, top), strict=False)
    ]
    H, W = camera.size or (0, 0)
    size = int((height or H - top) // steps[1]), int((width or W - left) // steps[0])
    matrix = (*rows, camera.matrix[2])
    return replace(camera, matrix=matrix, size=size if min(size) > 0 else None)


def _nerfstudio(record: Record) -> CameraRecord:
    """Of nerfstudio and instant-ngp: pixels count from the picture's corner, as COLMAP's."""
    model = _read_model(record)
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
    distortion = _single_coefficients(record, model)
    size = _checked_size(record.numbers("w") + record.numbers("h"))
    return _camera_from([fx, fy, cx - 0.5, cy - 0.5], distortion, model or RADIAL_TANGENTIAL, size)


OPENSFM = dict.fromkeys(
    _names("perspective brown radial simple_radial"), RADIAL_TANGENTIAL
) | dict.fromkeys(_names("fisheye fisheye_opencv"), FISHEYE)
"""Models of OpenSfM, and OpenCV's."""


def _opensfm(record: Record) -> CameraRecord:
    """Of OpenSfM and OpenDroneMap: lengths are fractions of the longer side, and count from the
    picture's centre."""
    name = str(record.get("projection_type"))
    if name not in OPENSFM:
        raise _unsupported(name, ", ".join(OPENSFM))
    size = _checked_size(record.numbers(*WIDTH) + record.numbers(*HEIGHT))
    fx = record.number("focal_x", "focal")
    if size is None or fx is None:
        raise InvalidInputError("no width, height and focal length; export the cameras again")
    fy = record.number("focal_y") or fx
    H, W = size
    longer = max(size)
    cx = longer * (record.number("c_x") or 0.0) + (W - 1) / 2
    cy = longer * (record.number("c_y") or 0.0) + (H - 1) / 2
    lens = _single_coefficients(record, OPENSFM[name])
    return _camera_from([longer * fx, longer * fy, cx, cy], lens, OPENSFM[name], size)


def _kitti(record: Record) -> CameraRecord:
    """The left 3 x 3 of a projection matrix of KITTI, whose last column is the place of the camera
    beside the first one."""
    return _camera_from(_left_part(record.numbers("kitti")))


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


def _colmap(record: Record) -> CameraRecord:
    """A line of ``cameras.txt``: the corner of the picture is (0, 0)."""
    words = list(map(str, flattened(record.get("colmap"))))
    line = f"line {record.get('line')}"
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
    return _camera_from(matrix, distortion, model, _checked_size([width, height]))


def _metashape(record: Record) -> CameraRecord:
    """Of Agisoft Metashape: cx and cy count from the picture's centre, p1 and p2 change places, k4
    is a power of r."""
    size = _read_size(record)
    if len(size) != 2:
        raise InvalidInputError("no width and height beside f; export the calibration again")
    names = _names("f cx cy b1 k1 k2 k3 k4 p1 p2 b2 p3 p4")
    values = {name: record.number(name) or 0.0 for name in names}
    f, cx, cy, b1, k1, k2, k3, k4, p1, p2, *_ = values.values()
    model = _read_model(record) or RADIAL_TANGENTIAL
    others = ("b2", "p1", "p2", "p3", "p4") if model == FISHEYE else ("b2", "k4", "p3", "p4")
    if unread := [name for name in others if values[name]]:
        raise InvalidInputError(
            f"distortion: {', '.join(unread)} of Metashape have no counterpart in OpenCV; "
            "optimise the cameras without them"
        )
    lens = [k1, k2, k3, k4] if model == FISHEYE else padded([k1, k2, p2, p1, k3])
    width, height = size
    matrix = [f + b1, f, width / 2 + cx - 0.5, height / 2 + cy - 0.5]
    return _camera_from(matrix, lens, model, _checked_size(size))


def _kannala_brandt(record: Record) -> CameraRecord:
    """Of camodocal: k2 to k5 are OpenCV's k1 to k4 of a fisheye."""
    matrix = [value for name in ("mu", "mv", "u0", "v0") for value in record.numbers(name)]
    distortion = [value for name in ("k2", "k3", "k4", "k5") for value in record.numbers(name)]
    record.words(*MODEL_NAMES)
    return _camera_from(matrix, distortion, FISHEYE, _checked_size(_read_size(record)))


def _mei(record: Record) -> CameraRecord:
    record.words(*MODEL_NAMES)
    raise _unsupported("MEI")


def _unread(keys: str, sentence: str) -> Format:
    """A format that is refused with a sentence that says how to write the camera."""

    def refuse(_: Record) -> CameraRecord:
        raise InvalidInputError(sentence)

    return Format(keys, refuse)


FORMATS = (
    _unread(
        "cameraAperture|cameraFocalLength",
        "camera_params of Isaac Sim; write fx = width * cameraFocalLength / cameraAperture[0], fy "
        "= height * cameraFocalLength / cameraAperture[1], cx = (width - 1) / 2 and cy = (height - "
        "1) / 2",
    ),
    _unread(
        "pxFocalLength|focalLength pxFocalLength|sensorWidth",
        "cameras of Meshroom; export them as COLMAP, or write fx = fy = width * focalLength / "
        "sensorWidth, cx = width / 2 + principalPoint[0] - 0.5 and cy = height / 2 + "
        "principalPoint[1] - 0.5",
    ),
    _unread(
        "android.lens.intrinsicCalibration|LENS_INTRINSIC_CALIBRATION|intrinsicCalibration",
        "a calibration of Android's Camera2; write its first four numbers as fx, fy, cx, cy, its "
        "lens distortion (a, b, c, d, e) as distortion_coefficients: [a, b, d, e, c], and the "
        "size of the pre-correction active array as width and height",
    ),
    Format("colmap", _colmap),
    Format("kitti", _kitti),
    Format("fl_x|camera_angle_x", _nerfstudio, inherits=True),
    Format("projection_type focal|focal_x", _opensfm),
    Format("mu mv", _kannala_brandt),
    Format("gamma1", _mei),
    Format("f !fx projection|class|type|b1|date", _metashape),
    Format("P|projection_matrix|binning_x|roi", _ros, {"P": _ros_rectified}, also=_is_plain),
    Format("matrix model", _own_result, also=_is_own_result),
    Format("", _matlab, also=_is_matlab),
    Format("", _unknown_order, also=_has_pair_of_sides),
    Format("", _plain_camera, also=_is_plain),
)
"""The first that detects a dict reads it."""
