"""Photographs, mesh, results and the chosen poses. It needs no page and no NiceGUI."""

import math
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from ..data import read_photo
from ..data.images import Photo
from ..errors import MAX_VIEWER_PHOTOGRAPHS, CurviregError, CurviregWarning, InvalidInputError
from ..evaluation.opening import QUALIFIERS, RegisterOptions, check_camera, open_registrar
from ..evaluation.runner import register_entry
from ..geometry import rotation_error, rotation_from_axis_angle, undistorted
from ..geometry.calibration import Camera
from ..geometry.cameras import rotation_towards, transform
from ..geometry.pose_prior import object_frame
from ..matching import ViewBank
from ..mesh import has_colours, load_mesh, mesh_centre, mesh_radius, mesh_up
from ..registration import Hypothesis, Registrar, Registration, fit_contours
from ..registration.result import used_box
from ..visualization import contour_overlay, pose_glb
from ..visualization.encoding import png
from ..visualization.pose_glb import mesh_glb

__all__ = ["Answer", "Numbers", "Point", "Result", "Session", "Shot", "dragged_box"]

HINT_WIDTH = 45.0  # degrees by which the pose may differ from a hint
MIN_SIDE = 3.0  # px of a new box; a smaller one was a click
NEAREST = 1.2  # least depth of the object's centre, in its radii, to which it can be moved by hand

Numbers = tuple[float, float, float, float]
Point = tuple[float, float]

_OPTIONS = ("unit", "up", "pose", "mesh_is", "preset", "pipeline", "renderer", "device")
_DEFAULTS = {option.name: option.default for option in fields(RegisterOptions)}


@dataclass(frozen=True)
class Answer:
    """The pose that is shown and saved: a hypothesis, its number from 0, and what was done to it by hand, in words."""

    pose: Hypothesis
    number: int = 0
    edits: tuple[str, ...] = ()

    def registration(self, found: Registration) -> Registration:
        """Return what was ``found`` with this pose first; nobody knows how probable a pose is that was set by hand."""
        if self.number == 0 and not self.edits:
            return found
        order = sorted(range(len(found.hypotheses)), key=lambda k: k != self.number)
        probabilities = () if self.edits or not found.probabilities else tuple(found.probabilities[k] for k in order)
        hypotheses = (self.pose, *(found.hypotheses[k] for k in order[1:]))
        return replace(found, hypotheses=hypotheses, probabilities=probabilities, confidence_features={})


@dataclass(frozen=True)
class Result:
    """A registration with its inputs."""

    registrar: Registrar
    registration: Registration
    document: dict[str, Any]  # the content of result.json, if the first answer is chosen
    image: Tensor  # (3, H, W) uint8
    box: Tensor  # (4,) px, with which the pose was found
    request: RegisterOptions  # what was asked for

    def moved(
        self, T: Tensor, rotation: Sequence[float] = (0, 0, 0), translation: Sequence[float] = (0, 0, 0)
    ) -> Tensor:
        """Return the (4, 4) pose ``T``, turned by degrees about the camera's axes and moved along them by radii.

        :class:`InvalidInputError` if the object would touch the camera.
        """
        describer = self.registrar.describer
        angles, shift = (torch.tensor(list(v), dtype=torch.float64) for v in (rotation, translation))
        centre = T[:3, :3] @ describer.centre + T[:3, 3] + describer.radius * shift
        if float(centre[2]) < NEAREST * describer.radius:
            raise InvalidInputError("the object would touch the camera; move it away")
        T = T.clone()
        T[:3, :3] = rotation_from_axis_angle(torch.deg2rad(angles)) @ T[:3, :3]
        T[:3, 3] = centre - T[:3, :3] @ describer.centre
        return T

    def dragged(self, T: Tensor, K: Tensor, start: Point, end: Point, *, turns: bool) -> Tensor:
        """Return the pose after a drag: the object's centre follows the mouse or, if it ``turns``, its near side."""
        describer, (dx, dy) = self.registrar.describer, (end[0] - start[0], end[1] - start[1])
        if max(abs(dx), abs(dy)) < 1.0:  # a click
            return T
        depth = float((T[:3, :3] @ describer.centre + T[:3, 3])[2])
        radii = depth / float(K[0, 0]) / describer.radius  # that one pixel is long
        if turns:
            return self.moved(T, rotation=(math.degrees(dy * radii), -math.degrees(dx * radii), 0.0))
        return self.moved(T, translation=(dx * radii, dy * radii, 0.0))

    def scaled(self, T: Tensor, factor: float, roll: float = 0.0) -> Tensor:
        """Return the pose that shows the object larger, at the same place in the photograph, and rolled by degrees."""
        describer = self.registrar.describer
        centre = T[:3, :3] @ describer.centre + T[:3, 3]
        shift = ((1.0 / factor - 1.0) * centre / describer.radius).tolist()
        return self.moved(T, rotation=(0.0, 0.0, roll), translation=shift)


