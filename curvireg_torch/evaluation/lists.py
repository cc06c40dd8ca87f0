"""Lists of photographs: CSV, JSON, COCO annotations, scenes of BOP sets, folders and videos; and their results."""

import csv
import glob
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ..data import Video, load_camera
from ..data.bop import bop_box, entry_at
from ..errors import InvalidInputError, MissingFileError
from ..geometry import Camera, camera_matrix
from ..utils.choices import IMAGES, UNITS, VIDEOS, is_pattern
from ..utils.files import check_table_size, finite_numbers, read_json, write_csv, write_file
from ..visualization.encoding import png
from ..visualization.overlay import to_uint8
from ..visualization.sheet import SheetEntry, write_sheet
from .benchmarks import BOPPose, write_bop_csv
from .opening import PRIOR_OPTIONS, limits_from_cells, prior_from_limits
from .runner import Entry, OpenRegistrar, failed_row, run_entries, thumbnail_of
from .store import ResultStore, Row

__all__ = ["POSE_COLUMNS", "Counts", "PhotoList", "list_photographs", "photo_list", "read_list", "register_list"]

BOX, CAMERA = ("x0", "y0", "x1", "y1"), ("fx", "fy", "cx", "cy")
_REQUIRED = ("photo", *BOX)
_KNOWN = (*_REQUIRED, *CAMERA, "camera", "mask", "mesh", *PRIOR_OPTIONS)
_BOP_NUMBERS = ("scene_id", "im_id", "obj_id")

POSE_COLUMNS = (*("r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"), *("tx", "ty", "tz"))
"""Columns of a pose: the rotation row by row, and the translation."""

RESULT_COLUMNS = ("status", "message", "confidence", "reliable", *POSE_COLUMNS)
"""Columns of ``results.csv`` after those of the list."""

BEST_MESH = "found_mesh"
"""A last column, if rows have several meshes: the best of them."""


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

    Columns, in any order: ``photo``, ``x0``, ``y0``, ``x1``, ``y1``; optional ``fx``, ``fy``, ``cx``, ``cy`` or
    ``camera`` (a calibration file), ``mask`` (a file), ``mesh`` and those of :data:`.PRIOR_OPTIONS`; others are passed
    through. Empty cells mean: detect the object, no camera, ``meshes``, ``limits``. A row that
    cannot be used holds the reason in its ``error``.

    Args:
        name, columns, rows: of the table; errors begin with the name. Empty cells beyond the last named column, as
            spreadsheets write them, do not count.
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
    columns = _without_empty_end(columns, 0)
    names = [column.strip().lower() for column in columns]
    if missing := [required for required in _REQUIRED if required not in names]:
        raise InvalidInputError(
            f"{name}: no column {', '.join(missing)} in its header {','.join(columns)[:80]!r}; "
            f"separate columns by commas and call them {','.join(_REQUIRED)}"
        )
    if twice := sorted({column for column in names if names.count(column) > 1}):
        raise InvalidInputError(f"{name}: two columns {', '.join(twice) or 'without a name'}; keep one of each")
    for column in set(names) - set(_KNOWN):
        if meant := get_close_matches(column, PRIOR_OPTIONS, 1, 0.8):
            raise InvalidInputError(f"{name}: unknown column {column!r}; rename it to {meant[0]}, or otherwise")
    if reserved := [column for column in names if column in (*RESULT_COLUMNS, BEST_MESH)]:
        raise InvalidInputError(f"{name}: {', '.join(reserved)}: names of result columns; rename those of the list")
    indices = {known: names.index(known) for known in _KNOWN if known in names}
    entries = tuple(_entry(cells, len(columns), indices, folder, tuple(meshes), limits or {}) for cells in rows)
    if not entries:
        raise InvalidInputError(f"{name}: no photographs; give one row for each")
    return PhotoList(tuple(columns), entries)


def _without_empty_end(cells: Sequence[str], least: int) -> list[str]:
    """The cells without the empty ones at the end; the first ``least`` stay."""
    kept = list(cells)
    while len(kept) > least and not kept[-1].strip():
        kept.pop()
    return kept


