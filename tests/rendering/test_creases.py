"""Which creases and inner contours are seen: closed cases of ridges and plates in front of a
camera."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import camera_matrix, transform
from curvireg_torch.rendering.contours import MAX_OCCLUDING, MeshContours, _Places, _Views
from tests._support import double, eye
from tests._support.tables import text_table

SIZE = 128
RADIUS = np.hypot(0.5, 0.5)
"""Of the plate."""
DISTANCE = 10.0
PIXEL = 0.01
"""Length of a pixel at the plate's distance."""
K = camera_matrix(DISTANCE / PIXEL, DISTANCE / PIXEL, 63.5, 63.5)
IN_FRONT = transform(eye(3), double([0.0, 0.0, DISTANCE]))[None]


def strip(x, z, y=0.5):
    """A surface that is bent along x only."""
    rows = [np.column_stack([x, np.full(len(x), end), z]) for end in (-y, y)]
    n = len(x)
    faces = [face for k in range(n - 1) for face in ((k, n + k, k + 1), (k + 1, n + k, n + k + 1))]
    return trimesh.Trimesh(np.concatenate(rows), faces, process=False)


def ridge(half_width, slope):
    """A plate of 100 px with a ridge towards the camera, ``half_width`` px to both sides."""
    a = half_width * PIXEL
    return strip([-0.5, -a, 0.0, a, 0.5], [0.0, 0.0, -slope * a, 0.0, 0.0])


def seen(mesh, unit=1.0):
    mesh = mesh.copy()
    mesh.apply_scale(unit)
    T = IN_FRONT.clone()
    T[:, :3, 3] *= unit
    return MeshContours(mesh).points(T, K[None], SIZE)


def has_crease(mesh, unit=1.0):
    """Whether points of a crease are along the middle of the plate."""
    points = seen(mesh, unit)
    model = points.model[0, MAX_OCCLUDING:][points.valid[0, MAX_OCCLUDING:]]
    return int((model[:, 0].abs() < 1e-3 * unit).sum()) > 10


@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.parametrize(("slope", "expected"), [(0.16, False), (0.20, True), (0.4, True)])
def test_a_crease_is_seen_from_a_fold_of_20_degrees_on(slope, expected, unit):
    assert has_crease(ridge(20.0, slope), unit) == expected


RIDGES = """
3.0 | 0.22 | true  | as a wide one
1.0 | 0.30 | false | half of it
1.0 | 0.50 | true  |
0.5 | 0.60 | false |
"""


@pytest.mark.parametrize(("half_width", "slope", "expected", "kind"), text_table(RIDGES))
def test_the_surface_is_looked_up_two_pixels_beside_a_crease(half_width, slope, expected, kind):
    """A 64th of the crop's side: a narrower ridge counts by its height."""
    assert has_crease(ridge(half_width, slope)) == expected, kind


def plates(gap):
    """A plate, and a smaller one of 40 px in front of it; the gap is a fraction of the radius."""
    large = strip([-0.5, 0.5], [0.0, 0.0])
    small = strip([-0.2, 0.2], [0.0, 0.0], y=0.2)
    small.apply_translation((0.0, 0.0, -gap * RADIUS))
    return trimesh.util.concatenate([large, small])


@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.parametrize(("gap", "expected"), [(0.04, 0), (0.06, 1)])
def test_an_inner_contour_needs_a_step_in_depth(gap, expected, unit):
    """Of a twentieth of the radius."""
    points = seen(plates(gap), unit)
    inner = points.valid & ~points.outline
    assert min(int(inner[0, :MAX_OCCLUDING].sum()), 1) == expected
    assert points.outline.sum() > 50


@pytest.mark.parametrize("unit", [1.0, 1e-3])
@pytest.mark.parametrize(("gap", "expected"), [(0.01, True), (0.03, False)])
def test_a_crease_may_lie_a_little_behind_the_surface(gap, expected, unit):
    """A fiftieth of the radius: a cover lies in front of the ridge."""
    cover = strip([-0.3, 0.3], [0.0, 0.0], y=0.6)
    cover.apply_translation((0.0, 0.0, -0.3 * 0.2 - gap * RADIUS))
    assert has_crease(trimesh.util.concatenate([ridge(20.0, 0.3), cover]), unit) == expected


@pytest.mark.parametrize(("drop", "expected"), [(0.05, True), (0.15, False)])
def test_a_step_in_depth_is_no_crease(drop, expected):
    """Beyond a tenth of the radius: two slopes that fall steeply to both sides."""
    a = 2.0 * PIXEL
    depth = drop * RADIUS
    steep = strip([-0.5, -a, 0.0, a, 0.5], [depth, depth, 0.0, depth, depth])
    assert has_crease(steep) == expected


NORMALS = """
0   | true  | true  | 0  | the same
45  | true  | true  | 45 | of the surface
55  | true  | true  | 55 | of the surface
65  | true  | true  | 0  | of another surface, as at the rim of a cone
45  | false | true  | 0  | of the edge
45  | true  | false | 0  | of the edge
225 | true  | true  | 45 | outward all the same
"""


@pytest.mark.parametrize(
    ("degrees", "smooth", "occluding", "expected", "kind"), text_table(NORMALS)
)
def test_normals_of_a_smooth_surface_replace_those_of_edges_they_agree_with(
    degrees, smooth, occluding, expected, kind
):
    """An edge whose normal in the image is (1, 0), of a surface whose normal is turned from it."""
    angle = np.radians(degrees)
    surface = torch.tensor([[np.cos(angle), np.sin(angle), 0.0]] * 2, dtype=torch.float32)
    first = torch.tensor([0])
    level = SimpleNamespace(
        starts=first, ends=first + 1, normals=surface, is_smooth=torch.tensor([smooth])
    )
    views = SimpleNamespace(
        level=level, rotation=torch.eye(3)[None], focal_lengths=torch.ones(1, 1, 2)
    )
    places = _Places(
        edge=first[None],
        fraction=torch.tensor([[0.5]]),
        at=torch.zeros(1, 1, 3),
        normal=torch.tensor([[[1.0, 0.0]]]),
        valid=torch.tensor([[True]]),
    )
    found = _Views._smoothed(views, places, torch.tensor([occluding])).normal[0, 0].tolist()
    assert np.degrees(np.arctan2(found[1], found[0])) == pytest.approx(expected, abs=1e-3), kind