@dataclass(eq=False)
class Shot:
    """A photograph, without the distortion of a calibrated camera, and what belongs to it.

    ``box_before`` and ``answer_before`` are those before the last change by hand.
    """

    path: Path = Path()
    photo: Photo | None = None
    box: Numbers | None = None
    box_before: Numbers | None = None
    result: Result | None = None
    answer: Answer | None = None
    answer_before: Answer | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the photograph."""
        assert self.photo is not None
        return int(self.photo.image.shape[-2]), int(self.photo.image.shape[-1])

    def set_box(self, box: Numbers | None) -> None:
        """Replace the box."""
        if box != self.box:
            self.box_before, self.box = self.box, box

    def require_result(self) -> tuple[Result, Answer]:
        """The result and the chosen pose; an error if there is none yet."""
        if self.result is None or self.answer is None:
            raise InvalidInputError("there is no result yet; register first")
        return self.result, self.answer

    def choose(self, number: int) -> None:
        """Make a hypothesis the answer, by its number from 0."""
        assert self.result is not None
        self.answer_before = None
        self.answer = Answer(self.result.registration.hypotheses[number], number)

    def place(self, T: Tensor, edit: str = "moved") -> None:
        """Move the answer to (4, 4) ``T_cam_from_model``, without its measurements; ``edit`` says how, in words."""
        result, answer = self.require_result()
        describer, (before, K) = result.registrar.describer, answer.pose.projection
        old, centre = (pose[:3, :3] @ describer.centre + pose[:3, 3] for pose in (before, T))
        degrees = float(rotation_error(T[:3, :3], before[:3, :3]))
        radii = float(torch.linalg.vector_norm(centre - old)) / describer.radius
        allocentric, has_translation = rotation_towards(centre).mT @ T[:3, :3], answer.pose.translation is not None
        pose = replace(
            answer.pose,
            rotation=T[:3, :3].clone() if has_translation else allocentric,
            translation=T[:3, 3].clone() if has_translation else None,
            score=float("nan"),
            evidence={},
            allocentric_rotation=allocentric,
            distance=float(torch.linalg.vector_norm(centre)),
            projection=(T, K),
            edge_support=None,
            covariance=None,
        )
        edit = f"{edit}: rotated {degrees:.1f} degrees, shifted {radii:.2f} radii"
        self.answer_before, self.answer = answer, Answer(pose, answer.number, (*answer.edits, edit))

    def fit(self) -> None:
        """Fit the contours at the answer to the photograph's edges."""
        result, answer = self.require_result()
        (T, K), registrar = answer.pose.projection, result.registrar
        margin = registrar.bank.settings.margin
        fit = fit_contours(registrar.describer.contours, result.image, result.box, K, T[None], margin=margin)
        supports = f"{float(fit.start_support[0]):.2f} to {float(fit.edge_support[0]):.2f}"
        self.place(fit.transform[0], f"contours fitted, edge support {supports}")

    def undo(self) -> None:
        """Take back the last change by hand; a second call repeats it."""
        if self.answer_before is not None:
            self.answer, self.answer_before = self.answer_before, self.answer

    def glb(self) -> bytes:
        """The answer as a GLB file, see :func:`curvireg_torch.visualization.pose_glb`."""
        result, answer = self.require_result()
        return pose_glb(result.registrar.bank.mesh, *answer.pose.projection, result.image)

    def overlay(self) -> bytes:
        """The contours at the answer on the photograph, as a PNG file."""
        result, answer = self.require_result()
        return png(contour_overlay(result.registrar, answer.pose, result.image, result.box))


