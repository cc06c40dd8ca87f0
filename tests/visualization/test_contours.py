"""Pictures draw the contours that were fitted."""

import numpy as np
import pytest
import trimesh

from curvireg_torch.matching import ViewDescriber
from curvireg_torch.pipeline import BankSettings
from curvireg_torch.visualization.contours import contour_layer, contour_pixels
from tests._support import double, eye

FOCAL = 200.0
SIZE = 120
CAMERA = double([[FOCAL, 0.0, 59.5], [0.0, FOCAL, 59.5], [0.0, 0.0, 1.0]])
GREEN = (0, 255, 80)
ORANGE = (255, 170, 0)


def placed(z):
    T = eye(4)
    T[2, 3] = z
    return T


def drawn(mesh, T, size=(SIZE, SIZE)):
    return contour_layer(ViewDescriber(mesh, BankSettings(image_size=64)), T, CAMERA, size)


def colour(layer, value):
    return (layer[..., :3] == value).all(axis=2) & (layer[..., 3] == 255)


def roof(degrees):
    """Two planes that meet at the vertical ridge x = 0 in an angle of 180 - degrees, seen along
    z."""
    fall = float(np.tan(np.deg2rad(degrees / 2)))
    vertices = [[-1, -1, fall], [0, -1, 0], [1, -1, fall], [-1, 1, fall], [0, 1, 0], [1, 1, fall]]
    faces = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]
    return trimesh.Trimesh(vertices, faces, process=False)


def test_outline_of_a_square_has_no_gap_and_nothing_inside():
    half_side = 38.3  # px of its front face, so that its edges lie at 21.2 and 97.8
    layer = drawn(trimesh.creation.box((2.0, 2.0, 2.0)), placed(1.0 + FOCAL / half_side))
    outline = colour(layer, GREEN)
    rows, columns = np.nonzero(outline)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (21, 98, 21, 98)
    for line in (outline[21, 23:97], outline[98, 23:97], outline[23:97, 21], outline[23:97, 98]):
        assert line.all(), "without a gap"
    assert not layer[30:90, 30:90].any(), "nothing inside a plane"
    alpha = layer[60, :, 3]
    assert ((alpha > 0) & (alpha < 255)).any(), "anti-aliased"
    rim = layer[60, 19]
    assert rim[3] > 60
    assert rim[:3].max() < 200, "darker than the line"
    assert not layer[:12].any()


@pytest.mark.parametrize(("degrees", "is_drawn"), [(8, False), (50, True)])
def test_creases_are_those_of_the_fit(degrees, is_drawn):
    crease = colour(drawn(roof(degrees), placed(5.0)), ORANGE)[40:80, 30:90]
    assert bool(crease.any()) == is_drawn
    if is_drawn:
        assert crease.any(axis=1).all(), "without a gap"
        assert set(np.nonzero(crease)[1] + 30) <= {58, 59, 60, 61}


def test_inner_occluding_edge_is_orange():
    near = trimesh.creation.box((1.0, 1.0, 0.2)).apply_translation([0.0, 0.0, -2.0])
    far = trimesh.creation.box((3.0, 3.0, 0.2))
    layer = drawn(trimesh.util.concatenate([near, far]), placed(8.0))
    inner = colour(layer, ORANGE)
    edge = round(59.5 + FOCAL * 0.5 / 5.9)  # of the front face of the near plate
    assert inner[50:70, edge - 1 : edge + 2].any(axis=1).all()
    assert colour(layer, GREEN)[50:70].any(axis=1).all(), "the outline is that of the far plate"


def test_pixels_are_those_of_the_points_of_the_fit():
    describer = ViewDescriber(trimesh.creation.icosphere(3), BankSettings(image_size=64))
    pixels, is_outline = contour_pixels(describer, placed(5.0), CAMERA, (SIZE, SIZE))
    radius = FOCAL / (5.0**2 - 1.0) ** 0.5  # of a sphere's outline
    distance = np.hypot(*(pixels[is_outline] - 59.5).T)
    assert len(distance) > 300
    assert np.abs(distance - radius).max() < 0.6


def test_object_outside_the_picture_or_around_the_camera_draws_nothing_wrong():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    beside = placed(5.0)
    beside[0, 3] = 40.0
    assert not drawn(box, beside).any()
    assert not drawn(box, placed(-5.0)).any(), "behind the camera"
    assert drawn(trimesh.creation.box((9.0, 9.0, 9.0)), placed(1.0)).shape == (SIZE, SIZE, 4)


def test_the_outline_is_drawn_over_the_creases_that_end_at_it():
    layer = drawn(roof(50), placed(5.0))
    columns = slice(58, 62)  # of the crease
    assert colour(layer, ORANGE)[40:80, columns].any(axis=1).all()
    for rows in (slice(18, 22), slice(98, 102)):
        assert colour(layer, GREEN)[rows, columns].any(axis=0).all(), (
            "without a gap where the crease ends"
        )
        assert not colour(layer, ORANGE)[rows, columns][:2].all()
