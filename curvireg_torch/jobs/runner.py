"""The resumable loop that registers objects in photographs, of lists and of datasets."""

import gc
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tqdm import tqdm

from ..errors import (
    BankError,
    CurviregError,
    InvalidInputError,
    LostObjectError,
    MeshError,
    MissingDependencyError,
    MissingFileError,
    WorkerError,
)
from ..formats.meshes.files import mesh_digest
from ..registration import Registrar
from ..registration.block import share_of_worker
from ..registration.photograph import Photograph
from ..registration.result import verdict_of_error
from ..utils.executors import Workers
from ..utils.files import file_digest, text_digest, write_file
from ..utils.sources import package_digest
from ..visualization.overlay import drawn_copies
from ..visualization.sheet import thumbnail
from .documents import SCHEMA, line_document, places_document
from .entry import Entry, prepare
from .options import with_advice
from .photograph import RegisteredPhotograph, register_entries
from .store import ResultStore, Row, has_pose, thumbnail_path

NOT_IN_RESULTS = ("cli", "viewer", "visualization")
"""Parts of the package that no stored result depends on."""

OpenRegistrar = Callable[[tuple[Path, ...]], Registrar]
"""Opens the registrar of some mesh files; it is sent to workers by pickle."""


def results_digest() -> str:
    """16 hexadecimal digits of the code that results depend on: rows of another one are not
    current."""
    return package_digest(without=NOT_IN_RESULTS)


class Task(NamedTuple):
    """An entry that is to be registered, and the digest of all that its result depends on besides
    the content of its photographs."""

    entry: Entry
    request: str


class Finished(NamedTuple):
    """The row of an entry, and its thumbnail, a JPEG, if it has a pose."""

    row: Row
    picture: bytes | None


def run_entries(
    entries: Sequence[Entry],
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    settings: Mapping[str, Any],
    label: str,
    textures: Sequence[Path] = (),
    progress: bool = True,
    workers: Workers | None = None,
) -> ResultStore:
    """Register the entries, without ``error`` and of different keys, whose results ``out`` does not
    hold yet.

    A stored row counts if its digests are the same: that of the photograph's content, and that of
    the request, which covers ``settings`` (all that every result depends on), the code of this
    library, the entry's own request and every file of its meshes, also in folders of ``textures``.
    Entries of the same meshes follow each other, so that a worker has only one bank in memory. The
    ``workers``, by default this process, take blocks of them; this process alone writes: each row
    is on disk as soon as its block is done. An input that cannot be used makes a row with
    ``failed`` as ``verdict`` and does not stop the others; the next run reads files again for which
    a package was missing.

    Returns:
        The store, which holds all entries.
    """
    workers = workers or Workers()
    store = ResultStore(out)
    common = json.dumps([dict(settings), results_digest()], sort_keys=True)
    digest_of_mesh = cache(partial(mesh_digest, textures=textures))
    digest_of_file = cache(file_digest)  # of a video once, for all its frames

    def task_of(entry: Entry) -> Task:
        meshes = [(path.name, digest_of_mesh(path)) for path in entry.meshes]
        return Task(entry, text_digest(json.dumps([common, entry.request(), meshes])))

    of_meshes = defaultdict[tuple[Path, ...], list[Entry]](list)
    for entry in entries:
        of_meshes[entry.meshes].append(entry)
    device = torch.device(settings.get("device") or "cpu").type
    size = share_of_worker(len(entries), workers.count, device)
    with tqdm(desc=label, unit="photo", total=len(entries), disable=not progress) as bar:

        def is_pending(task: Task) -> bool:
            photo = partial(_photo_digest, task.entry, digest_of_file)
            known = store.is_current(task.entry.key, task.request, photo)
            bar.update(known)
            return not known

        def blocks() -> Iterator[list[Task]]:
            for same in of_meshes.values():
                pending = filter(is_pending, map(task_of, same))
                while block := list(islice(pending, size)):
                    yield block

        state = _OpenedRegistrar(open_registrar, results_digest())
        for task, finished in workers.map(_register_block, state, blocks()):
            if isinstance(finished, WorkerError):
                # without the photograph's digest: the next run tries it again
                digests = {"request": task.request, "photo": ""}
                row = failed_row(finished, seconds={"bank": 0.0, "register": 0.0})
                finished = Finished({"digests": digests, **row}, None)
            if finished.picture is not None:
                write_file(thumbnail_path(out, finished.row["digests"]), finished.picture)
            store.append({"key": task.entry.key, **finished.row})
            bar.update()
    return store


def _photo_digest(entry: Entry, digest_of: Callable[[Path], str]) -> str:
    """Digests of the photographs of an entry; "" if one cannot be read."""
    photos = [digest_of(path) for path in (entry.photo, *(view.photo for view in entry.views))]
    return "-".join(photos) if all(photos) else ""


