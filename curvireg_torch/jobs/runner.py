"""The resumable loop that registers objects in photographs, of lists and of datasets."""

import gc
import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from ..errors import (
    BankError,
    CurviregError,
    InvalidInputError,
    LostObjectError,
    MeshError,
    MissingFileError,
)
from ..mesh.files import mesh_digest
from ..registration import Registrar
from ..registration.documents import SCHEMA, line_document, places_document
from ..registration.result import verdict_of_error
from ..utils.company import map_in_company
from ..utils.files import file_digest, text_digest, write_file
from ..utils.sources import package_digest
from ..utils.threads import map_on_threads
from ..visualization.overlay import drawn_copies
from ..visualization.sheet import thumbnail
from .entry import Entry, observe
from .options import with_advice
from .photograph import register_observation
from .store import ResultStore, Row, has_pose, workers

NOT_IN_RESULTS = ("cli", "viewer", "visualization")
"""Parts of the package that no stored result depends on."""

REPORTS = ("summary.json", "predictions.csv", "results.csv", "index.html")
"""Files that are written from all results at the end; older ones would not match newer results."""

OpenRegistrar = Callable[[tuple[Path, ...]], Registrar]  # opens the registrar of some mesh files


def results_digest() -> str:
    """16 hexadecimal digits of the code that results depend on: rows of another one are not
    current."""
    return package_digest(without=NOT_IN_RESULTS)


def run_entries(
    entries: Sequence[Entry],
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    settings: Mapping[str, Any],
    label: str,
    progress: bool = True,
    reports: Sequence[str] = REPORTS,
) -> ResultStore | None:
    """Register the entries, without ``error`` and of different keys, whose results ``out`` does not
    hold yet.

    A stored row counts if its digests are the same: that of the photograph's content, and that of
    the request, which covers ``settings`` (all that every result depends on), the code of this
    library, the entry's own request and every file of its meshes. Entries of the same meshes follow
    each other, so that only one bank is in memory, and are registered side by side on torch's
    threads; each row is on disk as soon as it is known. An input that cannot be used makes a row
    with ``failed`` as ``verdict`` and does not stop the others. ``reports``, files that are written
    from all results, are removed first.

    Returns:
        The store, which holds all entries; None in processes that leave the report to the first
        one.
    """
    common = json.dumps([dict(settings), results_digest()], sort_keys=True)
    photo_digest = cache(file_digest)
    digest_of_mesh = cache(mesh_digest)

    def digests(entry: Entry) -> dict[str, str]:
        meshes = [(path.name, digest_of_mesh(path)) for path in entry.meshes]
        request = text_digest(json.dumps([common, entry.request(), meshes]))
        photos = [
            photo_digest(path) for path in (entry.photo, *(view.photo for view in entry.views))
        ]
        return {"request": request, "photo": "-".join(photos) if all(photos) else ""}

    with workers() as group:
        if group.rank == 0:
            for name in reports:
                for path in out.glob(name):
                    path.unlink()
        group.wait()
        store = ResultStore(out, group)
        order = {
            meshes: place
            for place, meshes in enumerate(dict.fromkeys(entry.meshes for entry in entries))
        }
        part = group.part(sorted(entries, key=lambda entry: order[entry.meshes]))
        todo = [
            (entry, found)
            for entry in part
            if not store.is_current(entry.key, found := digests(entry))
        ]
        with tqdm(
            desc=label, unit="photo", total=len(part), disable=not (progress and group.rank == 0)
        ) as bar:
            bar.update(len(part) - len(todo))
            for meshes, same in groupby(todo, key=lambda pair: pair[0].meshes):
                _register_some(list(same), meshes, store, open_registrar, bar)
                # meshes are in cycles, and too few objects for the collector to look soon
                gc.collect(1)
        group.wait()
        if group.rank:
            return None
        if not store.is_complete({entry.key: digests(entry) for entry in entries}):
            raise InvalidInputError(
                f"{out}: a photograph or mesh changed meanwhile; run the same command again"
            )
        store.merge()
        return store


def _register_some(
    pairs: Sequence[tuple[Entry, dict[str, str]]],
    meshes: tuple[Path, ...],
    store: ResultStore,
    open_registrar: OpenRegistrar,
    bar: "tqdm[Any]",
) -> None:
    """Register entries of the same meshes."""
    lock = threading.Lock()
    start = time.perf_counter()
    registrar: Registrar | Exception
    try:
        registrar = open_registrar(meshes)
    except (MeshError, BankError, MissingFileError, OSError) as error:
        registrar = error
    seconds = time.perf_counter() - start

    def register_one(k: int) -> None:
        entry, digests = pairs[k]
        picture = thumbnail_path(store.folder, digests)
        row = _row(entry, registrar, picture, bank_seconds=0.0 if k else seconds)
        with lock:
            store.append({"key": entry.key, "digests": digests, **row})
            bar.update()

    device = registrar.bank.device if isinstance(registrar, Registrar) else "cpu"
    if torch.device(device).type == "cpu":
        map_on_threads(register_one, range(len(pairs)))
    else:
        map_in_company(register_one, range(len(pairs)))


def _row(
    entry: Entry, registrar: Registrar | Exception, picture: Path, *, bank_seconds: float
) -> Row:
    """The result of an entry; its thumbnail is on disk before."""
    start = time.perf_counter()
    try:
        photo = entry.read()
    except (CurviregError, OSError) as error:
        return failed_row(error, skipped="unreadable_image")
    if isinstance(registrar, Exception):
        return failed_row(registrar, skipped="unreadable_mesh")
    try:
        observation = observe(entry, photo)
        found = register_observation(observation, registrar, bank_seconds=bank_seconds)
    except CurviregError as error:
        seconds = {"bank": bank_seconds, "register": time.perf_counter() - start}
        places: Row = {}
        if isinstance(error, LostObjectError) and error.detection is not None:
            places = {
                "detection": places_document(error.detection),
                "inputs": {"picture": photo.facts()},
            }
        return failed_row(error, seconds=seconds, **places)
    describer = registrar.of_mesh(found.mesh_index).describer
    box = found.box.tolist()
    copies = drawn_copies(registrar, found.copies)
    write_file(picture, thumbnail(describer, found.projection, found.image, box, copies))
    return {"message": "", **line_document(found.document)}


def failed_row(error: Exception | str, **values: Any) -> Row:
    """The row of an entry without a pose; ``skipped`` names a file that could not be read."""
    verdict = verdict_of_error(error) if isinstance(error, Exception) else "failed"
    text = with_advice(error) if isinstance(error, CurviregError) else str(error)
    message = " ".join(text.split())
    return {"schema": SCHEMA, "verdict": verdict, "message": message, **values}


def thumbnail_path(out: Path, digests: Mapping[str, str]) -> Path:
    """Where the picture of a result in the folder ``out`` is."""
    return out / "thumbnails" / f"{digests['request']}.jpg"


def thumbnail_of(out: Path, row: Row) -> Path | None:
    """The picture of a row; None if it has no pose."""
    return thumbnail_path(out, row["digests"]) if has_pose(row) else None
