"""One photograph with what is known about it, before it is registered."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from ..data import Photo, read_photo
from ..errors import CurviregError, InvalidInputError
from ..formats.boxes import PictureSize
from ..formats.masks import existing_mask, mask_as_shown, mask_file
from ..formats.poses import PoseRecord
from ..geometry import Camera, camera_matrix
from ..geometry.cameras import camera_of_view
from ..geometry.pose_prior import PosePrior
from ..registration.photograph import Photograph, as_photographs
from ..utils.choices import UNITS
from ..utils.files import file_digest, text_digest
from ..utils.likes import BoxLike
from .options import RegisterOptions, prior_from_limits

# standard deviation of the focal length of a given field of view, as a fraction of it
VIEW_DEVIATION = 0.1


@dataclass(frozen=True)
class Entry:
    """One object in one photograph, to register."""

    # of a list: the texts of the row by column
    cells: Mapping[str, str] = field(default_factory=dict)
    name: str = ""  # as the user calls the photograph
    photo: Path = Path()
    meshes: tuple[Path, ...] = ()  # of several the best is found
    box: BoxLike | None = None  # x0, y0, x1, y1 in px; None: the object is detected
    # or fx, fy, cx, cy in px; "exif" insists on the file's; or a horizontal field of view in deg
    camera: Camera | tuple[float, ...] | str | float | None = None
    mask: Any = None  # of the object, instead of a box or beside it: a path, or pixels
    instances: int = 1  # without a box, see registration.detect
    prior: PosePrior | None = None
    start: PoseRecord | None = None  # the pose that is refined; nothing is searched for
    # other photographs, found together with this one, whose camera is their world
    views: tuple["Entry", ...] = ()
    T_cam_from_world: Tensor | None = None  # (4, 4) of a view, lengths in the mesh's unit
    # boxes refer to the pixels in the file; else the EXIF orientation is applied first
    as_stored: bool = False
    label: str = ""  # of a dataset's object: a name that no other object has
    read_frame: Callable[[], Tensor] | None = None  # of the video ``photo``
    error: str = ""  # why the object cannot be registered

    def request(self) -> list[Any]:
        """All that the result depends on besides the content of files."""
        prior = None if self.prior is None else self.prior.to_dict()
        camera = self.camera.describe() if isinstance(self.camera, Camera) else self.camera
        given = [self.name, self.box, camera, self.instances, prior]
        views = [(view.request(), view.in_world[1].tolist()) for view in self.views]
        mask = [] if self.mask is None else [str(self.mask), file_digest(mask_file(self.mask)[0])]
        start = (
            None
            if self.start is None
            else (self.start.T.tolist(), self.start.unit, self.start.confidence)
        )
        return [*given, start, views, self.as_stored, *mask]

    @property
    def in_world(self) -> tuple[Camera, Tensor]:
        """Camera and ``T_cam_from_world`` of one of several photographs."""
        assert isinstance(self.camera, Camera)
        assert self.T_cam_from_world is not None
        return self.camera, self.T_cam_from_world

    def read(self) -> Photo:
        """The photograph, or the frame; errors are those of :func:`read_photo`."""
        if self.read_frame is not None:
            return Photo(self.read_frame())
        return read_photo(self.photo, as_stored=self.as_stored)

    @property
    def files(self) -> tuple[Path, ...]:
        """The photographs, meshes and mask that are read."""
        masks = [mask_file(self.mask)[0]] if isinstance(self.mask, str | PathLike) else []
        photos = [self.photo, *(view.photo for view in self.views)]
        return (*photos, *self.meshes, *masks)

    @property
    def key(self) -> str:
        """The label, or a digest of the request and the mesh files: equal rows of a list are
        registered once."""
        return self.label or text_digest(repr((self.request(), self.meshes)))


def entry_of(photo: Path, options: RegisterOptions) -> Entry:
    """A photograph with the box, camera, meshes and other inputs of the options."""
    return Entry(
        name=str(photo),
        photo=photo,
        meshes=options.meshes,
        box=options.box_of(photo),
        camera=options.camera,
        mask=options.mask,
        instances=options.instances,
        prior=prior_from_limits(options.limits),
        start=options.read_start(),
    )


def prepare(entry: Entry, photo: Photo | None = None) -> Photograph:
    """The photograph of an entry, by default that of its file, once for all meshes; refuses what
    cannot be used, before meshes are opened."""
    photo = entry.read() if photo is None else photo
    if isinstance(entry.mask, str | PathLike):
        existing_mask(entry.mask)
    camera, source = camera_of(entry, photo)
    H, W = photo.image.shape[-2:]
    mask = mask_as_shown(entry.mask, PictureSize((H, W), photo.orientation))
    boxes = None if entry.box is None else [entry.box]
    masks = None if mask is None else [mask]
    item = as_photographs([photo.image], boxes, camera, entry.prior, masks)[0]
    if isinstance(item, CurviregError):
        is_of_mask = item.subject == str(entry.mask)
        raise item.with_subject(item.subject if is_of_mask else entry.name)
    return replace(item, facts={"camera_source": source, "picture": photo.facts()})


def camera_of(entry: Entry, photo: Photo) -> tuple[Camera | None, str | None]:
    """The camera, or None if it is unknown, and its source; that of a calibration has a size or
    distortion."""
    given = entry.camera
    if isinstance(given, tuple):
        given = Camera(camera_matrix(*given))
    if isinstance(given, Camera):
        return given, "file" if given.size or given.distorts else "given"
    if given not in (None, "exif"):
        H, W = photo.image.shape[-2:]
        return Camera(camera_of_view(float(given), (H, W)), focal_deviation=VIEW_DEVIATION), "fov"
    if photo.is_panorama and not entry.as_stored:
        raise InvalidInputError(
            "a panorama, or a strip of another picture, which is no pinhole camera with its axis "
            "in the middle; take an ordinary photograph, or give the camera of this part",
            subject=entry.name,
            kind="camera",
        )
    # boxes of datasets come with what is to be known
    camera = None if entry.as_stored else photo.camera()
    if camera is not None:
        return camera, "exif"
    if given == "exif" or entry.start is not None:
        message = "a start pose needs the camera; give it"
        if given == "exif":
            message = "no focal length in its EXIF; give the camera in another way"
        raise InvalidInputError(message, subject=entry.name, kind=f"camera {given or ''}".strip())
    return None, None


def start_in_unit(start: "PoseRecord", unit: str | None) -> tuple[tuple[float, ...], ...]:
    """(4, 4) of a pose, with the translation in the ``unit`` of a mesh."""
    T = start.T.copy()
    if start.unit is not None:
        T[:3, 3] *= UNITS[start.unit] / UNITS[unit or "m"]
    return tuple(map(tuple, T.tolist()))
