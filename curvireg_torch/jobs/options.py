"""Options of a registration, each declared once.

The command line and the viewer read the declarations, lists those of the limits on the pose.
Nothing heavy is imported before a file is opened, so that help and mistakes in options appear at
once.
"""

import argparse
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import CurviregError, InvalidInputError
from ..utils.aliases import Document, Fields
from ..utils.choices import (
    BOX_FORMATS,
    BOX_KINDS,
    DEFAULT,
    MESH_KINDS,
    PRESET_NAMES,
    RENDERER_NAMES,
    SIDE_NAMES,
    START_CONVENTIONS,
    UNITS,
    UP_AXES,
    VIDEOS,
)

if TYPE_CHECKING:
    from ..features import LearnedCurvilinearSaliency
    from ..formats.boxes import BoxFile, PictureSize
    from ..formats.boxes.files import Corners
    from ..formats.poses import PoseRecord
    from ..geometry import Camera
    from ..geometry.pose_prior import PosePrior
    from ..mesh import Mesh
    from ..pipeline import Pipeline

CAMERA_OPTIONS = "--camera FX FY CX CY, --camera FILE (a calibration), --camera exif or --fov DEG"
"""How the command line takes a camera."""

ADVICE = {
    "camera": f": {CAMERA_OPTIONS}",
    "camera exif": ": --camera FX FY CX CY, --camera FILE (a calibration) or --fov DEG",
    "calibration": "; without a calibration, use --camera exif",
    "view": ", as --fov DEG",
    "opengl": "; or give --start-convention opengl",
    "fractions": ", or add --box-format fractions, or yolo, to --box or a list",
    "corners": ", or add --box-format xywh to --box or a list",
    "out": " (--out)",
    "bank": ": curvireg bank MESH --out FILE",
    "bank unit": " (leave --unit out, or curvireg bank)",
    "bank up": " (leave --up out, or curvireg bank)",
}
"""Options that help, by the kind of an error. Messages of the library name no options."""


def with_advice(error: CurviregError) -> str:
    """The text of an error, for the command line."""
    return f"{error}{ADVICE.get(error.kind, '')}"


WITHIN = 45.0  # degrees of ``within`` beside ``near`` if none are given
QUALIFIERS = {"front"}  # arguments of :class:`PosePrior` that limit nothing by themselves


class Numbers:
    """Type of an option: finite numbers separated by blanks or commas, one for each name; those in
    brackets may lack.

    Example:
        >>> Numbers("AZIMUTH ELEVATION [THETA]")("300, 20"), Numbers("DEG")("45")
        ((300.0, 20.0), 45.0)
    """

    def __init__(self, names: str) -> None:
        self.names = names
        self.most = len(names.split())
        self.least = self.most - names.count("[")

    def __call__(self, text: str) -> Any:
        try:
            values = tuple(map(float, text.replace(",", " ").strip("[] ").split()))
        except ValueError:
            values = ()
        if not self.least <= len(values) <= self.most or not all(map(math.isfinite, values)):
            raise argparse.ArgumentTypeError(
                f"expected {self.names}, finite numbers, got {text[:40]!r}"
            )
        return values if self.most > 1 else values[0]


def whole_number(low: int, high: int | None = None) -> Callable[[str], int]:
    """Return a type of options: a whole number from ``low`` to ``high``."""
    limits = f"of at least {low}" if high is None else f"from {low} to {high}"

    def read(text: str) -> int:
        number = int(text) if re.fullmatch(r"[-+]?\d{1,18}", text) else None
        if number is None or number < low or (high is not None and number > high):
            raise argparse.ArgumentTypeError(f"expected a whole number {limits}, got {text!r}")
        return number

    return read


