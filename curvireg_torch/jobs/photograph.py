"""The registration of one photograph, and its result that can be drawn and saved."""

import base64
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..data import load_camera
from ..errors import CurviregError, InvalidInputError
from ..geometry import Camera
from ..geometry.cameras import camera_numbers
from ..geometry.pose_prior import PosePrior
from ..mesh import load_mesh
from ..pipeline import Pipeline
from ..registration import FailedRegistration, Registrar, Registration
from ..registration.detection import detect_prepared
from ..registration.hypotheses import projected_box
from ..registration.photograph import Photograph, as_photo
from ..registration.refinement import refine_prepared
from ..registration.registrar import ObjectLike
from ..registration.result import Results
from ..registration.several import register_prepared_views
from ..utils.checks import as_numbers
from ..utils.likes import BoxLike, CameraLike, ImageLike, MaskLike
from ..visualization import contour_overlay, plots, pose_glb, registration_sheet
from ..visualization.encoding import jpeg, png, shrink
from .documents import detection_document, result_document
from .entry import Entry, prepare, start_in_unit
from .opening import load_bank
from .outputs import output_folder
from .result_files import write_files

__all__ = ["RegisteredPhotograph", "register"]

THUMBNAIL_SIDE = 480  # pixels of the overlay's longer side in a notebook


