"""Lists of photographs: CSV files, folders and videos; and their results."""

import glob
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from ..data import Video
from ..data.cameras import Calibrations
from ..data.frames import FrameReader
from ..errors import (
    MAX_LIST_COLUMNS,
    CurviregError,
    CurviregWarning,
    InvalidInputError,
    MissingFileError,
)
from ..geometry import Camera
from ..registration.confidence import two_decimals
from ..utils.choices import IMAGES, VIDEOS, pattern_of
from ..utils.files import FindFile, found_in, read_csv, write_csv
from ..visualization.sheet import SheetEntry, write_sheet
from ..visualization.words import verdict_counts
from .entry import Entry, entry_of
from .options import PRIOR_OPTIONS, RegisterOptions, limits_from_cells, prior_from_limits
from .outputs import output_folder
from .runner import OpenRegistrar, failed_row, run_entries, thumbnail_of
from .store import ResultStore, Row, has_pose

BOX = ("x0", "y0", "x1", "y1")
CAMERA = ("fx", "fy", "cx", "cy")
_REQUIRED = ("photo", *BOX)
_KNOWN = (*_REQUIRED, *CAMERA, "camera", "mask", "mesh", *PRIOR_OPTIONS)

ROTATION = ("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33")
TRANSLATION = ("tx", "ty", "tz")
POSE_COLUMNS = ROTATION + TRANSLATION
"""Columns of a pose: the rotation row by row, and the translation."""

RESULT_COLUMNS = ("verdict", "message", "confidence", "reliable", *POSE_COLUMNS, "exactness")
"""Columns of ``results.csv`` after those of the list."""

BEST_MESH = "found_mesh"  # a last column, if rows have several meshes: the best of them
INSTANCE_COLUMNS = ("instance", "found_x0", "found_y0", "found_x1", "found_y1")
"""Last columns, if several objects of a photograph were asked for: the number of each, from 1, and
its box in px."""


def _entry(
    cells: Sequence[str],
    columns: Mapping[str, str],
    find: FindFile,
    options: RegisterOptions,
    calibrations: Calibrations,
) -> Entry:
    """The entry of a row; ``columns`` are the names in the file, by the plain ones."""
    cells = _without_empty_end(cells, len(columns))
    count = len(columns)
    shown = dict(zip(columns.values(), cells + [""] * count, strict=False))
    values = {name: shown[column].strip() for name, column in columns.items()}
    try:
        if len(cells) != count:
            raise InvalidInputError(
                f"{len(cells)} cells, the header has {count}; quote texts with commas"
            )
        if not values["photo"]:
            raise InvalidInputError("photo: empty; name a file")
        meshes = (find(values["mesh"]),) if values.get("mesh") else options.meshes
        if not meshes:
            raise InvalidInputError("mesh: empty, and no MESH was given; name one")
        photo = find(values["photo"])
        numbers = numbers_of(values, BOX)
        box = None if numbers is None else options.box_of(photo, numbers)
        camera = given_camera(values, find, calibrations) or options.camera
        mask = find(values["mask"]) if values.get("mask") else None
        prior = prior_from_limits({**options.limits, **limits_from_cells(values)})
    except CurviregError as error:
        return Entry(shown, values["photo"], error=str(error))
    return Entry(shown, values["photo"], photo, meshes, box, camera, mask, options.instances, prior)


def given_camera(
    values: Mapping[str, str], find: FindFile, calibrations: Calibrations
) -> Camera | tuple[float, ...] | None:
    """The camera of a row: a calibration that ``find`` finds by its name, or fx, fy, cx, cy; of a
    long list, cameras of these are made when they are needed."""
    numbers = numbers_of(values, CAMERA)
    if not values.get("camera"):
        return numbers
    if numbers is not None:
        raise InvalidInputError("camera: give it or fx, fy, cx, cy")
    return calibrations.load(find(values["camera"]))


def numbers_of(values: Mapping[str, str], names: Sequence[str]) -> tuple[float, ...] | None:
    """The numbers in some columns of a row; None if all are empty."""
    texts = [values.get(name, "") for name in names]
    empty = [name for name, text in zip(names, texts, strict=True) if not text]
    if len(empty) == len(names):
        return None
    if empty:
        present = f"{', '.join(filter(None, texts))} and nothing for {', '.join(empty)}"
        raise InvalidInputError(f"{', '.join(names)}: expected all or none, got {present}")
    numbers = []
    for name, text in zip(names, texts, strict=True):
        try:
            numbers.append(float(text))
        except ValueError:
            raise InvalidInputError(f"{name}: expected a number, got {text[:40]!r}") from None
    return tuple(numbers)


