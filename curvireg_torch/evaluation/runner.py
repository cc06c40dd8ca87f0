"""Objects in photographs, of lists and of datasets: their record, and the resumable loop that registers them."""

import json
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from ..data import Photo, read_photo
from ..errors import BankError, CurviregError, InvalidInputError, MeshError, MissingFileError
from ..geometry import Camera, undistorted
from ..geometry.calibration import Undistorted
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
from .store import ResultStore, Row, workers

POSE_SOURCES = (
    *("data", "filters", "geometry", "matching", "features", "mesh", "registration", "rendering", "terms.py"),
    *("utils", "errors.py", "pipeline.py"),
)
"""Parts of the package that results depend on."""

REPORTS = ("summary.json", "predictions.csv", "results.csv", "index.html")
"""Files that are written from all results at the end; older ones would not match newer results."""

CAMERA_OPTIONS = "--camera FX FY CX CY, --camera FILE (a calibration), --camera exif or --fov DEG"
"""How the command line takes a camera."""

OpenRegistrar = Callable[[tuple[Path, ...]], Registrar]  # opens the registrar of some mesh files


@dataclass(frozen=True)
class View:
    """One of several photographs of an object in one pose."""

    name: str  # as the user calls the photograph
    photo: Path
    box: Sequence[float] | None  # x0, y0, x1, y1 in px
    camera: Camera
    T_cam_from_world: Tensor  # (4, 4) float64, lengths in the mesh's unit
    image: Tensor | None = None  # its pixels, if it was read already


@dataclass(frozen=True)
class Entry:
    """One object in one photograph, to register."""

    cells: Mapping[str, str] = field(default_factory=dict)  # of a list: the texts of the row by column
    name: str = ""  # as the user calls the photograph
    photo: Path = Path()
    meshes: tuple[Path, ...] = ()  # of several the best is found
    box: Sequence[float] | None = None  # x0, y0, x1, y1 in px; None: the object is detected
    camera: Camera | str | float | None = None  # "exif" and a horizontal field of view in degrees are guesses
    mask: Path | None = None  # of the object, instead of a box or beside it
    instances: int = 1  # without a box, see registration.detect
    prior: PosePrior | None = None
    start: tuple[tuple[float, ...], ...] | None = None  # (4, 4) pose that is refined; nothing is searched for
    start_confidence: float | None = None
    views: tuple[View, ...] = ()  # other photographs, found together with this one, whose camera is their world
    as_stored: bool = False  # boxes refer to the pixels in the file; else the EXIF orientation is applied first
    label: str = ""  # of a dataset's object: a name that no other object has
    error: str = ""  # why the object cannot be registered

    def request(self) -> list[Any]:
        """All that the result depends on besides the content of files."""
        prior = None if self.prior is None else self.prior.to_dict()
        camera = self.camera.describe() if isinstance(self.camera, Camera) else self.camera
        given = [self.name, self.box, camera, self.instances, prior]
        views = [(view.box, view.camera.describe(), view.T_cam_from_world.tolist()) for view in self.views]
        mask = [] if self.mask is None else [str(self.mask), file_digest(self.mask)]
        return [*given, self.start, self.start_confidence, views, self.as_stored, *mask]

    @property
    def key(self) -> str:
        """The label, or a digest of the request and the mesh files: equal rows of a list are registered once."""
        return self.label or text_digest(repr((self.request(), self.meshes)))


def check_entry(entry: Entry, photo: Photo) -> None:
    """Refuse a box or camera that cannot be used, as :func:`register_entry` does, before meshes are opened."""
    _item(entry, photo, camera_of(entry, photo)[0])


def seen_image(entry: Entry, photo: Photo) -> Tensor:
    """The photograph as poses refer to it, without the distortion of a calibrated camera."""
    return undistorted(photo.image, entry.camera).image if isinstance(entry.camera, Camera) else photo.image


def _item(entry: Entry, photo: Photo, camera: Camera | None) -> ImageItem:
    if entry.mask is not None and not entry.mask.is_file():
        raise MissingFileError("no such file; check the path of the mask", subject=entry.mask)
    return image_item_of(photo.image, entry.box, camera, entry.prior, entry.mask, name=entry.name)