@dataclass(frozen=True, repr=False, eq=False, kw_only=True)
class RegisteredPhotograph(Registration):
    """A :class:`Registration` that knows its photograph, and so can be drawn and saved.

    Attributes:
        registrar: of the mesh.
        photograph: without distortion, with the box in which the object was found.
        document: the content of ``result.json``.
        inputs: files that were read.
        copies: further objects that were found in the photograph, by decreasing confidence.
    """

    registrar: Registrar
    photograph: Photograph
    document: dict[str, Any]
    inputs: tuple[Path, ...] = ()
    copies: tuple[Registration, ...] = ()

    @property
    def image(self) -> Tensor:
        """(1 or 3, H, W) of the photograph, without distortion."""
        return self.photograph.image

    @property
    def box(self) -> Tensor:
        """(4,) x0, y0, x1, y1 in px in which the object was found."""
        return self.photograph.box

    def overlay(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB: the photograph with the contours of the mesh at the pose, and the
        box; those of ``copies`` too."""
        return contour_overlay(self.registrar, self, self.photograph, copies=self.copies)

    def plot(self) -> Any:
        """The overlay as a ``matplotlib.figure.Figure``; needs matplotlib."""
        return plots.picture(self.overlay())

    def save(self, folder: str | PathLike[str]) -> None:
        """Write ``result.json``, ``overlay.png`` and ``pose.glb`` as ``curvireg register --out``
        does.

        Raises:
            InvalidInputError: a file in the way that is an input, or no result of this method or
                that command.
            OutputError: a file cannot be written.
        """
        with output_folder(Path(folder), "register", inputs=self.inputs):
            self.write(Path(folder))

    def write(self, folder: Path) -> None:
        """Write the files of :meth:`save` into a folder that :func:`.outputs.output_folder` has
        checked."""
        mesh = self.registrar.of_mesh(self.mesh_index).bank.mesh
        camera = self.document["camera"]
        distorts = camera is not None and (
            camera["model"] == "fisheye" or any(camera["distortion"])
        )
        note = "Distortion of the lens removed." if distorts else ""

        def overlay() -> bytes:
            return png(
                registration_sheet(
                    self.registrar, self, self.photograph, note=note, copies=self.copies
                )
            )

        def glb() -> bytes:
            return pose_glb(mesh, *self.projection, self.image)

        write_files(folder, self.document, len(mesh.faces), overlay, glb)

    def _repr_html_(self) -> str:
        """For notebooks: the overlay above the pose."""
        data = base64.b64encode(jpeg(shrink(self.overlay(), THUMBNAIL_SIDE), 85)).decode()
        return (
            f'<img alt="contours on the photograph" '
            f'src="data:image/jpeg;base64,{data}">{super()._repr_html_()}'
        )


def register(
    image: ImageLike,
    mesh: ObjectLike | Registrar,
    *,
    box: BoxLike | None = None,
    camera: CameraLike | str | PathLike[str] | None = None,
    mask: MaskLike | None = None,
    prior: PosePrior | None = None,
    unit: str | None = None,
    up: str | None = None,
    pipeline: Pipeline | None = None,
    progress: bool = True,
) -> RegisteredPhotograph:
    """Find the pose of a mesh in one photograph.

    Args:
        image: a path, a PIL image, an (H, W) or (H, W, 3) RGB array, or a (1 or 3, H, W) tensor.
        mesh: a mesh or a bank, or the path of one, see :class:`Registrar`; or a registrar, which is
            faster for several photographs.
        box: x0, y0, x1, y1 in px; without box and mask the object is searched for.
        camera: fx, fy, cx, cy in px, a (3, 3) camera matrix, a :class:`Camera`, or the path of a
            calibration file; "exif" insists on the focal length of the photograph's EXIF data.
            None: this one, if there is one, or else the focal length is estimated in the
            photograph; ``result.camera`` tells which.
        mask: (H, W) of the object, white, or its path; ``FILE:LABEL`` for one label of a picture of
            labels.
        prior: limits on the pose.
        unit, up: of a mesh file, see :func:`load_mesh`; None: "m", and the usual axis. A bank must
            have been built with those that are given.
        pipeline: the default is that of :class:`Registrar`.
        progress: show progress while the views of a mesh are rendered, the first time.

    Raises:
        CurviregError: an input that cannot be used, or a photograph that shows nothing to register.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=20, elevations=[10, 30])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> result = cr.register(scene.image, bank, box=scene.box, camera=scene.camera_matrix)
        >>> result.quaternion.shape, result.overlay().shape
        (torch.Size([4]), (720, 960, 3))
    """
    entry = Entry(box=box, camera=_camera(camera), mask=mask, prior=prior)
    if isinstance(image, str | PathLike):
        entry = replace(entry, name=str(image), photo=Path(image))
    photo = as_photo(image)
    if isinstance(mesh, str | PathLike):
        entry = replace(entry, meshes=(Path(mesh),))
        load = load_bank if Path(mesh).suffix == ".safetensors" else load_mesh
        mesh = load(Path(mesh), unit=unit, up=up)
    elif unit is not None or up is not None:
        raise InvalidInputError(
            "unit, up: of a mesh file; what is given as mesh has its own, leave them out"
        )
    if not isinstance(mesh, Registrar):
        mesh = Registrar(mesh, pipeline=pipeline, progress=progress)
    elif pipeline is not None:
        raise InvalidInputError("pipeline: a Registrar has its own, leave it out")
    return register_entry(entry, prepare(entry, photo), mesh)


def _camera(
    given: CameraLike | str | PathLike[str] | None,
) -> Camera | tuple[float, ...] | str | None:
    """The camera of :func:`register`, as an :class:`.Entry` has it."""
    if given is None or isinstance(given, Camera):
        return given
    if isinstance(given, str | PathLike):
        return "exif" if given == "exif" else load_camera(given)
    numbers = as_numbers(given, "camera", dtype=torch.float64)
    return tuple(numbers.tolist()) if numbers.shape == (4,) else Camera(numbers)


def register_entry(
    entry: Entry, photograph: Photograph, registrar: Registrar, *, bank_seconds: float = 0.0
) -> RegisteredPhotograph:
    """Register one photograph with the registrar of its meshes, which took ``bank_seconds`` to
    open."""
    (found,) = register_entries([(entry, photograph)], registrar, bank_seconds=bank_seconds)
    if isinstance(found, CurviregError):
        raise found
    return found


def register_entries(
    entries: Sequence[tuple[Entry, Photograph]], registrar: Registrar, *, bank_seconds: float = 0.0
) -> list[RegisteredPhotograph | CurviregError]:
    """Register entries, each with its photograph, with the registrar of their meshes, which took
    ``bank_seconds`` to open; those with boxes together. One that cannot be registered has its
    error.

    The ``document`` of a result is the content of ``result.json``, and of a line of
    ``results.jsonl``; its seconds are those of the photograph and its share of those of the call.
    """
    start = time.perf_counter()
    located = [item for entry, item in entries if _is_located(entry, item)]
    together = iter(registrar.register_prepared(located))
    seconds = (time.perf_counter() - start) / max(len(located), 1)
    found: list[RegisteredPhotograph | CurviregError] = []
    for place, (entry, item) in enumerate(entries):
        start = time.perf_counter()
        try:
            if _is_located(entry, item):
                answers: Results = [next(together)]
                taken = seconds
            else:
                answers = _results_of(entry, item, registrar)
                taken = time.perf_counter() - start
            spent = {"bank": 0.0 if place else bank_seconds, "register": taken}
            found.append(_registered(entry, item, registrar, answers, spent))
        except CurviregError as error:
            found.append(error)
    return found


def _is_located(entry: Entry, item: Photograph) -> bool:
    """Whether the object is searched for in one photograph, in a box."""
    return entry.start is None and not entry.views and item.has_box


def _results_of(entry: Entry, item: Photograph, registrar: Registrar) -> Results:
    """The registrations of a photograph with a start, with further views, or without a box."""
    alone = replace(item, prior=None)
    if entry.start is not None:
        start_pose = start_in_unit(entry.start, registrar.bank.mesh.unit)
        confidences = [entry.start.confidence]
        return refine_prepared(registrar, [alone], [start_pose], start_confidences=confidences)
    if entry.views:
        first = replace(entry, T_cam_from_world=torch.eye(4, dtype=torch.float64))
        views = [first, *entry.views]
        together = register_views(views, [alone, *prepare_views(entry.views)], registrar)
        best, *others = together.hypotheses
        best = replace(best, projection=(together.views[0].T_cam_from_model, item.K))
        return [replace(together, hypotheses=(best, *others), camera=item.pinhole)]
    if entry.instances > 1:
        return detect_prepared(registrar, [item], instances=entry.instances)[0]
    return registrar.register_prepared([item], detects=True)


def prepare_views(views: Sequence[Entry]) -> list[Photograph | CurviregError]:
    """The photographs of several entries, or why one cannot be used: others may do without it."""
    found: list[Photograph | CurviregError] = []
    for view in views:
        try:
            found.append(prepare(view))
        except CurviregError as error:
            found.append(error)
    return found


def register_views(
    views: Sequence[Entry],
    photographs: Sequence[Photograph | CurviregError],
    registrar: Registrar,
) -> Registration:
    """Register several photographs of one object together, see :meth:`.Registrar.register_views`;
    errors call them by their names."""
    T = torch.stack([view.in_world[1] for view in views])
    try:
        return register_prepared_views(registrar, photographs, T)
    except CurviregError as error:
        raise error.with_image_names([view.name for view in views]) from error


def _registered(
    entry: Entry,
    item: Photograph,
    registrar: Registrar,
    results: Results,
    seconds: dict[str, float],
) -> RegisteredPhotograph:
    """The first of the results, with its document and the others as copies."""
    result = results[0]
    if isinstance(result, FailedRegistration):
        raise result.error.with_subject(entry.name)
    box = item.box
    if result.detection is not None:
        box = result.detection.box
    elif not item.has_box:
        box = projected_box(registrar.of_mesh(result.mesh_index).describer, result.projection)
    camera = result.camera
    if camera is not None and item.camera is not None:
        camera = replace(camera, distortion=item.camera.distortion, model=item.camera.model)
    document = {
        **result_document(result, registrar, seconds),
        "mesh": str(entry.meshes[result.mesh_index]) if entry.meshes else None,
        "inputs": {
            "photo": entry.name,
            "mesh": ", ".join(map(str, entry.meshes)),
            "box": box.tolist(),
            "camera": None if item.camera is None else list(camera_numbers(item.K)),
            **item.facts,
        },
        "camera": camera and camera.describe(),
        "camera_source": camera and camera.source,
    }
    objects = [found for found in results if isinstance(found, Registration)]
    if result.detection is not None:
        document["detection"] = detection_document(objects)
    box = box.double() if result.corrected_box is None else result.corrected_box
    return RegisteredPhotograph(
        **vars(result),
        registrar=registrar,
        photograph=replace(item, box=box),
        document=document,
        inputs=entry.files,
        copies=tuple(objects[1:]),
    )
