"""What one page holds: a photograph, a box, a mesh, the answer, and the pose shown. Knows nothing of the page."""

import argparse
import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..cli.commands import open_registrar
from ..errors import CurviregError, InvalidInputError
from ..evaluation.lists import Entry, register_entry
from ..evaluation.store import to_json
from ..geometry import camera_matrix, rotation_error, rotation_from_axis_angle
from ..geometry.cameras import camera_of_view
from ..io import read_photo
from ..io.images import Photo
from ..io.meshes import has_colours, load_mesh
from ..limits import MAX_VIEWER_SECONDS
from ..matching import ViewBank
from ..registration import Hypothesis, Registrar, Registration, fit_contours
from ..registration.document import used_box
from ..utils.checks import check_square_pixels
from ..visualization import pose_glb
from .pictures import at

__all__ = ["Answer", "Session", "Shown"]

OPTIONS = ("unit", "up", "pose", "preset", "pipeline", "renderer", "device")
SHOWN = 5
"""Places where the object was looked for that are shown."""

DEFAULTS = {"unit": "m", "renderer": "auto", "device": "cpu"}


@dataclass(frozen=True)
class Answer:
    """What was found, of what, and by which command line."""

    registrar: Registrar
    result: Registration
    document: dict[str, Any]
    image: Tensor
    box: Tensor
    command: str


@dataclass(frozen=True)
class Shown:
    """The pose on the page: a hypothesis, by its number from 0, and what was done to it by hand, in words."""

    pose: Hypothesis
    number: int
    by_hand: tuple[str, ...] = ()


