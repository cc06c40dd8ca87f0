from dataclasses import replace

import pytest
import torch
from scipy.ndimage import binary_erosion, distance_transform_edt

from curvireg_torch import Registrar
from curvireg_torch.rendering import render_depth
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization import contour_overlay
from tests._support import CAMERA, SIZE, scene, truck_bank

GREEN = (0, 255, 80)


def fraction_near(picture, mask, pixels):
    """Fraction of the drawn outline within so many px of the outline of a mask."""
    contour = (picture == GREEN).all(axis=2)
    assert contour.sum() > 50
    edge = mask & ~binary_erosion(mask)
    return float((distance_transform_edt(~edge)[contour] <= pixels).mean())


@pytest.mark.parametrize(("camera", "shift"), [(CAMERA, 0.08), (None, 0.05)])
def test_contour_overlay_draws_the_object_although_the_box_is_wrong(camera, shift):
    image, box, T = scene(2)
    box = box + shift * (box[2:] - box[:2]).max() * torch.tensor([1.0, -1.0, 1.0, -1.0])
    registrar = Registrar(truck_bank())
    result = registrar([image], box[None], camera)[0]
    mask = (render_depth(example_mesh(), T, CAMERA, SIZE)[0, 0] > 0).numpy()
    picture = contour_overlay(registrar, result, image, box)
    assert fraction_near(picture, mask, 2) > 0.95
    assert fraction_near(picture, mask[::-1], 2) < 0.5
    truth = replace(result.hypotheses[0], projection=(T, CAMERA))
    at_the_truth = contour_overlay(registrar, truth, image, box)
    # The drawn contour is rounded to pixels, and so is the mask, by another renderer: a pixel or
    # two differ at corners.
    assert fraction_near(at_the_truth, mask, 1.5) > 0.98
    assert fraction_near(at_the_truth, mask, 2) == 1.0
    if camera is None:  # the estimated camera, not a view that fills the box
        assert result.camera.source == "estimated"
        at = result.allocentric_rotation[None], torch.tensor([result.distance])
        T, K = registrar.describer.cameras_of_boxes(*at, box[None])
        filling = replace(result.hypotheses[0], projection=(T[0], K[0]))
        assert fraction_near(contour_overlay(registrar, filling, image, box), mask, 2) < 0.5
