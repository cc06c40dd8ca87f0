"""Files named on the command line, looked at before anything heavy is imported."""

import glob
from collections.abc import Sequence
from pathlib import Path

from ..errors import InvalidInputError, MissingFileError
from .choices import IMAGES, MESHES, VIDEOS

__all__ = ["check_given", "is_one_photograph", "is_pattern"]

_MESHES = (*MESHES, ".safetensors")
_ORDER = "the photograph comes first, the mesh last"


def is_pattern(path: Path) -> bool:
    """Whether a path stands for several, as ``shots/*.jpg`` does."""
    return glob.has_magic(str(path)) and not path.exists()


def is_one_photograph(paths: Sequence[Path]) -> bool:
    """Whether they are a single file that is no video."""
    return len(paths) == 1 and not (is_pattern(paths[0]) or paths[0].is_dir() or paths[0].suffix.lower() in VIDEOS)


def check_given(photos: Sequence[Path], meshes: Sequence[Path], listed: Path | None = None) -> None:
    """Refuse what is not there, or stands in another's place; of several photographs each answers for itself later.

    Raises:
        InvalidInputError: photograph and mesh are swapped, or one of them is something else.
        MissingFileError: no such list or mesh, or none such as the only photograph.
    """
    for path, what in [*((photo, "a photograph") for photo in photos), *([(listed, "a list")] if listed else [])]:
        if path.suffix.lower() in _MESHES:
            other = next((str(mesh) for mesh in meshes if mesh.suffix.lower() not in _MESHES), "")
            cure = f"it and {other} seem to be swapped: {_ORDER}" if other else f"{_ORDER}, several by --mesh each"
            raise InvalidInputError(f"{path}: a mesh where {what} is expected; {cure}")
        if what == "a photograph" and path.suffix.lower() in (".csv", ".json"):
            raise InvalidInputError(f"{path}: a list where a photograph is expected; give it as --list {path}")
    for mesh in meshes:
        pictures = is_pattern(mesh) or mesh.suffix.lower() in (*IMAGES, *VIDEOS)
        if mesh.is_dir() or pictures:
            kind = "a photograph" if pictures else "a folder"
            raise InvalidInputError(f"{mesh}: {kind} where a mesh is expected; {_ORDER} ({', '.join(MESHES)})")
    alone = photos if is_one_photograph(photos) else ()
    needed = [*((path, "photograph") for path in alone), *([(listed, "list")] if listed else [])]
    for path, what in [*needed, *((mesh, "mesh") for mesh in meshes if listed is None)]:
        if not (path.is_file() or (what == "list" and path.is_dir())):
            raise MissingFileError(f"{path}: no such file; check the path of the {what}")
