import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import ViewSphere, rotation_error, sample_views, uniform_views, up_rotation
from curvireg_torch.utils.choices import UP_AXES


def directions(views: ViewSphere) -> torch.Tensor:
    return -views.rotations[:, 2].double()


@pytest.mark.parametrize("count", [2, 5, 20, 100, 300, 700])
def test_uniform_views_has_the_stated_covering_radius(count: int) -> None:
    probes = torch.randn(100_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    probes = torch.nn.functional.normalize(torch.cat([probes, torch.eye(3).double(), -torch.eye(3).double()]), dim=1)
    nearest = torch.cat([(p @ directions(uniform_views(count)).T).amax(1) for p in probes.split(20_000)])
    radius = math.degrees(math.acos(max(-1.0, float(nearest.min()))))
    assert 0.9 * 157 / math.sqrt(count) < radius <= 157 / math.sqrt(count)


def test_uniform_views_covers_rotations_with_thetas() -> None:
    views = uniform_views(200, thetas=range(0, 360, 20))
    R = torch.from_numpy(Rotation.random(2000, random_state=0).as_matrix())
    nearest = (R.flatten(1) @ views.rotations.double().flatten(1).T).argmax(dim=1)
    error = rotation_error(R, views.rotations[nearest].double())
    assert float(error.max()) <= 157 / math.sqrt(200) + 10.0


def test_view_functions_refuse_invalid_options() -> None:
    one = torch.zeros(1)
    for call, match in (
        (lambda: ViewSphere(one, one, one, one + 1), "distances > 1"),
        (lambda: ViewSphere(one, one, torch.zeros(2), one + 2), "one shape"),
        (lambda: sample_views(azimuth_step=0), "azimuth_step"),
        (lambda: sample_views(elevations=[]), "elevations"),
        (lambda: sample_views(elevations=[91]), "elevations"),
        (lambda: uniform_views(0), "count"),
        (lambda: uniform_views(2.5), "count: expected an integer"),
        (lambda: uniform_views(5, distances="far"), "distances: expected numbers"),
        (lambda: sample_views(elevations=["high"]), "elevations: expected numbers"),
        (lambda: sample_views(azimuth_step="10"), "azimuth_step: expected a number"),
        (lambda: cr.camera_matrix("1", 1, 1, 1), "fx: expected a number"),
        (lambda: cr.crop_images(torch.rand(1, 1, 4, 4), [[0, 0, 3, 3]], size=8.0), "size: expected an integer"),
        (lambda: sample_views(elevations=[float("nan")]), "elevations: expected at least one finite"),
        (lambda: uniform_views(5, thetas=[]), "thetas"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()


AXES = {s + a: (-1 if s else 1) * np.eye(3)[i] for i, a in enumerate("xyz") for s in ("", "-")}


@pytest.mark.parametrize("up", UP_AXES)
def test_up_rotation_takes_the_axis_to_z(up: str) -> None:
    R = up_rotation(up).numpy()
    assert np.linalg.det(R) == 1
    assert np.array_equal(R @ R.T, np.eye(3))
    assert np.array_equal(R @ AXES[up], [0, 0, 1])
    assert (up_rotation("y").numpy() @ [0, 0, 1]).tolist() == [0, -1, 0], "from glTF's front to that of PASCAL3D+"


@pytest.mark.parametrize("up", UP_AXES)
def test_for_up_shows_the_same_views_of_a_rotated_object(up: str) -> None:
    views = cr.sample_views(azimuth_step=40, elevations=[-20, 30, 90], thetas=[0, 25])
    seen = views.for_up(up).rotations.double() @ up_rotation(up).T
    torch.testing.assert_close(seen, views.rotations.double(), rtol=0, atol=2e-6)
