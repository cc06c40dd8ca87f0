"""Hypotheses whose search or fit ended in another one, or in nothing that is trusted: they stand at their own view."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from curvireg_torch import Registrar, Registration, ViewBank, rotation_error, sample_views
from curvireg_torch.geometry import rotation_from_viewpoint
from curvireg_torch.io.meshes import mesh_centre, mesh_radius
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.registration import Hypothesis, fit_contours
from curvireg_torch.rendering import make_renderer
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support.scenes import CAMERA, SIZE

HALF_WAY = (15.0, 45.0, 75.0, 225.0)
"""Azimuths half way between two views of the bank, both of which lead there."""


@cache
def coarse_bank() -> ViewBank:
    views = sample_views(azimuth_step=30, elevations=[20])
    return ViewBank.build(example_mesh(), views, pipeline=PRESETS["classical"], image_size=96, progress=False)


@cache
def photographs() -> tuple[list[torch.Tensor], torch.Tensor]:
    mesh, images, boxes = example_mesh(), [], []
    for azimuth in HALF_WAY:
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3] = rotation_from_viewpoint(azimuth, 20.0, 0.0)
        T[:3, 3] = torch.tensor([0.0, 0.0, 3.5 * mesh_radius(mesh)]) - T[:3, :3] @ mesh_centre(mesh)
        image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, torch.Generator().manual_seed(1))
        images.append(image)
        boxes.append(box)
    return images, torch.stack(boxes)


@pytest.fixture(scope="module")
def results() -> list[Registration]:
    images, boxes = photographs()
    return Registrar(coarse_bank(), pipeline=replace(coarse_bank().pipeline, hypotheses=5))(images, boxes, CAMERA)


def moved(hypothesis: Hypothesis) -> float:
    """Degrees from the bank's view that the hypothesis comes from."""
    view = coarse_bank().rotations[hypothesis.view].double()
    return float(rotation_error(hypothesis.allocentric_rotation, view))


def put_back(result: Registration) -> list[Hypothesis]:
    return [h for h in result.hypotheses if moved(h) < 0.01]


def test_hypotheses_that_became_another_come_last(results):
    """Their views are often more like the photograph than those of rivals, and still no peaks of their own."""
    overtaken = 0
    for result in results:
        steps = [moved(h) > 0.01 for h in result.hypotheses]
        assert steps[0]
        assert steps == sorted(steps, reverse=True)
        rivals = [h for h in result.hypotheses[1:] if moved(h) > 0.01]
        overtaken += any(a.score > b.score for a in put_back(result) for b in rivals)
    assert overtaken >= 2


def test_the_support_of_a_view_is_not_that_of_the_fit_it_led_to(results):
    """It is 0, not measured, or that of the contours of the view itself."""
    images, boxes = photographs()
    mesh, renderer = example_mesh(), make_renderer(example_mesh())
    for result, image, box in zip(results, images, boxes, strict=True):
        assert put_back(result)
        for h in put_back(result):
            assert h.evidence["edge_support"] == h.edge_support
            if h.edge_support != 0:
                T, K = h.projection
                places = {"centre": mesh_centre(mesh), "radius": mesh_radius(mesh)}
                own = fit_contours(renderer, image, box, K, T[None], **places).start_support
                assert h.edge_support == pytest.approx(float(own), abs=0.02)


def test_a_view_that_was_put_back_has_no_covariance(results):
    """It was not fitted: the covariance of the fit is of another pose."""
    for result in results:
        assert result.reliable
        assert result.covariance is not None
        assert put_back(result)
        assert all(h.covariance is None for h in put_back(result))


def test_without_a_camera_a_fit_is_taken_where_it_is_trusted(results):
    """Contours of rivals hardly fit: there the view stays. With a camera, the mesh counts as the object's own."""
    images, boxes = photographs()
    blind = Registrar(coarse_bank(), pipeline=replace(coarse_bank().pipeline, hypotheses=3))(images[::2], boxes[::2])
    for without, with_camera in zip(blind, results[::2], strict=True):
        rivals = {h.view for h in without.hypotheses[1:]}
        assert all(moved(h) < 0.01 for h in without.hypotheses[1:])
        assert any(moved(h) > 5 for h in with_camera.hypotheses[1:] if h.view in rivals)
    assert moved(blind[1].hypotheses[0]) > 5, "support above one half"
