"""Generated photographs of a mesh, registered with the defaults: how often the answer will be
right."""

import itertools
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median_low
from typing import Any, TypeAlias

import torch
import torch.nn.functional as F
from scipy.stats import binomtest
from torch import Tensor

from ..errors import CurviregError
from ..evaluation.metrics import symmetric_rotation_error
from ..geometry import PosePrior, rotation_from_axis_angle, viewpoint_from_rotation
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..geometry.viewpoint import up_rotation
from ..matching import cached_bank
from ..mesh import Mesh, mesh_centre
from ..registration import Registrar, Registration
from ..registration.block import share_of_worker
from ..synthetic import synthesize_photograph
from ..utils.aliases import Fields, Progress
from ..utils.threads import available_threads, map_on_threads
from .photographs import (
    SIZE,
    GeneratedPhotograph,
    PhotographGenerator,
    to_bytes,
    with_print,
)
from .surface import look_symmetries

RIGHT_DEGREES = 30.0  # within which an answer is right, as confidence understands it
FINE_DEGREES = 5.0
COMPARED_FRACTION = 0.2  # of the photographs, with which other conditions are tried
HINT_DEGREES = 45.0  # around a hint, within which the pose lies, as those of the viewer's
HINT_ERROR = 30.0  # Degrees by which hints are off, at most
SECOND_CAMERA = 60.0  # Degrees about the object between two photographs
IDENTITY = torch.eye(3, dtype=torch.float64)[None]

Register: TypeAlias = Callable[[Sequence[GeneratedPhotograph]], list["Outcome"]]
"""The outcomes of photographs."""

Conditions: TypeAlias = dict[str, tuple[Register | None, Register]]
"""Other conditions by name: how photographs are registered without and under them; None: as they
were."""


def report_nothing(stage: str, done: int, total: int) -> None:
    """Progress that nobody follows."""


@dataclass(frozen=True)
class Outcome:
    """The answer for a generated photograph: rotation error up to symmetries, and what the
    registration says."""

    photograph: GeneratedPhotograph
    result: Registration | None
    error_deg: float
    elevation: float

    @property
    def is_right(self) -> bool:
        return self.error_deg <= RIGHT_DEGREES

    @property
    def is_reliable(self) -> bool:
        return self.result is not None and self.result.reliable