def _entry(
    cells: Sequence[str],
    count: int,
    indices: Mapping[str, int],
    folder: Path,
    meshes: tuple[Path, ...],
    limits: Mapping[str, Any],
) -> Entry:
    cells = _without_empty_end(cells, count)
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
        mask = folder / values["mask"] if values.get("mask") else None
        calibration = load_camera(folder / values["camera"]) if values.get("camera") else None
        if camera is not None and calibration is not None:
            raise InvalidInputError("camera: give it or fx, fy, cx, cy")
        own = limits_from_cells({name: values[name] for name in PRIOR_OPTIONS if name in values})
        prior = prior_from_limits({**limits, **own})
    except (InvalidInputError, MissingFileError) as error:
        return Entry(padded, values["photo"], error=str(error))
    photo = folder / values["photo"]
    return Entry(padded, values["photo"], photo, meshes, box, camera or calibration, mask, prior=prior)


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


def list_photographs(
    paths: Sequence[Path],
    meshes: Sequence[Path],
    *,
    box: Sequence[float] | None = None,
    camera: Sequence[float] | Camera | None = None,
    limits: Mapping[str, Any] | None = None,
    every: int = 1,
    frames: Path,
) -> PhotoList:
    """List photographs that have the same box, camera and limits on the pose.

    Args:
        paths: photographs, folders of them, patterns such as ``shots/*.jpg``, videos.
        meshes: mesh files; of several the best is found.
        box, camera: x0, y0, x1, y1 (default: the object is detected) and fx, fy, cx, cy, in px; or a calibration.
        limits: arguments of :class:`PosePrior`.
        every, frames: use every n-th frame of videos; folder for these, as PNG.

    Raises:
        MissingFileError: a pattern or folder without photographs.
        ImageError: a video that cannot be read.
    """
    if every < 1:
        raise InvalidInputError(f"--every: expected >= 1, got {every}")
    calibration = camera if isinstance(camera, Camera) else None
    fours = box, None if isinstance(camera, Camera) else camera
    numbers = [text for four in fours for text in (map(str, four) if four else [""] * 4)]
    rows = [[str(photo), *numbers] for path in paths for photo in _found(path, every, frames)]
    photos = photo_list("photographs", ["photo", *BOX, *CAMERA], rows, Path(), meshes, limits)
    entries = [replace(entry, camera=calibration or entry.camera) for entry in photos.entries]
    return replace(photos, entries=tuple(entries))


def _found(path: Path, every: int, frames: Path) -> Iterator[Path]:
    if path.suffix.lower() in VIDEOS and path.is_file():
        for number, image in Video(path, every=every):
            frame = frames / f"{path.stem}-{number:06d}.png"
            write_file(frame, png(to_uint8(image)))
            yield frame
    elif path.is_dir() or is_pattern(path):
        inside = path.iterdir() if path.is_dir() else map(Path, glob.glob(str(path), recursive=True))
        photographs = sorted(found for found in inside if found.suffix.lower() in IMAGES and found.is_file())
        if not photographs:
            raise MissingFileError(f"{path}: no photographs ({', '.join(IMAGES)}); check the path")
        yield from photographs
    else:
        yield path


def read_list(path: Path, meshes: Sequence[Path] = (), limits: Mapping[str, Any] | None = None) -> PhotoList:
    """Read a list of photographs.

    - ``.csv``: a header and the columns of :func:`photo_list`; blank lines are ignored.
    - ``.json``: a list of objects ``{"photo": "a.jpg", "box": [x0, y0, x1, y1], "camera": [fx, fy, cx, cy], "mesh":
      "part.stl", "azimuth": [300, 60]}``, all but ``photo`` optional; other keys are columns. Or COCO annotations: one
      row each, with ``image_id``, ``annotation_id`` and ``category``; half a pixel is subtracted, as COCO measures from
      the corner.
    - a folder: a scene of a BOP dataset, with the boxes of whole objects, and the models of the dataset if present.

    Args:
        path: the file or folder; paths in it are relative to its folder.
        meshes, limits: for rows that do not give them, as in :func:`photo_list`.

    Raises:
        MissingFileError: no such file.
        InvalidInputError: another format, or no rows.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "list.json")
        >>> _ = file.write_text('[{"photo": "a.jpg", "box": [1, 2, 30, 40.5], "mesh": "part.stl"}]')
        >>> read_list(file).entries[0].box
        (1.0, 2.0, 30.0, 40.5)
    """
    if not path.exists():
        raise MissingFileError(f"{path}: no such file; check the path of the list")
    if not path.is_dir() and path.suffix.lower() != ".json":
        columns, *lines = _csv_cells(path) or [[]]
        return photo_list(str(path), columns, lines, path.parent, meshes, limits)
    rows = _bop_rows(path) if path.is_dir() else _json_rows(path)
    columns = list(dict.fromkeys(["photo", *BOX, *(key for row in rows for key in row)]))
    texts = [[_text(row.get(name)) for name in columns] for row in rows]
    return photo_list(str(path), columns, texts, path if path.is_dir() else path.parent, meshes, limits)


