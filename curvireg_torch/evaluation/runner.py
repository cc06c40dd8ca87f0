"""Objects in photographs, of lists and of datasets: their record, and the resumable loop that registers them."""

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ..data import Photo, read_photo
from ..errors import BankError, CurviregError, InvalidInputError, MeshError, MissingFileError
from ..geometry import Camera, camera_matrix, undistorted
from ..geometry.cameras import camera_of_view
from ..geometry.pose_prior import PosePrior
from ..mesh.files import mesh_digest
from ..registration import FailedRegistration, Registrar, Registration, detect
from ..registration.inputs import ImageItem, image_items
from ..registration.poses import projected_box
from ..registration.refinement import refine
from ..registration.result import SCHEMA, detection_document, result_document, used_box
from ..utils.files import code_digest, file_digest, text_digest, write_file
from ..utils.threads import map_on_threads
from ..visualization.sheet import thumbnail
from .store import ResultStore, Row
from .workers import workers

__all__ = [
    "POSE_SOURCES",
    "Entry",
    "OpenRegistrar",
    "check_entry",
    "failed_row",
    "register_entry",
    "run_entries",
    "seen_image",
]

POSE_SOURCES = (
    *("data", "filters", "geometry", "matching", "features", "mesh", "registration", "rendering", "terms"),
    *("utils", "errors.py", "pipeline.py"),
)
"""Parts of the package that results depend on."""

REPORTS = ("summary.json", "predictions.csv", "results.csv", "bop.csv", "index.html")
"""Files that are written from all results at the end; older ones would not match newer results."""

CAMERA_OPTIONS = "--camera FX FY CX CY, --camera FILE (a calibration), --camera exif or --fov DEG"
"""How the command line takes a camera."""

OpenRegistrar = Callable[[tuple[Path, ...]], Registrar]
"""Opens the registrar of some mesh files."""


@dataclass(frozen=True)
class OtherView:
    """Another photograph of the object of an :class:`Entry`, in the same pose.

    Attributes:
        photo, box, camera: as of an entry; the camera is needed.
        T_cam_from_first: (4, 4) transform from the camera of the entry's photograph to that of this one, with lengths
            in the unit of the mesh.
    """

    photo: Path
    box: Sequence[float] | None
    camera: Sequence[float]
    T_cam_from_first: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Entry:
    """One object in one photograph, to register.

    Attributes:
        cells: of a list: the texts of the row, one for each column.
        name, photo: the photograph as the user names it, and its file.
        meshes: mesh files; of several the best is found.
        box: x0, y0, x1, y1 in px; None: the object is detected.
        camera: fx, fy, cx, cy in px, or a calibrated camera; None if unknown.
        mask: file of a mask of the object, instead of a box or beside it.
        guess: replaces an unknown camera: "exif" takes the focal length in the photograph's file, a number is the
            horizontal field of view in degrees; None: no camera.
        instances: without a box, see :func:`curvireg_torch.registration.detect`.
        prior: limits on the pose.
        start, start_confidence: (4, 4) pose that is refined, nothing is searched for; and its confidence if known.
        views: other photographs, with which the pose in ``photo`` is found together.
        as_stored: boxes refer to the pixels as the file holds them; else the EXIF orientation is applied first.
        label: of a dataset's object: a name that no other object has.
        error: why the object cannot be registered; "" if it can.
    """

    cells: tuple[str, ...] = ()
    name: str = ""
    photo: Path = Path()
    meshes: tuple[Path, ...] = ()
    box: Sequence[float] | None = None
    camera: Sequence[float] | Camera | None = None
    mask: Path | None = None
    guess: str | float | None = None
    instances: int = 1
    prior: PosePrior | None = None
    start: tuple[tuple[float, ...], ...] | None = None
    start_confidence: float | None = None
    views: tuple[OtherView, ...] = ()
    as_stored: bool = False
    label: str = ""
    error: str = ""

    def request(self) -> list[Any]:
        """All that the result depends on besides the content of files."""
        prior = None if self.prior is None else self.prior.to_dict()
        camera = self.camera.describe() if isinstance(self.camera, Camera) else self.camera
        given = [self.name, self.box, camera, self.guess, self.instances, prior]
        views = [(view.box, view.camera, view.T_cam_from_first) for view in self.views]
        mask = [] if self.mask is None else [str(self.mask), file_digest(self.mask)]
        return [*given, self.start, self.start_confidence, views, self.as_stored, *mask]

    @property
    def key(self) -> str:
        """The label, or a digest of the request and the mesh files: equal rows of a list are registered once."""
        return self.label or text_digest(repr((self.request(), self.meshes)))


def check_entry(entry: Entry, photo: Photo) -> None:
    """Refuse a box or camera that cannot be used, as :func:`register_entry` does, before meshes are opened."""
    _item(entry, photo, _camera(entry, photo)[0])


