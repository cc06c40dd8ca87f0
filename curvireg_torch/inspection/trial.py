"""Generated photographs of a mesh, registered with the defaults: how often the answer will be
right."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..errors import CurviregError
from ..evaluation.metrics import symmetric_rotation_error
from ..filters import gaussian_smooth
from ..geometry import PosePrior, camera_matrix, rotation_from_axis_angle, viewpoint_from_rotation
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..geometry.viewpoint import up_rotation
from ..mesh import has_colours, mesh_up
from ..registration import Registrar, Registration
from ..synthetic import procedural_background, random_pose, synthesize_photograph

SIZE = (480, 640)  # of the photographs, H, W
FOCAL = 700.0  # px: a field of view of 49 degrees
FILL = (0.2, 0.7)  # of the photographs' shorter side, by the object
BOX_ERROR = 0.05  # Standard deviation of the box's edges, as a fraction of its sides
BLUR = 1.2  # px, the largest standard deviation
RIGHT_DEGREES = 30.0  # within which an answer is right, as confidence understands it
FINE_DEGREES = 5.0
COMPARED_FRACTION = 0.25  # of the photographs, with which other conditions are tried
HINT_DEGREES = 45.0  # by which the hint may be off, and which it allows
SECOND_CAMERA = 60.0  # Degrees about the object between two photographs


@dataclass(frozen=True)
class Photograph:
    """A generated photograph: (3, H, W) in [0, 1], its box (4,) in px, and the true pose (4, 4)."""

    image: Tensor
    box: Tensor
    truth: Tensor

    @property
    def pixels_across(self) -> float:
        """Longer side of the box in px."""
        return float((self.box[2:] - self.box[:2]).max())


@dataclass(frozen=True)
class Outcome:
    """The answer for a generated photograph: rotation error up to symmetries, and what the
    registration says."""

    photograph: Photograph
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
        errors = torch.tensor([outcome.error_deg for outcome in outcomes], dtype=torch.float64)
        reliable = torch.tensor([outcome.is_reliable for outcome in outcomes])
        right = errors <= RIGHT_DEGREES
        return cls(
            n=len(outcomes),
            right=float(right.double().mean()),
            within_5_deg=float((errors <= FINE_DEGREES).double().mean()),
            reliable=float(reliable.double().mean()),
            reliable_and_wrong=float((reliable & ~right).double().mean()),
            median_deg=float(errors.median()),
        )

    def to_dict(self) -> dict[str, Any]:
        return dict(vars(self))


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
            inside = [outcome for outcome in self.outcomes if low <= key(outcome) < high]
            if inside:
                ranges[f"{low:g} to {high:g}"] = Expected.of(inside)
        return ranges


def generate_photographs(
    mesh: trimesh.Trimesh,
    count: int,
    *,
    seed: int,
    upright: bool,
    backgrounds: Sequence[Tensor] = (),
) -> list[Photograph]:
    """Photographs of a mesh at random poses, sizes and places, in random light, out of focus by up
    to 1.2 px, with noise, in front of random or given ``backgrounds`` (3, H, W); boxes are wrong by
    about 5 % of their sides.

    Photograph k depends only on the seed and k.
    """
    K = trial_camera()
    photographs = []
    for index in range(count):
        generator = torch.Generator().manual_seed(1_000_003 * seed + index)
        truth = _random_truth(mesh, K, generator, upright=upright)
        background = procedural_background(SIZE, generator)
        if backgrounds:
            background = backgrounds[index % len(backgrounds)]
        image, box = synthesize_photograph(mesh, truth, K, SIZE, generator, background=background)
        blur = BLUR * float(torch.rand((), generator=generator))
        if blur > 0.3:
            image = gaussian_smooth(image[None], blur)[0]
        photographs.append(Photograph(image, _wrong_box(box, generator), truth))
    return photographs


def trial_camera() -> Tensor:
    """(3, 3) float64 camera matrix of the generated photographs."""
    height, width = SIZE
    return camera_matrix(FOCAL, FOCAL, 0.5 * (width - 1), 0.5 * (height - 1), dtype=torch.float64)


def run_trial(
    registrar: Registrar,
    photographs: Sequence[Photograph],
    *,
    with_camera: bool = True,
    compare: bool = True,
    report_progress: Callable[[int, int], object] | None = None,
) -> Trial:
    """Register photographs of the registrar's mesh, and a quarter of them without a camera, with a
    hint, and without the mesh's colours, where these are other conditions."""
    symmetries = _symmetries(registrar)
    K = trial_camera() if with_camera else None
    conditions = _conditions(registrar, with_camera=with_camera) if compare else {}
    part = photographs[: max(1, round(COMPARED_FRACTION * len(photographs)))]
    total = len(photographs) + len(part) * len(conditions)
    done = itertools.count(1)

    def reported(outcome: Outcome) -> Outcome:
        if report_progress is not None:
            report_progress(next(done), total)
        return outcome

    outcomes = [
        reported(_register(registrar, photograph, K, symmetries)) for photograph in photographs
    ]
    before = Expected.of(outcomes[: len(part)])
    compared = {}
    for name, register in conditions.items():
        others = [reported(register(photograph, symmetries)) for photograph in part]
        compared[name] = (before, Expected.of(others))
    return Trial(tuple(outcomes), compared)