@dataclass
class Session:
    """Everything that a page knows; computing methods may take long and belong into a thread.

    Attributes:
        options: of ``curvireg view``; unit, up, pose and preset may be changed.
        photo, mesh: where they are on disk, or None.
        names: what the user calls them, for messages and the command line.
        box, camera, fov: as ``--box``, ``--camera`` and ``--fov``, or None; a camera goes before the field of view.
        answer, shown: what was found, and the pose on the page; None before. The answer's command line is another than
            :meth:`command` where the inputs have changed since.
        limit: seconds that a registration may take.
    """

    options: argparse.Namespace
    photo: Path | None = None
    mesh: Path | None = None
    names: dict[Path, str] = field(default_factory=dict)
    picture: Photo | None = None
    box: tuple[float, float, float, float] | None = None
    camera: tuple[float, float, float, float] | None = None
    fov: float | None = None
    answer: Answer | None = None
    shown: Shown | None = None
    limit: float = MAX_VIEWER_SECONDS
    progress: tuple[str, int, int] = ("", 0, 1)
    stopped: bool = False
    _registrar: tuple[tuple[Any, ...], Registrar] | None = None

    def take_photo(self, path: Path, name: str | None = None) -> Photo:
        """Read a photograph; box, camera and answer of another are forgotten.

        Raises:
            MissingFileError, ImageError.
        """
        self.names[path] = name or str(path)
        with self._named():
            photo = read_photo(path, dtype=torch.uint8)
        self.photo, self.picture, self.box, self.camera = path, photo, None, None
        self._forget()
        return photo

    def take_mesh(self, path: Path, name: str | None = None) -> str:
        """Read a mesh, or a bank, to see whether it can be used; says what it is.

        Raises:
            MissingFileError, MeshError, BankError.
        """
        self.names[path] = name or str(path)
        with self._named():
            if path.suffix == ".safetensors":
                told = f"bank of {len(ViewBank.load(path))} views"
            else:
                mesh = load_mesh(path, unit=self.options.unit, up=self.options.up)
                size = " x ".join(f"{v:.4g}" for v in mesh.extents)
                seen = "its own colours" if has_colours(mesh) else "grey"
                told = f"{len(mesh.faces):,} faces, {size} {self.options.unit}, seen in {seen}"
        self.mesh = path
        self._forget()
        return told

    def guessed_camera(self) -> tuple[float, float, float, float] | None:
        """FX FY CX CY by the photograph's EXIF focal length, to 0.01 px; None where it says none."""
        K = None if self.picture is None else self.picture.guessed_camera_matrix()
        if K is None:
            return None
        fx, fy, cx, cy = (round(float(K[i, j]), 2) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return fx, fy, cx, cy

    @property
    def guessed(self) -> bool:
        """Whether the camera is the one that the EXIF block tells, as ``--camera exif`` takes it."""
        return self.camera is not None and self.camera == self.guessed_camera()

    @property
    def guess(self) -> str | float | None:
        """What the camera is guessed by: "exif", or the field of view in degrees; None where it is given or unknown."""
        return "exif" if self.guessed else self.fov if self.camera is None else None

    def command(self) -> str:
        """The command line that gives the same answer."""
        words = ["curvireg", "register"]
        words += [self._name(self.photo, "PHOTO"), self._name(self.mesh, "MESH")]
        words += [] if self.box is None else ["--box", *map(_short, self.box)]
        words += ["--camera", "exif"] if self.guessed else []
        words += ["--camera", *map(_short, self.camera)] if self.camera and not self.guessed else []
        words += ["--fov", _short(self.guess)] if isinstance(self.guess, float) else []
        for option in OPTIONS:
            value = getattr(self.options, option)
            if value is not None and value != DEFAULTS.get(option):
                words += [f"--{option}={value}"] if str(value).startswith("-") else [f"--{option}", str(value)]
        return shlex.join([*words, "--out", "result"])

    def register(self) -> Registration:
        """Find the pose, as ``curvireg register`` does.

        Raises:
            CurviregError: something is missing or cannot be used, it was stopped, or took too long.
        """
        if self.picture is None or self.mesh is None:
            raise InvalidInputError("register: choose a photograph and a mesh first")
        command, start, picture = self.command(), time.perf_counter(), self.picture
        camera = None if self.guessed else self.camera
        if camera is not None:
            check_square_pixels(camera_matrix(*camera))  # refused before the bank is made
        if isinstance(self.guess, float):
            camera_of_view(self.guess, (1, 1))
        self.stopped, report_progress = False, self._teller(start)
        with self._named():
            registrar = self._made(self.mesh, report_progress)
            registrar.progress = report_progress
            name, meshes = self._name(self.photo, ""), (Path(self._name(self.mesh, "")),)
            entry = Entry(name=name, cells=(), meshes=meshes, box=self.box, camera=camera, guess=self.guess)
            ready = time.perf_counter() - start
            result, document = register_entry(entry, picture, registrar, bank_seconds=ready)
        box = torch.tensor(used_box(document))
        self.answer = Answer(registrar, result, document, picture.image, box, command)
        self.choose(0)
        return result

    def seen(self) -> tuple[Answer, Shown]:
        """The answer and the pose on the page.

        Raises:
            InvalidInputError: there is none yet.
        """
        if self.answer is None or self.shown is None:
            raise InvalidInputError("there is no answer yet; register first")
        return self.answer, self.shown

    def proposals(self) -> list[list[float]]:
        """The best boxes in which the object was looked for, the answer's first; none where the box was given."""
        found = {} if self.answer is None else self.answer.document.get("localization", {})
        return [proposal["box"] for proposal in found.get("proposals", [])[:SHOWN]]

    def choose(self, number: int) -> None:
        """Show one of the hypotheses."""
        assert self.answer is not None
        self.shown = Shown(self.answer.result.hypotheses[number], number)

    def nudge(self, *, turn: Sequence[float] = (0, 0, 0), shift: Sequence[float] = (0, 0, 0)) -> None:
        """Move the pose shown by hand.

        Args:
            turn: degrees about the camera's x, y and z axes through the object's centre.
            shift: along them, in units of the object's radius; the object stays before the camera.
        """
        answer, shown = self.seen()
        describe = answer.registrar.describers[shown.pose.model]
        T = shown.pose.projection[0].clone()
        vector = torch.deg2rad(torch.tensor([float(v) for v in turn], dtype=torch.float64))
        centre = T[:3, :3] @ describe.centre + T[:3, 3]
        centre = centre + describe.radius * torch.tensor([float(v) for v in shift], dtype=torch.float64)
        if float(centre[2]) < 1.2 * describe.radius:
            raise InvalidInputError("nudge: the object would touch the camera; move it away")
        T[:3, :3] = rotation_from_axis_angle(vector) @ T[:3, :3]
        T[:3, 3] = centre - T[:3, :3] @ describe.centre
        told = [f"turned {v:g} degrees about {axis}" for v, axis in zip(turn, "xyz", strict=True) if v]
        told += [f"moved {v:g} radii along {axis}" for v, axis in zip(shift, "xyz", strict=True) if v]
        self.shown = Shown(at(describe.centre, shown.pose, T), shown.number, (*shown.by_hand, *told))

    def pull_in(self) -> str:
        """Let the mesh's contours pull the pose shown onto the photograph's edges; says how far that went."""
        answer, shown = self.seen()
        describe = answer.registrar.describers[shown.pose.model]
        T, K = shown.pose.projection
        fit = fit_contours(
            describe.renderer,
            answer.image,
            answer.box,
            K,
            T[None],
            centre=describe.centre,
            radius=describe.radius,
            margin=answer.registrar.bank.settings.margin,
        )
        turned = float(rotation_error(fit.transform[0, :3, :3], T[:3, :3]))
        edge_support = f"support {float(fit.start_support[0]):.2f} to {float(fit.edge_support[0]):.2f}"
        told = f"pulled in by contours: {turned:.1f} degrees, {edge_support}"
        moved = at(describe.centre, shown.pose, fit.transform[0])
        self.shown = Shown(moved, shown.number, (*shown.by_hand, told))
        return told

    def document(self) -> dict[str, Any]:
        """``result.json`` of the command line, and in ``viewer`` that command and the pose on the page."""
        answer, shown = self.seen()
        on_page = {
            "command": answer.command,
            "hypothesis": shown.number,
            "by_hand": list(shown.by_hand),
            **shown.pose.pose_dict(),
        }
        return {**answer.document, "viewer": on_page}

    def json(self) -> bytes:
        """:meth:`document` as a file."""
        return to_json(self.document()).encode()

    def glb(self) -> bytes:
        """The pose shown as a GLB file, see :func:`curvireg_torch.visualization.pose_glb`."""
        answer, shown = self.seen()
        return pose_glb(answer.registrar.bank.mesh, *shown.pose.projection, answer.image)

    def stop(self) -> None:
        """End a registration at its next step."""
        self.stopped = True

    def _forget(self) -> None:
        self.answer, self.shown = None, None

    def _teller(self, start: float) -> Callable[[str, int, int], None]:
        def report_progress(stage: str, done: int, of: int) -> None:
            self.progress = (stage, done, of)
            if self.stopped:
                raise CurviregError("stopped")
            if time.perf_counter() - start > self.limit:
                raise CurviregError(
                    f"stopped after {self.limit:g} s in the stage {stage!r}; "
                    "take a simpler mesh, a pose that stands upright, or the command line, which has no limit"
                )

        return report_progress

    def _made(self, path: Path, report_progress: Callable[[str, int, int], None]) -> Registrar:
        """For the mesh and the options; the last one where nothing has changed."""
        key = (path, *(getattr(self.options, name) for name in OPTIONS))
        if self._registrar is None or self._registrar[0] != key:
            self._registrar = key, open_registrar(self.options, [path], None, progress=report_progress)
        return self._registrar[1]

    def _name(self, path: Path | None, other: str) -> str:
        return other if path is None else self.names[path]

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors within call files what the user calls them."""
        try:
            yield
        except CurviregError as error:
            raise type(error)(self.said(str(error))) from error

    def said(self, text: str) -> str:
        """A message that calls files what the user calls them."""
        for path, name in self.names.items():
            text = text.replace(str(path), name)
        return text


def _short(value: float) -> str:
    return repr(int(value)) if math.isfinite(value) and value == int(value) else repr(float(value))