def _camera_option(text: str) -> Any:
    """Return fx, fy, cx, cy, "exif", or the name of a calibration file."""
    if not re.fullmatch(r"[-+.\deE,\s]+", text):
        return "exif" if text.lower() == "exif" else text
    try:
        return Numbers("FX FY CX CY")(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(
            f"{error}; or give FILE (a calibration), exif, or --fov DEG"
        ) from None


def _option(default: Any, text: str, **how: Any) -> Any:
    """A field that is an option: its default, its help, and other arguments of
    ``ArgumentParser.add_argument``; ``flag`` is its name where that is not the field's."""
    return field(default=default, metadata={"help": text, **how})


PRIOR_OPTIONS: dict[str, Fields] = {
    "azimuth": {"type": Numbers("LOW HIGH"), "help": "counted upwards; 300 60 goes through 0"},
    "elevation": {"type": Numbers("LOW HIGH"), "help": "-90 below to 90 above the object"},
    "theta": {"type": Numbers("LOW HIGH"), "help": "in-plane rotation"},
    "side": {
        "choices": SIDE_NAMES,
        "help": "side that faces the camera, 45 degrees to either side of it",
    },
    "near": {"type": Numbers("AZIMUTH ELEVATION [THETA]"), "help": "a viewpoint nearby"},
    "within": {"type": Numbers("DEG"), "help": f"largest angle from --near (default: {WITHIN:g})"},
    "distance": {"type": Numbers("NEAR FAR"), "help": "of the object's centre, in the mesh's unit"},
    "front": {
        "choices": UP_AXES,
        "help": "axis of the mesh file that points out of its front, at azimuth 0",
    },
}
"""What may be known about the pose: options of the command line, and columns of lists."""

FIELD_OF_VIEW = {
    "flag": "--fov",
    "type": Numbers("DEG"),
    "help": "horizontal field of view of the camera, if it is about known",
}
"""An option that is another way to give :attr:`RegisterOptions.camera`."""


@dataclass(frozen=True)
class RegisterOptions:
    """What to register, and how; names, defaults and help texts are those of
    ``curvireg register``."""

    photos: tuple[Path, ...] = ()  # photographs, folders, patterns or videos
    # mesh files or banks; of several, each photograph is registered to the best
    meshes: tuple[Path, ...] = ()
    box: tuple[float, float, float, float] | None = _option(
        None,
        "in px of the photograph; default: the object is detected",
        type=Numbers("X0 Y0 X1 Y1"),
    )
    box_format: str | None = _option(
        None,
        "of --box or of a list's boxes: xyxy, corners in px (default); xywh: corner, width, height "
        "in px; fractions: corners; yolo: centre, width, height in fractions of the picture",
        choices=BOX_FORMATS,
    )
    box_is: str | None = _option(
        None,
        "whole: boxes are those of the whole object. visible: those of its visible part, and "
        "something may hide the rest (default: whole)",
        choices=BOX_KINDS,
    )
    boxes: Path | None = _option(
        None,
        "boxes of a detector, the best for each photograph: JSON of COCO, MegaPose or LabelMe, XML "
        "of Pascal VOC, a text file of YOLO, or a folder of these; PATH:LABEL takes one label, "
        "PATH:id=7 one number of a tracker",
        type=Path,
    )
    # four numbers, a Camera, "exif", the horizontal field of view in degrees, or None
    camera: Any = _option(
        None,
        "FX FY CX CY in px, or FILE or FILE:NAME, a calibration of OpenCV, ROS, COLMAP, BOP or "
        "other tools, whose distortion is removed. exif insists on the focal length of the "
        "photograph's file (default: this one, if it has one; else the focal length is estimated, "
        "and the distance with it)",
        type=_camera_option,
    )
    mask: Path | None = _option(
        None,
        "picture in which the object is white, or opaque; FILE:2 for its label 2; instead of "
        "--box or beside it",
        type=Path,
    )
    start: Path | None = _option(
        None,
        "refine this pose; needs no box: result.json, or JSON with rotation and translation or "
        "T_cam_from_model, 4 x 4 numbers, TWO of MegaPose, scene_gt.json:IMAGE_ID of BOP; in the "
        "mesh's unit where the format has none",
        type=Path,
    )
    start_convention: str | None = _option(
        None,
        "axes of the camera of --start: opencv, x right, y down, z forward (default); opengl, x "
        "right, y up, z back",
        choices=START_CONVENTIONS,
    )
    limits: Document = field(default_factory=dict)  # on the pose, arguments of PosePrior
    unit: str | None = _option(
        None,
        "of the mesh file, and of lengths in and out (default: that which the file states, as "
        "STEP, IGES, 3MF, Collada, USD and URDF do; else m; for a BOP scene mm)",
        choices=sorted(UNITS),
    )
    link: str | None = _option(
        None, "link of a URDF whose mesh is registered (default: all, joints at zero)"
    )
    textures: Path | None = _option(
        None,
        "folder with files that the mesh names and that do not lie beside it",
        type=Path,
        metavar="DIR",
    )
    unit_is_given: bool = False  # by the user, who means banks too
    pose: str | None = _option(
        None,
        "any: no assumption. upright: the mesh's up axis points up in the photograph and the "
        "object is seen from 10 degrees below to 60 above; faster, and right more often where it "
        "is true (default: any)",
        choices=("any", "upright"),
    )
    up: str | None = _option(
        None,
        "axis of the mesh file that points up, as --up=-y; default: that which the file states "
        "(Collada, USD), y for glTF, else z",
        choices=UP_AXES,
    )
    mesh_is: str | None = _option(
        None,
        "exact: the mesh of this very object. similar: of another one of its kind; answers are "
        "then less certain (default: exact)",
        choices=MESH_KINDS,
    )
    preset: str | None = _option(
        None,
        "learned: with networks, the most accurate. classical: nothing learned. fast: the best "
        "view, without contour fit. paper: the published method, to the letter (default: that of "
        f"a bank, else {DEFAULT})",
        choices=PRESET_NAMES,
    )
    pipeline: Path | None = _option(None, "JSON of a pipeline, instead of --preset", type=Path)
    instances: int = _option(
        1, "without a box: up to so many objects (default: 1)", type=whole_number(1)
    )
    field: Path | None = _option(None, "weights of a learned field", type=Path)
    hypotheses: int | None = _option(
        None, "hypotheses to carry and report (default: 5)", type=whole_number(1)
    )
    refine: bool = _option(
        True, "stop at the best view of the bank", flag="--no-refine", action="store_false"
    )
    renderer: str = _option("auto", "default: auto", choices=RENDERER_NAMES)
    device: str = _option("cpu", "device of modules, bank and search (default: cpu)")
    progress: bool = _option(True, "no progress bars", flag="--quiet", action="store_false")

    def open_files(self) -> None:
        """Read the files that options name, so that a mistake in one is found before any work."""
        from ..formats.meshes.files import check_textures

        check_textures(self.textures)
        self.open_pipeline()
        self.read_start()
        _ = self.network, self._box_file

    @property
    def bank_decides(self) -> bool:
        """Whether the pipeline of a bank file applies, as none was chosen."""
        return self.preset is None and self.pipeline is None

    def load_mesh(self, path: Path) -> "Mesh":
        """The mesh of a file, with the options that say how it is read."""
        from ..mesh import load_mesh

        return load_mesh(path, unit=self.unit, up=self.up, link=self.link, textures=self.textures)

    def open_pipeline(self) -> "Pipeline":
        """The pipeline that ``preset``, ``pipeline`` and ``pose`` choose."""
        from ..pipeline import Pipeline, preset_named

        chosen = (
            preset_named(self.preset or DEFAULT)
            if self.pipeline is None
            else Pipeline.read(self.pipeline)
        )
        return chosen if self.pose is None else chosen.with_pose_prior(self.pose)

    @cached_property
    def network(self) -> "LearnedCurvilinearSaliency | None":
        """The network of ``field``, or None."""
        from ..features import LearnedCurvilinearSaliency

        return None if self.field is None else LearnedCurvilinearSaliency(weights=self.field)

    @cached_property
    def _box_file(self) -> "BoxFile | None":
        from ..formats.boxes import BoxFile

        return None if self.boxes is None else BoxFile(self.boxes)

    def box_of(self, photo: Path, numbers: Sequence[float] | None = None) -> "Corners | None":
        """The box of a photograph in px: ``numbers``, or those of ``box``, in the format; or that
        of a detector."""
        from ..formats.boxes import pixel_box
        from ..formats.pictures import picture_size

        numbers = self.box if numbers is None else numbers
        if numbers is None:
            return (
                None
                if self._box_file is None
                else self._box_file.box(photo, partial(picture_size, photo))
            )
        kind = self.box_format or "xyxy"
        is_relative = kind in ("fractions", "yolo") and photo.suffix.lower() not in VIDEOS
        return pixel_box(numbers, kind, picture_size(photo).shown if is_relative else None)

    def detected_box(self, name: str, picture: "PictureSize") -> "Corners | None":
        """The box of a detector for a frame by its name; None where it has none, or there is no
        detector."""
        return None if self._box_file is None else self._box_file.of_frame(name, picture)

    def read_start(self) -> "PoseRecord | None":
        """The pose of the file ``start``, or None."""
        if self.start is None:
            return None
        from ..data.poses import read_pose

        mesh = self.meshes[0].stem if self.meshes else ""
        return read_pose(self.start, convention=self.start_convention or "opencv", mesh=mesh)


def limits_from_options(options: Document) -> Fields:
    """Arguments of :class:`PosePrior`, of which ``side`` and ``near`` are shorter forms; None
    means: not given."""
    given = {name: options[name] for name in PRIOR_OPTIONS if options.get(name) is not None}
    side, near, within = (given.pop(name, None) for name in ("side", "near", "within"))
    if side is not None:
        from ..geometry.pose_prior import PosePrior

        if "azimuth" in given:
            raise InvalidInputError("side: give it or azimuth")
        given["azimuth"] = PosePrior.side(side).azimuth
    if near is not None:
        given["viewpoint"] = (*near, 0.0)[:3]
        given["within"] = WITHIN if within is None else within
    elif within is not None:
        raise InvalidInputError("within: expected near beside it")
    return given


def limits_from_cells(cells: Mapping[str, str]) -> Fields:
    """:func:`limits_from_options` of the cells of a row, such as "300 60"; empty ones are not
    given."""
    values = {}
    for name, option in PRIOR_OPTIONS.items():
        if text := cells.get(name):
            try:
                values[name] = option.get("type", str)(text)
            except argparse.ArgumentTypeError as error:
                raise InvalidInputError(f"{name}: {error}") from None
    return limits_from_options(values)


def prior_from_limits(limits: Document) -> "PosePrior | None":
    """The prior with these arguments; None if they limit nothing."""
    from ..geometry.pose_prior import PosePrior

    return PosePrior(**limits) if limits.keys() - QUALIFIERS else None


def check_camera(camera: "tuple[float, ...] | Camera | str | float | None") -> None:
    """Refuse a camera or field of view that cannot be used, before any photograph is read."""
    from ..geometry.cameras import camera_matrix, camera_of_view
    from ..utils.checks import check_square_pixels

    if isinstance(camera, tuple):
        check_square_pixels(camera_matrix(*camera), "camera")
    if isinstance(camera, float):
        camera_of_view(camera, (1, 1))