def _conditions(
    registrar: Registrar, *, with_camera: bool
) -> dict[str, Callable[[Photograph, Tensor], Outcome]]:
    """Other conditions by name, and how a photograph is registered under them."""
    K = trial_camera()
    given = K if with_camera else None
    other = None if with_camera else K
    camera_name = "without a camera" if with_camera else "with a camera"

    def with_hint(photograph: Photograph, symmetries: Tensor) -> Outcome:
        generator = torch.Generator().manual_seed(int(1000 * photograph.box.sum().abs()))
        error = HINT_DEGREES * (2.0 * float(torch.rand((), generator=generator)) - 1.0)
        middle = _azimuth(registrar.bank.mesh, photograph.truth) + error
        prior = PosePrior(
            azimuth=((middle - HINT_DEGREES) % 360.0, (middle + HINT_DEGREES) % 360.0)
        )
        return _register(registrar, photograph, given, symmetries, prior=prior)

    def with_two(photograph: Photograph, symmetries: Tensor) -> Outcome:
        return _register_pair(registrar, photograph, symmetries)

    conditions: dict[str, Callable[[Photograph, Tensor], Outcome]] = {
        camera_name: lambda photograph, symmetries: _register(
            registrar, photograph, other, symmetries
        ),
        f"with a pose prior: azimuth within {HINT_DEGREES:g} degrees": with_hint,
        "with a second photograph from another side": with_two,
    }
    if has_colours(registrar.bank.mesh):
        grey = registrar.bank.mesh.copy()
        grey.visual = trimesh.visual.ColorVisuals()
        grey.metadata.pop("colours", None)
        plain = Registrar(grey, pipeline=registrar.pipeline)
        conditions["without the mesh's colours"] = lambda photograph, symmetries: _register(
            plain, photograph, given, symmetries
        )
    return conditions


def _register(
    registrar: Registrar,
    photograph: Photograph,
    K: Tensor | None,
    symmetries: Tensor,
    *,
    prior: PosePrior | None = None,
) -> Outcome:
    result = registrar([photograph.image], photograph.box[None], K, prior=prior)[0]
    return _outcome(
        registrar, photograph, result if isinstance(result, Registration) else None, symmetries
    )


def _register_pair(registrar: Registrar, photograph: Photograph, symmetries: Tensor) -> Outcome:
    """The outcome of a photograph and a second one, of a camera to its side."""
    K = trial_camera()
    mesh = registrar.bank.mesh
    generator = torch.Generator().manual_seed(int(photograph.box.sum().abs() * 1000))
    turn = rotation_from_axis_angle(
        torch.tensor([0.0, math.radians(SECOND_CAMERA), 0.0], dtype=torch.float64)
    )
    centre = point_in_cameras(photograph.truth, torch.from_numpy(mesh.bounds.mean(axis=0)))
    move = pose_around(turn, centre, centre)
    image, box = synthesize_photograph(mesh, move @ photograph.truth, K, SIZE, generator)
    cameras = torch.stack([torch.eye(4, dtype=torch.float64), move])
    try:
        result = registrar.register_views(
            [photograph.image, image], torch.stack([photograph.box, box]), K, cameras
        )
    except CurviregError:
        return _outcome(registrar, photograph, None, symmetries)
    return _outcome(registrar, photograph, result, symmetries)


def _outcome(
    registrar: Registrar, photograph: Photograph, result: Registration | None, symmetries: Tensor
) -> Outcome:
    """The outcome of a registration; without a camera, rotations are compared as a camera that
    looks at the object sees them."""
    truth = photograph.truth[:3, :3]
    elevation = float(viewpoint_from_rotation(truth)[1])
    if result is None:
        return Outcome(photograph, None, 180.0, elevation)
    rotation = result.rotation
    if result.translation is None:
        centre = point_in_cameras(photograph.truth, registrar.describer.centre)
        truth = rotation_towards(centre).mT @ truth
        rotation = result.allocentric_rotation
    error = float(symmetric_rotation_error(rotation.double(), truth, symmetries))
    return Outcome(photograph, result, error, elevation)


def _symmetries(registrar: Registrar) -> Tensor:
    """(S, 3, 3) rotations that do not count as errors."""
    transforms = registrar.symmetries_of(exact=True)
    if transforms is None:
        return torch.eye(3, dtype=torch.float64)[None]
    return transforms[:, :3, :3].double()


def _random_truth(
    mesh: trimesh.Trimesh, K: Tensor, generator: torch.Generator, *, upright: bool
) -> Tensor:
    """A (4, 4) pose that shows the mesh; seen from everywhere and rolled, unless it is upright."""
    elevations = (-10.0, 60.0) if upright else (-90.0, 90.0)
    T = random_pose(mesh, K, SIZE, generator, elevations=elevations, fill=FILL)
    centre = torch.from_numpy(np.asarray(mesh.bounds.mean(axis=0)))
    position = point_in_cameras(T, centre)
    R = T[:3, :3]
    if not upright:
        quaternion = torch.randn(4, generator=generator, dtype=torch.float64)
        R = torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix())
    elif mesh_up(mesh) != "z":
        R = R @ up_rotation(mesh_up(mesh)).double()
    return pose_around(R, position, centre)


def _azimuth(mesh: trimesh.Trimesh, truth: Tensor) -> float:
    """Azimuth in degrees of a true pose, with the mesh's up axis."""
    R = truth[:3, :3] @ up_rotation(mesh_up(mesh)).double().mT
    return float(viewpoint_from_rotation(R)[0])


def _wrong_box(box: Tensor, generator: torch.Generator) -> Tensor:
    """The box with edges moved at random, within the photograph."""
    sides = (box[2:] - box[:2]).repeat(2)
    moved = box + BOX_ERROR * sides * torch.randn(4, generator=generator)
    height, width = SIZE
    low = torch.tensor([-0.5, -0.5, -0.5, -0.5])
    high = torch.tensor([width - 0.5, height - 0.5, width - 0.5, height - 0.5])
    return torch.minimum(torch.maximum(moved, low), high)
