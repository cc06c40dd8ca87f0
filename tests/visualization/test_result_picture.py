from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from curvireg_torch import Registrar
from curvireg_torch.registration.photograph import as_photograph
from curvireg_torch.rendering import render_depth
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.visualization import contour_overlay, overlay, registration_sheet
from tests._support import CAMERA, scene, truck_bank, unrefined

GREEN = (0, 255, 80)
SIDE = 227  # px of a small picture: four in a row of 960 px


@pytest.fixture(scope="module")
def registered():
    """registrar, result at the true pose, image, box."""
    image, box, T = scene(2)
    registrar = Registrar(truck_bank(), pipeline=unrefined(truck_bank()))
    result = registrar([image], box[None], CAMERA)[0]
    truth = replace(result.hypotheses[0], projection=(T, CAMERA))
    return registrar, replace(result, hypotheses=(truth, *result.hypotheses[1:])), image, box


def small_picture(sheet, number):
    """One of the eight pictures below the photograph and its caption, from 0."""
    rows = np.nonzero((sheet[720:, 20] != 255).any(axis=1))[0]  # of the first column
    starts = [
        r for r in rows if r - 1 not in rows and (rows < r + 100).sum() - (rows < r).sum() == 100
    ]
    top = 720 + starts[number // 4]
    left = 10 + number % 4 * (SIDE + 10)
    return sheet[top : top + SIDE, left : left + SIDE]


def test_registration_sheet_shows_the_whole_photograph_with_the_contours(registered):
    registrar, result, image, box = registered
    photograph = registration_sheet(registrar, result, image, box)[:720]
    assert photograph.shape == (720, 960, 3)
    enlarged = torch.nn.functional.interpolate(image[None], (720, 960), mode="bicubic")[0].permute(
        1, 2, 0
    )
    assert np.median(np.abs(photograph - 255 * enlarged.clamp(0, 1).numpy())) < 2
    K = (
        torch.tensor([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
        @ CAMERA
    )
    mask = (render_depth(example_mesh(), result.projection[0], K, (720, 960))[0, 0] > 0).numpy()
    rows, columns = np.nonzero((photograph == GREEN).all(axis=2))
    for drawn, seen in ((rows, np.nonzero(mask)[0]), (columns, np.nonzero(mask)[1])):
        assert abs(drawn.min() - seen.min()) <= 2
        assert abs(drawn.max() - seen.max()) <= 2


def test_registration_sheet_draws_rivals_at_their_poses(registered):
    registrar, result, image, box = registered
    sheet = registration_sheet(registrar, result, image, box)
    first, second, *others = result.hypotheses
    assert len(others) == 3
    close_up = small_picture(sheet, 0)
    same = replace(second, projection=first.projection)
    other = registration_sheet(
        registrar, replace(result, hypotheses=(first, same, *others)), image, box
    )
    assert np.array_equal(small_picture(other, 4), close_up)
    assert not np.array_equal(small_picture(sheet, 4), close_up)
    rows, columns = np.nonzero((sheet != other).any(axis=2))
    assert np.ptp(rows) < SIDE, "nothing else changes"
    assert np.ptp(columns) < SIDE


def test_pictures_are_drawn_from_the_contours_of_the_fit(registered, monkeypatch):
    registrar, result, image, box = registered
    whole = Mock(wraps=registrar.describer.renderer)
    monkeypatch.setattr(registrar.describer, "renderer", whole)
    registration_sheet(registrar, result, image, box)
    assert not whole.method_calls, "no second picture of the whole mesh is rendered"


def test_a_prepared_photograph_is_drawn_as_it_is(registered, monkeypatch):
    """With the part of its box that it shows."""
    registrar, result, image, box = registered
    beyond = torch.tensor([-50.0, *box[1:].tolist()])
    pictures = {
        draw: draw(registrar, result, image, beyond)
        for draw in (registration_sheet, contour_overlay)
    }
    photograph = replace(as_photograph(image, box, CAMERA), box=beyond.double())
    monkeypatch.setattr(overlay, "as_photograph", Mock(side_effect=AssertionError))
    for draw, expected in pictures.items():
        assert np.array_equal(draw(registrar, result, photograph), expected)
