"""Near-symmetries of an object, seen from a bank of its views: to be reported, never applied unasked."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry.conversions import rotation_from_axis_angle
from ..geometry.mesh import normalization_transform
from .bank import ViewBank

__all__ = ["NearSymmetry", "near_symmetries"]

_TURNS = (180.0, 120.0, 90.0, 72.0, 60.0, 45.0)
_REACH = 15.0  # degrees within which some view of the bank must lie to stand for a turned one
_PROBES = 300  # views that are compared, spread over the bank
_UNLIKE = 60.0  # degrees beyond which two views count as unrelated


@dataclass(frozen=True)
class NearSymmetry:
    """A turn of the model that leaves its views nearly as they are.

    Attributes:
        axis: unit vector in the model frame.
        angle: degrees.
        score: 1 = turned views look as alike as neighbouring views do at the same angle, 0 = as unrelated views do.
    """

    axis: tuple[float, float, float]
    angle: float
    score: float


def near_symmetries(bank: ViewBank, *, threshold: float = 0.8) -> list[NearSymmetry]:
    """Turns about the file's and the principal axes that a bank's views can hardly tell from the identity.

    For every candidate turn S, each view R is compared with the view of the bank nearest to R S. Their similarity is
    set against that of neighbouring views, as far apart as R S is from its nearest, and that of unrelated views. A turn
    that takes less than a quarter of the views to others of the bank is not judged.

    What comes back is a hint: a photograph may show what descriptors of the shape do not. Nothing is applied; see
    :func:`curvireg_torch.geometry.views_without_symmetric`.

    Args:
        bank: views dense enough for neighbours to look alike (10 degrees or so).
        threshold: least score that is reported.

    Returns:
        Best first.

    Raises:
        InvalidInputError: fewer than 8 views.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> views = sample_views(azimuth_step=15, elevations=[10, 40])
        >>> bank = ViewBank.build(trimesh.creation.box((1.0, 3.0, 2.0)), views, image_size=64, progress=False)
        >>> found = near_symmetries(bank)[0]
        >>> [abs(round(v)) for v in found.axis], found.angle
        ([0, 0, 1], 180.0)
    """
    if len(bank) < 8:
        raise InvalidInputError(f"bank: expected at least 8 views, got {len(bank)}")
    R = bank.rotations.double()
    descriptors = torch.nn.functional.normalize(bank.descriptors, dim=1)
    probes = torch.arange(0, len(bank), max(1, len(bank) // _PROBES), device=R.device)
    between = _angles(R[probes], R)
    alike = descriptors[probes] @ descriptors.T
    unlike = float(alike[between > _UNLIKE].mean())
    # What neighbours a given angle apart have in common: 1 at 0 degrees, measured at the nearest others.
    near = torch.where(between < 1e-3, torch.inf, between).amin(dim=1)
    neighbour = torch.where(between < 1e-3, torch.inf, between).argmin(dim=1)
    fall = float((1.0 - alike.gather(1, neighbour[:, None])[:, 0]).mean() / near.mean())
    found = []
    for axis in _axes(bank):
        for angle in _TURNS:
            S = rotation_from_axis_angle(axis * math.radians(angle)).to(R)
            turned = _angles(R[probes] @ S, R)
            off, match = turned.min(dim=1)
            there = off <= _REACH
            if int(there.sum()) * 4 < len(probes):
                continue
            similarity = alike.gather(1, match[:, None])[there, 0]
            expected = (1.0 - fall * off[there]).clamp(min=unlike + 1e-3)
            score = float((similarity - unlike).sum() / (expected - unlike).sum())
            if score >= threshold:
                x, y, z = axis.tolist()
                found.append(NearSymmetry((x, y, z), angle, min(1.0, score)))
    return sorted(found, key=lambda symmetry: -symmetry.score)


def _angles(A: Tensor, B: Tensor) -> Tensor:
    """(K, N) degrees between (K, 3, 3) and (N, 3, 3) rotations."""
    cosine = 0.5 * (A.flatten(1) @ B.flatten(1).T - 1.0)
    return torch.rad2deg(torch.acos(cosine.clamp(-1.0, 1.0)))


def _axes(bank: ViewBank) -> list[Tensor]:
    """The file's axes and the principal ones, each direction once."""
    T = normalization_transform(bank.mesh, align_axes=True)[:3, :3]
    principal = T / torch.linalg.vector_norm(T, dim=1, keepdim=True)
    axes: list[Tensor] = []
    for axis in (*torch.eye(3, dtype=torch.float64), *principal):
        if all(float((axis @ other).abs()) < math.cos(math.radians(5.0)) for other in axes):
            axes.append(axis)
    return axes