def list_photographs(options: RegisterOptions, *, every: int = 1) -> list[Entry]:
    """The photographs of the options, which have the same box, camera and limits on the pose.

    A photograph is called by its path as it was given, or that of its folder; a frame of a video by
    the video's path and its number, as in ``left/cam.avi:000012``. One that is named repeatedly, as
    by a folder and a pattern, counts once: no two share a name. ``every`` n-th frame of videos is
    taken. Errors are those of :func:`find_photographs`, and of :class:`.Video`.
    """
    camera = options.camera if isinstance(options.camera, tuple) else [""] * 4
    numbers = [*(options.box or [""] * 4), *camera]
    cells = dict(zip((*BOX, *CAMERA), map(str, numbers), strict=True))
    entries = []
    for path in options.photos:
        if is_video(path):
            common = entry_of(path, options)
            reader = FrameReader(path, every=every)
            for number in Video(path, every=every).numbers():
                name = f"{path}:{number:06d}"
                entries.append(replace(common, name=name, read_frame=partial(reader.read, number)))
        else:
            entries += [_entry_of(photo, options) for photo in find_photographs(path)]
    different = {entry.name: entry for entry in entries}
    return [replace(entry, cells={"photo": name, **cells}) for name, entry in different.items()]


def _entry_of(photo: Path, options: RegisterOptions) -> Entry:
    """The entry of a photograph; its ``error`` is why a detector's file has no box for it."""
    try:
        return entry_of(photo, options)
    except CurviregError as error:
        if options.boxes is None:
            raise
        return Entry(name=str(photo), photo=photo, meshes=options.meshes, error=str(error))


def is_video(path: Path) -> bool:
    """Whether a path is that of a video file."""
    return path.suffix.lower() in VIDEOS and path.is_file()


def find_photographs(path: Path) -> list[Path]:
    """The photographs in a folder or of a pattern such as ``shots/*.jpg``, frame-2 before frame-10;
    or ``path``."""
    pattern = pattern_of(path)
    if not (path.is_dir() or pattern):
        return [path]
    # without hidden files, as a Mac leaves them beside photographs (._1.jpg)
    inside = map(Path, glob.glob(pattern or f"{glob.escape(str(path))}/*", recursive=True))
    photographs = [found for found in inside if found.suffix.lower() in IMAGES and found.is_file()]
    if not photographs:
        raise MissingFileError(f"{path}: no photographs ({', '.join(IMAGES)}); check the path")
    return sorted(photographs, key=_counting_order)


def _counting_order(path: Path) -> tuple[list[str | int], str]:
    """Key by which names are in order, and numbers within them by value."""
    parts = re.split(r"(\d+)", str(path))  # texts and numbers in turn
    return [int(part) if number % 2 else part for number, part in enumerate(parts)], str(path)


def read_list(path: Path, options: RegisterOptions) -> list[Entry]:
    """Read a list of photographs: a CSV file with the columns that docs/results.md describes, in
    any order.

    Empty cells mean: detect the object, and the camera, meshes and limits of the options.
    Blank lines, and empty cells beyond the last named column, as spreadsheets write them, do not
    count. The ``error`` of a row that cannot be used is the reason.
    """
    header, *rows = read_csv(path) or [[]]
    header = _without_empty_end(header, 0)
    names = [column.strip().lower() for column in header]
    if missing := [required for required in _REQUIRED if required not in names]:
        raise InvalidInputError(
            f"{path}: no column {', '.join(missing)} in its header {','.join(header)[:80]!r}; "
            f"separate columns by commas, semicolons or tabs, and call them {','.join(_REQUIRED)}"
        )
    if len(names) > MAX_LIST_COLUMNS:
        raise InvalidInputError(f"{path}: more than {MAX_LIST_COLUMNS:,} columns; leave some out")
    if twice := sorted({column for column in names if names.count(column) > 1}):
        raise InvalidInputError(
            f"{path}: two columns {', '.join(twice) or 'without a name'}; keep one of each"
        )
    for column in set(names) - set(_KNOWN):
        if meant := get_close_matches(column, PRIOR_OPTIONS, 1, 0.8):
            raise InvalidInputError(
                f"{path}: unknown column {column!r}; rename it to {meant[0]}, or otherwise"
            )
    results = [*RESULT_COLUMNS, BEST_MESH, *(INSTANCE_COLUMNS if options.instances > 1 else ())]
    if reserved := [column for column in names if column in results]:
        raise InvalidInputError(
            f"{path}: {', '.join(reserved)}: names of result columns; rename those of the list"
        )
    if not rows:
        raise InvalidInputError(f"{path}: no photographs; give one row for each")
    columns = dict(zip(names, header, strict=True))
    find = found_in(path.parent)
    calibrations = Calibrations()
    return [_entry(cells, columns, find, options, calibrations) for cells in rows]


def _without_empty_end(cells: Sequence[str], least: int) -> list[str]:
    """The cells without the empty ones at the end; the first ``least`` stay."""
    filled = [number for number, cell in enumerate(cells, start=1) if cell.strip()]
    return list(cells[: max([least, *filled])])