@dataclass
class Session:
    """Photographs, one of which is shown, and the mesh. Methods that compute may take minutes: call them in a thread.

    Attributes:
        options: of ``curvireg view``, with the camera of all photographs; :meth:`set_camera` changes it.
        folder: of uploaded files, which messages call by their names alone.
        shots, shot: the photographs, and the one that is shown; an empty one before the first.
        searched: the one in which a registration runs.
        progress, cancelled: stage, done and total of a registration; True ends it at its next step.
    """

    options: RegisterOptions
    folder: Path | None = None
    shots: list[Shot] = field(default_factory=list)
    shot: Shot = field(default_factory=Shot)
    searched: Shot | None = None
    mesh_path: Path | None = None
    mesh: trimesh.Trimesh | None = None
    progress: tuple[str, int, int] = ("", 0, 1)
    cancelled: bool = False
    _registrar: tuple[RegisterOptions, Registrar] | None = None

    def load(self) -> str:
        """Open the files that the options name, and take their box; describes the mesh, or ""."""
        options = self.options
        if options.box is not None and not options.photos:
            raise InvalidInputError("--box: needs a photograph; name one, or draw the box on the page")
        self.options = replace(options, photos=(), meshes=(), box=None)
        for path in options.photos:
            self.open_photo(path, options.box)
        return "".join([self.open_mesh(path) for path in options.meshes])

    def name(self, path: str | Path) -> str:
        """What the user calls a file."""
        return Path(path).name if self.folder in Path(path).parents else str(path)

    def close(self) -> None:
        """Forget the photographs and the mesh."""
        self.shots, self.shot, self.mesh_path, self.mesh = [], Shot(), None, None

    def open_photo(self, path: Path, box: Numbers | None = None) -> Shot:
        """Add a photograph, and show it; a box in it loses its distortion too."""
        if len(self.shots) >= MAX_VIEWER_PHOTOGRAPHS:
            raise InvalidInputError(f"{MAX_VIEWER_PHOTOGRAPHS} photographs are open; remove one", subject=path)
        self.shot = Shot(path, *self._read(path, self.options.camera, box))
        self.shots.append(self.shot)
        return self.shot

    def remove_photo(self, shot: Shot) -> None:
        """Close a photograph; if it is shown, the next one is shown instead."""
        if shot not in self.shots:  # closed already, in another window
            return
        number = self.shots.index(shot)
        del self.shots[number]
        if shot is self.shot:
            self.shot = self.shots[min(number, len(self.shots) - 1)] if self.shots else Shot()

    def _read(
        self, path: Path, camera: Numbers | Camera | None, box: Numbers | None = None
    ) -> tuple[Photo, Numbers | None]:
        """A photograph and a box without the distortion of a calibrated camera, which must fit the photograph."""
        photo = read_photo(path, dtype=torch.uint8)
        if not isinstance(camera, Camera):
            return photo, box
        try:
            image, moved, _, _ = undistorted(photo.image, camera, None if box is None else torch.tensor(box))
        except InvalidInputError as error:
            raise error.with_subject(path) from error
        if moved is not None and camera.distorts:
            x0, y0, x1, y1 = (round(float(v), 1) for v in moved)
            box = x0, y0, x1, y1
        return replace(photo, image=image, notes=(*photo.notes, *["undistorted"] * camera.distorts)), box

    @property
    def is_undistorted(self) -> bool:
        """Whether the distortion of the camera is removed from photographs."""
        return isinstance(self.options.camera, Camera) and self.options.camera.distorts

    def set_camera(self, camera: Numbers | Camera | None = None, guess: str | float | None = None) -> None:
        """Change the camera of all photographs: four numbers, a calibrated one, or a guess.

        Boxes and results stay unless distortion is removed, or no longer is; after an error nothing has changed.
        """
        was_undistorted, shots = self.is_undistorted, self.shots
        if isinstance(camera, Camera) or was_undistorted:
            shots = [Shot(shot.path, *self._read(shot.path, camera)) for shot in self.shots]
        self.options = replace(self.options, camera=camera, guess=guess)
        if self.shots and (self.is_undistorted or was_undistorted):
            self.shot, self.shots = shots[self.shots.index(self.shot)], shots

    def open_mesh(self, path: Path) -> str:
        """Check that a mesh or a bank can be used, and describe it; it replaces the one before."""
        if path.suffix == ".safetensors":
            bank = ViewBank.load(path)
            mesh, facts = bank.mesh, f"bank of {len(bank)} views"
        else:
            mesh = load_mesh(path, unit=self.options.unit, up=self.options.up)
            size = " x ".join(f"{v:.4g}" for v in mesh.extents)
            colours = "in its colours" if has_colours(mesh) else "in grey"
            facts = f"{len(mesh.faces):,} faces, {size} {self.options.unit}, rendered {colours}"
        self.mesh_path, self.mesh = path, mesh
        for shot in self.shots:
            shot.result = shot.answer = None
        return facts

    @property
    def has_exif(self) -> bool:
        """Whether the photograph's file tells the focal length."""
        return self.shot.photo is not None and self.shot.photo.guessed_camera_matrix() is not None

    def set_limits(self, **limits: Any) -> None:
        """Change what is known of the pose: arguments of :class:`PosePrior`; None removes a limit."""
        known = {**(self.options.limits or {}), **limits}
        self.options = replace(self.options, limits={n: value for n, value in known.items() if value is not None})

    def remove_limits(self) -> None:
        """Forget what was known of the pose, but not which side of the mesh is its front."""
        self.set_limits(**{name: None for name in self.options.limits or {} if name != "front"})

    def object_frame(self) -> Tensor:
        """(3, 3) rotation from the mesh's axes to those of limits, see :func:`.object_frame`."""
        assert self.mesh is not None
        return object_frame(mesh_up(self.mesh), (self.options.limits or {}).get("front"))

    def hint_direction(self, position: Sequence[float]) -> None:
        """Limit the pose to views like that from a point beside the object, in the frame of limits, z up."""
        x, y, z = position
        azimuth, elevation = math.degrees(math.atan2(x, -y)) % 360.0, math.degrees(math.atan2(z, math.hypot(x, y)))
        self.remove_limits()
        self.set_limits(viewpoint=(round(azimuth, 1), round(elevation, 1), 0.0), within=HINT_WIDTH)

    def mesh_axis(self, position: Sequence[float]) -> str:
        """The mesh's axis that points to a point on its surface, in the frame of limits about the object's centre."""
        at = self.object_frame().mT @ torch.tensor(list(position), dtype=torch.float64)
        axis = int(at.abs().argmax())
        return ("" if at[axis] > 0 else "-") + "xyz"[axis]

    def preview(self) -> bytes:
        """The mesh as a GLB file, in the frame of limits and its radii."""
        assert self.mesh is not None
        frame, radius = self.object_frame(), mesh_radius(self.mesh)
        return mesh_glb(self.mesh, transform(frame, -frame @ mesh_centre(self.mesh)) / radius)

    def request(self, shot: Shot | None = None) -> RegisterOptions:
        """The registration that the inputs describe, in the photograph that is shown, or in another."""
        shot, camera = shot or self.shot, self.options.camera
        if isinstance(camera, Camera):
            K = camera.matrix if shot.photo is None else camera.at(shot.size).matrix
            camera = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        photos = () if shot.photo is None else (shot.path,)
        meshes = () if self.mesh_path is None else (self.mesh_path,)
        return replace(self.options, photos=photos, meshes=meshes, box=shot.box, camera=camera)

    def command(self) -> str:
        """The command line that gives the same result; none takes the box of an undistorted photograph."""
        return "" if self.is_undistorted else _command_line(self.request(), self.name)

    def register(self) -> Registration:
        """Find the pose in the photograph that is shown, as ``curvireg register`` does."""
        start, shot, camera = time.perf_counter(), self.shot, self.options.camera
        request = self.request(shot)  # another photograph may be shown meanwhile
        if shot.photo is None or not request.meshes:
            raise InvalidInputError("register: choose a photograph and a mesh first")
        photo, command = shot.photo, "" if self.is_undistorted else _command_line(request, self.name)
        check_camera(request.camera, request.guess)
        self.searched = shot
        try:
            registrar = self._open_registrar(request)
            registrar.progress = self._report_progress
            entry = request.entry(request.photos[0])
            meshes = tuple(Path(self.name(path)) for path in entry.meshes)
            entry = replace(entry, name=self.name(entry.photo), meshes=meshes)
            ready = time.perf_counter() - start
            registration, document = register_entry(entry, photo, registrar, bank_seconds=ready)
            self._report_progress("contours", 1, 1)  # it may have been stopped in the last step
        except CurviregError as error:
            raise (CurviregError("stopped") if self.cancelled else error) from None
        finally:
            self.cancelled, self.searched = False, None
        if isinstance(camera, Camera):
            document["camera"] = camera.at(shot.size).describe()
            document["inputs"]["camera_source"] = "file"
        document["viewer"] = {"command": command}
        box = torch.tensor(used_box(document))
        shot.result = Result(registrar, registration, document, photo.image, box, request)
        shot.choose(0)
        return registration

    def document(self) -> dict[str, Any]:
        """``result.json`` with the answer as its result; ``viewer`` tells what was chosen or done by hand."""
        result, answer = self.shot.require_result()
        document, registration = dict(result.document), answer.registration(result.registration)
        if registration is not result.registration:
            document |= registration.to_dict()
            if document["inputs"]["camera_source"] in ("exif", "fov"):
                document["covariance"] = document["standard_deviations"] = None
            if "detection" in document:
                first, *others = document["detection"]["instances"]
                first = {**first, "confidence": registration.confidence, **answer.pose.pose_dict()}
                document["detection"] = {**document["detection"], "instances": [first, *others]}
        by_hand = {"hypothesis": answer.number, "by_hand": list(answer.edits)}
        return {**document, "viewer": {**document["viewer"], **by_hand}}

    def python(self) -> str:
        """A Python program that gives the answer."""
        result, answer = self.shot.require_result()
        request, prior = result.request, result.registration.prior
        photo, mesh = repr(self.name(request.photos[0])), repr(self.name(request.meshes[0]))
        if "undistorted" in result.document["inputs"]["picture"]["notes"]:
            photo = f"cr.geometry.undistorted(cr.data.read_photo({photo}).image, cr.load_camera('CALIBRATION')).image"
        model = f"cr.load_mesh({mesh}, unit={request.unit!r}, up={request.up!r})"
        model = f"cr.ViewBank.load({mesh})" if request.meshes[0].suffix == ".safetensors" else model
        pipeline = f"cr.Pipeline.read({str(request.pipeline)!r})" if request.pipeline else "cr.Pipeline()"
        pipeline = f"cr.pipeline.PRESETS[{request.preset!r}]" if request.preset else pipeline
        pipeline = f"{pipeline}.with_pose_prior({request.pose!r})" if request.pose else pipeline
        pipeline = "None" if request.bank_decides and not request.pose else pipeline
        lines = [
            "import curvireg_torch as cr",
            "",
            f"registrar = cr.Registrar({model}, pipeline={pipeline}, mesh_is={request.mesh_is!r})",
            f"prior = {None if prior is None else f'cr.PosePrior(**{prior.to_dict()})'}",
            f"box, camera = {request.box}, {result.document['inputs']['camera']}",
            f"result = cr.register({photo}, registrar, box=box, camera=camera, prior=prior)",
            f"pose = result.hypotheses[{answer.number}].pose_dict()",
            *([f"pose = {answer.pose.pose_dict()}  # corrected by hand"] if answer.edits else []),
        ]
        return "\n".join([*lines, "print(pose)", ""])

    def describe_warning(self, warning: Warning) -> str:
        """The text of a warning, with the user's name of its file."""
        if isinstance(warning, CurviregWarning):
            warning = warning.with_subject(self.name(warning.subject))
        return str(warning)

    def _report_progress(self, stage: str, done: int, total: int) -> None:
        self.progress = (stage, done, total)
        if self.cancelled:
            raise CurviregError("stopped")

    def _open_registrar(self, request: RegisterOptions) -> Registrar:
        """The registrar of a mesh and options; the last one is reused."""
        key = replace(request, photos=(), box=None, limits=None, camera=None, guess=None)
        if self._registrar is None or self._registrar[0] != key:
            self._registrar = key, open_registrar(key, key.meshes, progress=self._report_progress)
        return self._registrar[1]


