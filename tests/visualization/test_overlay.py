"""Pictures show the pose with the camera of the registration."""

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import binary_erosion, distance_transform_edt

from curvireg_torch import Registrar
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.rendering import make_renderer, render_depth
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization import contour_overlay
from tests._support.scenes import CAMERA, SIZE, scene, truck_bank, unrefined

GREEN = (0, 255, 80)


def silhouette(T, K=CAMERA, mesh=None, size=SIZE):
    return (render_depth(mesh or example_mesh(), T, K, size)[0, 0] > 0).numpy()


def is_contour(picture):
    return (picture == GREEN).all(axis=2)


def fraction_near(contour, mask, pixels):
    """Fraction of the contour's pixels within so many px of the contour of a mask."""
    assert contour.sum() > 50
    edge = mask & ~binary_erosion(mask)
    return float((distance_transform_edt(~edge)[contour] <= pixels).mean())


def shifted(box, fraction):
    """The box moved to the right and up by a fraction of its longer side."""
    return box + fraction * (box[2:] - box[:2]).max() * torch.tensor([1.0, -1.0, 1.0, -1.0])


def registered(fraction, camera):
    image, box, T = scene(2)
    registrar, box = Registrar(truck_bank()), shifted(box, fraction)
    return registrar, registrar([image], box[None], camera)[0], image, box, T


@pytest.fixture(scope="module")
def with_camera():
    """registrar, result, image, wrong box, true pose."""
    return registered(0.08, CAMERA)


@pytest.fixture(scope="module")
def without_camera():
    return registered(0.05, None)


def check_contour(contour, truth):
    assert fraction_near(contour, truth, 2) > 0.95
    assert fraction_near(contour, truth[::-1], 2) < 0.5


def test_contour_overlay_draws_the_object_although_the_box_is_wrong(with_camera):
    registrar, result, image, box, T = with_camera
    contour = is_contour(contour_overlay(registrar, result, image, box))
    check_contour(contour, silhouette(T))
    assert fraction_near(contour, silhouette(T)[:, ::-1], 2) < 0.5
    truth = replace(result.hypotheses[0], projection=(T, CAMERA))
    assert fraction_near(is_contour(contour_overlay(registrar, truth, image, box)), silhouette(T), 1) == 1.0


def check_assumed_camera(registrar, result, image, box, truth):
    """Without a camera the overlay uses the assumed one, not a view that fills the box."""
    assert result.translation is None
    check_contour(is_contour(contour_overlay(registrar, result, image, box)), truth)
    rotation, distance = result.allocentric_rotation[None], torch.tensor([result.distance])
    T, K = registrar.describer.cameras_of_boxes(rotation, distance, box[None])
    filling = replace(result.hypotheses[0], projection=(T[0], K[0]))
    assert fraction_near(is_contour(contour_overlay(registrar, filling, image, box)), truth, 2) < 0.5


def test_contour_overlay_without_a_camera(without_camera):
    *registered, T = without_camera
    check_assumed_camera(*registered, silhouette(T))


def test_contour_overlay_uses_the_renderer_of_the_registrar(bank):
    (image, box, _), renderer, sizes = scene(0), make_renderer(example_mesh()), []
    render = renderer.render
    renderer.render = lambda T, K, size, **options: sizes.append(size) or render(T, K, size, **options)
    registrar = Registrar(bank, pipeline=unrefined(bank), renderer=renderer)
    contour_overlay(registrar, registrar([image], box[None])[0], image, box)
    assert sizes[-1] == SIZE
    with pytest.raises(InvalidInputError, match="knows one mesh"):
        Registrar([bank, bank], renderer=renderer)
