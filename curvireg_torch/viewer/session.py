"""Photographs, mesh, rig and options, what is registered with them, and how. It needs no page and
no NiceGUI."""

import math
import re
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..data import Photo, read_photo
from ..errors import (
    MAX_VIEWER_PHOTOGRAPHS,
    CurviregError,
    InvalidInputError,
    MissingFileError,
)
from ..geometry import undistorted
from ..geometry.calibration import Camera
from ..geometry.cameras import camera_numbers, transform
from ..geometry.pose_prior import object_frame
from ..jobs.entry import Entry, entry_of, prepare
from ..jobs.opening import open_registrar
from ..jobs.options import QUALIFIERS, WITHIN, RegisterOptions, check_camera
from ..jobs.photograph import register_entry
from ..jobs.rigs import read_rig, register_rig
from ..matching import ViewBank
from ..mesh import Mesh, mesh_centre, mesh_radius
from ..registration import Registrar, Registration
from ..registration.photograph import Photograph
from ..utils.aliases import Fields, Progress
from ..utils.files import only_in
from ..visualization.pose_glb import mesh_glb
from .programs import command_line, python_program
from .shot import Answer, Numbers, Result, Shot, numbers

STATIC = Path(__file__).parent / "static"  # parts of the page, and the files of its sample
Registered = tuple[Registration, Fields, Sequence[Photograph], list[Tensor | None]]
GivenCamera = Numbers | Camera | str | float | None  # see RegisterOptions.camera
UNPACKED = "parts"  # the folder of what was in an archive
# Why there is no command line for what is shown
UNDISTORTED = (
    "None: the command line takes the box in the photograph as it was taken, the page in the "
    "undistorted one."
)
UNCERTAIN = (
    "None: four numbers do not tell how uncertain the calibration's focal length is; give its file "
    "as --camera FILE."
)
NOT_IN_RIG = (
    "None: first write the boxes that were drawn here into the columns x0 to y1 of the rig, and "
    "open all photographs."
)


