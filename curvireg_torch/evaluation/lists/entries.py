"""A list of photographs with their boxes, cameras and meshes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any

from ...errors import InvalidInputError
from ...geometry import camera_matrix
from ...geometry.pose_prior import PosePrior
from ...utils.files import text_digest
from ..prior_options import PRIOR_OPTIONS, limits_from_cells, prior_from_limits
from .tables import BEST_MESH, RESULT_COLUMNS

__all__ = ["BOX", "CAMERA", "Entry", "PhotoList", "photo_list"]

BOX, CAMERA = ("x0", "y0", "x1", "y1"), ("fx", "fy", "cx", "cy")
_REQUIRED = ("photo", *BOX)
_KNOWN = (*_REQUIRED, *CAMERA, "mesh", *PRIOR_OPTIONS)


@dataclass(frozen=True)
class Entry:
    """One row of a list: a photograph to register.

    Attributes:
        cells: the texts of the row, one for each column of the list.
        name, photo: the photograph as the list names it, and its file.
        meshes: mesh files; of several the best is found.
        box: x0, y0, x1, y1 in px; None: the object is detected.
        camera: fx, fy, cx, cy in px; None if unknown.
        guess: replaces an unknown camera: "exif" takes the focal length in the photograph's file, a number is the
            horizontal field of view in degrees; None: no camera.
        instances: without a box, see :func:`curvireg_torch.registration.detect`.
        prior: limits on the pose.
        start: (4, 4) pose that is refined; nothing is searched for.
        error: why the row cannot be used; "" if it can.
    """

    cells: tuple[str, ...] = ()
    name: str = ""
    photo: Path = Path()
    meshes: tuple[Path, ...] = ()
    box: Sequence[float] | None = None
    camera: Sequence[float] | None = None
    guess: str | float | None = None
    instances: int = 1
    prior: PosePrior | None = None
    start: tuple[tuple[float, ...], ...] | None = None
    start_confidence: float | None = None
    error: str = ""

    def request(self) -> Any:
        """All that the result depends on besides the content of files."""
        prior = None if self.prior is None else self.prior.to_dict()
        return [self.name, self.box, self.camera, self.guess, self.instances, prior, self.start, self.start_confidence]

    @cached_property
    def key(self) -> str:
        """Digest of the request and the mesh files: equal rows are registered once."""
        return text_digest(repr((self.request(), self.meshes)))


@dataclass(frozen=True)
class PhotoList:
    """Photographs to register: ``columns``, the names of the columns, and ``entries``, one for each row."""

    columns: tuple[str, ...]
    entries: tuple[Entry, ...]


def photo_list(
    name: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    folder: Path,
    meshes: Sequence[Path] = (),
    limits: Mapping[str, Any] | None = None,
) -> PhotoList:
    """Make a list from a table of texts.

    Columns, in any order: ``photo``, ``x0``, ``y0``, ``x1``, ``y1``; optional ``fx``, ``fy``, ``cx``, ``cy``, ``mesh``
    and those of :data:`.PRIOR_OPTIONS`; others are passed through. Empty cells mean: detect the object, no camera,
    ``meshes``, ``limits``. A row that cannot be used holds the reason in its ``error``.

    Args:
        name, columns, rows: of the table; errors begin with the name.
        folder: to which its paths are relative.
        meshes: for rows that name none; of several the best is found.
        limits: on the pose, arguments of :class:`PosePrior` for rows that do not give them.

    Raises:
        InvalidInputError: a missing, repeated or reserved column, or no rows.

    Example:
        >>> rows = ["a.jpg", "1", "2", "30", "40"], ["b.jpg", "", "", "", ""], ["c.jpg", "1", "2", "", ""]
        >>> found = photo_list("list", ["photo", "x0", "y0", "x1", "y1"], rows, Path("here"), [Path("part.stl")])
        >>> [entry.box or entry.error for entry in found.entries]
        [(1.0, 2.0, 30.0, 40.0), '', 'x0, y0, x1, y1: expected all four or none, got 1, 2 and nothing for x1, y1']
    """
    names = [column.strip().lower() for column in columns]
    if missing := [required for required in _REQUIRED if required not in names]:
        raise InvalidInputError(
            f"{name}: no column {', '.join(missing)} in its header {','.join(columns)[:80]!r}; "
            f"separate columns by commas and call them {','.join(_REQUIRED)}"
        )
    if twice := sorted({column for column in names if names.count(column) > 1}):
        raise InvalidInputError(f"{name}: two columns {', '.join(twice)}; keep one of each")
    for column in set(names) - set(_KNOWN):
        if meant := get_close_matches(column, PRIOR_OPTIONS, 1, 0.8):
            raise InvalidInputError(f"{name}: unknown column {column!r}; rename it to {meant[0]}, or otherwise")
    if reserved := [column for column in names if column in (*RESULT_COLUMNS, BEST_MESH)]:
        raise InvalidInputError(f"{name}: {', '.join(reserved)}: names of result columns; rename those of the list")
    indices = {known: names.index(known) for known in _KNOWN if known in names}
    entries = tuple(_entry(list(cells), len(columns), indices, folder, tuple(meshes), limits or {}) for cells in rows)
    if not entries:
        raise InvalidInputError(f"{name}: no photographs; give one row for each")
    return PhotoList(tuple(columns), entries)


def _entry(
    cells: list[str],
    count: int,
    indices: Mapping[str, int],
    folder: Path,
    meshes: tuple[Path, ...],
    limits: Mapping[str, Any],
) -> Entry:
    padded = tuple((cells + [""] * count)[:count])
    values = {name: padded[index].strip() for name, index in indices.items()}
    try:
        if len(cells) != count:
            raise InvalidInputError(f"{len(cells)} cells, the header has {count}; quote texts with commas")
        if not values["photo"]:
            raise InvalidInputError("photo: empty; name a file")
        meshes = (folder / values["mesh"],) if values.get("mesh") else meshes
        if not meshes:
            raise InvalidInputError("mesh: empty, and no MESH was given; name one")
        box, camera = _four_numbers(values, BOX), _four_numbers(values, CAMERA)
        if camera is not None:
            camera_matrix(*camera)  # raises if it is invalid
        own = limits_from_cells({name: values[name] for name in PRIOR_OPTIONS if name in values})
        prior = prior_from_limits({**limits, **own})
    except InvalidInputError as error:
        return Entry(padded, values["photo"], error=str(error))
    return Entry(padded, values["photo"], folder / values["photo"], meshes, box, camera, prior=prior)


def _four_numbers(values: Mapping[str, str], names: tuple[str, ...]) -> tuple[float, ...] | None:
    texts = [values.get(name, "") for name in names]
    empty = [name for name, text in zip(names, texts, strict=True) if not text]
    if len(empty) == len(names):
        return None
    if empty:
        present = f"{', '.join(filter(None, texts))} and nothing for {', '.join(empty)}"
        raise InvalidInputError(f"{', '.join(names)}: expected all four or none, got {present}")
    numbers = []
    for name, text in zip(names, texts, strict=True):
        try:
            numbers.append(float(text))
        except ValueError:
            raise InvalidInputError(f"{name}: expected a number, got {text[:40]!r}") from None
    return tuple(numbers)