def _text(value: Any) -> str:
    return "" if value is None else value if isinstance(value, str) else json.dumps(value)


def _csv_cells(path: Path) -> list[list[str]]:
    check_table_size(path)
    try:
        table = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""), strict=True)
        return [cells for cells in table if any(map(str.strip, cells))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"{path}: not CSV in UTF-8 ({error}); save it as CSV in UTF-8") from error


def _json_rows(path: Path) -> list[Row]:
    check_table_size(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: not JSON ({error}); a table of commas is named .csv") from error
    if isinstance(content, dict) and {"images", "annotations"} <= set(content):
        return _coco_rows(path, content)
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise InvalidInputError(f"{path}: expected a list of objects with photo, box, camera, mesh; or COCO's images")
    rows = []
    for entry in content:  # values of box and camera that are not four numbers are refused later
        row = {key: value for key, value in entry.items() if key not in ("box", "camera")}
        for key, names in (("box", BOX), ("camera", CAMERA)):
            if isinstance(values := entry.get(key), str):
                row[key] = values  # a calibration file
            elif values is not None:
                four = values if isinstance(values, list) and len(values) == 4 else [f"{key} {values}"] * 4
                row |= dict(zip(names, four, strict=True))
        rows.append(row)
    return rows


def _coco_rows(path: Path, content: Mapping[str, Any]) -> list[Row]:
    rows = []
    try:
        files = {image["id"]: image["file_name"] for image in content["images"]}
        kinds = {kind["id"]: kind["name"] for kind in content.get("categories", [])}
        for annotation in content["annotations"]:
            box = bop_box(annotation.get("bbox"))
            row = {"photo": files[annotation["image_id"]]}
            row |= dict(zip(BOX, ["no bbox"] * 4 if box is None else [v - 0.5 for v in box], strict=True))
            row |= {"image_id": annotation["image_id"], "annotation_id": annotation.get("id")}
            rows.append({**row, "category": kinds.get(annotation.get("category_id"))})
    except (KeyError, TypeError, AttributeError) as error:
        raise InvalidInputError(f"{path}: not COCO annotations ({type(error).__name__}: {error})") from error
    return rows


def _bop_rows(folder: Path) -> list[Row]:
    names = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
    readme = "--list takes the folder of a BOP scene; datasets/README.md"
    contents = [read_json(folder / name, dict, readme) for name in names]
    try:
        return list(_bop_objects(folder, *contents))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInputError(f"{folder}: not a scene of a BOP set ({type(error).__name__}: {error})") from error


def _bop_objects(folder: Path, cameras: Any, truths: Any, infos: Any) -> Iterator[Row]:
    """Rows of a scene; a text in place of a missing or invalid value makes the row fail later."""
    for key, objects in truths.items():
        pictures = [f"{kind}/{key.zfill(6)}{end}" for kind in ("rgb", "gray") for end in (".png", ".jpg", ".tif")]
        photo = next((name for name in pictures if (folder / name).is_file()), pictures[0])
        camera = cameras.get(key)
        K = finite_numbers(camera.get("cam_K") if isinstance(camera, dict) else None, 9) or ["no cam_K"] * 9
        for index, truth in enumerate(objects):
            number = truth.get("obj_id") if isinstance(truth, dict) else None
            model = f"../../models/obj_{number:06d}.ply" if isinstance(number, int) else None
            box = bop_box(entry_at(infos.get(key), index).get("bbox_obj")) or ["no bbox_obj"] * 4
            yield {
                "photo": photo,
                **dict(zip(BOX, box, strict=True)),
                **dict(zip(CAMERA, (K[0], K[4], K[2], K[5]), strict=True)),
                "mesh": model if model and (folder / model).is_file() else None,
                "scene_id": int(folder.resolve().name),
                "im_id": int(key) if key.isdecimal() else key,
                "obj_id": number,
            }


@dataclass(frozen=True)
class Counts:
    """Numbers of rows with a pose, and with a reliable one; ``failures``: number, name and reason of each other row."""

    ok: int
    reliable: int
    failures: tuple[str, ...]

    def __str__(self) -> str:
        failed = len(self.failures)
        return f"{self.ok + failed} photographs: {self.ok} ok, {failed} failed, {self.reliable} reliable"


def register_list(
    photos: PhotoList,
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    settings: Mapping[str, Any],
    progress: bool = True,
) -> Counts | None:
    """Register the photographs of a list; ``out`` gets ``results.jsonl``, ``results.csv`` and ``index.html``.

    A second call registers only what is new or has changed, see :func:`~curvireg_torch.evaluation.runner.run_entries`.
    A row that cannot be registered ends as ``failed``, with the reason; it does not stop the others. Under
    ``torchrun``, or in a job array that sets ``RANK`` and ``WORLD_SIZE``, each process registers a part of the rows.

    Args:
        photos, out: the list, and the folder for the results.
        open_registrar: opens the registrar of one mesh, or of several.
        settings: plain values, all that results depend on besides the files.
        progress: show a bar.

    Returns:
        The counts; None in processes that do not write the tables.

    Raises:
        CurviregError: ``open_registrar`` refuses its options, or ``out`` cannot be written to.
    """
    entries = list({entry.key: entry for entry in photos.entries if not entry.error}.values())
    if (out / "summary.json").exists():
        raise InvalidInputError(f"{out}: holds the evaluation of a dataset; choose another --out")
    store = run_entries(entries, out, open_registrar, settings=settings, label="register", progress=progress)
    return None if store is None else _write_tables(photos, out, store)


def _write_tables(photos: PhotoList, out: Path, store: ResultStore) -> Counts:
    shown, failures = [], []
    for entry, row in zip(photos.entries, _rows(photos, store), strict=True):
        number, message = row["row"], row["message"]
        reliable, confidence = row.get("reliable", False), row.get("confidence") or 0.0
        kind = "failed" if message else "reliable" if reliable else "doubtful"
        caption, picture = message or f"confidence {confidence:.2f}, {kind}", thumbnail_of(out, row)
        on_page = SheetEntry(number=number, name=entry.name, caption=caption, kind=kind, picture=picture)
        shown.append(((bool(message), not reliable, -confidence, number), on_page))
        if message:
            reason = message if entry.name in message else f"{entry.name}: {message}"
            failures.append(f"row {number}: {reason}".encode(errors="backslashreplace").decode())
    counts = Counts(len(shown) - len(failures), sum(not key[1] for key, _ in shown), tuple(failures))
    shown.sort(key=lambda pair: pair[0])
    write_sheet(out / "index.html", str(counts), [on_page for _, on_page in shown], table="results.csv")
    store.rewrite(_rows(photos, store))
    _write_bop_results(out / "bop.csv", photos.columns, _rows(photos, store))
    several = any(len(entry.meshes) > 1 for entry in photos.entries)
    lines = [[*photos.columns, *RESULT_COLUMNS, BEST_MESH]]
    lines += [[*row["columns"].values(), *_result_cells(row), row.get("mesh", "")] for row in _rows(photos, store)]
    write_csv(out / "results.csv", lines if several else [line[:-1] for line in lines])
    return counts


def _rows(photos: PhotoList, store: ResultStore) -> Iterator[Row]:
    """The result of each entry, in the order of the list, with its number and its cells."""
    for number, entry in enumerate(photos.entries, start=1):
        head = {"row": number, "columns": dict(zip(photos.columns, entry.cells, strict=True))}
        unusable = {"key": "", "digests": {"request": "", "photo": ""}, **failed_row(entry.error)}
        yield {**head, **(unusable if entry.error else store.read(entry.key)), **head}


def _result_cells(row: Row) -> list[str]:
    if row["status"] != "ok":
        return [row["status"], row["message"], "", "false", *[""] * 12]
    confidence = "" if row["confidence"] is None else str(row["confidence"])
    pose = [*(v for line in row["rotation"] for v in line), *(row["translation"] or [""] * 3)]
    return ["ok", "; ".join(row["warnings"]), confidence, "true" if row["reliable"] else "false", *map(str, pose)]


def _write_bop_results(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write the poses that have a translation, in mm; nothing for a list without scene, image and object numbers."""
    if not set(_BOP_NUMBERS) <= set(columns):
        return
    poses: list[BOPPose] = []
    for row in rows:
        numbers = [row["columns"][name] for name in _BOP_NUMBERS]
        if row["status"] != "ok" or row["translation"] is None or not all(map(str.isdecimal, numbers)):
            continue
        millimetres = [v * UNITS[row["unit"] or "m"] / UNITS["mm"] for v in row["translation"]]
        poses.append((numbers, row["confidence"] or 0.0, row["rotation"], millimetres, -1.0))
    write_bop_csv(path, poses)
