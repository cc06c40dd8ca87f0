"""Options of a registration, and the registrar that they ask for: shared by the command line and the viewer."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ..errors import BankError, InvalidInputError
from ..features import LearnedCurvilinearSaliency
from ..geometry import camera_matrix
from ..geometry.cameras import camera_of_view, transform
from ..matching import ViewBank, cached_bank
from ..mesh import load_mesh
from ..pipeline import Pipeline, preset_named
from ..registration import Registrar
from ..utils.checks import check_rotation, check_square_pixels
from ..utils.choices import DEFAULT
from ..utils.files import finite_numbers, read_json
from .prior_options import prior_from_limits
from .runner import Entry

__all__ = ["RegisterOptions", "check_camera", "open_registrar"]


@dataclass(frozen=True)
class RegisterOptions:
    """What to register, and how; the names and defaults are those of ``curvireg register``.

    Attributes:
        photos: photographs, folders, patterns or videos.
        meshes: mesh files or banks; of several, each photograph is registered to the best.
        box, camera: x0, y0, x1, y1 and fx, fy, cx, cy in px; None: detected, and unknown.
        guess: of an unknown camera: "exif", or the horizontal field of view in degrees.
        instances: without a box, see :func:`curvireg_torch.registration.detect`.
        limits: on the pose, arguments of :class:`PosePrior`.
        start: file of a pose (``rotation`` and ``translation``, as in result.json) that is refined instead of a search.
        preset, pipeline: name of a pipeline, or its JSON file; None: the pipeline of a bank, or the default.
        pose, top: the pose prior, and the number of hypotheses; None: those of the pipeline.
        field: weights of an adapted field.
        refine: False stops at the best view of the bank.
        mesh_is: "exact" or "similar", see :class:`Registrar`.
        unit, up: of mesh files, see :func:`curvireg_torch.load_mesh`.
        renderer, device: where views are rendered, and where the search runs.
    """

    photos: tuple[Path, ...] = ()
    meshes: tuple[Path, ...] = ()
    box: tuple[float, float, float, float] | None = None
    camera: tuple[float, float, float, float] | None = None
    guess: str | float | None = None
    instances: int = 1
    limits: Mapping[str, Any] | None = None
    start: Path | None = None
    preset: str | None = None
    pipeline: Path | None = None
    pose: str | None = None
    field: Path | None = None
    top: int | None = None
    refine: bool = True
    mesh_is: str | None = None
    unit: str = "m"
    up: str | None = None
    renderer: str = "auto"
    device: str = "cpu"
    progress: bool = True

    @property
    def bank_decides(self) -> bool:
        """Whether the pipeline of a bank file applies, as none was chosen."""
        return self.preset is None and self.pipeline is None

    def open_pipeline(self) -> Pipeline:
        """The pipeline that ``preset``, ``pipeline`` and ``pose`` choose."""
        chosen = preset_named(self.preset or DEFAULT) if self.pipeline is None else Pipeline.read(self.pipeline)
        return chosen if self.pose is None else chosen.with_pose_prior(self.pose)

    def open_field(self) -> LearnedCurvilinearSaliency | None:
        """The network of ``field``, or None."""
        return None if self.field is None else LearnedCurvilinearSaliency(weights=self.field)

    def entry(self, photo: Path) -> Entry:
        """A photograph with the box, camera and meshes of these options."""
        prior = prior_from_limits(self.limits or {})
        return self.complete(Entry((), str(photo), photo, self.meshes, self.box, self.camera, prior=prior))

    def complete(self, entry: Entry) -> Entry:
        """A photograph of a list with the options that a list does not hold."""
        start, confidence = (None, None) if self.start is None else read_start(self.start)
        own = replace(entry, guess=self.guess, instances=self.instances)
        return replace(own, start=start, start_confidence=confidence)


def check_camera(camera: Sequence[float] | None, guess: str | float | None) -> None:
    """Refuse a camera (fx, fy, cx, cy) or field of view that cannot be used, before any file is read."""
    if camera is not None:
        try:
            check_square_pixels(camera_matrix(*camera), "--camera")
        except InvalidInputError as error:
            raise InvalidInputError(f"--camera: {str(error).partition(': ')[2]}") from error
    if isinstance(guess, float):
        try:
            camera_of_view(guess, (1, 1))
        except InvalidInputError as error:
            raise InvalidInputError(f"--{error}") from error


def read_start(path: Path) -> tuple[tuple[tuple[float, ...], ...], float | None]:
    """(4, 4) pose ``T_cam_from_model`` of a JSON file that holds ``rotation`` and ``translation``, as result.json does,
    and its ``confidence``, if the file has one.

    Raises:
        CurviregError: the file is missing, damaged or does not hold a rigid pose.
    """
    content = read_json(path, dict, "docs/guides/known-pose.md")
    rows = content.get("rotation")
    rotation = [finite_numbers(row, 3) for row in rows] if isinstance(rows, list) else []
    translation = finite_numbers(content.get("translation"), 3)
    if len(rotation) != 3 or None in rotation or translation is None:
        raise InvalidInputError("expected rotation (3 x 3 numbers) and translation (3 numbers)", subject=path)
    R = torch.tensor([list(row or ()) for row in rotation], dtype=torch.float64)
    try:
        check_rotation(R, "rotation")
    except InvalidInputError as error:
        raise error.with_subject(str(path)) from error
    T = transform(R, torch.tensor(translation, dtype=torch.float64))
    confidence = finite_numbers([content.get("confidence")], 1)
    return tuple(map(tuple, T.tolist())), confidence[0] if confidence else None


def open_registrar(
    options: RegisterOptions,
    meshes: Sequence[Path],
    field: LearnedCurvilinearSaliency | None = None,
    *,
    progress: Callable[[str, int, int], object] | None = None,
) -> Registrar:
    """The registrar of mesh files or banks.

    Args:
        options: its settings; ``photos``, ``meshes`` and what belongs to a photograph are not used.
        meshes, field: the files, and the network from :meth:`RegisterOptions.open_field`.
        progress: called while banks are built, instead of showing a bar.

    Raises:
        CurviregError: a file is missing or damaged, or a bank was built with other settings.
    """
    pipeline = options.open_pipeline()
    banks = [_open_bank(options, mesh, pipeline, progress or options.progress) for mesh in meshes]
    banks = [bank.to(options.device) for bank in banks]
    if all(mesh.suffix == ".safetensors" for mesh in meshes):
        if options.bank_decides:
            pipeline = banks[0].pipeline
        elif options.pose is None and options.pipeline is None:  # a preset does not fix the views
            pipeline = replace(pipeline, views=banks[0].pipeline.views)
    if not options.refine:
        pipeline = replace(pipeline, contours=False)
    if options.top is not None:
        pipeline = replace(pipeline, hypotheses=options.top)
    return Registrar(banks, pipeline=pipeline, field=field, renderer=options.renderer, mesh_is=options.mesh_is)


def _open_bank(
    options: RegisterOptions, mesh: Path, pipeline: Pipeline, progress: bool | Callable[[str, int, int], object]
) -> ViewBank:
    if mesh.suffix != ".safetensors":
        loaded = load_mesh(mesh, unit=options.unit, up=options.up)
        return cached_bank(loaded, pipeline=pipeline, renderer=options.renderer, progress=progress)
    bank = ViewBank.load(mesh)
    if options.pose not in (None, bank.pipeline.views.pose):
        built = "given views" if bank.pipeline.views.pose == "given" else f"--pose {bank.pipeline.views.pose}"
        message = f"built for {built}, not for --pose {options.pose}; leave --pose out, or "
        raise BankError(f"{message}build it again with 'curvireg bank'", subject=mesh)
    return bank