@dataclass(frozen=True)
class Expected:
    """Shares of the outcomes of one condition."""

    n: int
    right: float
    within_5_deg: float
    reliable: float
    reliable_and_wrong: float
    median_deg: float

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> "Expected":
        errors = [outcome.error_deg for outcome in outcomes]
        return cls(
            n=len(outcomes),
            right=fmean(outcome.is_right for outcome in outcomes),
            within_5_deg=fmean(error <= FINE_DEGREES for error in errors),
            reliable=fmean(outcome.is_reliable for outcome in outcomes),
            reliable_and_wrong=fmean(
                outcome.is_reliable and not outcome.is_right for outcome in outcomes
            ),
            median_deg=median_low(errors),
        )

    @property
    def right_interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the share of right answers."""
        counted = binomtest(round(self.right * self.n), self.n)
        interval = counted.proportion_ci(method="wilson")
        return float(interval.low), float(interval.high)

    def to_dict(self) -> Fields:
        return {**vars(self), "right_interval": list(self.right_interval)}


@dataclass(frozen=True)
class Trial:
    """Outcomes with the conditions that were asked for, and of a part of the photographs with
    others."""

    outcomes: tuple[Outcome, ...]
    compared: dict[str, tuple[Expected, Expected]]
    """For each other condition what is expected without and with it, of the same photographs."""

    @property
    def expected(self) -> Expected:
        return Expected.of(self.outcomes)

    def by(self, key: Callable[[Outcome], float], borders: Sequence[float]) -> dict[str, Expected]:
        """What is expected in each of the ranges between ``borders``; ranges without outcomes are
        left out."""
        ranges = {}
        for low, high in itertools.pairwise(borders):
            inside = [
                outcome
                for outcome in self.outcomes
                if low <= key(outcome) < high or key(outcome) == high == borders[-1]
            ]
            name = f"{low:g} or more" if math.isinf(high) else f"{low:g} to {high:g}"
            if inside:
                ranges[name] = Expected.of(inside)
        return ranges


def run_trial(
    registrar: Registrar,
    generate: PhotographGenerator,
    count: int,
    *,
    with_camera: bool = True,
    compare: bool = True,
    report: Progress = report_nothing,
) -> Trial:
    """Register photographs 0 to ``count - 1`` of the registrar's mesh, in batches, and a
    fifth of them without a camera, with a hint, with a second photograph, and without the mesh's
    colours or with a print.

    Args:
        registrar: of the mesh.
        generate: photographs of the mesh, by number.
        count: of the photographs.
        with_camera: whether the camera is known.
        compare: whether other conditions are tried.
        report: called with "photographs", done and in all, by one thread at a time, after "bank" of
            the mesh with or without a print.
    """
    symmetries = registrar.symmetries
    if symmetries is None:  # what cannot be seen
        symmetries = look_symmetries(registrar.bank.mesh)
    setup = _Setup(registrar, with_camera, symmetries[:, :3, :3].double())
    conditions = _conditions(setup, generate, report) if compare else {}
    part = max(1, round(COMPARED_FRACTION * count))
    total = count + part * sum(1 if before is None else 2 for before, _ in conditions.values())
    done = 0
    lock = threading.Lock()

    def results(register: Callable[[Sequence[Any]], list[Outcome]], items: Any) -> list[Outcome]:
        def job(batch: Sequence[Any]) -> list[Outcome]:
            nonlocal done
            outcomes = register(batch)
            with lock:
                done += len(batch)
                report("photographs", done, total)
            return outcomes

        size = share_of_worker(len(items), available_threads())
        batches = [items[k : k + size] for k in range(0, len(items), size)]
        of_batches = map_on_threads(job, batches, device=registrar.bank.device)
        return list(itertools.chain.from_iterable(of_batches))

    report("photographs", 0, total)
    registrar.share()
    outcomes = results(lambda numbers: setup.register(list(map(generate, numbers))), range(count))
    some = outcomes[:part]
    photographs = [outcome.photograph for outcome in some]
    compared = {}
    for name, (before, after) in conditions.items():
        without = some if before is None else results(before, photographs)
        compared[name] = Expected.of(without), Expected.of(results(after, photographs))
    return Trial(tuple(outcomes), compared)


@dataclass(frozen=True)
class _Setup:
    """A registrar, whether it is told the camera, and the (S, 3, 3) rotations that do not count as
    errors."""

    registrar: Registrar
    with_camera: bool
    symmetries: Tensor

    @property
    def mesh(self) -> Mesh:
        return self.registrar.bank.mesh

    def register(
        self,
        photographs: Sequence[GeneratedPhotograph],
        *,
        prior: Sequence[PosePrior] | None = None,
    ) -> list[Outcome]:
        images = [photograph.image for photograph in photographs]
        boxes = torch.stack([photograph.box for photograph in photographs])
        cameras = torch.stack([photograph.camera for photograph in photographs])
        found = self.registrar(images, boxes, cameras if self.with_camera else None, prior=prior)
        return [self.outcome(*pair) for pair in zip(photographs, found, strict=True)]

    def with_second(self, photograph: GeneratedPhotograph, subject: Mesh) -> Outcome:
        """The outcome of a photograph and a second one of the ``subject``, from beside it."""
        K = photograph.camera
        turn = rotation_from_axis_angle(
            torch.tensor([0.0, math.radians(SECOND_CAMERA), 0.0], dtype=torch.float64)
        )
        centre = point_in_cameras(photograph.truth, mesh_centre(self.mesh))
        move = pose_around(turn, centre, centre)
        generator = _generator(photograph)
        image, box = synthesize_photograph(subject, move @ photograph.truth, K, SIZE, generator)
        images = [photograph.image, to_bytes(image)]
        boxes = torch.stack([photograph.box, box])
        cameras = torch.stack([torch.eye(4, dtype=torch.float64), move])
        found: Registration | CurviregError
        try:
            found = self.registrar.register_views(images, boxes, K, cameras)
        except CurviregError as error:
            found = error
        return self.outcome(photograph, found)

    def outcome(self, photograph: GeneratedPhotograph, result: object) -> Outcome:
        """The outcome of a registration, or of what stands for a failed one; without a camera,
        rotations are compared as a camera that looks at the object sees them."""
        truth = photograph.truth[:3, :3]
        # from the mesh's axes, z up
        viewpoint = viewpoint_from_rotation(truth @ up_rotation(self.mesh.up).double().mT)
        elevation = float(viewpoint[1])
        if not isinstance(result, Registration):
            return Outcome(photograph, None, 180.0, elevation)
        rotation = result.rotation
        if result.translation is None:
            centre = point_in_cameras(photograph.truth, mesh_centre(self.mesh))
            truth = rotation_towards(centre).mT @ truth
            rotation = result.allocentric_rotation
        error = float(symmetric_rotation_error(rotation.double(), truth, self.symmetries))
        return Outcome(photograph, result, error, elevation)


def _conditions(setup: _Setup, generate: PhotographGenerator, report: Progress) -> Conditions:
    """What a camera, a hint, a second photograph and a print add, or what is lost without them.

    A print makes poses differ that look alike without: with and without it, each counts.
    """

    def like(mesh: Mesh) -> Registrar:
        bank = setup.registrar.bank
        pipeline = setup.registrar.pipeline
        other = cached_bank(mesh, pipeline=pipeline, device=bank.device, progress=report)
        return Registrar(other, mesh_is="exact")

    other = replace(setup, with_camera=not setup.with_camera)
    conditions: Conditions = {
        "without a camera" if setup.with_camera else "with a camera": (None, other.register),
        f"with a pose prior within {HINT_DEGREES:g} degrees": (
            None,
            lambda some: setup.register(some, prior=list(map(_hint, some))),
        ),
        "with a second photograph from another side": (
            None,
            lambda some: [setup.with_second(each, generate.subject) for each in some],
        ),
    }
    if setup.mesh.has_colours:
        plain = replace(setup, registrar=like(replace(setup.mesh, colours=None)))
        return {**conditions, "without the mesh's colours": (None, plain.register)}
    printed = with_print(setup.mesh)
    by_shape = replace(setup, symmetries=IDENTITY)
    by_print = replace(by_shape, registrar=like(printed))
    print_seen = replace(generate, mesh=printed)

    def shown(setup: _Setup) -> Register:
        return lambda some: setup.register([print_seen(each.number) for each in some])

    name = "with a print, also in the mesh: orientations that look alike without count as wrong"
    return {**conditions, name: (shown(by_shape), shown(by_print))}


def _hint(photograph: GeneratedPhotograph) -> PosePrior:
    """A pose that a user has set by hand, some degrees off."""
    generator = _generator(photograph)
    axis = F.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    angle = math.radians(HINT_ERROR) * float(torch.rand((), generator=generator))
    rotation = rotation_from_axis_angle(angle * axis) @ photograph.truth[:3, :3]
    return PosePrior(rotation=rotation, within=HINT_DEGREES)


def _generator(photograph: GeneratedPhotograph) -> torch.Generator:
    """Of what is drawn for another condition of a photograph."""
    return torch.Generator().manual_seed(int(1000 * photograph.box.sum().abs()))
