"""The loop over a list: each photograph's result is on disk as soon as it is known."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, starmap
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from ...errors import BankError, CurviregError, ImageError, InvalidInputError, MeshError
from ...geometry import camera_matrix
from ...geometry.cameras import camera_of_view
from ...io import Photo, read_photo
from ...io.meshes.files import mesh_digest
from ...registration import FailedRegistration, Registrar, Registration, localize
from ...registration.document import SCHEMA, localization_document, result_document, used_box
from ...utils.digests import file_digest, text_digest
from ...utils.files import write_file
from ...utils.threads import map_on_threads
from ...visualization.sheet import Shown, thumbnail, write_sheet
from .bop import write_bop_results
from .listing import Entry, Listing
from .records import Record, Records

__all__ = ["Counts", "register_entry", "register_list"]

NONE = {"request": "", "photo": ""}
"""Digests of what was not asked for."""


@dataclass(frozen=True)
class Counts:
    """How a list ended: rows with a pose, without, and with one to rely on."""

    ok: int
    failed: int
    reliable: int

    def __str__(self) -> str:
        return f"{self.ok + self.failed} photographs: {self.ok} ok, {self.failed} failed, {self.reliable} reliable"


def register_list(
    listing: Listing,
    out: Path,
    open_registrar: Callable[[tuple[Path, ...]], Registrar],
    *,
    settings: Mapping[str, Any],
    progress: bool = True,
) -> Counts:
    """Register the photographs of a list; ``out`` gets ``results.jsonl``, ``results.csv`` and ``index.html``.

    Photographs of one mesh follow each other, so that only its bank is in memory; as many as torch has threads are
    registered side by side. What ``results.jsonl`` holds of the same photograph, mesh, box, camera and settings is not
    done again. A row that cannot be registered (photograph or mesh missing or broken, box or camera that is none) ends
    ``failed``, with the reason.

    Args:
        listing: the photographs.
        out: folder for the results.
        open_registrar: of the files of one mesh, or of several.
        settings: plain values, all that results depend on besides the files.
        progress: show a bar.

    Raises:
        CurviregError: ``open_registrar`` refuses its options, or ``out`` cannot be written to.
    """
    return _Run(Records(out), open_registrar, json.dumps(settings, sort_keys=True), progress)(listing)


def register_entry(
    entry: Entry, photo: Photo, registrar: Registrar, *, bank_seconds: float
) -> tuple[Registration, Record]:
    """The pose of one photograph, and its document.

    Args:
        entry: its name, box and camera.
        photo: as read from its file.
        registrar: of its mesh.
        bank_seconds: what fetching the registrar's bank took.

    Raises:
        CurviregError: it cannot be registered; the message begins with the photograph's name.
    """
    start = time.perf_counter()
    K, source = _camera(entry, photo)
    if entry.box is None:
        results = localize(registrar, [photo.image], K, instances=entry.instances, distance=entry.distance)[0]
    else:
        results = registrar([photo.image], torch.tensor(entry.box)[None], K)
    result = results[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject(entry.name)
    box = torch.tensor(entry.box) if result.localization is None else result.localization.box
    document = result_document(result, registrar, {"bank": bank_seconds, "register": time.perf_counter() - start})
    document["mesh"] = str(entry.meshes[result.model])
    for pose, hypothesis in zip(document["top"], result.hypotheses, strict=True):
        pose["mesh"] = str(entry.meshes[hypothesis.model])
    document["inputs"] = {
        "photo": entry.name,
        "mesh": ", ".join(map(str, entry.meshes)),
        "box": box.tolist(),
        "camera": None if K is None else [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
        "camera_source": source,
        "picture": photo.facts(),
    }
    if result.localization is not None:
        document["localization"] = localization_document([r for r in results if isinstance(r, Registration)])
    if source in ("exif", "fov"):  # how far a guess is off, nobody knows
        document["covariance"] = document["standard_deviations"] = document["squared_radius"] = None
    return result, document


def _camera(entry: Entry, photo: Photo) -> tuple[torch.Tensor | None, str | None]:
    """(3, 3) camera matrix, and where it is from: "given", "exif" or "fov"."""
    if entry.camera is not None:
        return camera_matrix(*entry.camera, dtype=torch.float64), "given"
    if entry.guess is None:
        return None, None
    if isinstance(entry.guess, float):
        H, W = photo.image.shape[-2:]
        return camera_of_view(entry.guess, (H, W)), "fov"
    K = photo.guessed_camera_matrix()
    if K is None:
        raise InvalidInputError(f"{entry.name}: no focal length in its EXIF; give --camera FX FY CX CY, or --fov DEG")
    return K, "exif"


@dataclass
class _Run:
    records: Records
    open_registrar: Callable[[tuple[Path, ...]], Registrar]
    settings: str
    progress: bool
    meshes: tuple[Path, ...] = ()
    registrar: Registrar | Exception | None = None
    mesh_digests: dict[Path, str] = field(default_factory=dict)

    def __call__(self, listing: Listing) -> Counts:
        for older in ("results.csv", "index.html", "bop.csv"):  # never stand beside newer lines
            (self.records.table.parent / older).unlink(missing_ok=True)
        usable = [entry for entry in listing.entries if not entry.trouble]
        requests = {self._request(entry): entry for entry in usable}
        todo = [(request, entry) for request, entry in requests.items() if not self._is_done(request, entry)]
        order = {meshes: place for place, meshes in enumerate(dict.fromkeys(entry.meshes for entry in usable))}
        todo.sort(key=lambda pair: order[pair[1].meshes])
        bar = tqdm(
            total=len(requests),
            initial=len(requests) - len(todo),
            desc="register",
            unit="photo",
            disable=not self.progress,
        )
        with bar:
            for meshes, group in groupby(todo, key=lambda pair: pair[1].meshes):
                self._register(meshes, list(group), bar)
        return self._finish(listing)

    def _register(self, meshes: tuple[Path, ...], some: Sequence[tuple[str, Entry]], bar: "tqdm[Any]") -> None:
        """Photographs of the same meshes, side by side; each is on disk as soon as it is done."""
        start = time.perf_counter()
        registrar = self._opened(meshes)
        seconds = time.perf_counter() - start
        lock = threading.Lock()

        def one(k: int) -> None:
            record = self._record(*some[k], registrar, 0.0 if k else seconds)  # the bank was opened for the first
            with lock:
                self.records.append(record)
                bar.update()

        map_on_threads(one, range(len(some)))

    def _request(self, entry: Entry) -> str:
        """Names all that the result depends on but the photograph's content, which is read only where it must be."""
        for mesh in entry.meshes:
            if mesh not in self.mesh_digests:
                self.mesh_digests[mesh] = mesh_digest(mesh)
        meshes = [(mesh.name, self.mesh_digests[mesh]) for mesh in entry.meshes]
        asked = [
            *(entry.name, entry.box, entry.camera, entry.guess, entry.instances, entry.distance),
            *(meshes, self.settings),
        ]
        return text_digest(json.dumps(asked))

    def _is_done(self, request: str, entry: Entry) -> bool:
        before = self.records.photo_digest(request)
        assert entry.photo is not None
        return bool(before) and before == file_digest(entry.photo)

    def _record(self, request: str, entry: Entry, registrar: Registrar | Exception, bank_seconds: float) -> Record:
        assert entry.photo is not None
        digests = {"request": request, "photo": file_digest(entry.photo)}
        try:
            photo = read_photo(entry.photo, dtype=torch.uint8)
        except (CurviregError, OSError) as error:
            return _failed(str(error), digests)
        if not isinstance(registrar, Registrar):
            return _failed(str(registrar), digests)
        try:
            result, document = register_entry(entry, photo, registrar, bank_seconds=bank_seconds)
        except (ImageError, InvalidInputError) as error:
            return _failed(str(error), digests)
        renderer = registrar.describers[result.model].renderer
        picture = thumbnail(renderer, result.projection, photo.image, used_box(document))
        write_file(self._picture(request), picture)  # before the line that says that all is done
        return {"status": "ok", "message": "", **document, "digests": digests}

    def _picture(self, request: str) -> Path:
        return self.records.table.parent / "thumbnails" / f"{request}.jpg"

    def _opened(self, meshes: tuple[Path, ...]) -> Registrar | Exception:
        """Of these meshes, or why there is none."""
        if self.registrar is None or meshes != self.meshes:
            self.meshes, self.registrar = meshes, None  # the memory goes before more is asked for
            try:
                self.registrar = self.open_registrar(meshes)
            except (MeshError, BankError, OSError) as error:
                self.registrar = error
        return self.registrar

    def _finish(self, listing: Listing) -> Counts:
        shown = list(starmap(self._shown, enumerate(self._answers(listing), start=1)))
        kinds = [one.kind for one, _ in shown]
        counts = Counts(len(kinds) - kinds.count("failed"), kinds.count("failed"), kinds.count("reliable"))
        shown.sort(key=lambda pair: pair[1])
        folder = self.records.table.parent
        write_bop_results(folder / "bop.csv", listing.columns, self._rows(listing))
        write_sheet(folder / "index.html", str(counts), [one for one, _ in shown], table="results.csv")
        which = any(len(entry.meshes) > 1 for entry in listing.entries)
        self.records.finish(listing.columns, self._rows(listing), which=which)  # last: it moves the lines
        return counts

    def _shown(self, number: int, answer: tuple[Entry, Record]) -> tuple[Shown, tuple[bool, bool, float, int]]:
        """A row on the page, and by what it is sorted."""
        entry, record = answer
        message, reliable, confidence = record["message"], record.get("reliable", False), record.get("confidence", 0.0)
        kind = "failed" if message else "reliable" if reliable else "doubtful"
        path = self._picture(record["digests"]["request"])
        shown = Shown(
            number=number,
            name=entry.name,
            said=message or f"confidence {confidence:.2f}, {kind}",
            kind=kind,
            picture=lambda: path.read_bytes() if not message and path.is_file() else None,
        )
        return shown, (bool(message), not reliable, -confidence, number)

    def _answers(self, listing: Listing) -> Iterator[tuple[Entry, Record]]:
        for entry in listing.entries:
            yield entry, _failed(entry.trouble, NONE) if entry.trouble else self.records.read(self._request(entry))

    def _rows(self, listing: Listing) -> Iterator[tuple[Sequence[str], Record]]:
        return ((entry.cells, record) for entry, record in self._answers(listing))


def _failed(trouble: str, digests: Mapping[str, str]) -> Record:
    return {"schema": SCHEMA, "status": "failed", "message": " ".join(trouble.split()), "digests": dict(digests)}
