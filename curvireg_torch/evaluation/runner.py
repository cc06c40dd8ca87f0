"""The resumable loop over photographs, for lists and for datasets."""

import json
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tqdm import tqdm

from ..mesh.files import mesh_digest
from ..registration import Registrar
from ..utils.files import code_digest, file_digest, text_digest
from ..utils.threads import map_on_threads
from .store import ResultStore, Row
from .workers import Workers, workers

__all__ = ["POSE_SOURCES", "Item", "OpenRegistrar", "run_items"]


class Item(Protocol):
    """One photograph to register.

    ``key`` is a name that no other item of the run has; of several ``meshes`` the best is found; ``request`` returns
    plain values of all that the result depends on besides files and the settings of the run.
    """

    @property
    def key(self) -> str: ...
    @property
    def photo(self) -> Path: ...
    @property
    def meshes(self) -> tuple[Path, ...]: ...
    def request(self) -> Any: ...


ItemT = TypeVar("ItemT", bound=Item)

POSE_SOURCES = (
    *("data", "filters", "geometry", "matching", "features", "mesh", "registration", "rendering", "terms"),
    *("utils", "errors.py", "pipeline.py"),
)
"""Parts of the package that results depend on."""

OpenRegistrar = Callable[[tuple[Path, ...]], Registrar | Exception]
"""Opens the registrar of some mesh files, or returns why there is none."""


def run_items(
    items: Sequence[ItemT],
    out: Path,
    open_registrar: OpenRegistrar,
    register: Callable[[ItemT, Registrar | Exception, float, Row], Row],
    *,
    settings: Any,
    prepare: Callable[[ResultStore], None],
    label: str,
    progress: bool = True,
) -> ResultStore | None:
    """Register the items that the store in ``out`` does not hold yet, in one process or several.

    A stored row is used again if its digests are the same: that of the photograph's content, and that of the request,
    which covers ``settings``, the code of this library, the item's own request and every file of its meshes. Rows that
    are marked ``skipped`` are tried again. Items of the same meshes follow each other, so that only one bank is in
    memory, and are registered side by side on torch's threads; each row is on disk as soon as it is known.

    Args:
        items: of different keys.
        out: folder of the store.
        open_registrar: called once for each set of meshes.
        register: called with an item, what ``open_registrar`` returned, the seconds that this took (0 for all items but
            the first), and the digests; returns the row. An error that it raises ends the run.
        settings: plain values, everything that all results depend on.
        prepare: called with the store by one process before the others start; in a job array by each.
        label: of the progress bar.
        progress: show it.

    Returns:
        The store, which holds all items; None in processes that leave the report to another.
    """
    with workers() as group:
        if group.reports:
            prepare(ResultStore(out, group))
        group.wait()
        store = ResultStore(out, group)
        common = json.dumps([settings, code_digest(*POSE_SOURCES)], sort_keys=True)
        with tqdm(desc=label, unit="photo", disable=not (progress and group.rank == 0)) as bar:
            _register_part(items, group, store, open_registrar, register, common, bar)
        group.wait()
        if not group.reports or not store.is_complete(item.key for item in items):
            return None
        if group.leads:
            store.merge()
        return store


def _register_part(
    items: Sequence[ItemT],
    workers: Workers,
    store: ResultStore,
    open_registrar: OpenRegistrar,
    register: Callable[[ItemT, Registrar | Exception, float, Row], Row],
    common: str,
    bar: "tqdm[Any]",
) -> None:
    digest_of_photo, digest_of_mesh = cache(file_digest), cache(mesh_digest)

    def digests(item: ItemT) -> dict[str, str]:
        meshes = [(path.name, digest_of_mesh(path)) for path in item.meshes]
        return {
            "request": text_digest(json.dumps([common, item.request(), meshes])),
            "photo": digest_of_photo(item.photo),
        }

    order = {meshes: place for place, meshes in enumerate(dict.fromkeys(item.meshes for item in items))}
    mine = workers.part(sorted(items, key=lambda item: order[item.meshes]))
    todo = [(item, found) for item in mine if not store.is_current(item.key, found := digests(item))]
    bar.reset(len(mine))
    bar.update(len(mine) - len(todo))
    lock = threading.Lock()
    registrar: Registrar | Exception | None
    for meshes, pairs in [(meshes, list(group)) for meshes, group in groupby(todo, key=lambda pair: pair[0].meshes)]:
        registrar = None  # free its memory before the next one is opened
        start = time.perf_counter()
        registrar = open_registrar(meshes)
        seconds = time.perf_counter() - start

        def register_one(k: int, registrar: Registrar | Exception = registrar) -> None:
            item, found = pairs[k]  # noqa: B023
            row = register(item, registrar, 0.0 if k else seconds, found)  # noqa: B023
            with lock:
                store.append({"key": item.key, "digests": found, **row})
                bar.update()

        device = registrar.bank.device if isinstance(registrar, Registrar) else "cpu"
        map_on_threads(register_one, range(len(pairs)), device=device)
