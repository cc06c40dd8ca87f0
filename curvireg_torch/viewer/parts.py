"""Files that belong to a mesh and come after it: materials, pictures and buffers."""

import re
from pathlib import Path, PurePosixPath
from urllib.parse import quote, unquote

from ..utils.choices import IMAGES

PARTS = (".mtl", ".bin")  # files of no other use
NAMING = (".obj", ".mtl", ".gltf", ".dae", ".ply", ".urdf", ".usda")  # formats that name files
# formats that cannot be opened before their parts have come
WAITING = (".gltf", ".urdf")
MAX_NAMING_BYTES = 2**24  # of a file, in which names of others are looked for


def place_part(path: Path, mesh: Path) -> bool:
    """Move an uploaded file to where a mesh, or a part of it beside it, names it.

    False if none of them does, or if a picture has come there already, which another photograph may
    be called like: then the file stays where it is.
    """
    materials = filter(Path.is_file, mesh.parent.rglob("*.mtl"))
    for owner in (mesh, *materials):
        if owner.suffix.lower() in NAMING and (place := _named_place(path.name, owner)):
            if path.suffix.lower() in IMAGES and place.exists():
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            path.replace(place)
            return True
    return False


def _named_place(name: str, owner: Path) -> Path | None:
    """Where a file lies of which another tells the name; beside that one, if it tells a place
    outside of its folder."""
    with owner.open("rb") as file:
        content = file.read(MAX_NAMING_BYTES)
    spellings = b"|".join(re.escape(each.encode()) for each in (name, quote(name)))
    folders = rb"(?<![\w.-])((?:[\w.-]+[/\\])*)"
    pattern = folders + rb"(?:" + spellings + rb")(?![\w.-])"
    found = re.search(pattern, content)
    if found is None:
        return None
    folder = PurePosixPath(unquote(found[1].decode("utf-8", "replace")).replace("\\", "/"))
    if ".." in folder.parts or folder.is_absolute():
        folder = PurePosixPath()
    return owner.parent / folder / name
