import math

import pytest
import torch

from curvireg_torch.geometry import rotation_error, rotation_from_viewpoint
from curvireg_torch.geometry.pose_prior import PosePrior, object_frame
from tests._support import eye, refused, uniform
from tests._support.tables import text_table


def rotations(azimuth, elevation=0.0, theta=0.0):
    return rotation_from_viewpoint(
        *(torch.as_tensor(v, dtype=torch.float64) for v in (azimuth, elevation, theta))
    )


def random_rotations(count):
    a, e, t = uniform(3, count)
    return rotations(360.0 * a, 160.0 * e - 80.0, 360.0 * t - 180.0)


WRAPPED = """
[300, 60] | 0   | 0
[300, 60] | 290 | 10
[300, 60] | 180 | 120
[60, 300] | 0   | 60
[0, 360]  | 123 | 0
"""


@pytest.mark.parametrize(("limits", "azimuth", "missed"), text_table(WRAPPED))
def test_azimuth_limits_wrap_around_zero(limits, azimuth, missed):
    excess = PosePrior(azimuth=limits).excess(rotations(float(azimuth)))
    assert float(excess.clamp(min=0.0)) == pytest.approx(min(missed, 90), abs=1e-5)


@pytest.mark.parametrize("elevation", [-85.0, -30.0, 0.0, 50.0, 89.0])
@pytest.mark.parametrize("azimuth", [70.0, 140.0, 220.0])
def test_azimuth_excess_and_nearest_are_the_least_rotation_into_the_range(elevation, azimuth):
    R = rotations(azimuth, elevation, 25.0)
    prior = PosePrior(azimuth=(300, 60))
    grid = rotations(
        *torch.meshgrid(
            torch.arange(-60.0, 60.5, 1.0), torch.arange(-90.0, 90.5, 0.5), indexing="ij"
        )
    )
    # angle of the directions
    least = torch.rad2deg((R[2] * grid[..., 2, :]).sum(-1).clamp(-1.0, 1.0).acos()).min()
    assert float(prior.excess(R)) == pytest.approx(float(least), abs=0.3)
    moved = prior.nearest(R)
    assert prior.excess(moved) <= 1e-4
    assert rotation_error(moved, R) == pytest.approx(float(prior.excess(R)), abs=1e-4)


def test_elevation_and_theta_are_limited_each_by_itself():
    prior = PosePrior(elevation=(0, 45), theta=(-10, 10))
    R = rotations([10.0, 10.0, 10.0, 10.0], [20.0, 50.0, -30.0, 20.0], [0.0, 0.0, 0.0, 25.0])
    least = math.degrees(math.asin(math.cos(math.radians(20.0)) * math.sin(math.radians(15.0))))
    inside = math.degrees(math.asin(math.cos(math.radians(20.0)) * math.sin(math.radians(10.0))))
    assert prior.excess(R).tolist() == pytest.approx([-inside, 5.0, 30.0, least], abs=1e-6)
    assert PosePrior(elevation=(-90, 90)).excess(R).tolist() == [-180.0] * 4


PRIORS = [PosePrior(azimuth=(300, 60)), PosePrior(elevation=(10, 30), theta=(-5, 5))]
PRIORS += [
    PosePrior(azimuth=(100, 140), theta=(-15, 15)),
    PosePrior(rotation=rotations(200.0, 40.0, -20.0), within=25),
]


@pytest.mark.parametrize(
    "prior", PRIORS, ids=["azimuth", "elevation, theta", "azimuth, theta", "rotation"]
)
def test_nearest_moves_rotations_to_the_border_and_keeps_those_inside(prior):
    R = random_rotations(4000)
    before = prior.excess(R)
    moved = prior.nearest(R)
    assert prior.excess(moved).max() < 1e-5
    inside = before <= 0.0
    assert inside.any()
    assert not inside.all()
    assert torch.equal(moved[inside], R[inside])
    if prior.rotation is not None:
        assert torch.allclose(rotation_error(moved, R), before.clamp(min=0.0), atol=1e-5)


def test_nearest_satisfies_limits_together():
    """One pass leaves limits that were satisfied before by up to the tolerance of a later one."""
    centre = rotations(70.0, 35.0, 12.0)
    prior = PosePrior(
        azimuth=(30, 60), elevation=(0, 25), theta=(-8, 8), rotation=centre, within=25.0
    )
    R = random_rotations(500)
    assert prior.excess(prior._moved_once(R, None)).max() > 1.0
    assert prior.excess(prior.nearest(R)).max() < 0.1


@pytest.mark.parametrize(
    "prior", [PosePrior(azimuth=(300, 60)), PosePrior(viewpoint=(20, 10, 0), within=30)], ids=str
)
def test_angles_are_counted_about_the_objects_own_axes(prior):
    frame = object_frame("y", "x")
    R = rotations(torch.arange(0.0, 360.0, 20.0), 15.0)
    in_file = R @ frame
    assert torch.allclose(prior.excess(in_file, frame), prior.excess(R), atol=1e-5)
    assert torch.allclose(prior.nearest(in_file, frame), prior.nearest(R) @ frame, atol=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_object_frame_puts_up_on_z_and_the_front_towards_azimuth_zero(up):
    for front in ("x", "y", "z", "-x", "-y", "-z"):
        if front[-1] == up[-1]:
            with refused("front: expected another axis"):
                object_frame(up, front)
            continue
        axes = {
            s + a: (1.0 - 2.0 * bool(s)) * eye(3)[i] for i, a in enumerate("xyz") for s in ("", "-")
        }
        R = object_frame(up, front)
        assert torch.allclose(R @ axes[up], axes["z"], atol=1e-12)
        assert torch.allclose(R @ axes[front], axes["-y"], atol=1e-12)
        assert torch.det(R) == pytest.approx(1.0)


OPTIONS = """
{}                                 | at least one limit
{"azimuth": [1, 2, 3]}             | azimuth: expected 2 finite
{"elevation": [50, 40]}            | elevation: expected -90 <= low
{"azimuth": [0, 9], "within": 5}   | within: expected degrees beside
{"azimuth": [0, 9], "front": "w"}  | front
"""
OF_ROTATIONS = [
    ({"rotation": torch.eye(3), "within": 0.0}, r"within: expected degrees in \(0, 180\]"),
    ({"rotation": 2 * torch.eye(3), "within": 5.0}, "rotation"),
]


@pytest.mark.parametrize(("options", "words"), [*text_table(OPTIONS), *OF_ROTATIONS])
def test_pose_prior_refuses_what_it_cannot_mean(options, words):
    with refused(words):
        PosePrior(**options)
