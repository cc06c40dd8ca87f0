"""Poses beside a photograph, and evidence for them, in closed cases."""

from dataclasses import fields, replace
from types import SimpleNamespace

import torch

from curvireg_torch.evidence import Evidence, EvidenceWeights
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration.hypotheses import Hypotheses
from tests._support.numbers import double
from tests._support.scenes import CAMERA

HALF_TURN = torch.diag(double([-1.0, -1.0, 1.0, 1.0]))
"""Of the model, about its vertical axis."""


def turned(*degrees):
    """(N, 3, 3) rotations of views about the vertical axis."""
    return torch.stack([rotation_from_viewpoint(angle, 30.0, 0.0).double() for angle in degrees])


def placed_at(T, centre, K=CAMERA, photograph=None):
    """The poses T (N, 4, 4) of view 0 in one camera."""
    nothing = torch.zeros(len(T))
    cameras = K.expand(len(T), 3, 3)
    view = nothing.long()
    return Hypotheses.at(T, cameras, centre, view, nothing.double(), photograph)


def poses_at(*degrees, x=0.0, centre=(0.0, 0.0, 0.0)):
    """Of the views 0, 1, ..., five units away and ``x`` to the right."""
    T = transform(turned(*degrees), double([x, 0.0, 5.0]).expand(len(degrees), 3))
    poses = placed_at(T, torch.as_tensor(centre).double())
    return replace(poses, view=torch.arange(len(T)))


def evidence_of(*similarity, **columns):
    """Evidence with these similarities, or columns of other names; the others are 0."""
    known = {name: double(column) for name, column in columns.items()}
    known = known or {"similarity": double(similarity)}
    nothing = torch.zeros_like(next(iter(known.values())))
    return Evidence(**{field.name: known.get(field.name, nothing) for field in fields(Evidence)})


def competing(poses, evidence, outside=None):
    """The poses with this evidence, some of them outside the limits."""
    return replace(
        poses, evidence=evidence, is_outside=torch.tensor(outside or [False] * len(poses))
    )


def all_kept(poses):
    """Limits that keep all poses."""
    return torch.ones(len(poses), dtype=torch.bool)


def target_of(**attributes):
    """A registrar by its default weights and pipeline, and what else a function asks for."""
    known = {"score_weights": lambda **_: EvidenceWeights(), "pipeline": Pipeline()}
    return SimpleNamespace(**known | attributes)