def image_item_of(image: Any, box: Any, camera: Any, prior: PosePrior | None, mask: Any, *, name: str) -> ImageItem:
    """One photograph and what is known about it, checked; errors begin with its name."""
    boxes, masks = None if box is None else [box], None if mask is None else [mask]
    item = image_items([image], boxes, camera, prior, masks)[0]
    if isinstance(item, CurviregError):
        raise item.with_subject(name)
    return item


def register_image(
    registrar: Registrar, image: Any, box: Any, camera: Any, prior: PosePrior | None, mask: Any, instances: int = 1
) -> Sequence[Registration | FailedRegistration]:
    """The pose in one photograph, or of its ``instances`` objects if they are detected, without box and mask."""
    if box is None and mask is None:
        return detect(registrar, [image], camera, instances=instances, prior=prior)[0]
    boxes, masks = None if box is None else [box], None if mask is None else [mask]
    return registrar([image], boxes, camera, prior=prior, masks=masks)


def box_of_result(result: Registration, registrar: Registrar, item: ImageItem, *, given: bool) -> Tensor:
    """(4,) in px: the box that was given or detected, or that of the mesh at the pose."""
    if given:
        return item.box
    if result.detection is not None:
        return result.detection.box
    return projected_box(registrar.of_model(result.model).describer, projection_of(result, item.camera_matrix))


def register_entry(
    entry: Entry, photo: Photo, registrar: Registrar, *, bank_seconds: float
) -> tuple[Registration, Row]:
    """Register one photograph with the registrar of its meshes, which took ``bank_seconds`` to open.

    Returns:
        The registration, and its document: the content of ``result.json``, and of a line of ``results.jsonl``.
    """
    start = time.perf_counter()
    camera, source = camera_of(entry, photo)
    item = _item(entry, photo, camera)
    results: Sequence[Registration | FailedRegistration]
    if entry.start is not None:
        results = refine(registrar, [photo.image], camera, [entry.start], start_confidences=[entry.start_confidence])
    elif entry.views:
        assert camera is not None  # of datasets with cameras only
        first = View(entry.name, entry.photo, entry.box, camera, torch.eye(4, dtype=torch.float64))
        results = [register_views([first, *entry.views], registrar, as_stored=entry.as_stored)[0]]
    else:
        results = register_image(registrar, photo.image, entry.box, camera, entry.prior, entry.mask, entry.instances)
    result = results[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject(entry.name)
    K, given = item.camera_matrix, entry.box is not None or entry.mask is not None
    box = box_of_result(result, registrar, item, given=given)
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
        "camera": None if camera is None else camera.at(item.size).describe(),
    }
    if result.detection is not None:
        document["detection"] = detection_document([r for r in results if isinstance(r, Registration)])
    if source in ("exif", "fov"):  # the error of a guessed camera is unknown
        document["covariance"] = document["standard_deviations"] = None
    return result, document


def register_views(
    views: Sequence[View], registrar: Registrar, *, as_stored: bool = False
) -> tuple[Registration, list[Undistorted | None], list[Camera]]:
    """Register several photographs together, see :meth:`.Registrar.register_views`, without their distortion.

    Returns:
        The registration; and the photographs without distortion, None for one that could not be read, and their
        cameras.
    """
    seen, cameras = [], []
    for view in views:
        one, camera = None, view.camera
        with suppress(CurviregError, OSError):  # the registrar reports what cannot be read, and goes on without it
            one = read_photo(view.photo, as_stored=as_stored).image if view.image is None else view.image
        try:
            if one is not None:
                camera = camera.at((one.shape[-2], one.shape[-1]))
            box = None if view.box is None else torch.tensor(view.box)
            seen.append(None if one is None else undistorted(one, camera, box))
        except CurviregError as error:
            raise error.with_subject(view.name) from error
        cameras.append(camera)
    images = [view.photo if one is None else one.image for view, one in zip(views, seen, strict=True)]
    boxes = [None if one is None else one.box for one in seen]
    matrices, poses = (torch.stack(each) for each in ([c.matrix for c in cameras], [v.T_cam_from_world for v in views]))
    try:
        return registrar.register_views(images, boxes, matrices, poses), seen, cameras
    except CurviregError as error:
        named = re.sub(r"\bimage (\d+)\b", lambda number: views[int(number[1])].name, f"{error}")
        raise InvalidInputError(named) from error


