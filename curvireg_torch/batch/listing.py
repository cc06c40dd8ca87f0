"""Lists of photographs to register, with their boxes, cameras and meshes."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..data._json import check_table_size
from ..errors import InvalidInputError, MissingFileError
from ..geometry import camera_matrix
from .records import RESULT_COLUMNS

__all__ = ["Entry", "Listing", "read_list"]

_BOX, _CAMERA = ("x0", "y0", "x1", "y1"), ("fx", "fy", "cx", "cy")
_NEEDED = ("photo", *_BOX)
_KNOWN = (*_NEEDED, *_CAMERA, "mesh")


@dataclass(frozen=True)
class Entry:
    """One row of a list.

    Attributes:
        cells: its texts, as many as the list has columns.
        name: the photograph, as the list calls it.
        photo, mesh: their files; None where ``trouble`` is.
        box: x0, y0, x1, y1 in px, None for the whole image.
        camera: fx, fy, cx, cy in px, None where it is not known.
        trouble: why the row cannot be used, "" where it can.
    """

    cells: tuple[str, ...]
    name: str = ""
    photo: Path | None = None
    mesh: Path | None = None
    box: Sequence[float] | None = None
    camera: Sequence[float] | None = None
    trouble: str = ""


@dataclass(frozen=True)
class Listing:
    """Photographs to register: ``columns``, the names of the columns, and ``entries``, one for each row."""

    columns: tuple[str, ...]
    entries: tuple[Entry, ...]


def read_list(path: Path, mesh: Path | None = None) -> Listing:
    """The photographs of a CSV file with a header.

    Columns, in any order: ``photo``, ``x0``, ``y0``, ``x1``, ``y1``, and, if wanted, ``fx``, ``fy``, ``cx``, ``cy``,
    ``mesh``; others are passed through. Paths count from the file's folder. Empty cells: the whole image, no camera,
    ``mesh``. A row that cannot be used says so in its ``trouble``; blank lines are no rows.

    Args:
        path: the file, UTF-8.
        mesh: of rows that name none.

    Raises:
        MissingFileError: no such file.
        InvalidInputError: not such a table, or one without rows.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "list.csv")
        >>> _ = file.write_text("photo,x0,y0,x1,y1\\na.jpg,1,2,30,40\\nb.jpg,,,,\\nc.jpg,1,2,,\\n")
        >>> [entry.box or entry.trouble for entry in read_list(file, Path("part.stl")).entries]
        [(1.0, 2.0, 30.0, 40.0), '', 'x0, y0, x1, y1: expected all four or none, got 1, 2 and nothing for x1, y1']
    """
    lines = _lines(path)
    if not lines:
        raise InvalidInputError(f"{path}: empty; give a header with the columns {', '.join(_NEEDED)}")
    columns = lines[0]
    names = [name.strip().lower() for name in columns]
    if missing := [name for name in _NEEDED if name not in names]:
        raise InvalidInputError(
            f"{path}: no column {', '.join(missing)} in its header {','.join(columns)[:80]!r}; "
            f"separate columns by commas and call them {','.join(_NEEDED)}"
        )
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInputError(f"{path}: two columns {', '.join(twice)}; keep one of each")
    if taken := [name for name in columns if name in RESULT_COLUMNS]:
        raise InvalidInputError(f"{path}: results have columns {', '.join(taken)} of their own; rename the list's")
    if len(lines) == 1:
        raise InvalidInputError(f"{path}: a header and no rows; give one row for each photograph")
    places = {name: names.index(name) for name in _KNOWN if name in names}
    return Listing(tuple(columns), tuple(_entry(cells, len(columns), places, path.parent, mesh) for cells in lines[1:]))


def _lines(path: Path) -> list[list[str]]:
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; check the path of the list")
    check_table_size(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        return [cells for cells in csv.reader(io.StringIO(text, newline=""), strict=True) if any(map(str.strip, cells))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"{path}: not a CSV file in UTF-8 ({error}); save it as such") from error


def _entry(cells: list[str], count: int, places: Mapping[str, int], folder: Path, mesh: Path | None) -> Entry:
    own = tuple((cells + [""] * count)[:count])
    given = {name: own[place].strip() for name, place in places.items()}
    try:
        if len(cells) != count:
            raise InvalidInputError(f"{len(cells)} cells, the header has {count}; quote texts with commas")
        if not given["photo"]:
            raise InvalidInputError("photo: empty; name a file")
        named = folder / given["mesh"] if given.get("mesh") else mesh
        if named is None:
            raise InvalidInputError("mesh: empty, and no MESH was given; name one")
        box, camera = _numbers(given, _BOX), _numbers(given, _CAMERA)
        if camera is not None:
            camera_matrix(*camera)  # says what is wrong with it
    except InvalidInputError as error:
        return Entry(own, given["photo"], trouble=str(error))
    return Entry(own, given["photo"], folder / given["photo"], named, box, camera)


def _numbers(given: Mapping[str, str], names: tuple[str, ...]) -> tuple[float, ...] | None:
    """The numbers of these columns, None where all are empty."""
    texts = [given.get(name, "") for name in names]
    empty = [name for name, text in zip(names, texts, strict=True) if not text]
    if len(empty) == len(names):
        return None
    if empty:
        told = ", ".join(text for text in texts if text)
        raise InvalidInputError(
            f"{', '.join(names)}: expected all four or none, got {told} and nothing for {', '.join(empty)}"
        )
    return tuple(_number(text, name) for text, name in zip(texts, names, strict=True))


def _number(text: str, name: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InvalidInputError(f"{name}: expected a number, got {text[:40]!r}") from None
