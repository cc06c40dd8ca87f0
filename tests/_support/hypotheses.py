"""Poses beside a photograph, and evidence for them, in closed cases."""

from dataclasses import fields

import torch

from curvireg_torch.evidence import Evidence
from curvireg_torch.geometry import rotation_from_viewpoint, transform
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
    R = turned(*degrees)
    count = len(R)
    T = transform(R, double([x, 0.0, 5.0]).expand(count, 3))
    rank = torch.zeros(count, dtype=torch.float64)
    cameras = CAMERA.expand(count, 3, 3)
    return Hypotheses.at(T, cameras, torch.as_tensor(centre).double(), torch.arange(count), rank)


def evidence_of(*similarity, **columns):
    """Evidence with these similarities, or columns of other names; the others are 0."""
    known = {name: double(column) for name, column in columns.items()}
    known = known or {"similarity": double(similarity)}
    nothing = torch.zeros_like(next(iter(known.values())))
    return Evidence(**{field.name: known.get(field.name, nothing) for field in fields(Evidence)})
