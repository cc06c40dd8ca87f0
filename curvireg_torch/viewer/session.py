"""The state of one page: inputs, result and displayed pose. It needs no page and no NiceGUI."""

import math
import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..data import read_photo
from ..data.images import Photo
from ..errors import MAX_VIEWER_SECONDS, CurviregError, CurviregWarning, InvalidInputError
from ..evaluation.lists import register_entry
from ..evaluation.opening import RegisterOptions, check_camera, open_registrar
from ..evaluation.prior_options import QUALIFIERS
from ..evaluation.store import to_json
from ..matching import ViewBank
from ..mesh import has_colours, load_mesh
from ..registration import Registrar, Registration
from ..registration.result import used_box
from ..visualization import pose_glb
from .editing import DisplayedPose, fit_displayed, move_displayed

__all__ = ["MAX_PROPOSALS", "Result", "Session"]

MAX_PROPOSALS = 5  # proposed boxes that are drawn where the object was detected

Numbers = tuple[float, float, float, float]

_OPTIONS = ("unit", "up", "pose", "mesh_is", "preset", "pipeline", "renderer", "device")
_DEFAULTS = {option.name: option.default for option in fields(RegisterOptions)}


@dataclass(frozen=True)
class Result:
    """A registration with its inputs."""

    registrar: Registrar
    registration: Registration
    document: dict[str, Any]  # the content of result.json
    image: Tensor  # (3, H, W) uint8
    box: Tensor  # (4,) px, with which the pose was found
    command: str  # gives the same result


