"""Lists of photographs to register, with their boxes, cameras and meshes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ...errors import InvalidInputError
from ...geometry import camera_matrix
from .records import FOUND_MESH, RESULT_COLUMNS

__all__ = ["BOX", "CAMERA", "Entry", "Listing", "listing"]

BOX, CAMERA = ("x0", "y0", "x1", "y1"), ("fx", "fy", "cx", "cy")
_NEEDED = ("photo", *BOX)
_KNOWN = (*_NEEDED, *CAMERA, "mesh")


@dataclass(frozen=True)
class Entry:
    """One row of a list.

    Attributes:
        cells: its texts, as many as the list has columns.
        name: the photograph, as the list calls it.
        photo: its file; None where ``trouble`` is.
        meshes: files; several: which of them is it?
        box: x0, y0, x1, y1 in px, None: the object is looked for.
        camera: fx, fy, cx, cy in px, None where it is not known.
        guess: where it is not known: "exif" takes the focal length that the photograph's file tells, a number is the
            degrees that the picture shows across its width; None: no camera.
        instances, distance: without a box, see :func:`curvireg_torch.registration.find`.
        trouble: why the row cannot be used, "" where it can.
    """

    cells: tuple[str, ...]
    name: str = ""
    photo: Path | None = None
    meshes: tuple[Path, ...] = ()
    box: Sequence[float] | None = None
    camera: Sequence[float] | None = None
    guess: str | float | None = None
    instances: int = 1
    distance: tuple[float, float] | None = None
    trouble: str = ""


@dataclass(frozen=True)
class Listing:
    """Photographs to register: ``columns``, the names of the columns, and ``entries``, one for each row."""

    columns: tuple[str, ...]
    entries: tuple[Entry, ...]


def listing(
    name: str, columns: Sequence[str], rows: Iterable[Sequence[str]], folder: Path, meshes: Sequence[Path] = ()
) -> Listing:
    """The photographs of a table of texts.

    Columns, in any order: ``photo``, ``x0``, ``y0``, ``x1``, ``y1``, and, if wanted, ``fx``, ``fy``, ``cx``, ``cy``,
    ``mesh``; others are passed through. Empty cells: the object is looked for, no camera, ``meshes``.
    A row that cannot be used says so in its ``trouble``.

    Args:
        name: of the table, for errors.
        columns, rows: its texts.
        folder: from which its paths count.
        meshes: of rows that name none; several: which of them is it?

    Raises:
        InvalidInputError: not such columns, or no rows.

    Example:
        >>> rows = ["a.jpg", "1", "2", "30", "40"], ["b.jpg", "", "", "", ""], ["c.jpg", "1", "2", "", ""]
        >>> found = listing("list", ["photo", "x0", "y0", "x1", "y1"], rows, Path("here"), [Path("part.stl")])
        >>> [entry.box or entry.trouble for entry in found.entries]
        [(1.0, 2.0, 30.0, 40.0), '', 'x0, y0, x1, y1: expected all four or none, got 1, 2 and nothing for x1, y1']
    """
    names = [column.strip().lower() for column in columns]
    if missing := [needed for needed in _NEEDED if needed not in names]:
        raise InvalidInputError(
            f"{name}: no column {', '.join(missing)} in its header {','.join(columns)[:80]!r}; "
            f"separate columns by commas and call them {','.join(_NEEDED)}"
        )
    if twice := sorted({column for column in names if names.count(column) > 1}):
        raise InvalidInputError(f"{name}: two columns {', '.join(twice)}; keep one of each")
    if taken := [column for column in names if column in (*RESULT_COLUMNS, FOUND_MESH)]:
        raise InvalidInputError(f"{name}: results have columns {', '.join(taken)} of their own; rename the list's")
    places = {known: names.index(known) for known in _KNOWN if known in names}
    entries = tuple(_entry(list(cells), len(columns), places, folder, tuple(meshes)) for cells in rows)
    if not entries:
        raise InvalidInputError(f"{name}: no photographs; give one row for each")
    return Listing(tuple(columns), entries)


def _entry(cells: list[str], count: int, places: Mapping[str, int], folder: Path, meshes: tuple[Path, ...]) -> Entry:
    own = tuple((cells + [""] * count)[:count])
    given = {name: own[place].strip() for name, place in places.items()}
    try:
        if len(cells) != count:
            raise InvalidInputError(f"{len(cells)} cells, the header has {count}; quote texts with commas")
        if not given["photo"]:
            raise InvalidInputError("photo: empty; name a file")
        named = (folder / given["mesh"],) if given.get("mesh") else meshes
        if not named:
            raise InvalidInputError("mesh: empty, and no MESH was given; name one")
        box, camera = _numbers(given, BOX), _numbers(given, CAMERA)
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