def seen_image(entry: Entry, photo: Photo) -> Tensor:
    """The photograph as poses refer to it, without the distortion of a calibrated camera."""
    return undistorted(photo.image, entry.camera).image if isinstance(entry.camera, Camera) else photo.image


def _item(entry: Entry, photo: Photo, camera: Tensor | Camera | None) -> ImageItem:
    boxes = None if entry.box is None else [entry.box]
    masks = None if entry.mask is None else [entry.mask]
    if entry.mask is not None and not entry.mask.is_file():
        raise MissingFileError("no such file; check the path of the mask", subject=entry.mask)
    item = image_items([photo.image], boxes, camera, entry.prior, masks)[0]
    if isinstance(item, CurviregError):
        raise item.with_subject(entry.name)
    return item


def register_entry(
    entry: Entry, photo: Photo, registrar: Registrar, *, bank_seconds: float
) -> tuple[Registration, Row]:
    """Register one photograph with the registrar of its meshes, which took ``bank_seconds`` to open.

    Returns:
        The registration, and its document: the content of ``result.json``, and of a line of ``results.jsonl``.

    Raises:
        CurviregError: it cannot be registered; the message begins with the photograph's name.
    """
    start = time.perf_counter()
    camera, source = _camera(entry, photo)
    item, images = _item(entry, photo, camera), [photo.image]
    if entry.start is not None:
        results = refine(registrar, images, camera, [entry.start], start_confidences=[entry.start_confidence])
    elif entry.views:
        results = [_registered_views(entry, photo, registrar)]
    elif entry.box is None and entry.mask is None:
        results = detect(registrar, images, camera, instances=entry.instances, prior=entry.prior)[0]
    else:
        box = None if entry.box is None else torch.tensor(entry.box)[None]
        masks = None if entry.mask is None else [entry.mask]
        results = registrar(images, box, camera, prior=entry.prior, masks=masks)
    result = results[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject(entry.name)
    if entry.box is not None or entry.mask is not None:
        box = item.box
    elif result.detection is not None:
        box = result.detection.box
    else:
        box = projected_box(registrar.of_model(result.model).describer, projection_of(result, item.camera_matrix))
    K = item.camera_matrix
    document = {
        **result_document(result, registrar, {"bank": bank_seconds, "register": time.perf_counter() - start}),
        "mesh": str(entry.meshes[result.model]),
        "inputs": {
            "photo": entry.name,
            "mesh": ", ".join(map(str, entry.meshes)),
            "box": box.tolist(),
            "camera": None if K is None else [float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "camera_source": source,
            "picture": photo.facts(),
        },
        "camera": None if K is None else (camera if isinstance(camera, Camera) else Camera(K)).at(item.size).describe(),
    }
    if result.detection is not None:
        document["detection"] = detection_document([r for r in results if isinstance(r, Registration)])
    if source in ("exif", "fov"):  # the error of a guessed camera is unknown
        document["covariance"] = document["standard_deviations"] = None
    return result, document


def _registered_views(entry: Entry, photo: Photo, registrar: Registrar) -> Registration:
    """The pose in the first of several photographs: the world is its camera."""
    images: list[Any] = [photo.image]
    for view in entry.views:
        try:
            images.append(read_photo(view.photo, as_stored=entry.as_stored).image)
        except CurviregError:
            images.append(view.photo)  # the registrar reports that it cannot be read, and goes on without it
    boxes = [entry.box, *(view.box for view in entry.views)]
    assert not isinstance(entry.camera, Camera)  # of datasets only
    cameras = [entry.camera or (), *(view.camera for view in entry.views)]
    K = torch.stack([camera_matrix(*camera, dtype=torch.float64) for camera in cameras])
    first = torch.eye(4, dtype=torch.float64)
    poses = [torch.tensor(view.T_cam_from_first, dtype=torch.float64) for view in entry.views]
    return registrar.register_views(images, boxes, K, torch.stack([first, *poses]))


def projection_of(result: Registration, K: Tensor | None) -> tuple[Tensor, Tensor]:
    """``T_cam_from_model`` and the camera matrix that project the mesh onto the photograph, the first of several."""
    return (result.views[0].T_cam_from_model, K) if result.views and K is not None else result.projection


def _camera(entry: Entry, photo: Photo) -> tuple[Tensor | Camera | None, str | None]:
    """Camera or camera matrix, and its source."""
    if isinstance(entry.camera, Camera):
        return entry.camera, "file"
    if entry.camera is not None:
        return camera_matrix(*entry.camera, dtype=torch.float64), "given"
    if entry.guess is None:
        if entry.start is not None:
            raise InvalidInputError(f"--start: needs the camera; give {CAMERA_OPTIONS}", subject=entry.name)
        return None, None
    if isinstance(entry.guess, float):
        H, W = photo.image.shape[-2:]
        return camera_of_view(entry.guess, (H, W)), "fov"
    K = photo.guessed_camera_matrix()
    if K is None:
        raise InvalidInputError(f"no focal length in its EXIF; give {CAMERA_OPTIONS}", subject=entry.name)
    return K, "exif"


def run_entries(
    entries: Sequence[Entry],
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    settings: Mapping[str, Any],
    label: str,
    progress: bool = True,
) -> ResultStore | None:
    """Register the entries whose results the store in ``out`` does not hold yet, in one process or several.

    A stored row counts if its digests are the same: that of the photograph's content, and that of the request, which
    covers ``settings``, the code of this library, the entry's own request and every file of its meshes. Entries of the
    same meshes follow each other, so that only one bank is in memory, and are registered side by side on torch's
    threads; each row is on disk as soon as it is known. An input that cannot be used makes a row with ``failed`` as
    ``status`` and does not stop the others.

    Args:
        entries: without ``error``, of different keys.
        out: folder of the store, and of the ``thumbnails`` of the results.
        open_registrar: called once for each set of meshes.
        settings: plain values, everything that all results depend on.
        label: of the progress bar.
        progress: show it.

    Returns:
        The store, which holds all entries; None in processes that leave the report to another.

    Raises:
        CurviregError: ``open_registrar`` refuses its options, or ``out`` cannot be written to.
    """
    common = json.dumps([dict(settings), code_digest(*POSE_SOURCES)], sort_keys=True)
    photo_digest, digest_of_mesh = cache(file_digest), cache(mesh_digest)

    def digests(entry: Entry) -> dict[str, str]:
        meshes = [(path.name, digest_of_mesh(path)) for path in entry.meshes]
        request = text_digest(json.dumps([common, entry.request(), meshes]))
        photos = [photo_digest(path) for path in (entry.photo, *(view.photo for view in entry.views))]
        return {"request": request, "photo": "-".join(photos) if all(photos) else ""}

    with workers() as group:
        if group.reports:
            for name in REPORTS:
                (out / name).unlink(missing_ok=True)
        group.wait()
        store = ResultStore(out, group)
        order = {meshes: place for place, meshes in enumerate(dict.fromkeys(entry.meshes for entry in entries))}
        part = group.part(sorted(entries, key=lambda entry: order[entry.meshes]))
        todo = [(entry, found) for entry in part if not store.is_current(entry.key, found := digests(entry))]
        with tqdm(desc=label, unit="photo", total=len(part), disable=not (progress and group.rank == 0)) as bar:
            bar.update(len(part) - len(todo))
            for meshes, same in groupby(todo, key=lambda pair: pair[0].meshes):
                _register_some(list(same), meshes, store, open_registrar, bar)
        group.wait()
        if not group.reports or not store.is_complete({entry.key: digests(entry) for entry in entries}):
            if group.leads:
                raise InvalidInputError(f"{out}: a photograph or mesh changed meanwhile; run the same command again")
            return None
        if group.leads:
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
    lock, start = threading.Lock(), time.perf_counter()
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
    map_on_threads(register_one, range(len(pairs)), device=device)


def _row(entry: Entry, registrar: Registrar | Exception, picture: Path, *, bank_seconds: float) -> Row:
    """The result of an entry; its thumbnail is on disk before."""
    start = time.perf_counter()
    try:
        photo = read_photo(entry.photo, as_stored=entry.as_stored)
    except (CurviregError, OSError) as error:
        return failed_row(error, skipped="unreadable_image")
    if isinstance(registrar, Exception):
        return failed_row(registrar, skipped="unreadable_mesh")
    try:
        result, document = register_entry(entry, photo, registrar, bank_seconds=bank_seconds)
    except CurviregError as error:
        return failed_row(error, seconds={"bank": bank_seconds, "register": time.perf_counter() - start})
    renderer = registrar.of_model(result.model).describer.renderer
    K = camera_matrix(*entry.camera) if entry.views and isinstance(entry.camera, Sequence) else None
    projection = projection_of(result, K)
    write_file(picture, thumbnail(renderer, projection, seen_image(entry, photo), used_box(document)))
    return {"status": "ok", "message": "", **document}


def failed_row(error: Exception | str, **values: Any) -> Row:
    """The row of an entry without a pose; ``skipped`` names a file that could not be read."""
    return {"schema": SCHEMA, "status": "failed", "message": " ".join(str(error).split()), **values}


def thumbnail_path(out: Path, digests: Mapping[str, str]) -> Path:
    """Where the picture of a result in the folder ``out`` is."""
    return out / "thumbnails" / f"{digests['request']}.jpg"


def thumbnail_of(out: Path, row: Row) -> Callable[[], bytes | None]:
    """Return a function that reads the picture of a row; its result is None if there is none."""
    path = thumbnail_path(out, row["digests"])
    return lambda: path.read_bytes() if row["status"] == "ok" and path.is_file() else None
