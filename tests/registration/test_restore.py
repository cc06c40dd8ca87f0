"""Hypotheses that merged with another one, or whose fit is not trusted, are restored to the views they started from."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from curvireg_torch import Registrar, Registration, ViewBank, rotation_error, sample_views
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import Hypothesis
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support.scenes import CAMERA, SIZE

AZIMUTHS = (15.0, 45.0, 75.0, 225.0)
"""Half-way between two views of the bank, so that both lead to the same pose."""


@cache
def coarse_bank() -> ViewBank:
    views = sample_views(azimuth_step=30, elevations=[20])
    return ViewBank.build(example_mesh(), views, pipeline=PRESETS["classical"], image_size=96, progress=False)


@cache
def photographs() -> tuple[list[torch.Tensor], torch.Tensor]:
    mesh, images, boxes = example_mesh(), [], []
    for azimuth in AZIMUTHS:
        R = rotation_from_viewpoint(azimuth, 20.0, 0.0).double()
        T = transform(R, torch.tensor([0.0, 0.0, 3.5 * mesh_radius(mesh)]) - R @ mesh_centre(mesh))
        image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, torch.Generator().manual_seed(1))
        images.append(image)
        boxes.append(box)
    return images, torch.stack(boxes)


def coarse_registrar(hypotheses: int) -> Registrar:
    return Registrar(coarse_bank(), pipeline=replace(coarse_bank().pipeline, hypotheses=hypotheses))


@pytest.fixture(scope="module")
def results() -> list[Registration]:
    return coarse_registrar(5)(*photographs(), CAMERA)


def angle_moved(hypothesis: Hypothesis) -> float:
    """Degrees from the view that the hypothesis started from."""
    view = coarse_bank().rotations[hypothesis.view].double()
    return float(rotation_error(hypothesis.allocentric_rotation, view))


def restored(result: Registration) -> list[Hypothesis]:
    return [h for h in result.hypotheses if angle_moved(h) < 0.01]


def test_restored_hypotheses_come_last(results):
    """Although their views are often more similar to the photograph than those of rivals."""
    higher = 0
    for result in results:
        is_moved = [angle_moved(h) > 0.01 for h in result.hypotheses]
        assert is_moved[0]
        assert is_moved == sorted(is_moved, reverse=True)
        rivals = [h for h in result.hypotheses[1:] if angle_moved(h) > 0.01]
        higher += any(a.score > b.score for a in restored(result) for b in rivals)
    assert higher >= 2


def test_restored_hypotheses_have_no_covariance(results):
    for result in results:
        assert restored(result)
        assert result.reliable
        assert result.covariance is not None
        assert all(h.covariance is None for h in restored(result))


def test_fits_without_a_camera_are_kept_where_they_are_trusted(results):
    """Contours of rivals hardly fit, so their views are restored; with a camera, fits are kept."""
    images, boxes = photographs()
    without_camera = coarse_registrar(3)(images[::2], boxes[::2])
    for without, with_camera in zip(without_camera, results[::2], strict=True):
        rivals = {h.view for h in without.hypotheses[1:]}
        assert all(angle_moved(h) < 0.01 for h in without.hypotheses[1:])
        assert any(angle_moved(h) > 5 for h in with_camera.hypotheses[1:] if h.view in rivals)
    assert angle_moved(without_camera[1].hypotheses[0]) > 5, "edge support above one half"
