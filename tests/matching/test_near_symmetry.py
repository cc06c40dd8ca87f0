import pytest
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import sample_views, uniform_views
from curvireg_torch.matching import BankSettings, ViewBank, near_symmetries
from curvireg_torch.synthetic import example_mesh

SETTINGS = BankSettings(image_size=64)
UPRIGHT = sample_views(azimuth_step=15, elevations=[0, 25, 50])


def turns(mesh: trimesh.Trimesh, views: object = UPRIGHT) -> set[tuple[tuple[int, ...], float]]:
    bank = ViewBank.build(mesh, views, settings=SETTINGS, progress=False)  # type: ignore[arg-type]
    return {(tuple(abs(round(v)) for v in s.axis), s.angle) for s in near_symmetries(bank)}


def test_turns_of_a_post_a_slab_and_a_truck() -> None:
    z = (0, 0, 1)
    post = trimesh.creation.box((1.0, 1.0, 3.0))
    assert {(z, 180.0), (z, 90.0)} <= turns(post)
    assert not {(z, 120.0), (z, 60.0), (z, 45.0)} & turns(post)
    slab = turns(trimesh.creation.box((1.0, 2.5, 0.6)))
    assert (z, 180.0) in slab
    assert (z, 90.0) not in slab
    assert turns(example_mesh()) == set()


def test_all_turns_of_a_can() -> None:
    can = trimesh.creation.cylinder(1.0, 2.0, sections=64)
    assert {((0, 0, 1), a) for a in (180.0, 120.0, 90.0, 72.0, 60.0, 45.0)} <= turns(can)


def test_bank_of_all_directions_sees_other_axes() -> None:
    found = turns(trimesh.creation.box((1.0, 2.0, 3.0)), uniform_views(100, thetas=range(0, 360, 20)))
    assert {(axis, 180.0) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))} <= found
    assert all(angle == 180.0 for _, angle in found)


def test_too_few_views() -> None:
    bank = ViewBank.build(example_mesh(), uniform_views(5), settings=SETTINGS, progress=False)
    with pytest.raises(InvalidInputError, match="8 views"):
        near_symmetries(bank)
