"""Names that a user may choose from, and files that a user may name, checked before torch is
imported."""

import glob
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..errors import InvalidInputError, MissingFileError
from .extras import check_extras

RENDERER_NAMES = ("auto", "embree", "pyrender")  # renderers
DEFAULT = "learned"  # the default preset
# of :data:`curvireg_torch.pipeline.PRESETS`
PRESET_NAMES = ("learned", "classical", "fast", "paper")
# metres per unit
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


def unit_of_length(metres: float) -> str | None:
    """The unit that has so many metres, of those of ``UNITS``.

    Example:
        >>> unit_of_length(0.0254), unit_of_length(0.025)
        ('in', None)
    """
    lengths = UNITS.items()
    return next((unit for unit, length in lengths if abs(metres / length - 1.0) < 1e-6), None)


PHONE_IMAGES = (".avif", ".heic", ".heif")  # which optional decoders read
IMAGES = (
    ".bmp",
    ".jpeg",
    ".jpg",
    ".pgm",
    ".png",
    ".pnm",
    ".ppm",
    ".tif",
    ".tiff",
    ".webp",
    *PHONE_IMAGES,
)
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm")
MESHES = (
    ".obj",
    ".ply",
    ".stl",
    ".off",
    ".glb",
    ".gltf",
    ".3mf",
    ".step",
    ".stp",
    ".iges",
    ".igs",
    ".dae",
    ".urdf",
    ".usd",
    ".usda",
    ".usdc",
    ".usdz",
)
MESHES_AND_BANKS = (*MESHES, ".safetensors")  # suffixes of file names, in lower case

BOX_FORMATS = ("xyxy", "xywh", "fractions", "yolo")
"""Four numbers of a box: corners in px; corner, width and height in px; corners, and centre, width
and height, in fractions of the picture."""

START_CONVENTIONS = ("opencv", "opengl")
"""Axes of the camera of a given pose: x right, y down, z forward; or x right, y up, z backward."""

MESH_KINDS = ("exact", "similar")
"""Whether a mesh is that of the photographed object itself, or of another one of its kind."""

BOX_KINDS = ("whole", "visible")
"""Whether boxes are those of whole objects, or of what photographs show of them."""

SIDE_NAMES = (
    "front",
    "front-right",
    "right",
    "back-right",
    "back",
    "back-left",
    "left",
    "front-left",
)
"""Sides of an object, every 45 degrees of azimuth from 0."""

UP_AXES = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
"""Axis that points up, and the rotation by quarter turns that brings it to z."""

_ORDER = "the photograph comes first, the mesh last"


def listed(names: Iterable[object], most: int = 8) -> str:
    """The first names, and whether there are more, for a message.

    Example:
        >>> listed("abc", 2)
        'a, b, ...'
    """
    texts = list(map(str, names))
    if len(texts) > most:
        texts[most:] = ["..."]
    return ", ".join(texts)


def pattern_of(path: Path) -> str:
    """The pattern of :func:`glob.glob` for a path with wildcards beyond the folders that exist;
    "" without any, as of a file in a folder called ``part [1]``.

    Example:
        >>> pattern_of(Path("shots/a.jpg")), pattern_of(Path("shots-of-nobody/*.jpg"))
        ('', './shots-of-nobody/*.jpg')
    """
    existing = next((part for part in (path, *path.parents) if os.path.exists(part)), Path())
    rest = os.path.relpath(path, existing) if path.is_absolute() else path.relative_to(existing)
    if not glob.has_magic(str(rest)):
        return ""
    return f"{glob.escape(str(existing))}/{rest}"


def is_one_photograph(paths: Sequence[Path]) -> bool:
    """Whether the paths are a single file that is not a video."""
    return len(paths) == 1 and not (
        pattern_of(paths[0]) or paths[0].is_dir() or paths[0].suffix.lower() in VIDEOS
    )


def check_given(
    photos: Sequence[Path],
    meshes: Sequence[Path],
    listed: Path | None = None,
    *,
    packages: Sequence[str] = (),
    banks: bool = True,
) -> None:
    """Refuse files of another kind, swapped files, a missing list, mesh or only photograph, and
    files whose readers are not installed, together with ``packages`` that are not; also banks in
    the place of meshes, unless ``banks`` will do.

    Of several photographs, those that are missing are reported later, each by itself.
    """
    lists = [listed] if listed else []
    swapped = [mesh for mesh in meshes if mesh.suffix.lower() not in MESHES_AND_BANKS]
    for path in (*photos, *lists):
        kind = "a list" if path in lists else "a photograph"
        if path.suffix.lower() in MESHES_AND_BANKS:
            advice = f"{_ORDER}, several by --mesh each"
            if swapped:
                advice = f"it and {swapped[0]} seem to be swapped: {_ORDER}"
            raise InvalidInputError(f"a mesh where {kind} is expected; {advice}", subject=path)
        if path not in lists and path.suffix.lower() == ".csv":
            raise InvalidInputError(
                f"a list where a photograph is expected; give it as --list {path}", subject=path
            )
    for mesh in meshes:
        if mesh.suffix == ".safetensors" and not banks:
            raise InvalidInputError("a bank where a mesh is expected", subject=mesh)
        is_picture = bool(pattern_of(mesh)) or mesh.suffix.lower() in (*IMAGES, *VIDEOS)
        if mesh.is_dir() or is_picture:
            kind = "a photograph" if is_picture else "a folder"
            raise InvalidInputError(
                f"{kind} where a mesh is expected; {_ORDER} ({', '.join(MESHES)})", subject=mesh
            )
    required = [(path, "photograph") for path in photos] if is_one_photograph(photos) else []
    if listed is None:
        required += [(mesh, "mesh") for mesh in meshes]
    elif not listed.is_dir():
        required.append((listed, "list"))
    for path, kind in required:
        if not path.is_file():
            raise MissingFileError(f"no such file; check the path of the {kind}", subject=path)
    check_extras([path for path, _ in required], packages)