@dataclass
class Session:
    """The state of one page. Methods that compute may take minutes: call them in a thread.

    Attributes:
        options: of ``curvireg view``; replace them to change unit, up, pose or preset, call ``set_limits`` for limits.
        names: what the user calls the files, for messages and the command line.
        box, camera, fov: as ``--box``, ``--camera`` and ``--fov``, or None; a camera takes precedence over ``fov``.
        result, displayed: the last result and the pose on the page, or None.
        limit: seconds after which a registration is cancelled.
        progress: stage, done and total.
    """

    options: RegisterOptions
    photo_path: Path | None = None
    mesh_path: Path | None = None
    names: dict[Path, str] = field(default_factory=dict)
    photo: Photo | None = None
    box: Numbers | None = None
    camera: Numbers | None = None
    fov: float | None = None
    result: Result | None = None
    displayed: DisplayedPose | None = None
    limit: float = MAX_VIEWER_SECONDS
    progress: tuple[str, int, int] = ("", 0, 1)
    cancelled: bool = False
    _registrar: tuple[RegisterOptions, Registrar] | None = None

    def load(self) -> str:
        """Open the files that the options name, and take their box and camera; describes the mesh, or ""."""
        options = self.options
        self.options = replace(options, photos=(), meshes=(), box=None, camera=None, guess=None)
        for path in options.photos:
            self.open_photo(path)
        facts = "".join([self.open_mesh(path) for path in options.meshes])
        self.box, self.camera = options.box, options.camera
        self.fov = options.guess if isinstance(options.guess, float) else None
        return facts

    def open_photo(self, path: Path, name: str | None = None) -> Photo:
        """Read a photograph; it replaces box, camera and result of the one before."""
        self.names[path] = name or str(path)
        with self._user_names():
            photo = read_photo(path, dtype=torch.uint8)
        self.photo_path, self.photo, self.box, self.camera = path, photo, None, None
        self.result = self.displayed = None
        return photo

    def open_mesh(self, path: Path, name: str | None = None) -> str:
        """Check that a mesh or a bank can be used, and describe it; it replaces the one before."""
        self.names[path] = name or str(path)
        with self._user_names():
            if path.suffix == ".safetensors":
                facts = f"bank of {len(ViewBank.load(path))} views"
            else:
                mesh = load_mesh(path, unit=self.options.unit, up=self.options.up)
                size = " x ".join(f"{v:.4g}" for v in mesh.extents)
                colours = "in its colours" if has_colours(mesh) else "in grey"
                facts = f"{len(mesh.faces):,} faces, {size} {self.options.unit}, rendered {colours}"
        self.mesh_path = path
        self.result = self.displayed = None
        return facts

    def exif_camera(self) -> Numbers | None:
        """FX FY CX CY from the focal length in the photograph's EXIF block, to 0.01 px; None without one."""
        K = None if self.photo is None else self.photo.guessed_camera_matrix()
        if K is None:
            return None
        fx, fy, cx, cy = (round(float(K[i, j]), 2) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return fx, fy, cx, cy

    @property
    def guess(self) -> str | float | None:
        """How the camera is guessed: "exif", or the field of view in degrees; None if it is given or unknown."""
        if self.camera is None:
            return self.fov
        return "exif" if self.camera == self.exif_camera() else None

    def set_limits(self, **limits: Any) -> None:
        """Change what is known of the pose: arguments of :class:`PosePrior`; None removes a limit."""
        known = {**(self.options.limits or {}), **limits}
        self.options = replace(self.options, limits={n: value for n, value in known.items() if value is not None})

    def request(self) -> RegisterOptions:
        """The registration that the inputs describe."""
        return replace(
            self.options,
            photos=() if self.photo_path is None else (self.photo_path,),
            meshes=() if self.mesh_path is None else (self.mesh_path,),
            box=self.box,
            camera=None if self.guess == "exif" else self.camera,
            guess=self.guess,
        )

    def command(self) -> str:
        """The command line that gives the same result."""
        return _command_line(self.request(), self.names)

    def register(self) -> Registration:
        """Find the pose, as ``curvireg register`` does.

        Raises:
            CurviregError: an input is missing or cannot be used, or the registration was cancelled or took too long.
        """
        request, start, photo = self.request(), time.perf_counter(), self.photo
        if photo is None or not request.meshes:
            raise InvalidInputError("register: choose a photograph and a mesh first")
        check_camera(request.camera, request.guess)
        report_progress = self._progress_callback(start)
        names = {path: Path(name) for path, name in self.names.items()}
        try:
            with self._user_names():
                registrar = self._open_registrar(request.meshes[0], report_progress)
                registrar.progress = report_progress
                entry = request.entry(request.photos[0])
                entry = replace(entry, name=self.names[entry.photo], meshes=tuple(names[p] for p in entry.meshes))
                ready = time.perf_counter() - start
                registration, document = register_entry(entry, photo, registrar, bank_seconds=ready)
            if self.cancelled:  # too late for the last step
                raise CurviregError("stopped")
        except CurviregError:
            if self.cancelled:
                raise CurviregError("stopped") from None
            raise
        finally:
            self.cancelled = False
        box, command = torch.tensor(used_box(document)), _command_line(request, self.names)
        self.result = Result(registrar, registration, document, photo.image, box, command)
        self.display(0)
        return registration

    def require_result(self) -> tuple[Result, DisplayedPose]:
        """The result and the displayed pose; an error if there is none yet."""
        if self.result is None or self.displayed is None:
            raise InvalidInputError("there is no result yet; register first")
        return self.result, self.displayed

    def proposals(self) -> list[list[float]]:
        """The best boxes of the detection, the chosen one first; empty if the box was given."""
        detection = {} if self.result is None else self.result.document.get("detection", {})
        return [proposal["box"] for proposal in detection.get("proposals", [])[:MAX_PROPOSALS]]

    def display(self, number: int, *, chosen: bool = False) -> None:
        """Put a hypothesis on the page, by its number from 0; ``chosen`` if the user picks it as the answer."""
        assert self.result is not None
        self.displayed = DisplayedPose(self.result.registration.hypotheses[number], number, chosen=chosen)

    def move(self, *, rotation: Sequence[float] = (0, 0, 0), translation: Sequence[float] = (0, 0, 0)) -> None:
        """Change the displayed pose, see :func:`~curvireg_torch.viewer.editing.move_displayed`."""
        result, displayed = self.require_result()
        self.displayed = move_displayed(result.registrar, displayed, rotation=rotation, translation=translation)

    def fit(self) -> str:
        """Fit the contours at the displayed pose to the photograph's edges; returns the change in words."""
        result, displayed = self.require_result()
        self.displayed = fit_displayed(result.registrar, displayed, result.image, result.box)
        return self.displayed.edits[-1]

    def document(self) -> dict[str, Any]:
        """``result.json`` of the command line; ``viewer`` holds that command line and the displayed pose."""
        result, displayed = self.require_result()
        edits = {"hypothesis": displayed.number, "chosen": displayed.chosen, "by_hand": list(displayed.edits)}
        return {**result.document, "viewer": {"command": result.command, **edits, **displayed.pose.pose_dict()}}

    def json(self) -> bytes:
        """:meth:`document` as a file."""
        return to_json(self.document()).encode()

    def glb(self) -> bytes:
        """The displayed pose as a GLB file, see :func:`curvireg_torch.visualization.pose_glb`."""
        result, displayed = self.require_result()
        return pose_glb(result.registrar.bank.mesh, *displayed.pose.projection, result.image)

    def cancel(self) -> None:
        """End the registration at its next step."""
        self.cancelled = True

    def describe_warning(self, warning: Warning) -> str:
        """The text of a warning, with the user's name of its file."""
        if isinstance(warning, CurviregWarning):
            warning = warning.with_subject(self.names.get(Path(warning.subject), warning.subject))
        return str(warning)

    def _progress_callback(self, start: float) -> Callable[[str, int, int], None]:
        def report_progress(stage: str, done: int, total: int) -> None:
            self.progress = (stage, done, total)
            if self.cancelled:
                raise CurviregError("stopped")
            if time.perf_counter() - start > self.limit:
                raise CurviregError(
                    f"stopped after {self.limit:g} s in the stage {stage!r}; "
                    "use a simpler mesh, the pose prior upright, or the command line, which has no limit"
                )

        return report_progress

    def _open_registrar(self, mesh: Path, report_progress: Callable[[str, int, int], None]) -> Registrar:
        """The registrar of a mesh and the present options; the last one is reused."""
        key = replace(self.options, meshes=(mesh,), limits=None)
        if self._registrar is None or self._registrar[0] != key:
            self._registrar = key, open_registrar(key, key.meshes, progress=report_progress)
        return self._registrar[1]

    @contextmanager
    def _user_names(self) -> Iterator[None]:
        """Errors inside call files what the user calls them."""
        try:
            yield
        except CurviregError as error:
            raise error.with_subject(self.names.get(Path(error.subject), error.subject)) from error


def _command_line(options: RegisterOptions, names: Mapping[Path, str]) -> str:
    """``curvireg register`` with these options; ``names`` are what the user calls the files."""
    words = ["curvireg", "register"]
    for paths, placeholder in ((options.photos, "PHOTO"), (options.meshes, "MESH")):
        words += [names[path] for path in paths] or [placeholder]
    for name, numbers in (("--box", options.box), ("--camera", options.camera)):
        words += [] if numbers is None else [name, *map(_number, numbers)]
    if isinstance(options.guess, float):
        words += ["--fov", _number(options.guess)]
    elif options.guess is not None:
        words += ["--camera", options.guess]
    words += _limit_words(options.limits or {})
    for name in _OPTIONS:
        value, option = getattr(options, name), name.replace("_", "-")
        if value != _DEFAULTS[name]:
            words += [f"--{option}={value}"] if str(value).startswith("-") else [f"--{option}", str(value)]
    return shlex.join([*words, "--out", "result"])


def _limit_words(limits: Mapping[str, Any]) -> list[str]:
    words: list[str] = []
    for name, value in limits.items() if limits.keys() - QUALIFIERS else ():
        if isinstance(value, str):
            words.append(f"--{name}={value}")
        else:
            numbers = value if isinstance(value, tuple) else (value,)
            words += ["--near" if name == "viewpoint" else f"--{name}", *map(_number, numbers)]
    return words


def _number(value: float) -> str:
    return repr(int(value)) if math.isfinite(value) and value == int(value) else repr(float(value))