def projection_of(result: Registration, K: Tensor | None) -> tuple[Tensor, Tensor]:
    """``T_cam_from_model`` and the camera matrix that project the mesh onto the photograph, the first of several."""
    return (result.views[0].T_cam_from_model, K) if result.views and K is not None else result.projection


def camera_of(entry: Entry, photo: Photo) -> tuple[Camera | None, str | None]:
    """The camera, and its source; that of a calibration has a size or distortion."""
    given = entry.camera
    if isinstance(given, Camera):
        return given, "file" if given.size or given.distorts else "given"
    if given is None:
        if entry.start is not None:
            raise InvalidInputError(f"--start: needs the camera; give {CAMERA_OPTIONS}", subject=entry.name)
        return None, None
    if given != "exif":
        H, W = photo.image.shape[-2:]
        return Camera(camera_of_view(float(given), (H, W))), "fov"
    K = photo.guessed_camera_matrix()
    if K is None:
        raise InvalidInputError(f"no focal length in its EXIF; give {CAMERA_OPTIONS}", subject=entry.name)
    return Camera(K), "exif"


def run_entries(
    entries: Sequence[Entry],
    out: Path,
    open_registrar: OpenRegistrar,
    *,
    settings: Mapping[str, Any],
    label: str,
    progress: bool = True,
) -> ResultStore | None:
    """Register the entries, without ``error`` and of different keys, whose results ``out`` does not hold yet.

    A stored row counts if its digests are the same: that of the photograph's content, and that of the request, which
    covers ``settings`` (all that every result depends on), the code of this library, the entry's own request and every
    file of its meshes. Entries of the same meshes follow each other, so that only one bank is in memory, and are
    registered side by side on torch's threads; each row is on disk as soon as it is known. An input that cannot be used
    makes a row with ``failed`` as ``status`` and does not stop the others.

    Returns:
        The store, which holds all entries; None in processes that leave the report to the first one.
    """
    common = json.dumps([dict(settings), code_digest(*POSE_SOURCES)], sort_keys=True)
    photo_digest, digest_of_mesh = cache(file_digest), cache(mesh_digest)

    def digests(entry: Entry) -> dict[str, str]:
        meshes = [(path.name, digest_of_mesh(path)) for path in entry.meshes]
        request = text_digest(json.dumps([common, entry.request(), meshes]))
        photos = [photo_digest(path) for path in (entry.photo, *(view.photo for view in entry.views))]
        return {"request": request, "photo": "-".join(photos) if all(photos) else ""}

    with workers() as group:
        if group.rank == 0:
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
        if group.rank:
            return None
        if not store.is_complete({entry.key: digests(entry) for entry in entries}):
            raise InvalidInputError(f"{out}: a photograph or mesh changed meanwhile; run the same command again")
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
    K = entry.camera.matrix if entry.views and isinstance(entry.camera, Camera) else None
    projection = projection_of(result, K)
    write_file(picture, thumbnail(renderer, projection, seen_image(entry, photo), used_box(document)))
    return {"status": "ok", "message": "", **document}


def failed_row(error: Exception | str, **values: Any) -> Row:
    """The row of an entry without a pose; ``skipped`` names a file that could not be read."""
    return {"schema": SCHEMA, "status": "failed", "message": " ".join(str(error).split()), **values}


def thumbnail_path(out: Path, digests: Mapping[str, str]) -> Path:
    """Where the picture of a result in the folder ``out`` is."""
    return out / "thumbnails" / f"{digests['request']}.jpg"


def thumbnail_of(out: Path, row: Row) -> Path | None:
    """The picture of a row; None if it has no pose."""
    return thumbnail_path(out, row["digests"]) if row["status"] == "ok" else None