class _OpenedRegistrar:
    """The registrar of the meshes that a worker had last.

    Args:
        open_registrar: opens it.
        code: :func:`results_digest` of the process that asks for results.
    """

    def __init__(self, open_registrar: OpenRegistrar, code: str) -> None:
        self._open = open_registrar
        self._code = code
        self._meshes: tuple[Path, ...] | None = None
        self._registrar: Registrar | Exception | None = None

    def of(self, meshes: tuple[Path, ...]) -> tuple[Registrar | Exception, float]:
        """The registrar, or why there is none, and the seconds that it took to open now."""
        if self._registrar is not None and meshes == self._meshes:
            return self._registrar, 0.0
        if self._code != results_digest():
            raise InvalidInputError("a worker has another version of curvireg_torch; install one")
        if self._registrar is not None:
            self._registrar = None
            gc.collect()  # meshes are in cycles, and too few objects for it to be called soon
        start = time.perf_counter()
        try:
            self._registrar = self._open(meshes)
        except (MeshError, BankError, MissingDependencyError, MissingFileError, OSError) as error:
            self._registrar = error
        self._meshes = meshes
        return self._registrar, time.perf_counter() - start


def _register_block(opened: _OpenedRegistrar, tasks: Sequence[Task]) -> list[Finished]:
    """Register entries of the same meshes."""
    registrar, bank_seconds = opened.of(tasks[0].entry.meshes)
    # before the photographs are read: one that changes meanwhile is registered again
    digest_of = cache(file_digest)
    digests = [
        {"request": task.request, "photo": _photo_digest(task.entry, digest_of)} for task in tasks
    ]
    rows = _rows([task.entry for task in tasks], registrar, bank_seconds=bank_seconds)
    return [
        Finished({"digests": known | row.pop("digests", {}), **row}, picture)
        for known, (row, picture) in zip(digests, rows, strict=True)
    ]


def _rows(
    entries: Sequence[Entry], registrar: Registrar | Exception, *, bank_seconds: float
) -> list[tuple[Row, bytes | None]]:
    """The results of entries, which are registered together, and their thumbnails; the first pays
    for the bank, and one without a pose its share of the time."""
    start = time.perf_counter()
    items = [_prepared(entry, registrar) for entry in entries]
    ready = [
        (entry, item)
        for entry, item in zip(entries, items, strict=True)
        if isinstance(item, Photograph)
    ]
    results: Iterator[RegisteredPhotograph | CurviregError] = iter(())
    if isinstance(registrar, Registrar):
        results = iter(register_entries(ready, registrar, bank_seconds=bank_seconds))
    share = (time.perf_counter() - start) / len(entries)
    rows: list[tuple[Row, bytes | None]] = []
    for k, item in enumerate(items):
        one = next(results) if isinstance(item, Photograph) else item
        if isinstance(one, RegisteredPhotograph):
            rows.append(({"message": "", **line_document(one.document)}, _thumbnail(one)))
            continue
        if isinstance(one, CurviregError):
            seconds = {"bank": 0.0 if k else bank_seconds, "register": share}
            places: Row = {}
            if isinstance(item, Photograph) and isinstance(one, LostObjectError) and one.detection:
                places["detection"] = places_document(one.detection)
                places["inputs"] = {"picture": item.facts["picture"]}
            one = failed_row(one, seconds=seconds, **places)
        rows.append((one, None))
    return rows


def _prepared(entry: Entry, registrar: Registrar | Exception) -> Photograph | CurviregError | Row:
    """The photograph of an entry, why it cannot be registered, or the row of unreadable files."""
    try:
        photo = entry.read()
    except (CurviregError, OSError) as error:
        return _unreadable(error, "image")
    if isinstance(registrar, Exception):
        return _unreadable(registrar, "mesh")
    try:
        return prepare(entry, photo)
    except CurviregError as error:
        return error


def _unreadable(error: Exception, kind: str) -> Row:
    """The row of a file that could not be read. Without a digest, the next run tries it again:
    where a package is missing, no file need change."""
    unknown = {"digests": {"photo": ""}} if isinstance(error, MissingDependencyError) else {}
    return failed_row(error, skipped=f"unreadable_{kind}", **unknown)


def _thumbnail(found: RegisteredPhotograph) -> bytes:
    registrar = found.registrar
    describer = registrar.of_mesh(found.mesh_index).describer
    copies = drawn_copies(registrar, found.copies)
    return thumbnail(describer, found.projection, found.image, found.box.tolist(), copies)


def failed_row(error: Exception | str, **values: Any) -> Row:
    """The row of an entry without a pose; ``skipped`` names a file that could not be read."""
    verdict = verdict_of_error(error) if isinstance(error, Exception) else "failed"
    text = with_advice(error) if isinstance(error, CurviregError) else str(error)
    message = " ".join(text.split())
    return {"schema": SCHEMA, "verdict": verdict, "message": message, **values}


def thumbnail_of(out: Path, row: Row) -> Path | None:
    """The picture of a row; None if it has no pose."""
    return thumbnail_path(out, row["digests"]) if has_pose(row) else None
