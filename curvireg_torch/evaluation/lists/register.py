"""Registration of a list of photographs."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ...data import Photo, read_photo
from ...errors import BankError, CurviregError, ImageError, InvalidInputError, MeshError
from ...geometry import camera_matrix
from ...geometry.cameras import camera_of_view
from ...registration import FailedRegistration, Registrar, Registration, detect
from ...registration.inputs import image_items
from ...registration.poses import projected_box
from ...registration.refinement import refine
from ...registration.result import SCHEMA, detection_document, result_document, used_box
from ...utils.files import write_file
from ...visualization.sheet import SheetEntry, thumbnail, write_sheet
from ..runner import OpenRegistrar, run_items
from ..store import ResultStore, Row
from .entries import Entry, PhotoList
from .tables import write_bop_results, write_results

__all__ = ["Counts", "check_entry", "register_entry", "register_list"]


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

    A second call registers only what is new or has changed, see :func:`~curvireg_torch.evaluation.runner.run_items`. A
    row that cannot be registered (photograph or mesh missing or damaged, invalid box or camera) ends as ``failed``,
    with the reason; it does not stop the others. Under ``torchrun``, or in a job array that sets ``RANK`` and
    ``WORLD_SIZE``, each process registers a part of the rows.

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

    def opened(meshes: tuple[Path, ...]) -> Registrar | Exception:
        try:
            return open_registrar(meshes)
        except (MeshError, BankError, OSError) as error:
            return error

    def register(entry: Entry, registrar: Registrar | Exception, seconds: float, digests: Row) -> Row:
        return _register(entry, registrar, seconds, _thumbnail_path(out, digests))

    items = list({entry.key: entry for entry in photos.entries if not entry.error}.values())
    store = run_items(
        items, out, opened, register, settings=dict(settings), prepare=_prepare, label="register", progress=progress
    )
    return None if store is None else _write_tables(photos, out, store)


def _prepare(store: ResultStore) -> None:
    if store.settings_path.exists():
        raise InvalidInputError(f"{store.folder}: holds the evaluation of a dataset; choose another --out")
    for name in ("results.csv", "index.html", "bop.csv"):  # they would not match newer rows
        (store.folder / name).unlink(missing_ok=True)


def check_entry(entry: Entry, photo: Photo) -> tuple[str, ...]:
    """Refuse a box or camera that cannot be used, before meshes are opened; returns what is questionable about them.

    Raises:
        CurviregError: as :func:`register_entry`.
    """
    K, _ = _camera(entry, photo)
    item = image_items([photo.image], None if entry.box is None else [entry.box], K, entry.prior)[0]
    if isinstance(item, CurviregError):
        raise item.with_subject(entry.name)
    return item.warnings


def register_entry(
    entry: Entry, photo: Photo, registrar: Registrar, *, bank_seconds: float
) -> tuple[Registration, Row]:
    """Register one photograph with the registrar of its meshes, which took ``bank_seconds`` to open.

    Returns:
        The registration, and its document.

    Raises:
        CurviregError: it cannot be registered; the message begins with the photograph's name.
    """
    start = time.perf_counter()
    K, source = _camera(entry, photo)
    if entry.start is not None:
        results = refine(registrar, [photo.image], K, [entry.start], start_confidences=[entry.start_confidence])
    elif entry.box is None:
        results = detect(registrar, [photo.image], K, instances=entry.instances, prior=entry.prior)[0]
    else:
        results = registrar([photo.image], torch.tensor(entry.box)[None], K, prior=entry.prior)
    result = results[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject(entry.name)
    if entry.box is None:
        describer = registrar.of_model(result.model).describer
        box = projected_box(describer, result.projection) if result.detection is None else result.detection.box
    else:
        box = torch.tensor(entry.box)
    seconds = {"bank": bank_seconds, "register": time.perf_counter() - start}
    document = result_document(result, registrar, seconds)
    document["mesh"] = str(entry.meshes[result.model])
    document["inputs"] = {
        "photo": entry.name,
        "mesh": ", ".join(map(str, entry.meshes)),
        "box": box.tolist(),
        "camera": None if K is None else [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "camera_source": source,
        "picture": photo.facts(),
    }
    if result.detection is not None:
        document["detection"] = detection_document([r for r in results if isinstance(r, Registration)])
    if source in ("exif", "fov"):  # the error of a guessed camera is unknown
        document["covariance"] = document["standard_deviations"] = None
    return result, document


def _camera(entry: Entry, photo: Photo) -> tuple[torch.Tensor | None, str | None]:
    """Camera matrix, and its source."""
    if entry.camera is not None:
        return camera_matrix(*entry.camera, dtype=torch.float64), "given"
    if entry.guess is None:
        if entry.start is not None:
            raise InvalidInputError("--start: needs the camera; give --camera FX FY CX CY", subject=entry.name)
        return None, None
    if isinstance(entry.guess, float):
        H, W = photo.image.shape[-2:]
        return camera_of_view(entry.guess, (H, W)), "fov"
    K = photo.guessed_camera_matrix()
    if K is None:
        raise InvalidInputError(f"{entry.name}: no focal length in its EXIF; give --camera FX FY CX CY, or --fov DEG")
    return K, "exif"


def _register(entry: Entry, registrar: Registrar | Exception, bank_seconds: float, picture: Path) -> Row:
    """The row of an entry; its thumbnail is on disk before."""
    try:
        photo = read_photo(entry.photo, dtype=torch.uint8)
    except (CurviregError, OSError) as error:
        return _failed(error)
    if isinstance(registrar, Exception):
        return _failed(registrar)
    try:
        result, document = register_entry(entry, photo, registrar, bank_seconds=bank_seconds)
    except (ImageError, InvalidInputError) as error:
        return _failed(error)
    renderer = registrar.of_model(result.model).describer.renderer
    write_file(picture, thumbnail(renderer, result.projection, photo.image, used_box(document)))
    return {"status": "ok", "message": "", **document}


def _failed(error: Exception | str) -> Row:
    return {"schema": SCHEMA, "status": "failed", "message": " ".join(str(error).split())}


def _thumbnail_path(out: Path, digests: Row) -> Path:
    return out / "thumbnails" / f"{digests['request']}.jpg"


def _write_tables(photos: PhotoList, out: Path, store: ResultStore) -> Counts:
    sheet = [_sheet_entry(entry, row, out) for entry, row in zip(photos.entries, _rows(photos, store), strict=True)]
    failures = tuple(
        f"row {shown.number}: " + ("" if shown.name in shown.caption else f"{shown.name}: ") + shown.caption
        for shown, _ in sheet
        if shown.kind == "failed"
    )
    reliable = sum(shown.kind == "reliable" for shown, _ in sheet)
    counts = Counts(len(sheet) - len(failures), reliable, failures)
    sheet.sort(key=lambda pair: pair[1])
    several = any(len(entry.meshes) > 1 for entry in photos.entries)
    write_sheet(out / "index.html", str(counts), [shown for shown, _ in sheet], table="results.csv")
    store.rewrite(_rows(photos, store))
    write_bop_results(out / "bop.csv", photos.columns, _rows(photos, store))
    write_results(out / "results.csv", photos.columns, _rows(photos, store), best_mesh=several)
    return counts


def _rows(photos: PhotoList, store: ResultStore) -> Iterator[Row]:
    """The result of each entry, in the order of the list, with its number and its cells."""
    for number, entry in enumerate(photos.entries, start=1):
        head = {"row": number, "columns": dict(zip(photos.columns, entry.cells, strict=True))}
        unusable = {"key": "", "digests": {"request": "", "photo": ""}, **_failed(entry.error)}
        yield {**head, **(unusable if entry.error else store.read(entry.key)), **head}


def _sheet_entry(entry: Entry, row: Row, out: Path) -> tuple[SheetEntry, tuple[bool, bool, float, int]]:
    message, reliable, confidence = row["message"], row.get("reliable", False), row.get("confidence") or 0.0
    kind = "failed" if message else "reliable" if reliable else "doubtful"
    path = _thumbnail_path(out, row["digests"])
    entry_on_page = SheetEntry(
        number=row["row"],
        name=entry.name,
        caption=message or f"confidence {confidence:.2f}, {kind}",
        kind=kind,
        picture=lambda: path.read_bytes() if not message and path.is_file() else None,
    )
    return entry_on_page, (bool(message), not reliable, -confidence, row["row"])