@dataclass
class Session:
    """Photographs, one of which is shown, and the mesh. Methods that compute may take minutes: call
    them in a thread.

    Attributes:
        options: of ``curvireg view``, with the camera of all photographs; :meth:`set_camera`
            changes it.
        folder: of uploaded files, which messages call by their names alone.
        shots, shot: the photographs, and the one that is shown; an empty one before the first.
        removed: the photograph that was removed last, and its number.
        rig_path, rig: the file of a rig, and its rows by the names of their photographs; none if it
            could not be read.
        mesh_path, mesh, mesh_facts: the mesh, and what it is in words.
        searched: photographs in which a registration runs.
        progress, cancelled: stage, done and total of a registration; True ends it at its next step.
    """

    options: RegisterOptions
    folder: Path
    shots: list[Shot] = field(default_factory=list)
    shot: Shot = field(default_factory=Shot)
    removed: tuple[int, Shot] | None = None
    rig_path: Path | None = None
    rig: dict[str, Entry] = field(default_factory=dict)
    searched: tuple[Shot, ...] = ()
    mesh_path: Path | None = None
    mesh: Mesh | None = None
    mesh_facts: str = ""
    progress: tuple[str, int, int] = ("", 0, 1)
    cancelled: bool = False
    _registrar: tuple[tuple[Mesh | None, RegisterOptions], Registrar] | None = None
    _opening: threading.Lock = field(default_factory=threading.Lock)

    def load(self) -> None:
        """Open the files that the options name, and take their box."""
        options = self.options
        given = "box" if options.boxes is None else "boxes"
        if getattr(options, given) is not None and not options.photos:
            raise InvalidInputError(
                f"--{given}: needs a photograph; name one, or draw the box on the page"
            )
        self.options = replace(options, photos=(), meshes=(), box=None, boxes=None, box_format=None)
        for path in options.photos:
            self.open_photo(path, options.box_of(path))
        for path in options.meshes:
            self.open_mesh(path)

    def name(self, path: str | Path) -> str:
        """What the user calls a file."""
        return Path(path).name if {self.folder, STATIC} & {*Path(path).parents} else str(path)

    def without_folders(self, text: str) -> str:
        """A text in which uploaded files, and those unpacked from an archive, have their names
        alone."""
        folders = {str(self.folder), str(self.folder.resolve())}
        places = "|".join(map(re.escape, sorted(folders, key=len, reverse=True)))
        return re.sub(rf"(?:{places})[/\\](?:upload-\w+[/\\]?)?(?:{UNPACKED}[/\\])?", "", text)

    def usable_name(self, path: Path) -> str:
        """:meth:`name`, in commands and programs; the sample has no other place than its own."""
        return str(path) if path.parent == STATIC else self.name(path)

    def close(self) -> None:
        """Forget the photographs, the rig and the mesh."""
        self.shots = []
        self.shot = Shot()
        self.removed = None
        self.mesh_path = None
        self.mesh = None
        self.rig_path = None
        self.rig = {}

    def open_photo(self, path: Path, box: Numbers | None = None) -> Shot:
        """Add a photograph, and show it; a box in it loses its distortion too."""
        self._check_number(path)
        self.shot = self._opened(path, box, self._row_of(path, self.shots), self.options.camera)
        self.shots.append(self.shot)
        return self.shot

    def _check_number(self, path: Path) -> None:
        if len(self.shots) >= MAX_VIEWER_PHOTOGRAPHS:
            raise InvalidInputError(
                f"{MAX_VIEWER_PHOTOGRAPHS} photographs are open; remove one", subject=path
            )

    def restore_photo(self) -> None:
        """Open the photograph again that was removed last, with its box and its result, and show
        it."""
        if self.removed is None:
            return
        number, shot = self.removed
        self._check_number(shot.path)
        shot = self._open_again(shot, self._row_of(shot.path, self.shots), self.options.camera)
        self.shots.insert(number, shot)
        self.shot = shot
        self.removed = None

    def remove_photo(self, shot: Shot) -> None:
        """Close a photograph; if it is shown, the next one is shown instead."""
        if shot not in self.shots:  # closed already, in another window
            return
        number = self.shots.index(shot)
        del self.shots[number]
        self.removed = number, shot
        if shot is self.shot:
            self.shot = self.shots[min(number, len(self.shots) - 1)] if self.shots else Shot()
        self._match_rig()  # another one of its name may be open

    def _opened(
        self,
        path: Path,
        box: Numbers | None,
        view: Entry | None,
        camera: GivenCamera,
        photo: Photo | None = None,
    ) -> Shot:
        """A photograph and a box, those of a ``view`` of a rig if there is one, without the
        distortion of the camera, which must fit the photograph. It is read from its file, unless it
        was ``photo``."""
        photo = photo or read_photo(path)
        if view is not None:
            camera, _ = view.in_world
            box = box if box is not None or view.box is None else numbers(view.box)
        if not isinstance(camera, Camera):
            return Shot(path, photo, box, view)
        try:
            image, moved, _, _ = undistorted(
                photo.image, camera, None if box is None else torch.tensor(box)
            )
        except InvalidInputError as error:
            raise error.with_subject(path if view is None else view.name) from error
        if moved is not None and camera.distorts:
            box = numbers([round(float(v), 1) for v in moved])
        notes = (*photo.notes, *["undistorted"] * camera.distorts)
        return Shot(path, replace(photo, image=image, notes=notes), box, view)

    def _open_again(self, shot: Shot, view: Entry | None, camera: GivenCamera) -> Shot:
        """A photograph with another camera, or row of a rig. Its box stays unless distortion is
        removed, or no longer is, or another one; its result only where no rig is concerned."""
        photo = None if shot.is_undistorted else shot.photo
        opened = self._opened(shot.path, None, view, camera, photo)
        is_same = torch.equal(opened.image, shot.image)
        if opened.is_undistorted != shot.is_undistorted or not is_same:
            return opened
        if view is not None or shot.view is not None:
            return replace(opened, box=shot.box or opened.box, box_before=shot.box_before)
        return shot

    def _replace_shots(self, shots: list[Shot]) -> None:
        if self.shots:
            self.shot = shots[self.shots.index(self.shot)]
            self.shots = shots

    def open_rig(self, path: Path | None) -> None:
        """Read a rig, as ``curvireg register --views`` does, or forget it; its rows belong to
        photographs by their file names. A rig that cannot be used has no rows; one that cannot be
        forgotten, as the camera does not fit its photographs, stays."""
        before = self.rig_path, self.rig
        self.rig_path = path
        self.rig = {}
        try:
            self.rig = {} if path is None else self._read_rig(path)
            self._match_rig()
        except CurviregError as error:
            self.rig = {}
            if path is None:
                self.rig_path, self.rig = before
                raise
            self._match_rig()
            subject = str(error.subject).replace(str(path), self.rig_name)
            if isinstance(error, MissingFileError):
                raise MissingFileError("no such file; drop it here", subject=subject) from error
            raise error.with_subject(subject) from error

    def _read_rig(self, path: Path) -> dict[str, Entry]:
        """The rows of a rig. It comes from anyone who has the address: it names files beside it
        only."""
        views = read_rig(path, self.mesh_path, find=only_in(path if path.is_dir() else path.parent))
        rows = dict[str, Entry]()
        for view in views:
            same = rows.setdefault(_key(view.photo), view)
            if same is not view:
                message = (
                    f"{same.name} and {view.name} have the same file name; rename the photographs"
                )
                raise InvalidInputError(message, subject=path)
        return rows

    def _match_rig(self) -> None:
        """Give each photograph its row of the rig; the first of several that have one name gets
        it."""
        shots: list[Shot] = []
        for shot in self.shots:
            view = self._row_of(shot.path, shots)
            shots.append(
                shot if view is shot.view else self._open_again(shot, view, self.options.camera)
            )
        self._replace_shots(shots)

    def _row_of(self, path: Path, shots: Sequence[Shot]) -> Entry | None:
        """The row of the rig with the file name of a photograph, if none of ``shots`` has it."""
        is_taken = any(shot.view and _key(shot.path) == _key(path) for shot in shots)
        return None if is_taken else self.rig.get(_key(path))

    def together(self) -> list[Shot]:
        """The photographs that are registered with the shown one: those of the rig, or it alone."""
        if self.shot.view is None:
            return [self.shot]
        return [one for view in self.rig.values() for one in self.shots if one.view is view]

    @property
    def rig_name(self) -> str:
        """What the user calls the rig."""
        path = self.rig_path
        return "" if path is None else "scene_camera.json" if path.is_dir() else path.name

    def rig_gaps(self) -> str:
        """Which photographs of the rig are not open, and which are not of it, in words."""
        if not self.rig:
            return ""
        used = {_key(shot.path) for shot in self.shots if shot.view is not None}
        missing = [view.photo.name for key, view in self.rig.items() if key not in used]
        others = [shot.path.name for shot in self.shots if shot.view is None]
        gaps = []
        if missing:
            gaps.append(
                f"not open: {_listed(missing)}; drop what is missing here"
                + ", or go on without" * bool(used)
            )
        if others:
            gaps.append(f"not in the rig: {_listed(others)}; registered alone")
        return "; ".join(gaps)

    def set_camera(self, camera: GivenCamera = None) -> None:
        """Change the camera of all photographs that have none in a rig.

        Boxes and results stay unless distortion is removed, or no longer is, or another one; after
        an error nothing has changed.
        """
        try:
            check_camera(camera)
        except InvalidInputError as error:
            raise InvalidInputError(str(error).replace("fov", "field of view")) from error
        calibrated = isinstance(camera, Camera) or isinstance(self.options.camera, Camera)
        shots = [
            self._open_again(shot, None, camera) if calibrated and not shot.view else shot
            for shot in self.shots
        ]
        # at once: the page looks at them meanwhile
        self.options = replace(self.options, camera=camera)
        self._replace_shots(shots)

    def open_mesh(self, path: Path) -> None:
        """Check that a mesh or a bank can be used, and describe it; it replaces the one before."""
        if path.suffix == ".safetensors":
            bank = ViewBank.load(path)
            mesh = bank.mesh
            facts = f"bank of {len(bank)} views"
        else:
            mesh = self.options.load_mesh(path)
            size = " x ".join(f"{v:.4g}" for v in mesh.extents)
            facts = (
                f"{len(mesh.faces):,} faces, {size} {mesh.unit}, rendered {_colours_in_words(mesh)}"
            )
        self.mesh_path = path
        self.mesh = mesh
        self.mesh_facts = facts
        for shot in (*self.shots, *([self.removed[1]] if self.removed else [])):
            shot.result = None
        # boxes of a BOP scene are those of the mesh
        if self.rig_path is not None and self.rig_path.is_dir():
            self.open_rig(self.rig_path)

    def set_limits(self, **limits: Any) -> None:
        """Change what is known of the pose: arguments of :class:`PosePrior`; None removes a
        limit."""
        known = {**self.options.limits, **limits}
        self.options = replace(
            self.options, limits={n: value for n, value in known.items() if value is not None}
        )

    def remove_limits(self) -> None:
        """Forget what was known of the pose, but not which side of the mesh is its front."""
        self.set_limits(**dict.fromkeys(self.options.limits.keys() - QUALIFIERS))

    def object_frame(self) -> Tensor:
        """(3, 3) rotation from the mesh's axes to those of limits, see :func:`.object_frame`."""
        assert self.mesh is not None
        return object_frame(self.mesh.up, self.options.limits.get("front"))

    def hint_direction(self, position: Sequence[float]) -> None:
        """Limit the pose to views like that from a point beside the object, in the frame of limits,
        z up."""
        x, y, z = position
        azimuth = math.degrees(math.atan2(x, -y)) % 360.0
        elevation = math.degrees(math.atan2(z, math.hypot(x, y)))
        self.remove_limits()
        self.set_limits(viewpoint=(round(azimuth, 1), round(elevation, 1), 0.0), within=WITHIN)

    def mesh_axis(self, position: Sequence[float]) -> str:
        """The mesh's axis that points to a point on its surface, in the frame of limits about the
        object's centre."""
        at = self.object_frame().mT @ torch.tensor(list(position), dtype=torch.float64)
        axis = int(at.abs().argmax())
        return ("" if at[axis] > 0 else "-") + "xyz"[axis]

    def preview(self) -> bytes:
        """The mesh as a GLB file, in the frame of limits and its radii."""
        assert self.mesh is not None
        frame = self.object_frame()
        radius = mesh_radius(self.mesh)
        return mesh_glb(self.mesh, transform(frame, -frame @ mesh_centre(self.mesh)) / radius)

    def inputs(self) -> tuple[RegisterOptions, tuple[Numbers | None, ...]]:
        """The :meth:`request`, and the boxes of all photographs that are registered together."""
        return self.request(), tuple(each.box for each in self.together())

    def request(self) -> RegisterOptions:
        """The registration that the inputs describe, in the photograph that is shown."""
        shot = self.shot
        camera = self.options.camera
        if shot.view is not None:  # the rig has boxes and cameras
            camera = None
        if isinstance(camera, Camera):
            camera = camera_numbers((camera if shot.photo is None else camera.at(shot.size)).matrix)
        photos = () if shot.photo is None else tuple(each.path for each in self.together())
        meshes = () if self.mesh_path is None else (self.mesh_path,)
        box = None if shot.view is not None else shot.box
        return replace(self.options, photos=photos, meshes=meshes, box=box, camera=camera)

    def lacks_command(self) -> str:
        """Why no command line gives the same result; empty if one does."""
        if self.shot.view is None:
            camera = self.options.camera
            if self.shot.is_undistorted:
                return UNDISTORTED
            return UNCERTAIN if isinstance(camera, Camera) and camera.focal_deviation > 0.0 else ""
        shots = self.together()
        is_whole = self.rig_path is not None and len(shots) == len(self.rig)
        return "" if is_whole and all(shot.has_box_of_view for shot in shots) else NOT_IN_RIG

    def command(self) -> str:
        """The command line that gives the same result, if there is one."""
        if self.lacks_command():
            return ""
        path = self.rig_path if self.shot.view is not None else None
        if path is None:
            return command_line(self.request(), self.usable_name)
        return command_line(self.request(), self.name, "SCENE" if path.is_dir() else self.rig_name)

    def register(self) -> Registration:
        """Find the pose in the photograph that is shown, as ``curvireg register`` does, or in those
        of its rig."""
        start = time.perf_counter()
        shot = self.shot
        inputs = self.inputs()
        # another may be shown meanwhile
        request = inputs[0]
        shots = self.together()
        command = self.command()
        if shot.photo is None or not request.meshes:
            raise InvalidInputError("register: choose a photograph and a mesh first")
        check_camera(request.camera)
        if shot.view is not None and request.limits.keys() - QUALIFIERS:
            raise InvalidInputError("a pose prior: photographs of a rig take none; press No prior")
        self.searched = tuple(shots)
        try:
            registrar = self.open_registrar(request, self.report_progress)
            registrar.progress = self.report_progress
            register = self._register_alone if shot.view is None else self._register_rig
            found = register(shots, request, registrar, time.perf_counter() - start)
            self.report_progress("contours", 1, 1)  # it may have been stopped in the last step
        except CurviregError as error:
            raise (CurviregError("stopped") if self.cancelled else error) from None
        finally:
            self.cancelled = False
            self.searched = ()
        registration, document, photographs, boxes = found
        answer = Answer(registration.hypotheses[0])
        result = Result(registrar, registration, document, photographs, inputs, answer)
        result.document["viewer"] = {"command": command}
        for each, box in zip(shots, boxes, strict=True):
            each.result = result
            each.found_box = box
        return result.registration

    def _register_alone(
        self, shots: Sequence[Shot], request: RegisterOptions, registrar: Registrar, seconds: float
    ) -> Registered:
        (shot,) = shots
        entry = entry_of(request.photos[0], request)
        meshes = tuple(Path(self.name(path)) for path in entry.meshes)
        entry = replace(entry, name=self.name(entry.photo), meshes=meshes)
        photograph = _prepared(entry, shot, self.options.camera)
        found = register_entry(entry, photograph, registrar, bank_seconds=seconds)
        return found, found.document, (), [found.box.float()]

    def _register_rig(
        self, shots: Sequence[Shot], request: RegisterOptions, registrar: Registrar, seconds: float
    ) -> Registered:
        views = []
        photographs = []
        for shot in shots:
            assert shot.view is not None
            view = replace(shot.view, photo=Path(self.name(shot.path)), box=shot.box)
            views.append(view)
            photographs.append(_prepared(view, shot, view.camera))
        found = register_rig(
            Path(self.rig_name), views, photographs, registrar, bank_seconds=seconds
        )
        found.document["mesh"] = self.name(request.meshes[0])
        boxes = [view.box for view in found.registration.views]
        return found.registration, found.document, photographs, boxes

    def document(self) -> Fields:
        """:meth:`.Shot.document` of the photograph that is shown."""
        return self.shot.document()

    def python(self) -> str:
        """A Python program that gives the answer."""
        return python_program(self.shot, self.usable_name)

    def report_progress(self, stage: str, done: int, total: int) -> None:
        """Show progress, and end a registration that was stopped."""
        self.progress = (stage, done, total)
        if self.cancelled:
            raise CurviregError("stopped")

    def open_registrar(self, request: RegisterOptions, report: Progress) -> Registrar:
        """The registrar of a mesh and options; the last one is reused until the mesh is opened
        again, and one thread at a time builds one."""
        options = registrar_key(request)
        key = self.mesh, options
        with self._opening:
            if self._registrar is None or self._registrar[0] != key:
                self._registrar = key, open_registrar(options, options.meshes, progress=report)
            return self._registrar[1]


def _prepared(entry: Entry, shot: Shot, camera: object) -> Photograph:
    """The photograph of an entry as it is shown: that of a calibrated ``camera`` has lost its
    distortion already."""
    if not isinstance(camera, Camera):
        return prepare(entry, shot.photo)
    camera = camera.at(shot.size)
    pinhole = Camera(camera.matrix, size=shot.size)
    photograph = prepare(replace(entry, camera=pinhole), shot.photo)
    return replace(photograph, camera=camera)


def registrar_key(request: RegisterOptions) -> RegisterOptions:
    """The options of a request on which its registrar depends."""
    return replace(request, photos=(), box=None, limits={}, camera=None)


def _colours_in_words(mesh: Mesh) -> str:
    """How a mesh is rendered, and what it lacks."""
    is_incomplete = any(warning.kind in ("texture", "material") for warning in mesh.warnings)
    words = "in its colours" if mesh.has_colours else "in grey"
    if is_incomplete:
        words = words.replace("its", "some of its")
        return f"{words}: materials or textures are missing; send it with them in a zip archive"
    return words


def _key(photo: Path) -> str:
    """What files of one photograph have in common: those of BOP sets have different suffixes."""
    return photo.stem.lower()


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