@dataclass(frozen=True)
class Counts:
    """Numbers of rows by verdict; ``failures``: number, name and reason of each without a pose."""

    verdicts: Mapping[str, int]
    failures: tuple[str, ...]

    @property
    def posed(self) -> int:
        """Number of rows with a pose."""
        return sum(self.verdicts.values()) - len(self.failures)

    def __str__(self) -> str:
        total = sum(self.verdicts.values())
        return f"{total} photograph{'s' * (total != 1)}: {verdict_counts(self.verdicts)}"


def register_list(
    entries: Sequence[Entry],
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    inputs: Sequence[Path] = (),
    source: Sequence[str] = (),
    **how: Any,
) -> Counts:
    """Register the photographs of a list; ``out`` gets ``results.jsonl``, ``results.csv`` and
    ``index.html``.

    A second call registers only what is new or has changed, see :func:`.runner.run_entries`, whose
    further arguments are ``how``. ``inputs`` are files besides those of the entries, and
    ``source`` is what the entries are of, see :func:`.outputs.output_folder`.
    """
    usable = list({entry.key: entry for entry in entries if not entry.error}.values())
    files = chain(inputs, chain.from_iterable(entry.files for entry in usable))
    with output_folder(out, "register several", inputs=files, source=source):
        store = run_entries(usable, out, open_registrar, label="register", **how)
        asked = {entry.name for entry in entries}
        if removed := sum(photo not in asked for photo in store.photos()):
            text = f"{out}: removed results of photographs that the list no longer has: {removed}"
            warnings.warn(text, CurviregWarning, stacklevel=2)
        return _write_tables(entries, out, store)


def _write_tables(entries: Sequence[Entry], out: Path, store: ResultStore) -> Counts:
    shown = []
    failures = []
    columns = [*entries[0].cells, *RESULT_COLUMNS]
    if any(len(entry.meshes) > 1 for entry in entries):
        columns.append(BEST_MESH)
    if any(entry.instances > 1 for entry in entries):
        columns += INSTANCE_COLUMNS
    lines: list[Sequence[object]] = [columns]
    for entry, row in zip(entries, _rows(entries, store), strict=True):
        number = row["row"]
        message = row["message"]
        reliable = row.get("reliable", False)
        confidence = row.get("confidence") or 0.0
        verdict = row["verdict"]
        objects = _objects(row)
        count = f"{len(objects)} objects, the best: " if len(objects) > 1 else ""
        caption = message or f"{count}{verdict}, confidence {two_decimals(confidence)}"
        picture = thumbnail_of(out, row)
        rank = bool(message), not reliable, -confidence, number
        shown.append(SheetEntry(number, entry.name, caption, verdict, picture, rank))
        if message:
            reason = message if entry.name in message else f"{entry.name}: {message}"
            failures.append(f"row {number}: {reason}".encode(errors="backslashreplace").decode())
        for instance, found in enumerate(objects, start=1):
            # A list may have columns such as "instance" of its own where no objects are numbered.
            cells = {BEST_MESH: row.get("mesh"), **_result_cells(instance, found), **entry.cells}
            lines.append([cells.get(column) for column in columns])
    counts = Counts(Counter(shot.kind for shot in shown), tuple(failures))
    write_sheet(out / "index.html", str(counts), shown, table="results.csv")
    store.rewrite(_rows(entries, store))
    write_csv(out / "results.csv", lines)
    return counts


def _rows(entries: Sequence[Entry], store: ResultStore) -> Iterator[Row]:
    """The result of each entry, in the order of the list, with its number and its cells."""
    for number, entry in enumerate(entries, start=1):
        head = {"row": number, "columns": dict(entry.cells)}
        unusable = {"key": "", "digests": {"request": "", "photo": ""}, **failed_row(entry.error)}
        yield {**head, **(unusable if entry.error else store.read(entry.key)), **head}


def _objects(row: Row) -> list[Row]:
    """The row itself, or one for each object that was detected, the best first."""
    if not has_pose(row) or "detection" not in row:
        return [row]
    return [{**row, **instance} for instance in row["detection"]["instances"]]


def _result_cells(number: int, row: Row) -> Row:
    """The cells of an object and its number, by their columns; without a pose most are left
    out."""
    if not has_pose(row):
        return {"verdict": row["verdict"], "message": row["message"], "reliable": "false"}
    pose = [*chain(*row["rotation"]), *(row["translation"] or [None] * 3)]
    box = row.get("box") or row["inputs"]["box"]
    return {
        "verdict": row["verdict"],
        "message": "; ".join(row["warnings"]),
        "confidence": row["confidence"],
        "reliable": "true" if row["reliable"] else "false",
        "exactness": (row.get("exactness") or {}).get("words"),
        **dict(zip(POSE_COLUMNS, pose, strict=True)),
        **dict(zip(INSTANCE_COLUMNS, [number, *box], strict=True)),
    }
