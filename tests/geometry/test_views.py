import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import ViewSphere, paper_views, rotation_error, sample_views, uniform_views
from curvireg_torch.geometry.symmetry import symmetry_transforms, views_without_symmetric

AXIS = {"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}
HALF_TURN = {"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}


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


def test_paper_views_is_the_grid_of_the_paper() -> None:
    views = paper_views()
    assert len(views) == 756
    assert sorted({round(float(d), 4) for d in views.distance}) == pytest.approx([1.5, 3.0, 4.5, 6.0, 7.5, 9.0])
    one_shell = views[views.distance == views.distance[0]]
    assert len(one_shell) == 126
    R = one_shell.rotations.double()
    assert float((rotation_error(R[:, None], R) + 9.0 * torch.eye(126)).min()) > 3.0  # no view twice
    # Neighbours in elevation differ by 50 degrees about the camera's x axis.
    grid = one_shell.rotations.view(7, 18, 3, 3)
    assert torch.allclose(rotation_error(grid[1:], grid[:-1]), torch.tensor(50.0), atol=1e-3)
    step = grid[1:] @ grid[:-1].mT
    assert torch.allclose(step[..., 0, 0], torch.tensor(1.0), atol=1e-5)
    with pytest.raises(InvalidInputError, match="object_radius"):
        paper_views(object_radius=0.3)


def test_within_selects_a_range() -> None:
    views = sample_views(azimuth_step=10, elevations=[-20, 0, 20], thetas=[-10, 0, 10])
    car = views.within(azimuth=(350, 10), elevation=(0, 20), theta=(0, 10))
    assert len(car) == 3 * 2 * 2
    assert sorted(set(car.azimuth.tolist())) == [0.0, 10.0, 350.0]
    assert len(views.within()) == len(views)
    assert len(views.within(azimuth=(-10, 10))) == 3 * 3 * 3
    assert len(uniform_views(40, thetas=[350]).within(theta=(-20, 0))) == 40  # 350 is -10
    assert len(views.within(azimuth=(20, 320))) == 31 * 9  # more than half a circle, and less than a whole
    assert len(views.within(azimuth=(0, 359), theta=(-180, 170))) == len(views)
    poles = sample_views(azimuth_step=180, elevations=[-90, 90], thetas=[-180, 170])
    assert len(poles.within()) == len(poles)
    with pytest.raises(InvalidInputError, match="none of 324 views"):
        views.within(elevation=(30, 40))


@pytest.mark.parametrize(("info", "expected"), [({}, 72 * 3), (HALF_TURN, 36 * 3), (AXIS, 1 * 3)])
def test_views_without_symmetric_drops_duplicates_of_a_grid(info: dict[str, object], expected: int) -> None:
    views = sample_views(azimuth_step=5, elevations=[-30, 0, 30])
    assert len(views_without_symmetric(views, symmetry_transforms(info))) == expected


def test_views_without_symmetric_keeps_one_view_of_each_appearance() -> None:
    views = uniform_views(150, thetas=range(0, 360, 30), distances=[3, 5])
    symmetries = symmetry_transforms(HALF_TURN)
    kept = views_without_symmetric(views, symmetries, tolerance=12.0)
    assert 0.2 * len(views) < len(kept) < 0.6 * len(views)
    for distance in (3, 5):
        R = kept[kept.distance == distance].rotations.double()
        seen = (R[:, None] @ symmetries[:, :3, :3]).flatten(0, 1)
        all_views = views[views.distance == distance].rotations.double()
        nearest = (all_views.flatten(1) @ seen.flatten(1).T).argmax(dim=1)
        assert float(rotation_error(all_views, seen[nearest]).max()) <= 12.01
    # No two remaining views are duplicates.
    R = kept[kept.distance == 3].rotations.double()
    off = rotation_error(R[None], R[:, None] @ symmetries[1:, :3, :3]).fill_diagonal_(180.0)
    assert float(off.min()) > 12.0


def test_view_functions_refuse_invalid_options() -> None:
    one = torch.zeros(1)
    for call, match in (
        (lambda: ViewSphere(one, one, one, one + 1), "distances > 1"),
        (lambda: ViewSphere(one, one, torch.zeros(2), one + 2), "one shape"),
        (lambda: sample_views(azimuth_step=0), "azimuth_step"),
        (lambda: sample_views(elevations=[]), "elevations"),
        (lambda: sample_views(elevations=[91]), "elevations"),
        (lambda: uniform_views(0), "count"),
        (lambda: uniform_views(5, elevation_range=(10, -10)), "elevation_range"),
        (lambda: uniform_views(5, elevation_range=(-200, 90)), r"elevation_range: expected degrees in \[-90, 90\]"),
        (lambda: uniform_views(5, elevation_range=(-90, 90.1)), "elevation_range: expected degrees"),
        (lambda: uniform_views(5, elevation_range=(float("nan"), 90)), "elevation_range: expected degrees"),
        (lambda: sample_views(elevations=[float("nan")]), "elevations: expected degrees"),
        (lambda: uniform_views(5, thetas=[]), "thetas"),
        (lambda: views_without_symmetric(uniform_views(5), torch.eye(4)), "symmetries"),
        (lambda: views_without_symmetric(uniform_views(5), torch.eye(4)[None], tolerance=-1.0), "tolerance"),
        (lambda: sample_views(elevations=[-91]), "elevations"),
        (lambda: uniform_views(5).in_model_frame(torch.eye(3)), "T_views_from_model"),
        (lambda: uniform_views(5).in_model_frame(torch.diag(torch.tensor([1.0, 2, 1, 1]))), "rotation"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()