def dragged_box(box: Numbers | None, start: Point, end: Point, *, reach: float) -> Numbers | None:
    """The box in px after a drag: of an edge or corner within ``reach`` px, of all of it from inside, or a new one."""
    (x, y), (u, v) = start, end
    x0, y0, x1, y1 = box or (math.inf, math.inf, -math.inf, -math.inf)
    if x0 - reach <= x <= x1 + reach and y0 - reach <= y <= y1 + reach:
        left, right = _near_edges(x, x0, x1, reach)
        top, bottom = _near_edges(y, y0, y1, reach)
        if not (left or right or top or bottom):
            x0, y0, x1, y1 = x0 + u - x, y0 + v - y, x1 + u - x, y1 + v - y
        x0, y0 = u if left else x0, v if top else y0
        x1, y1 = u if right else x1, v if bottom else y1
    else:
        x0, y0, x1, y1 = x, y, u, v
    if min(abs(x1 - x0), abs(y1 - y0)) < MIN_SIDE:
        return box
    return round(min(x0, x1), 1), round(min(y0, y1), 1), round(max(x0, x1), 1), round(max(y0, y1), 1)


def _near_edges(at: float, low: float, high: float, reach: float) -> tuple[bool, bool]:
    """Whether the low or the high edge is near; inside, at most a third of the box is near to an edge."""
    inside = min(reach, (high - low) / 3)
    return at <= low + inside, at > low + inside and at >= high - inside


def _command_line(options: RegisterOptions, name: Callable[[Path], str]) -> str:
    """``curvireg register`` with these options; ``name`` tells what the user calls a file."""
    words = ["curvireg", "register"]
    for paths, placeholder in ((options.photos, "PHOTO"), (options.meshes, "MESH")):
        words += list(map(name, paths)) or [placeholder]
    limits = {} if options.limits is None or not options.limits.keys() - QUALIFIERS else dict(options.limits)
    values: dict[str, Any] = {
        "box": options.box,
        "camera": "exif" if options.guess == "exif" else options.camera,
        "fov": None if options.guess == "exif" else options.guess,
        **{"near" if limit == "viewpoint" else limit: value for limit, value in limits.items()},
        **{key.replace("_", "-"): v for key in _OPTIONS if (v := getattr(options, key)) != _DEFAULTS[key]},
    }
    for option, value in values.items():
        if value is not None:
            texts = [str(v).removesuffix(".0") for v in (value if isinstance(value, tuple) else (value,))]
            words += (
                [f"--{option}={value}"] if texts[0][0] == "-" and isinstance(value, str) else [f"--{option}", *texts]
            )
    return shlex.join([*words, "--out", "result"])
