"""Files that are dropped on the page: what they are, how large they may be, and archives. It needs no NiceGUI."""

import re
import shutil
import struct
import zipfile
from pathlib import Path, PurePosixPath

from ..errors import MAX_ARCHIVE_FILES, MAX_IMAGE_BYTES, MAX_MESH_BYTES, InvalidInputError
from ..utils.choices import IMAGES, MESHES, MESHES_AND_BANKS

__all__ = ["HEAD_BYTES", "file_name", "identify", "size_limit", "unpack"]

HEAD_BYTES = 1 << 16
"""Bytes from the start of a file that :func:`identify` looks at."""

_MAX_NAME = 120  # characters
_IMAGE_STARTS = (
    *(b"\xff\xd8", b"\x89PNG", b"II*\0", b"MM\0*", b"RIFF", b"BM", b"P2", b"P3", b"P5", b"P6"),
    *(b"GIF8", b"\xff\x0a", b"\0\0\0\x0cJXL", b"\0\0\0\x0cjP"),
)
_MESH_STARTS = {b"glTF": ".glb", b"ply": ".ply", b"OFF": ".off", b"COFF": ".off", b"solid": ".stl"}
_OBJ_LINE = re.compile(rb"(?m)^(v|vn|vt)( +[-+.0-9eE]+){2,}[ \r]*$")


def file_name(text: str) -> str:
    """The name of an uploaded file without folders and control characters.

    Example:
        >>> file_name("C:\\\\parts\\\\wheel.stl")
        'wheel.stl'
    """
    name = "".join(c for c in re.split(r"[/\\]", text)[-1] if c.isprintable()).strip()
    return name[-_MAX_NAME:] or "file"


def size_limit(name: str) -> tuple[str, int]:
    """What a file seems to be by its name, and the bytes that it may have.

    Raises:
        InvalidInputError: by its name, it is neither a photograph nor a mesh.
    """
    suffix = Path(name).suffix.lower()
    if suffix in (*MESHES_AND_BANKS, ".zip"):
        return "mesh", MAX_MESH_BYTES
    if suffix == ".mtl":
        raise InvalidInputError(f"{name}: materials go with their mesh and its pictures into a zip archive")
    if suffix == ".bin":
        raise InvalidInputError(f"{name}: the parts of a glTF file go with it into a zip archive")
    return "photograph", MAX_IMAGE_BYTES


def identify(name: str, head: bytes, size: int) -> tuple[str, str]:
    """Whether a file is a "photograph", a "mesh" or an "archive", and the suffix of its format ("" of photographs).

    The content decides, then the name: a part that is called ``wheel.jpg`` by mistake is still a mesh.

    Args:
        name: of the file.
        head: its first :data:`HEAD_BYTES` bytes.
        size: of the file, bytes.

    Raises:
        InvalidInputError: it is none of them.

    Example:
        >>> identify("part", b"ply\\nformat ascii 1.0", 300)
        ('mesh', '.ply')
    """
    suffix = Path(name).suffix.lower()
    if head.startswith(b"PK\3\4"):
        return "archive", ".zip"
    for start, format_suffix in _MESH_STARTS.items():
        if head.startswith(start):
            return "mesh", format_suffix
    if len(head) >= 84 and size == 84 + 50 * struct.unpack_from("<I", head, 80)[0]:
        return "mesh", ".stl"
    if head.startswith(_IMAGE_STARTS) or head[4:8] == b"ftyp":
        return "photograph", ""
    if suffix in MESHES_AND_BANKS:
        return "mesh", suffix
    if suffix in IMAGES:
        return "photograph", ""
    if head.lstrip().startswith(b"{") and b'"asset"' in head:
        return "mesh", ".gltf"
    if _OBJ_LINE.search(head):
        return "mesh", ".obj"
    raise InvalidInputError(
        f"{name}: neither a photograph (JPEG, PNG, TIFF, WebP, BMP, PGM or PPM) nor a mesh "
        f"({', '.join(MESHES)}, or a zip archive of one with its parts)"
    )


def unpack(archive: Path, folder: Path, name: str) -> Path:
    """Unpack a zip archive into a new folder; returns the path of the only mesh in it.

    Args:
        archive: the file.
        folder: that is created, and removed after an error.
        name: what the user calls the archive, for messages.

    Raises:
        InvalidInputError: it is damaged, too large, encrypted, names a file outside, or does not hold one mesh.
    """
    folder.mkdir()
    try:
        with zipfile.ZipFile(archive) as content:
            members = [member for member in content.infolist() if not member.is_dir()]
            _check_members(members, name)
            meshes = [_inside(folder, member.filename, name) for member in members]
            meshes = [path for path in meshes if path.suffix.lower() in MESHES and not path.name.startswith("._")]
            if len(meshes) != 1:
                found = "no mesh" if not meshes else "several meshes: " + ", ".join(p.name for p in meshes[:4])
                raise InvalidInputError(f"{name}: {found}; put one of {', '.join(MESHES)} with its parts into it")
            for member in members:
                target = _inside(folder, member.filename, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                with content.open(member) as source, target.open("wb") as file:
                    shutil.copyfileobj(source, file)  # at most the bytes that the header claims
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError, OSError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{name}: the archive cannot be unpacked; pack it again, without a password") from None
    return meshes[0]


def _check_members(members: list[zipfile.ZipInfo], name: str) -> None:
    if len(members) > MAX_ARCHIVE_FILES:
        raise InvalidInputError(f"{name}: {len(members):,} files, more than {MAX_ARCHIVE_FILES:,}")
    total = sum(member.file_size for member in members)
    if total > MAX_MESH_BYTES:
        raise InvalidInputError(f"{name}: {total:,} bytes when unpacked, more than {MAX_MESH_BYTES:,}")


def _inside(folder: Path, member: str, name: str) -> Path:
    """The path of a member in the folder; an error if it leads out of it."""
    path = PurePosixPath(member.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in member or not path.parts:
        raise InvalidInputError(f"{name}: it names a file outside the archive, {member[:60]!r}")
    return folder.joinpath(*path.parts)
